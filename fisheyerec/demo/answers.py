"""What happens when something on the page is moved: from the values of its controls to their new ones. Needs Gradio."""

from __future__ import annotations

import html
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import gradio as gr

from ..bulk import one_line
from ..cameras import FisheyeCamera
from ..file_rectifiers import BlindRectifier, ViewOptions
from .controls import (
    BALANCE,
    DEGREES,
    ideal_camera,
    moved,
    reaches,
    view_options,
)
from .downloads import write_camera, write_rectified
from .figures import figures, trouble
from .photo import Photo
from .preview import make_preview

ESTIMATED, LENS_FILE, IDEAL = "Estimate", "Lens file", "Ideal lens"
"""Where a lens comes from."""

LINES, MASK = "Lines, green where straight", "Hatch what the photo does not show"
"""What is drawn on the pictures."""

_EXAMPLE = "room.jpg"
_PARAMETERS = len(FisheyeCamera.parameter_names)


class Answers:
    """The answers of one server.

    Args:
        first: the picture that a page begins with; None for the example.
        blind: estimates lenses.
        folder: where files to be downloaded are put.
    """

    def __init__(self, first: Path | None, blind: BlindRectifier, folder: Path) -> None:
        self.first, self.blind, self.folder = first, blind, folder

    def begin(self) -> Photo:
        """Open the picture that the page begins with."""
        if self.first is not None:
            return self.open_photo(str(self.first))
        with as_file(files(__package__) / _EXAMPLE) as path:
            return Photo.open(path)

    def open_photo(self, path: str) -> Photo:
        """Open a picture that was dropped."""
        with _told(path):
            return Photo.open(Path(path))

    def source_of_new_photo(self, lens_file: str | None) -> list[Any]:
        """Keep a lens file for the next photo, and estimate the lens without; see `show_source`."""
        source = ESTIMATED if lens_file is None else LENS_FILE
        return [source, *self.show_source(source)]

    def show_source(self, source: str) -> list[Any]:
        """Show the controls of where the lens comes from: a button, a file, or projection and field of view."""
        return [gr.update(visible=source == shown) for shown in (ESTIMATED, LENS_FILE, IDEAL)]

    def find_lens(
        self, photo: Photo | None, source: str, lens_file: str | None, projection: str, fov_deg: float
    ) -> list[Any]:
        """Give the photo's camera, the sliders of its parameters, and what is to be said of it."""
        if photo is None or (source == LENS_FILE and lens_file is None):
            return [gr.skip(), *[gr.skip()] * _PARAMETERS, gr.skip()]
        note = ""
        if source == ESTIMATED:
            with _told(str(photo.path)):
                estimate = self.blind.rectifier().estimate(photo.picture.pixels)
            camera = estimate.camera
            note = f"Confidence {estimate.confidence:.2f}" if estimate.distorted else "No fisheye distortion found"
        elif lens_file is not None and source == LENS_FILE:
            with _told(lens_file):
                camera = photo.load_camera(Path(lens_file))
        else:
            camera = ideal_camera(projection, fov_deg, photo.size)
        sliders = [gr.update(**reach._asdict()) for reach in reaches(camera).values()]
        return [camera, *sliders, note]

    def show_view(self, projection: str, framing: str, wide_framing: str) -> list[Any]:
        """Show the controls that a projection and its framing have."""
        wide = projection != "pinhole"
        shown = [not wide, not wide and framing == DEGREES, not wide and framing == BALANCE]
        shown += [wide, wide and wide_framing == DEGREES]
        return [gr.update(visible=visible) for visible in shown]

    def show(self, photo: Photo | None, lens: FisheyeCamera | None, *values: Any) -> tuple[Any, Any]:
        """Give the pictures before and after, and what is to be said of them."""
        if photo is None or lens is None or lens.image_size != photo.size:
            return gr.skip(), gr.skip()  # there is none yet, or not of this photo
        *controls, marks = values
        camera, options = _camera_and_view(lens, controls)
        try:
            preview = make_preview(photo, camera, options, lines=LINES in marks, mask=MASK in marks)
        except ValueError as error:
            return gr.skip(), trouble(one_line(error))
        return (preview.before, preview.after), figures(preview, photo.size)

    def rectified_file(self, photo: Photo | None, lens: FisheyeCamera | None, *values: Any) -> str:
        """Write the whole photo rectified, in a format or ("") its own."""
        *controls, suffix = values
        with _told():
            if photo is None or lens is None:
                raise ValueError("expected a photo and its lens, got none yet")
            camera, options = _camera_and_view(lens, controls)
            return str(write_rectified(photo, camera, options, self._new_folder(), suffix=suffix or None))

    def camera_file(self, photo: Photo | None, lens: FisheyeCamera | None, *params: float) -> str:
        """Write the lens file."""
        with _told():
            if photo is None or lens is None:
                raise ValueError("expected a photo and its lens, got none yet")
            return str(write_camera(photo, moved(lens, params), self._new_folder()))

    def _new_folder(self) -> Path:
        return Path(tempfile.mkdtemp(dir=self.folder))


def _camera_and_view(lens: FisheyeCamera, controls: list[Any]) -> tuple[FisheyeCamera, ViewOptions]:
    return moved(lens, controls[:_PARAMETERS]), view_options(*controls[_PARAMETERS:])


@contextmanager
def _told(path: str = "") -> Iterator[None]:
    """Tell on the page what is wrong, in one line that names a file without its folder."""
    try:
        yield
    except (ValueError, OSError) as error:
        message = one_line(error).replace(path, Path(path).name) if path else one_line(error)
        raise gr.Error(html.escape(message), print_exception=False) from error
