"""From a picture or video file to a straight one: with a calibrated camera, or by what the file shows itself."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from . import numpy as door
from .cameras import Camera, FisheyeCamera
from .companions import moved
from .folders import Task
from .manifest import camera_entry
from .pictures import PICTURE_SUFFIXES, Picture, picture_format_of, read_picture, write_picture
from .views import view_for, view_rotation

if TYPE_CHECKING:
    from .image_circle import ImageCircle
    from .rectifier import PhotoEstimate, Rectifier

VIDEO_SUFFIXES = frozenset(
    [".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv", ".3gp", ".insv"]
)
"""Files taken for videos; all others are taken for pictures."""

_WRITTEN_VIDEO_SUFFIXES = {".mp4", ".mov", ".mkv", ".webm", ".avi", ".ts"}

SUFFIXES = PICTURE_SUFFIXES | VIDEO_SUFFIXES
"""What a folder is searched for."""

OnFrame = Callable[[int, int | None], None]


@dataclass(frozen=True)
class FileReport:
    """What became of a file."""

    camera: FisheyeCamera
    """The camera of the input, at its size."""
    view: Camera | None
    """The camera of the output; None where it came out as it went in."""
    summary: str
    """What to say of it, in one line."""
    complaint: str | None = None
    """What is wrong with the input, where some of it could be rectified nevertheless."""


class FileRectifier(Protocol):
    """Makes one file from another, and from its companions, each whole or not at all."""

    def __call__(self, task: Task, *, on_frame: OnFrame) -> FileReport:
        """Rectify a picture with its companions, or a video.

        Args:
            task: the file to read and the one to write, and the companions of a picture; older files are replaced.
            on_frame: called with the frames of a video that are done and, if known, how many there will be; what it
                raises ends the work.

        Raises:
            ValueError: a file is broken or does not fit, or its target has an unknown suffix.
            OSError: a file cannot be read or written.
        """

    def settings(self) -> dict[str, Any]:
        """Give what decides how outputs look, to be compared when a run is taken up again; plain JSON values."""


@dataclass(frozen=True)
class ViewOptions:
    """What view to make of a camera: the arguments of `views.view_for` and `views.view_rotation`."""

    mode: str | None = None
    fov_deg: float | None = None
    focal: float | None = None
    balance: float | None = None
    projection: str = "pinhole"
    size: tuple[int, int] | None = None
    """(height, width); None for the input's."""
    pan_deg: float = 0
    tilt_deg: float = 0
    roll_deg: float = 0

    def view_of(self, camera: FisheyeCamera, circle: ImageCircle | None = None) -> Camera:
        """Choose the view of a camera, of which the picture may end in a circle."""
        seen = camera if circle is None else circle.to_view(self.mode, self.balance).of(camera)
        return view_for(seen, self.size or camera.image_size, self.mode, projection=self.projection, **self.zoom())

    def of_video(self, size: tuple[int, int]) -> ViewOptions:
        """Give these options for a video of this size: what is left to the input gets even sides, as codecs want."""
        height, width = size
        return replace(self, size=self.size or (height - height % 2, width - width % 2))

    def zoom(self) -> dict[str, float | None]:
        """Give the options that say how much of the scene is seen."""
        return {"fov_deg": self.fov_deg, "focal": self.focal, "balance": self.balance}

    def rotation(self) -> np.ndarray | None:
        """Give the rotation of the view, camera_from_view; None where it is not turned."""
        angles = (self.pan_deg, self.tilt_deg, self.roll_deg)
        return view_rotation(*angles) if any(angles) else None


