"""One call for one uncalibrated photo: look at a small copy, carry the camera back, rectify the photo itself.

    photo (any size) -> working copy (longer side at most 512 px, 8 bit RGB) -> frame that the network looks at
    camera of the photo <- resize <- camera of the working copy, refined on its lines <- resize <- its camera

Each arrow to the left undoes one to the right exactly, by `Camera.resize`. A lens chart is relative to half the longer
side, so the network's estimate and its covariance are those of the photo.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from . import numpy as door
from .cameras import Camera, FisheyeCamera, PinholeCamera
from .image_circle import ImageCircle, find_image_circle, without_rim
from .lens_chart import ASPECT, PRINCIPAL_POINT, SIZE, camera_from_chart, chart_of, perspective_chart, stretch
from .network import FishEyeRecNet
from .pictures import decode, read_picture
from .refinement import DISTORTED_EVIDENCE, DISTORTED_STRETCH, Prior, Refinement, circle_prior, refine_on, wide_prior
from .straightness import WORKING_SIDE, find_pieces, straightness_of
from .views import view_for
from .weights import load_network

SMALLEST_SIDE = 16
"""Photos below this many pixels on either side say nothing about a lens."""

# What the network's deviations of the chart are multiplied by. It was trained on principal points that lie a third
# farther off than the standard protocol's, and its errors are half as large as it expects (decision 0012).
_TRUST = np.array([0.7, 0.7, 0.7, 0.7, 1.0, 0.75, 0.75, 0.7])
_JUDGED_SIDE = 256  # px, of the pictures whose error the confidence is about
# The field of view, across the longer side, of the lens that an undistorted photo is said to have: any would do.
_STRAIGHT_FOV = math.radians(50)


@dataclass(frozen=True)
class PhotoEstimate:
    """What one photo tells about its lens."""

    camera: FisheyeCamera
    """For the photo's own pixels, upright; float64 (8,). One without distortion where `distorted` is False."""
    confidence: float
    """exp(-d / 2) in (0, 1], d being the expected error in pixels of a picture of 256x256: the RMS distance, over the
    covariance of the lens, between where rectified pixels are looked for, apart from a shift and a scale of the whole
    picture, which bend nothing. The covariance is the network's, narrowed by the lines that the refinement found."""
    distorted: bool
    """Whether the photo has a fisheye distortion worth undoing: `camera` has one and lines do not contradict it."""
    straightness_before: float
    """RMS bend of the photo's lines in % of their length (`straightness.straightness`); NaN without lines."""
    straightness_after: float
    """The same under `camera`."""
    refined: bool
    """Whether the camera was refined on lines; else it is the network's."""
    covariance: np.ndarray
    """(8, 8): of the lens chart, which the confidence sums up."""
    image_circle: ImageCircle | None
    """Where the photo ends, in its own pixels, if it does not fill its frame."""

    @property
    def judged_camera(self) -> FisheyeCamera:
        """The camera of that part of the photo to whose chart `covariance` belongs: the square within the circle."""
        return self.camera if self.image_circle is None else self.image_circle.inscribed.of(self.camera)


@dataclass(frozen=True, repr=False)
class PhotoRectification(PhotoEstimate):
    """A straight photo and what it was made with."""

    image: Any
    """Like the photo: a tensor ([1,] C, h, w), or an array (h, w) or (h, w, C), of its dtype."""
    valid: Any
    """Where the view meets the photo: bool ([1,] 1, h, w) or (h, w)."""
    view: Camera
    """The view that the photo was rectified into."""

    def __repr__(self) -> str:
        return (
            f"PhotoRectification(image={tuple(self.image.shape)} {self.image.dtype}, "
            f"confidence={self.confidence:.2f}, distorted={self.distorted}, refined={self.refined}, "
            f"straightness {self.straightness_before:.2f} -> {self.straightness_after:.2f} %, "
            f"camera={self.camera!r}, view={self.view!r})"
        )


