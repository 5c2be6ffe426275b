"""The command line. What it calls is imported inside each command, so that `fisheyerec --help` is immediate."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from lightning_fabric import Fabric

    from .cameras import FisheyeCamera, PinholeCamera
    from .rectifier import PhotoEstimate, Rectifier
    from .training.train import TrainingOptions

_REFINE_HELP = "Refine an estimated lens on the lines of the picture."
_SAVE_CAMERA_HELP = "File for the estimated lens (.json, .yaml), of one picture."
_WEIGHTS_HELP = "Weights file to estimate with, as train writes it; the package's own if left out."

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
    refine: Annotated[bool, typer.Option(help=_REFINE_HELP)] = True,
    save_camera: Annotated[Path | None, typer.Option(help=_SAVE_CAMERA_HELP)] = None,
    weights: Annotated[Path | None, typer.Option(help=_WEIGHTS_HELP)] = None,
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
        _check_save_camera(images, save_camera)
        if camera is None:
            rectifier = _load_rectifier(weights)

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
        raise _fail("rectify", error) from error

    _for_each("rectify", images, lambda image: straighten(image, output / image.name if to_folder else output))


@app.command()
def estimate(
    images: Annotated[list[Path], typer.Argument(help="Fisheye pictures.", show_default=False)],
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object a line.")] = False,
    refine: Annotated[bool, typer.Option(help=_REFINE_HELP)] = True,
    save_camera: Annotated[Path | None, typer.Option("--save-camera", "-o", help=_SAVE_CAMERA_HELP)] = None,
    weights: Annotated[Path | None, typer.Option(help=_WEIGHTS_HELP)] = None,
) -> None:
    """Estimate the lens of fisheye pictures from what they show: camera, confidence and straightness.

    Straightness is how much lines bend, in % of their length, in the picture and under the camera.
    """
    try:
        _check_save_camera(images, save_camera)
        rectifier = _load_rectifier(weights)
    except (ValueError, OSError) as error:
        raise _fail("estimate", error) from error

    def estimate_one(image: Path) -> None:
        found = rectifier.estimate(image, refine=refine)
        if save_camera is not None:
            found.camera.save(save_camera)
        typer.echo(_json_line(image, found) if json else f"{image}: {_describe(found)}")

    _for_each("estimate", images, estimate_one)


@app.command()
def synthesize(
    roots: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE",
            help="Folders of photographs, of photographs with labels (SceneParse150 layout), or of panoramas.",
            show_default=False,
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write the pairs to.")],
    count_per_source: Annotated[int, typer.Option(min=1, help="Cameras for each source.")] = 10,
    sources: Annotated[
        int | None, typer.Option(min=1, help="How many sources, drawn by chance; all if left out.")
    ] = None,
    split: Annotated[str, typer.Option(help="training, validation or all: of pictures and of real lenses.")] = (
        "training"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Where chance starts: the same pairs for the same seed.")] = 0,
    size: Annotated[int, typer.Option(min=8, help="Width and height of the pictures.")] = 256,
    recipe: Annotated[str, typer.Option(help="standard, the protocol to report on; or wide, to train on.")] = (
        "standard"
    ),
    jobs: Annotated[int | None, typer.Option(min=1, help="Threads; one a core if left out.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a run with the same options ended.")] = False,
) -> None:
    """Make pairs of fisheye pictures and their straight counterparts, with the lens of each.

    The paper's test set is --split validation --sources 100, its training set --split training --sources 2450.
    """
    import os

    from .training.sources import Sources
    from .training.synthesis import SyntheticPairs
    from .training.writing import write_pairs

    try:
        pairs = SyntheticPairs(
            Sources.open(*roots, split=split),
            recipe=recipe,
            size=(size, size),
            seed=seed,
            split=split,
            cameras_per_source=count_per_source,
        )
        total = min(len(pairs), (sources or len(pairs)) * count_per_source)
        with _progress("pairs") as advance:
            count, failures = write_pairs(
                pairs,
                output,
                total,
                jobs=jobs or os.cpu_count() or 1,
                resume=resume,
                on_pair=advance,
            )
    except (ValueError, OSError) as error:
        raise _fail("synthesize", error) from error
    used = len({pairs.source_number(index) for index in range(total)})
    typer.echo(f"{output}: {count} pairs of {used - len(failures)} sources")
    for message in failures.values():
        typer.echo(f"fisheyerec synthesize: {message}", err=True)
    if failures:
        typer.echo(f"fisheyerec synthesize: {len(failures)} of {used} sources failed", err=True)
        raise typer.Exit(1)


@app.command()
def evaluate(
    pairs: Annotated[Path, typer.Option(help="Folder of pairs, as synthesize writes it.")],
    method: Annotated[str, typer.Option(help="Methods to judge, separated by commas.")] = "identity,oracle",
    json: Annotated[Path | None, typer.Option(help="File for the figures.")] = None,
    csv: Annotated[Path | None, typer.Option(help="File for one row a picture and method.")] = None,
    sheet: Annotated[Path | None, typer.Option(help="File for a contact sheet, .png or .jpg.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first so many pairs.")] = None,
) -> None:
    """Judge methods that rectify a single picture by a folder of pairs, and print a table."""
    from .training import reports
    from .training.evaluate import evaluate_methods, load_methods

    try:
        methods = load_methods(name.strip() for name in method.split(",") if name.strip())
        with _progress("pictures") as advance:
            evaluation = evaluate_methods(pairs, methods, limit=limit, on_picture=advance)
        typer.echo(reports.text_table(evaluation.summary()))
        if json is not None:
            reports.write_json(json, evaluation)
        if csv is not None:
            reports.write_csv(csv, evaluation)
        if sheet is not None and evaluation.results:
            reports.write_sheet(sheet, pairs, evaluation)
    except (ValueError, OSError) as error:
        raise _fail("evaluate", error) from error
    for name, reason in evaluation.skipped.items():
        typer.echo(f"fisheyerec evaluate: skipped {name}: {reason}", err=True)
    if evaluation.skipped:
        skipped, count = len(evaluation.skipped), evaluation.count
        typer.echo(f"fisheyerec evaluate: {skipped} of {count} pairs could not be read", err=True)
        raise typer.Exit(1)


@app.command()
def train(
    roots: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE", help="Folders to train on, as for synthesize.", show_default=False),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the run; where there is one, training goes on.")
    ],
    validation: Annotated[
        list[Path] | None,
        typer.Option(help="Folder to choose the best by, of which the validation split is taken; may be repeated."),
    ] = None,
    network: Annotated[str, typer.Option(help="compact, paper, or rong with the recipe rong.")] = "compact",
    recipe: Annotated[str, typer.Option(help="modern, paper or rong: losses, optimiser and schedule.")] = "modern",
    steps: Annotated[int, typer.Option(min=1, help="How many batches.")] = 10_000,
    batch_size: Annotated[int, typer.Option(min=1, help="Pairs a step, over all devices.")] = 32,
    accumulate: Annotated[int, typer.Option(min=1, help="Parts that a device works off its pairs in.")] = 1,
    precision: Annotated[str, typer.Option(help="32-true, bf16-mixed or 16-mixed.")] = "32-true",
    devices: Annotated[int | None, typer.Option(min=1, help="How many; 1, or what torchrun says.")] = None,
    strategy: Annotated[str, typer.Option(help="auto or ddp.")] = "auto",
    workers: Annotated[int, typer.Option(min=0, help="Processes that make pairs, for each device.")] = 1,
    scene_parsing: Annotated[
        bool, typer.Option("--scene-parsing/--no-scene-parsing", help='Without: "-SPN -SL" of the paper.')
    ] = True,
    parsing_loss: Annotated[
        bool, typer.Option("--parsing-loss/--no-parsing-loss", help='Without: "-SL" of the paper.')
    ] = True,
    classes: Annotated[int, typer.Option(min=1, help="Labels are 1 to this, 0 being unlabelled.")] = 8,
    vgg16: Annotated[Path | None, typer.Option(help="torchvision's VGG-16 weights, to begin with (paper).")] = None,
    start_from: Annotated[Path | None, typer.Option(help="Weights of an earlier run, to begin with.")] = None,
    validation_pairs: Annotated[int, typer.Option(min=1, help="How many pairs choose the best.")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="Where chance starts.")] = 0,
) -> None:
    """Train the network; the best weights are best.safetensors in the folder, its log log.csv.

    A run that was interrupted or killed goes on by the same command, and ends with the same weights. Several devices:
    --devices N, or torchrun on every machine.
    """
    import dataclasses

    try:
        from lightning_fabric.utilities.exceptions import MisconfigurationException

        from .training.log import describe
        from .training.sources import Sources
        from .training.train import RECIPES, TrainingOptions
        from .training.train import train as run
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        if missing not in ("lightning_fabric", "tensorboard"):
            raise
        raise _fail("train", ValueError(f"{missing} is missing: pip install 'fisheyerec[train]'")) from error

    try:
        if precision not in ("32-true", "bf16-mixed", "16-mixed"):
            raise ValueError(f"expected --precision of 32-true, bf16-mixed or 16-mixed, got {precision!r}")
        if recipe not in RECIPES:
            raise ValueError(f"expected --recipe in {sorted(RECIPES)}, got {recipe!r}")
        losses = RECIPES[recipe] if parsing_loss else dataclasses.replace(RECIPES[recipe], parsing=0.0)
        options = TrainingOptions(
            network,
            classes,
            scene_parsing,
            losses,
            steps,
            batch_size,
            accumulate,
            seed,
            validation_pairs=validation_pairs,
        )
        sources = Sources.open(*roots)
        validation_sources = Sources.open(*(validation or roots), split="validation")
        fabric = _launch(precision, devices, strategy)
        with _interruptible() as stop, _training_progress(options, fabric.is_global_zero) as (say, on_step):
            best = run(
                output,
                sources,
                validation_sources,
                options,
                vgg16=vgg16,
                start_from=start_from,
                workers=workers,
                fabric=fabric,
                report=lambda row: say(describe(row, steps)),
                warn=say,
                on_step=on_step,
                stop=stop,
            )
    except (ValueError, OSError, MisconfigurationException) as error:
        raise _fail("train", error) from error
    except FloatingPointError as error:
        _fail("train", error)
        raise typer.Exit(1) from error
    if fabric.is_global_zero:
        if stop():
            typer.echo(f"fisheyerec train: stopped; the same command goes on where {output} stands", err=True)
        else:
            typer.echo(f"{best}: the best weights by validation")
    if stop():
        raise typer.Exit(130)


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


def _for_each(command: str, images: list[Path], work: Callable[[Path], None]) -> None:
    """Go through the pictures; where there are several, one that fails does not stop the rest."""
    failures = 0
    for image in images:
        try:
            work(image)
        except (ValueError, OSError) as error:
            failures += 1
            failed = _fail(command, error)
            if len(images) == 1:
                raise failed from error
    if failures:
        typer.echo(f"fisheyerec {command}: {failures} of {len(images)} pictures failed", err=True)
        raise typer.Exit(1)


def _load_rectifier(weights: Path | None) -> Rectifier:
    from .rectifier import Rectifier

    return Rectifier.from_pretrained(weights)


def _rectify_photo(image: Path, output: Path, save_camera: Path | None, rectifier: Rectifier, **options: Any) -> None:
    from .pictures import Picture, read_picture, write_picture

    if output.exists() and output.samefile(image):
        raise ValueError(f"expected an output other than the picture itself, got {output}")
    picture = read_picture(image)
    result = rectifier(picture.pixels, **options)
    if save_camera is not None:
        result.camera.save(save_camera)
    write_picture(output, Picture(result.image, picture.metadata))
    height, width = result.valid.shape
    shown = f"{width}x{height}, {result.valid.mean():.1%} valid, " if result.distorted else "as it was, "
    typer.echo(f"{output}: {shown}{_describe(result)}")


def _check_save_camera(images: list[Path], save_camera: Path | None) -> None:
    if save_camera is not None and len(images) > 1:
        raise ValueError(f"expected --save-camera with one picture, got {len(images)}")
    if save_camera is not None and save_camera.suffix.lower() not in (".json", ".yaml", ".yml"):
        raise ValueError(f"expected --save-camera with a suffix .json or .yaml, got {save_camera.name!r}")


def _describe(estimate: PhotoEstimate) -> str:
    if not estimate.distorted:
        return f"no fisheye distortion found, lines bend by {estimate.straightness_before:.2f} %"
    names = zip(estimate.camera.parameter_names, estimate.camera.params, strict=True)
    return (
        ", ".join(f"{name} {value:.6g}" for name, value in names)
        + f", confidence {estimate.confidence:.2f}, lines bend by {estimate.straightness_before:.2f} % before and "
        f"{estimate.straightness_after:.2f} % after{'' if estimate.refined else ', not refined'}"
    )


def _json_line(image: Path, estimate: PhotoEstimate) -> str:
    import json
    import math

    camera = estimate.camera
    height, width = camera.image_size
    parameters = dict(zip(camera.parameter_names, map(float, camera.params), strict=True))
    values = {
        "image": str(image),
        "camera": {"model": camera.model, "width": width, "height": height, **parameters},
        "confidence": estimate.confidence,
        "distorted": estimate.distorted,
        "straightness_before": estimate.straightness_before,
        "straightness_after": estimate.straightness_after,
    }
    without_lines = [name for name, value in values.items() if isinstance(value, float) and math.isnan(value)]
    return json.dumps(values | dict.fromkeys(without_lines), allow_nan=False)


def _load_fisheye(path: Path) -> FisheyeCamera:
    from .cameras import FisheyeCamera

    return FisheyeCamera.load(path)


def _view(fisheye: FisheyeCamera, size: tuple[int, int], **options: float | None) -> PinholeCamera:
    from . import views

    return views.choose(fisheye, size, **options)


def _parse_size(size: str | None) -> tuple[int, int] | None:
    if size is None:
        return None
    match = re.fullmatch(r"([1-9]\d{0,5})x([1-9]\d{0,5})", size)
    if match is None:
        raise ValueError(f"expected --size as WIDTHxHEIGHT such as 1280x720, got {size!r}")
    return int(match[2]), int(match[1])


@contextmanager
def _progress(noun: str) -> Iterator[Callable[[int], None]]:
    """Show a progress bar where standard error is a terminal; gives what to call with the total after each step."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    rate = TextColumn(f"{noun}, {{task.fields[rate]:.0f}} a second,")
    columns = [BarColumn(), MofNCompleteColumn(), rate, TimeRemainingColumn()]
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(noun, rate=0)
        yield lambda total: progress.update(task, total=total, advance=1, rate=progress.tasks[0].speed or 0)