@dataclass(frozen=True)
class CalibratedRectifier:
    """Rectifies the files of one calibrated camera; those of another scale take the scaled camera and its view.

    Args:
        camera: the camera that took them.
        options: the view to make.
        interpolation: "bilinear" or "nearest" (pictures only).
        quality: from 1 to 100; None for the defaults of `write_picture` and `rectify_video`.
        threads: how many for one picture; None for OpenMP's default.
        antialias: whether to average where a picture shrinks (pictures only).
    """

    camera: FisheyeCamera
    options: ViewOptions
    interpolation: str = "bilinear"
    quality: int | None = None
    threads: int | None = None
    antialias: bool = False
    _views: dict[tuple[int, int], Camera] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __call__(self, task: Task, *, on_frame: OnFrame) -> FileReport:
        """Rectify a file; see `FileRectifier`."""
        source, target, companions = task
        if is_video(source):
            from . import video

            camera = camera_at(self.camera, video.frame_size(source), source)
            view = self.options.of_video(camera.image_size).view_of(camera)
            rotation = self.options.rotation()
            result = video.rectify_video(
                source, target, camera, view, rotation=rotation, quality=self.quality, on_frame=on_frame
            )
            return FileReport(camera, view, f"{_describe(view)}, {result.summary}", result.complaint)
        picture = read_picture(source)
        camera = camera_at(self.camera, picture.pixels.shape[:2], source)
        view, rotation = self._view_of(camera), self.options.rotation()
        writers = moved(companions, camera, view, rotation)
        image, valid = door.rectify(
            picture.pixels,
            camera,
            view,
            rotation=rotation,
            interpolation=self.interpolation,
            antialias=self.antialias,
            threads=self.threads,
        )
        write_picture(target, Picture(image, picture.metadata), quality=self.quality)
        for write in writers:
            write()
        return FileReport(camera, view, f"{_describe(view)}, {valid.mean():.1%} valid")

    def _view_of(self, camera: FisheyeCamera) -> Camera:
        if camera.image_size not in self._views:
            self._views[camera.image_size] = self.options.view_of(camera)
        return self._views[camera.image_size]

    def settings(self) -> dict[str, Any]:
        """Give what decides how outputs look; see `FileRectifier`."""
        return {
            "camera": camera_entry(self.camera),
            "options": asdict(self.options),
            "interpolation": self.interpolation,
            "antialias": self.antialias,
            "quality": self.quality,
        }


@dataclass(frozen=True)
class BlindRectifier:
    """Rectifies files of unknown cameras: each picture by its own estimate, each video by one of several frames.

    What has no fisheye distortion comes out as it went in. The network is loaded once a process.

    Args:
        options: the view to make.
        interpolation: "bilinear" or "nearest" (pictures only).
        quality: from 1 to 100; None for the defaults of `write_picture` and `rectify_video`.
        weights: a weights file; None for the package's own.
        refine: whether to refine estimates on lines.
        antialias: whether to average where a picture shrinks (pictures only).
    """

    options: ViewOptions
    interpolation: str = "bilinear"
    quality: int | None = None
    weights: Path | None = None
    refine: bool = True
    antialias: bool = False

    def __call__(self, task: Task, *, on_frame: OnFrame) -> FileReport:
        """Rectify a file; see `FileRectifier`."""
        source, target, companions = task
        if is_video(source):
            return self._rectify_video(source, target, on_frame)
        picture = read_picture(source)
        options = self.options
        result = self.rectifier()(
            picture.pixels,
            view=options.mode,
            projection=options.projection,
            size=options.size,
            rotation=options.rotation(),
            interpolation=self.interpolation,
            antialias=self.antialias,
            refine=self.refine,
            **options.zoom(),
        )
        view = result.view if result.distorted else None
        writers = moved(companions, result.camera, view, options.rotation())
        write_picture(target, Picture(result.image, picture.metadata), quality=self.quality)
        for write in writers:
            write()
        height, width = result.valid.shape
        shown = f"{width}x{height}, {result.valid.mean():.1%} valid" if result.distorted else "as it was"
        return FileReport(result.camera, view, f"{shown}, {describe(result)}")

    def _rectify_video(self, source: Path, target: Path, on_frame: OnFrame) -> FileReport:
        from . import video
        from .pooling import pool

        def estimate(frame: np.ndarray) -> PhotoEstimate:
            on_frame(0, None)
            return self.rectifier().estimate(frame, refine=self.refine)

        found = pool([estimate(frame) for frame in video.sample_frames(source)])
        camera = found.camera.resize(video.frame_size(source))  # of pixels as they are stored, square or not
        if not found.distorted:
            video.copy_video(source, target)
            return FileReport(camera, None, f"as it was, {describe(found)}")
        view = self.options.of_video(found.camera.image_size).view_of(found.camera, found.image_circle)
        rotation = self.options.rotation()
        result = video.rectify_video(
            source, target, camera, view, rotation=rotation, quality=self.quality, on_frame=on_frame
        )
        summary = f"{_describe(view)}, {result.summary}, {describe(found)}"
        return FileReport(camera, view, summary, result.complaint)

    def rectifier(self) -> Rectifier:
        """Load the network, the first time.

        Raises:
            ValueError: a broken weights file.
            OSError: it is missing or cannot be read.
        """
        return _load(self.weights)

    def settings(self) -> dict[str, Any]:
        """Give what decides how outputs look; see `FileRectifier`."""
        return {**asdict(self), "weights": None if self.weights is None else str(self.weights)}


