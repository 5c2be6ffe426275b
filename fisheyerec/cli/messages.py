"""What the command line says where something went wrong: one line, and the exit status."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import typer


def fail(command: str, error: Exception) -> typer.Exit:
    """Print one line that says what went wrong; the exit to raise."""
    message = " ".join(str(error).split())
    if isinstance(error, OSError) and error.filename is not None:
        message = f"{error.filename}: {error.strerror}"
    typer.echo(f"fisheyerec {command}: {message}", err=True)
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
        typer.echo(f"fisheyerec {command}: {failures} of {len(images)} pictures failed", err=True)
        raise typer.Exit(1)
