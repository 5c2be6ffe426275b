"""`fisheyerec rectify`."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .estimating import REFINE_HELP, SAVE_CAMERA_HELP, WEIGHTS_HELP, check_save_camera, describe, load_rectifier
from .messages import fail, for_each

if TYPE_CHECKING:
    from ..cameras import FisheyeCamera, PinholeCamera
    from ..rectifier import Rectifier


def rectify(
    images: Annotated[list[Path], typer.Argument(help="Fisheye pictures.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Picture to write; for several images, a folder.")],
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Lens file of the camera that took them (JSON, YAML, OpenCV, kalibr...); estimated if left out."
        ),
    ] = None,
    fov_deg: Annotated[float | None, typer.Option(help="Field of view across the result's width, below 180.")] = None,
    focal: Annotated[float | None, typer.Option(help="Focal length of the result in pixels.")] = None,
    balance: Annotated[
        float | None, typer.Option(help="0: only valid pixels; 1: keep the whole picture; or between.")
    ] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the result; the picture's own if left out.")] = None,
    interpolation: Annotated[str, typer.Option(help="bilinear, or nearest for label maps.")] = "bilinear",
    refine: Annotated[bool, typer.Option(help=REFINE_HELP)] = True,
    save_camera: Annotated[Path | None, typer.Option(help=SAVE_CAMERA_HELP)] = None,
    weights: Annotated[Path | None, typer.Option(help=WEIGHTS_HELP)] = None,
) -> None:
    """Make fisheye pictures straight: with the lens file of a calibrated camera, or each by what it shows itself.

    Without --camera, a picture without fisheye distortion is written as it is.
    Without --fov-deg, --focal or --balance the view is edge-matched: the nearest edge of the fisheye picture stays at
    the edge of the result, so nothing in it is empty.
    """
    try:
        if sum(option is not None for option in (fov_deg, focal, balance)) > 1:
            raise ValueError("expected one of --fov-deg, --focal and --balance, got several")
        options = {"fov_deg": fov_deg, "focal": focal, "balance": balance}
        view_size = _parse_size(size)
        check_save_camera(images, save_camera)
        if camera is None:
            rectifier = load_rectifier(weights)

            def straighten(image: Path, to: Path) -> None:
                _rectify_photo(
                    image,
                    to,
                    save_camera,
                    rectifier,
                    size=view_size,
                    interpolation=interpolation,
                    refine=refine,
                    **options,
                )
        else:
            if save_camera is not None or weights is not None:
                raise ValueError("expected --camera, or --save-camera and --weights to estimate one, got both")
            fisheye = _load_fisheye(camera)
            view = _view(fisheye, view_size or fisheye.image_size, **options)

            def straighten(image: Path, to: Path) -> None:
                _rectify_file(image, fisheye, view, to, interpolation)

        to_folder = len(images) > 1 or output.is_dir()
        if to_folder:
            output.mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError) as error:
        raise fail("rectify", error) from error

    for_each("rectify", images, lambda image: straighten(image, output / image.name if to_folder else output))


def _rectify_file(image: Path, fisheye: FisheyeCamera, view: PinholeCamera, output: Path, interpolation: str) -> None:
    from .. import numpy
    from ..pictures import Picture, read_picture, write_picture

    if output.exists() and output.samefile(image):
        raise ValueError(f"expected an output other than the picture itself, got {output}")
    picture = read_picture(image)
    height, width = picture.pixels.shape[:2]
    expected_height, expected_width = fisheye.image_size
    if (height, width) != fisheye.image_size:
        if abs(width * expected_height - height * expected_width) > max(width, height):
            raise ValueError(
                f"expected {image} in the shape of its lens file, {expected_width}x{expected_height}, "
                f"got {width}x{height}"
            )
        fisheye = fisheye.resize((height, width))
    start = time.perf_counter()
    result = numpy.rectify(picture.pixels, fisheye, view, interpolation=interpolation)
    milliseconds = (time.perf_counter() - start) * 1e3
    write_picture(output, Picture(result.image, picture.metadata))
    height, width = view.image_size
    typer.echo(
        f"{output}: {width}x{height}, focal {view.params[0]:.1f} px, {result.valid.mean():.1%} valid, "
        f"{milliseconds:.1f} ms"
    )


def _rectify_photo(image: Path, output: Path, save_camera: Path | None, rectifier: Rectifier, **options: Any) -> None:
    from ..pictures import Picture, read_picture, write_picture

    if output.exists() and output.samefile(image):
        raise ValueError(f"expected an output other than the picture itself, got {output}")
    picture = read_picture(image)
    result = rectifier(picture.pixels, **options)
    if save_camera is not None:
        result.camera.save(save_camera)
    write_picture(output, Picture(result.image, picture.metadata))
    height, width = result.valid.shape
    shown = f"{width}x{height}, {result.valid.mean():.1%} valid, " if result.distorted else "as it was, "
    typer.echo(f"{output}: {shown}{describe(result)}")


def _load_fisheye(path: Path) -> FisheyeCamera:
    from ..cameras import FisheyeCamera

    return FisheyeCamera.load(path)


def _view(fisheye: FisheyeCamera, size: tuple[int, int], **options: float | None) -> PinholeCamera:
    from .. import views

    return views.choose(fisheye, size, **options)


def _parse_size(size: str | None) -> tuple[int, int] | None:
    if size is None:
        return None
    match = re.fullmatch(r"([1-9]\d{0,5})x([1-9]\d{0,5})", size)
    if match is None:
        raise ValueError(f"expected --size as WIDTHxHEIGHT such as 1280x720, got {size!r}")
    return int(match[2]), int(match[1])
