"""`fisheyerec convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .messages import fail
from .sizes import parse_size


def convert(
    camera: Annotated[
        Path,
        typer.Argument(
            help="Lens file: of fisheyerec, OpenCV, ROS, kalibr, COLMAP, gyroflow, OCamCalib or camodocal.",
            show_default=False,
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Lens file to write.")],
    format: Annotated[
        str, typer.Option(help="fisheyerec (.json, .yaml), opencv, kalibr, colmap (.txt), gyroflow (.json) or ros.")
    ] = "fisheyerec",
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the pictures, where the file does not say.")] = None,
    max_fit_error_px: Annotated[
        float, typer.Option(help="The largest error, in pixels, that a lens of another model may be fitted with.")
    ] = 1.0,
) -> None:
    """Convert a lens file into another format, and a lens of another model into a Kannala-Brandt camera.

    Brown-Conrady, unified, extended unified, double sphere, division, field of view, thin prism and OCam lenses are
    fitted over the rays that the picture's pixels see; the error of the fit is printed.
    """
    from ..camera_files import read_camera_file
    from ..cameras import FisheyeCamera, load_camera
    from ..file_rectifiers import describe_camera

    try:
        if output.exists() and output.samefile(camera):
            raise ValueError(f"expected an output other than the lens file itself, got {output}")
        image_size = parse_size(size)
        read = read_camera_file(camera, image_size=image_size)
        converted = load_camera(camera, image_size=image_size, max_fit_error_px=max_fit_error_px)
        converted.save(output, format=format)
    except (ValueError, OSError) as error:
        raise fail("convert", error) from error
    height, width = converted.image_size
    fitted = ""
    if isinstance(converted, FisheyeCamera) and converted.fit_error_px is not None:
        fitted = f"; fitted to {read.model}: {converted.fit_rms_px:.2g} px RMS, {converted.fit_error_px:.2g} px at most"
    typer.echo(f"{output}: {converted.model} {width}x{height}, {describe_camera(converted)}{fitted}")
