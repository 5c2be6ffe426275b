"""What the command line says where something went wrong: one line, and the exit status."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import typer


def say(command: str, message: str) -> None:
    """Print a line to standard error."""
    typer.echo(f"fisheyerec {command}: {message}", err=True)


def fail(command: str, error: Exception) -> typer.Exit:
    """Print one line that says what went wrong; the exit to raise."""
    from ..bulk import one_line

    say(command, one_line(error))
    return typer.Exit(2)


def for_each(command: str, images: list[Path], work: Callable[[Path], None]) -> None:
    """Go through the pictures; where there are several, one that fails does not stop the rest."""
    failures = 0
    for image in images:
        try:
            work(image)
        except (ValueError, OSError) as error:
            failures += 1
            failed = fail(command, error)
            if len(images) == 1:
                raise failed from error
    if failures:
        say(command, f"{failures} of {len(images)} pictures failed")
        raise typer.Exit(1)


def check_new(targets: Sequence[Path], *, overwrite: bool) -> None:
    """Refuse files that are there, unless they may be replaced."""
    there = [] if overwrite else [target for target in targets if target.exists()]
    if there:
        others = f" and {len(there) - 1} others" if len(there) > 1 else ""
        raise ValueError(f"expected a new file, or --overwrite, got {there[0]}{others}")