def is_video(path: Path) -> bool:
    """Tell by the suffix whether a file is taken for a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def target_suffix(suffix: str, *, picture_suffix: str | None, video_suffix: str | None) -> str:
    """Give the suffix of what is made of a file: the given one of its kind, its own, or .png and .mp4 for odd ones."""
    if suffix.lower() in VIDEO_SUFFIXES:
        return video_suffix or (suffix if suffix.lower() in _WRITTEN_VIDEO_SUFFIXES else ".mp4")
    if picture_suffix is not None:
        return picture_suffix
    try:
        picture_format_of(Path(f"picture{suffix}"))
    except ValueError:
        return ".png"
    return suffix


def describe(estimate: PhotoEstimate) -> str:
    """Tell an estimate in half a line."""
    has_lines = not math.isnan(estimate.straightness_before)
    bend = f"lines bend by {estimate.straightness_before:.2f} %" if has_lines else "no lines to judge by"
    if not estimate.distorted:
        return f"no fisheye distortion found, {bend}"
    after = f" before and {estimate.straightness_after:.2f} % after" if has_lines else ""
    unrefined = "" if estimate.refined else ", not refined"
    return f"{describe_camera(estimate.camera)}, confidence {estimate.confidence:.2f}, {bend}{after}{unrefined}"


def describe_camera(camera: Camera) -> str:
    """Tell the parameters of a camera, each after its name."""
    return ", ".join(f"{name} {value:.6g}" for name, value in zip(camera.parameter_names, camera.params, strict=True))


def describe_fit(camera: Camera) -> str | None:
    """Tell how far a camera is from the lens of another model that it was fitted to; None where it was not."""
    if not isinstance(camera, FisheyeCamera) or camera.fitted_to is None:
        return None
    return f"fitted to {camera.fitted_to}: {camera.fit_rms_px:.2g} px RMS, {camera.fit_error_px:.2g} px at most"


def _describe(view: Camera) -> str:
    height, width = view.image_size
    return f"{width}x{height}, focal {view.params[0]:.1f} px"


@functools.cache
def _load(weights: Path | None) -> Rectifier:
    from .rectifier import Rectifier

    return Rectifier.from_pretrained(weights)


def camera_at(camera: FisheyeCamera, size: tuple[int, int], source: Path) -> FisheyeCamera:
    """Scale a camera to a picture of the same shape.

    Args:
        camera: the camera.
        size: (height, width) of the picture.
        source: the picture's file, for the error.

    Raises:
        ValueError: a picture of another shape.
    """
    height, width = size
    expected_height, expected_width = camera.image_size
    if abs(width * expected_height - height * expected_width) > max(width, height):
        raise ValueError(
            f"expected {source} in the shape of its lens file, {expected_width}x{expected_height}, got {width}x{height}"
        )
    return camera if size == camera.image_size else camera.resize(size)
