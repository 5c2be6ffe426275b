"""The command line. What it calls is imported inside each command, so that `fisheyerec --help` is immediate."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from .cameras import FisheyeCamera, PinholeCamera

app = typer.Typer(
    name="fisheyerec",
    help="Make fisheye pictures straight.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line. Exits 0; 1 where some of several files failed; 2 on bad input, with one line why."""
    app()


@app.callback(invoke_without_command=True)
def version(show: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    """Make fisheye pictures straight."""
    if show:
        from . import __version__

        typer.echo(__version__)
        raise typer.Exit


@app.command()
def rectify(
    images: Annotated[list[Path], typer.Argument(help="Fisheye pictures.", show_default=False)],
    camera: Annotated[
        Path, typer.Option(help="Lens file of the camera that took them (JSON, YAML, OpenCV, kalibr...).")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Picture to write; for several images, a folder.")],
    fov_deg: Annotated[float | None, typer.Option(help="Field of view across the result's width, below 180.")] = None,
    focal: Annotated[float | None, typer.Option(help="Focal length of the result in pixels.")] = None,
    balance: Annotated[
        float | None, typer.Option(help="0: only valid pixels; 1: keep the whole picture; or between.")
    ] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the result; the picture's own if left out.")] = None,
    interpolation: Annotated[str, typer.Option(help="bilinear, or nearest for label maps.")] = "bilinear",
) -> None:
    """Make pictures of a calibrated fisheye camera straight.

    Without --fov-deg, --focal or --balance the view is edge-matched: the nearest edge of the fisheye picture stays at
    the edge of the result, so nothing in it is empty.
    """
    try:
        if sum(option is not None for option in (fov_deg, focal, balance)) > 1:
            raise ValueError("expected one of --fov-deg, --focal and --balance, got several")
        fisheye = _load_fisheye(camera)
        view = _view(fisheye, fov_deg, focal, balance, _parse_size(size) or fisheye.image_size)
        to_folder = len(images) > 1 or output.is_dir()
        if to_folder:
            output.mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError) as error:
        raise _fail("rectify", error) from error

    failures = 0
    for image in images:
        try:
            _rectify_file(image, fisheye, view, output / image.name if to_folder else output, interpolation)
        except (ValueError, OSError) as error:
            failures += 1
            failed = _fail("rectify", error)
            if len(images) == 1:
                raise failed from error
    if failures:
        typer.echo(f"fisheyerec rectify: {failures} of {len(images)} pictures failed", err=True)
        raise typer.Exit(1)


def _rectify_file(image: Path, fisheye: FisheyeCamera, view: PinholeCamera, output: Path, interpolation: str) -> None:
    from . import numpy
    from .pictures import Picture, read_picture, write_picture

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


def _load_fisheye(path: Path) -> FisheyeCamera:
    from .cameras import FisheyeCamera

    return FisheyeCamera.load(path)


def _view(
    fisheye: FisheyeCamera, fov_deg: float | None, focal: float | None, balance: float | None, size: tuple[int, int]
) -> PinholeCamera:
    from . import views
    from .cameras import PinholeCamera

    if fov_deg is not None:
        return PinholeCamera.from_fov(fov_deg, size)
    if focal is not None:
        return PinholeCamera.from_focal(focal, size)
    if balance is not None:
        return views.balanced(fisheye, balance, size)
    return PinholeCamera.edge_matched(fisheye, size)


def _parse_size(size: str | None) -> tuple[int, int] | None:
    if size is None:
        return None
    match = re.fullmatch(r"([1-9]\d{0,5})x([1-9]\d{0,5})", size)
    if match is None:
        raise ValueError(f"expected --size as WIDTHxHEIGHT such as 1280x720, got {size!r}")
    return int(match[2]), int(match[1])


def _fail(command: str, error: Exception) -> typer.Exit:
    """Print one line that says what went wrong; the exit to raise."""
    message = " ".join(str(error).split())
    if isinstance(error, OSError) and error.filename is not None:
        message = f"{error.filename}: {error.strerror}"
    typer.echo(f"fisheyerec {command}: {message}", err=True)
    return typer.Exit(2)


if __name__ == "__main__":
    main()