class Rectifier:
    """Makes photos of unknown fisheye lenses straight: `Rectifier.from_pretrained()(photo)`.

    Args:
        network: ready for inference (`eval()`), on the CPU.
        average: whether to average what the network says of the photo's flips and quarter turns, eight times the work.
    """

    def __init__(self, network: FishEyeRecNet, *, average: bool = False) -> None:
        self.network, self.average = network, average

    @classmethod
    def from_pretrained(cls, path: str | os.PathLike[str] | None = None, *, average: bool = False) -> Self:
        """Load a trained network.

        Args:
            path: a weights file as `fisheyerec train` writes it; None for the one in this package.
            average: as for `Rectifier`.

        Raises:
            ValueError: another file, or weights that do not fit the network they name.
            OSError: the file is missing or cannot be read.
        """
        with as_file(files(__package__) / "pretrained.safetensors") as shipped:
            weights = shipped if path is None else Path(path)
            if not weights.exists():
                raise FileNotFoundError(
                    f"Rectifier.from_pretrained(): expected a weights file, got {str(weights)!r} that does not exist"
                    + ("; this installation came without, give the path of one" if path is None else "")
                )
            return cls(load_network(weights), average=average)

    def __call__(
        self,
        photo: Any,
        *,
        view: Camera | str | None = None,
        fov_deg: float | None = None,
        focal: float | None = None,
        balance: float | None = None,
        projection: str = "pinhole",
        size: tuple[int, int] | None = None,
        rotation: Any = None,
        interpolation: str = "bilinear",
        antialias: bool = False,
        refine: bool = True,
    ) -> PhotoRectification:
        """Make a photo straight; one without fisheye distortion comes back as it is, whatever view was asked for.

        Args:
            photo: a path; a PIL image; an array (H, W), (H, W, 3) or (H, W, 4), uint8, uint16 or floating; or a tensor
                (C, H, W) or (1, C, H, W) with 1, 3 or 4 channels. RGB, from black 0 to white, which for floats is 1
                or the next 2^n - 1 above what there is; at least 16x16.
            view: the view to make, or a mode of `view_for`; or one of the following at most.
            fov_deg: field of view across the result's width, in (0, 180); other projections may be wider.
            focal: focal length of the result in pixels.
            balance: from 0, only valid pixels, to 1, the whole photo.
            projection: of the view, as for `view_for`.
            size: (height, width) of the result; None for the photo's.
            rotation: (3, 3) camera_from_view, which turns the view, as `view_rotation` gives it; None for none.
            interpolation: "bilinear" or "nearest".
            antialias: whether to average where the photo shrinks, as in `fisheyerec.numpy.rectify`.
            refine: whether to refine the network's camera on the photo's lines.

        Without view, fov_deg, focal and balance the view is edge-matched (`PinholeCamera.edge_matched`).

        Raises:
            TypeError: photo is nothing of these.
            ValueError: another shape, dtype or range, NaN or infinite pixels, a file that is no picture, or options
                that contradict each other.
            OSError: the file cannot be read.
        """
        opened = _open(photo)
        options = {"fov_deg": fov_deg, "focal": focal, "balance": balance}
        mode = view if isinstance(view, str) else None
        if isinstance(view, Camera) and (size is not None or any(option is not None for option in options.values())):
            raise ValueError("Rectifier(): expected view alone or fov_deg, focal, balance and size, got both")
        estimate = self._estimate(opened.pixels, refine)
        if not isinstance(view, Camera):
            circle = estimate.image_circle
            seen = estimate.camera if circle is None else circle.to_view(mode, balance).of(estimate.camera)
            view = view_for(seen, size or opened.pixels.shape[:2], mode, projection=projection, **options)
        if not estimate.distorted:
            image, valid = opened.pixels, np.ones(opened.pixels.shape[:2], dtype=bool)
            view = PinholeCamera.edge_matched(estimate.camera, opened.pixels.shape[:2])
        else:
            image, valid = door.rectify(
                opened.pixels,
                estimate.camera,
                view,
                rotation=rotation,
                interpolation=interpolation,
                antialias=antialias,
            )
            if estimate.image_circle is not None:
                valid &= estimate.image_circle.seen(estimate.camera, view, rotation)
        return PhotoRectification(
            **vars(estimate), image=opened.restore(image), valid=opened.restore_mask(valid), view=view
        )

    def estimate(self, photo: Any, *, refine: bool = True) -> PhotoEstimate:
        """Estimate the camera of a photo without rectifying it; arguments and errors as in calling the rectifier."""
        return self._estimate(_open(photo).pixels, refine)

    def _estimate(self, pixels: np.ndarray, refine: bool) -> PhotoEstimate:
        working = _working_copy(pixels)
        pieces, size = find_pieces(working)
        circle = find_image_circle(working)
        if circle is None:
            camera, covariance = self._look(working)
        else:
            pieces = circle.inscribed.pieces(without_rim(pieces, circle))
            size = (circle.inscribed.side, circle.inscribed.side)
            mean, covariance = circle_prior()
            camera = _camera_of(mean, size)
        before = straightness_of(pieces, None, size)
        refinement = None
        if refine:
            mean = chart_of(camera)
            prior = Prior(mean, covariance) if np.isfinite(mean).all() else wide_prior()
            refinement = refine_on(pieces, size, camera, prior)
            camera, covariance = refinement.camera, refinement.covariance
        distorted = _is_distorted(camera, refinement)
        if not distorted:
            camera = _camera_of(perspective_chart(_STRAIGHT_FOV / 2), size)
            after = before
        else:
            after = straightness_of(pieces, camera, size) if refinement is None else refinement.straightness_after
        confidence = math.exp(-_expected_error_px(chart_of(camera), covariance) / 2)
        if circle is not None:
            camera = circle.inscribed.whole(camera, working.shape[:2])
            circle = circle.resize(max(pixels.shape[:2]) / max(working.shape[:2]))
        refined = refinement is not None and refinement.accepted and distorted
        camera = camera.numpy().resize(pixels.shape[:2])
        return PhotoEstimate(camera, confidence, distorted, before, after, refined, covariance, circle)

    def _look(self, working: np.ndarray) -> tuple[FisheyeCamera, np.ndarray]:
        """Ask the network: the camera of the working copy, and the covariance (8, 8) of its chart."""
        frame = network_frame(working, self.network.longer_side)
        tensor = torch.from_numpy(frame).permute(2, 0, 1)[None] / 255
        chart, covariance = _ask(self.network, tensor, self.average)
        if not (chart.isfinite().all() and covariance.isfinite().all()):
            raise ValueError("Rectifier(): expected a finite lens from the network, got none: broken weights?")
        size = frame.shape[:2]
        return _camera_of(chart.numpy(), size).resize(working.shape[:2]), covariance.numpy() * np.outer(_TRUST, _TRUST)


