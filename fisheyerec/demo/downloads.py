"""The files that are taken away: the whole photo rectified, as the command line does it, and its camera."""

from __future__ import annotations

from pathlib import Path

from .. import numpy as door
from ..cameras import FisheyeCamera
from ..file_rectifiers import ViewOptions, target_suffix
from ..pictures import Picture, write_picture
from .photo import Photo


def write_rectified(
    photo: Photo, camera: FisheyeCamera, options: ViewOptions, folder: Path, *, suffix: str | None = None
) -> Path:
    """Rectify the whole photo, with all its file said about itself.

    Args:
        photo: the photo.
        camera: its camera.
        options: the view to make.
        folder: where to write.
        suffix: of the file, such as ".png"; None for the photo's own.

    Raises:
        ValueError: there is no such view of the camera, or the format cannot hold the pixels.
        OSError: the file cannot be written.
    """
    picture = photo.picture
    enlarged = max(picture.pixels.shape[:2]) / max(photo.preview.shape[:2])
    view = options.view_of(camera, None if photo.circle is None else photo.circle.resize(enlarged))
    image, _ = door.rectify(picture.pixels, camera, view, rotation=options.rotation())
    suffix = target_suffix(photo.path.suffix, picture_suffix=suffix, video_suffix=None)
    target = folder / f"{photo.path.stem}_rectified{suffix}"
    write_picture(target, Picture(image, picture.metadata))
    return target


def write_camera(photo: Photo, camera: FisheyeCamera, folder: Path) -> Path:
    """Write the camera as a lens file named after the photo.

    Raises:
        ValueError: the parameters make no camera.
        OSError: the file cannot be written.
    """
    target = folder / f"{photo.path.stem}_camera.json"
    camera.save(target)
    return target
