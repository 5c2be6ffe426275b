"""`fisheyerec train`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .messages import fail

if TYPE_CHECKING:
    from lightning_fabric import Fabric

    from ..training.train import TrainingOptions


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

        from ..training.log import describe
        from ..training.sources import Sources
        from ..training.train import RECIPES, TrainingOptions
        from ..training.train import train as run
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        if missing not in ("lightning_fabric", "tensorboard"):
            raise
        raise fail("train", ValueError(f"{missing} is missing: pip install 'fisheyerec[train]'")) from error

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
        raise fail("train", error) from error
    except FloatingPointError as error:
        fail("train", error)
        raise typer.Exit(1) from error
    if fabric.is_global_zero:
        if stop():
            typer.echo(f"fisheyerec train: stopped; the same command goes on where {output} stands", err=True)
        else:
            typer.echo(f"{best}: the best weights by validation")
    if stop():
        raise typer.Exit(130)


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