class _Photo(NamedTuple):
    """A photo of any kind as an array, and the way back to its kind."""

    pixels: np.ndarray
    restore: Callable[[np.ndarray], Any]
    restore_mask: Callable[[np.ndarray], Any]


def _open(photo: Any) -> _Photo:
    if isinstance(photo, Tensor):
        return _open_tensor(photo)
    if isinstance(photo, str | os.PathLike):
        pixels = read_picture(photo).pixels
    elif isinstance(photo, Image.Image):
        pixels = decode(photo).pixels
    elif isinstance(photo, np.ndarray):
        pixels = photo
    else:
        raise TypeError(
            f"Rectifier(): expected photo as a path, PIL image, array or tensor, got {type(photo).__name__}"
        )
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,), (4,)):
        raise ValueError(f"Rectifier(): expected photo of shape (H, W), (H, W, 3) or (H, W, 4), got {pixels.shape}")
    return _Photo(_checked(pixels), np.asarray, np.asarray)


def _open_tensor(photo: Tensor) -> _Photo:
    shape = tuple(photo.shape)
    if photo.ndim not in (3, 4) or shape[-3] not in (1, 3, 4) or shape[:-3] not in ((), (1,)):
        raise ValueError(
            f"Rectifier(): expected photo of shape (C, H, W) or (1, C, H, W) with 1, 3 or 4 channels, got {shape}"
        )
    channels = photo.detach().reshape(shape[-3:]).cpu()
    if channels.dtype in (torch.bfloat16, torch.float16):
        channels = channels.float()
    pixels = channels[0] if shape[-3] == 1 else channels.permute(1, 2, 0)

    def restore_mask(array: np.ndarray) -> Tensor:
        tensor = torch.from_numpy(array)
        tensor = tensor[None] if array.ndim == 2 else tensor.permute(2, 0, 1)
        return tensor.reshape(*shape[:-3], *tensor.shape).to(photo.device)

    return _Photo(_checked(pixels.numpy()), lambda array: restore_mask(array).to(photo.dtype), restore_mask)


def _checked(pixels: np.ndarray) -> np.ndarray:
    if pixels.dtype not in (np.uint8, np.uint16, np.float16, np.float32, np.float64):
        raise ValueError(f"Rectifier(): expected photo of uint8, uint16 or a floating dtype, got {pixels.dtype}")
    if min(pixels.shape[:2]) < SMALLEST_SIDE:
        height, width = pixels.shape[:2]
        raise ValueError(
            f"Rectifier(): expected photo of at least {SMALLEST_SIDE}x{SMALLEST_SIDE} pixels, got {width}x{height}"
        )
    if pixels.dtype.kind == "f" and not (np.isfinite(pixels.min()) and np.isfinite(pixels.max())):
        raise ValueError("Rectifier(): expected photo of finite pixels, got NaN or infinite ones")
    return pixels


def _working_copy(pixels: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8, of the photo's shape within half a pixel."""
    height, width = pixels.shape[:2]
    white = 255.0 if pixels.dtype == np.uint8 else _white(float(pixels.max()))
    if pixels.ndim == 3:
        pixels = pixels[..., :3]
    if pixels.dtype == np.float16:
        pixels = pixels.astype(np.float32)
    shrink = WORKING_SIDE / max(height, width)
    pixels = np.ascontiguousarray(pixels)
    if shrink < 1:
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    if pixels.dtype != np.uint8:
        pixels = np.rint((pixels * (255 / white)).clip(0, 255)).astype(np.uint8)
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, -1)


