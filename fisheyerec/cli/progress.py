"""A progress bar on standard error, where that is a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress(noun: str) -> Iterator[Callable[[int], None]]:
    """Show a progress bar where standard error is a terminal; gives what to call with the total after each step."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    rate = TextColumn(f"{noun}, {{task.fields[rate]:.0f}} a second,")
    columns = [BarColumn(), MofNCompleteColumn(), rate, TimeRemainingColumn()]
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(noun, rate=0)
        yield lambda total: progress.update(task, total=total, advance=1, rate=progress.tasks[0].speed or 0)