def _launch(precision: str, devices: int | None, strategy: str) -> Fabric:
    """Start Fabric in this process and its siblings, which torchrun made or which are made here."""
    import os

    from lightning_fabric import Fabric

    here = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    machines = int(os.environ.get("WORLD_SIZE", "1")) // here if "LOCAL_WORLD_SIZE" in os.environ else 1
    fabric = Fabric(precision=precision, devices=devices or here, num_nodes=machines, strategy=strategy)  # type: ignore[arg-type]
    fabric.launch()
    return fabric


@contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Turn a first Ctrl-C into the answer to "was it pressed?"; a second one interrupts as ever."""
    import signal

    pressed = False

    def press(number: int, frame: object) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, press)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _training_progress(
    options: TrainingOptions, shows: bool
) -> Iterator[tuple[Callable[[str], None], Callable[[int, dict[str, float]], None]]]:
    """Show a bar where standard error is a terminal; gives how to say a line, and what to call after each step."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn()]
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not (shows and console.is_terminal)) as progress:
        task = progress.add_task("", total=options.steps)
        begun = False

        def on_step(step: int, losses: dict[str, float]) -> None:
            nonlocal begun
            if not begun:  # the time that is left is judged by the steps of this run
                progress.reset(task, completed=step)
                begun = True
            rate = options.batch_size * (progress.tasks[0].speed or 0)
            numbers = f"loss {losses['loss']:.3f}, {losses['landing']:.2f} px, {rate:.1f} pictures/s"
            progress.update(task, completed=step, description=numbers)

        def say(line: str) -> None:
            if shows:
                progress.console.print(line, markup=False, highlight=False, soft_wrap=True)

        yield say, on_step


def _fail(command: str, error: Exception) -> typer.Exit:
    """Print one line that says what went wrong; the exit to raise."""
    message = " ".join(str(error).split())
    if isinstance(error, OSError) and error.filename is not None:
        message = f"{error.filename}: {error.strerror}"
    typer.echo(f"fisheyerec {command}: {message}", err=True)
    return typer.Exit(2)


if __name__ == "__main__":
    main()