def _white(largest: float) -> float:
    """The white level of pixels whose largest value this is: 1, or 2^n - 1 for n bits, at least 8."""
    if largest <= 1:
        return 1.0
    return float(2 ** max(8, math.ceil(math.log2(largest + 1))) - 1)


def network_frame(working: np.ndarray, longer_side: int) -> np.ndarray:
    """Resize a working copy to what the network looks at: (h, w, 3), the shorter side even, so that it has a middle."""
    height, width = (max(2, 2 * round(side * longer_side / max(working.shape[:2]) / 2)) for side in working.shape[:2])
    shrinks = longer_side < max(working.shape[:2])
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(working, (width, height), interpolation=interpolation))


def _ask(network: FishEyeRecNet, frame: Tensor, average: bool) -> tuple[Tensor, Tensor]:
    """Ask the network about a frame (1, 3, h, w): mean (8,) and covariance (8, 8) of the chart.

    Of several answers, those about flips and quarter turns put upright, the moments of their mixture: where they
    disagree the covariance is wider.
    """
    charts, covariances = [], []
    for turned in (False, True) if average else (False,):
        upright = frame.mT if turned else frame
        signs = [(x, y) for x in (1, -1) for y in (1, -1)] if average else [(1, 1)]
        flips = [upright.flip([dim for dim, sign in ((-1, x), (-2, y)) if sign < 0]) for x, y in signs]
        with torch.inference_mode():
            estimate = network(torch.cat(flips), straighten=False).estimate
        undo = torch.stack([_undo(x, y, turned) for x, y in signs])  # (B, 8, 8)
        charts.append((undo @ estimate.chart[..., None])[..., 0])
        covariances.append(undo @ estimate.covariance @ undo.mT)
    chart, covariance = torch.cat(charts), torch.cat(covariances)
    mean = chart.mean(0)
    scatter = chart - mean
    return mean, covariance.mean(0) + scatter.mT @ scatter / len(chart)


def _undo(x: int, y: int, turned: bool) -> Tensor:
    """The matrix from the chart of a frame that was transposed, then mirrored, to the chart of the frame."""
    matrix = torch.eye(SIZE, dtype=torch.float64)
    across, down = range(SIZE)[PRINCIPAL_POINT]
    matrix[across, across], matrix[down, down] = x, y
    if turned:
        matrix[[across, down]] = matrix[[down, across]]
        matrix[ASPECT, ASPECT] = -1
    return matrix


def _is_distorted(camera: FisheyeCamera, refinement: Refinement | None) -> bool:
    """Whether the camera bends lines by an amount worth mentioning, and the photo's lines do not speak against it.

    Lines through the centre are straight under any lens: a photo that has no others is judged by the network.
    """
    bends = stretch(chart_of(camera)) > DISTORTED_STRETCH
    return bends and (refinement is None or refinement.evidence > -DISTORTED_EVIDENCE)


def _camera_of(chart: np.ndarray, image_size: tuple[int, int]) -> FisheyeCamera:
    return FisheyeCamera(camera_from_chart(torch.from_numpy(chart), image_size).numpy(), image_size)


def _expected_error_px(chart: np.ndarray, covariance: np.ndarray) -> float:
    """RMS distance between where lenses of this distribution look for the same pixel of the edge-matched view.

    Taken over the 16 sigma points of the distribution, on a grid over a picture of 256x256, after the shift and the
    scale that bring each closest to the mean: a principal point that is off by some pixels does little else.
    """
    size = (_JUDGED_SIDE, _JUDGED_SIDE)
    values, axes = np.linalg.eigh(covariance)
    spread = math.sqrt(SIZE) * (axes * np.sqrt(values.clip(0))).T
    charts = np.concatenate([chart[None], chart + spread, chart - spread])
    cameras = FisheyeCamera(camera_from_chart(torch.from_numpy(charts), size), size)
    view = PinholeCamera.edge_matched(cameras, size)
    across = torch.linspace(0, _JUDGED_SIDE - 1, 9, dtype=torch.float64)
    grid = torch.cartesian_prod(across, across).expand(len(charts), -1, -1)
    points, _ = cameras.project(view.unproject(grid)[0])
    centred = points - points.nanmean(1, keepdim=True)
    mean, off = centred[0], centred[1:] - centred[0]
    scale = (off * mean).nansum((1, 2)) / mean.square().nansum()
    return float((off - scale[:, None, None] * mean).square().sum(-1).nanmean().sqrt())
