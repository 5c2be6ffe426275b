"""`fisheyerec synthesize`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .messages import fail
from .progress import progress


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

    from ..training.sources import Sources
    from ..training.synthesis import SyntheticPairs
    from ..training.writing import write_pairs

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
        with progress("pairs") as advance:
            count, failures = write_pairs(
                pairs,
                output,
                total,
                jobs=jobs or os.cpu_count() or 1,
                resume=resume,
                on_pair=advance,
            )
    except (ValueError, OSError) as error:
        raise fail("synthesize", error) from error
    used = len({pairs.source_number(index) for index in range(total)})
    typer.echo(f"{output}: {count} pairs of {used - len(failures)} sources")
    for message in failures.values():
        typer.echo(f"fisheyerec synthesize: {message}", err=True)
    if failures:
        typer.echo(f"fisheyerec synthesize: {len(failures)} of {used} sources failed", err=True)
        raise typer.Exit(1)
