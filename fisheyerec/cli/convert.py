"""`fisheyerec convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .estimating import OVERWRITE_HELP
from .messages import check_new, fail
from .sizes import parse_size

MAX_FIT_ERROR_HELP = "The largest error, in pixels, that a lens of another model may be fitted with."


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
    max_fit_error_px: Annotated[float, typer.Option(help=MAX_FIT_ERROR_HELP)] = 1.0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help=OVERWRITE_HELP)] = False,
) -> None:
    """Convert a lens file into another format, and a lens of another model into a Kannala-Brandt camera.

    Brown-Conrady, unified, extended unified, double sphere, division, field of view, thin prism and OCam lenses are
    fitted over the rays that the picture's pixels see; the error of the fit is printed.
    """
    from ..cameras import load_camera
    from ..file_rectifiers import describe_camera, describe_fit

    try:
        if output.exists() and output.samefile(camera):
            raise ValueError(f"expected an output other than the lens file itself, got {output}")
        check_new([output], overwrite=overwrite)
        converted = load_camera(camera, image_size=parse_size(size), max_fit_error_px=max_fit_error_px)
        converted.save(output, format=format)
    except (ValueError, OSError) as error:
        raise fail("convert", error) from error
    height, width = converted.image_size
    told = [f"{converted.model} {width}x{height}, {describe_camera(converted)}", describe_fit(converted)]
    typer.echo(f"{output}: {'; '.join(filter(None, told))}")
