"""Progress bars on standard error, where that is a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from ..folders import Task


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


class FileProgress(NamedTuple):
    """What to call while files are worked on; from any thread."""

    echo: Callable[[str], None]
    """Print a line on standard output, above the bars where it is the same terminal."""
    complain: Callable[[str], None]
    """Print a line on standard error, above the bars."""
    on_frame: Callable[[Task, int, int | None], None]
    """A video has come so many frames of so many, as far as is known."""
    on_file: Callable[[Task], None]
    """A file is done."""


@contextmanager
def file_progress(count: int) -> Iterator[FileProgress]:
    """Show one bar for the files, where there are several, and one for each video in progress."""
    import functools
    import sys

    import typer
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        TaskID,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Task as ProgressTask
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: ProgressTask) -> Text:
            return Text(f"{task.fields['unit']}, {task.speed or 0:.1f} a second,")

    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn()]
    console = Console(stderr=True)
    bars: dict[Task, TaskID] = {}
    with Progress(*columns, console=console, disable=not console.is_terminal, redirect_stdout=False) as progress:
        files = progress.add_task("", total=count, unit="files", visible=count > 1)

        def echo(line: str, err: bool = False) -> None:
            if console.is_terminal and (err or sys.stdout.isatty()):
                progress.console.print(line, markup=False, highlight=False, soft_wrap=True)
            else:
                typer.echo(line, err=err)

        def on_frame(task: Task, done: int, total: int | None) -> None:
            if task not in bars:
                bars[task] = progress.add_task(task.source.name, total=total, unit="frames")
            progress.update(bars[task], completed=done, total=total)

        def on_file(task: Task) -> None:
            progress.advance(files)
            if task in bars:
                progress.remove_task(bars.pop(task))

        yield FileProgress(echo, functools.partial(echo, err=True), on_frame, on_file)
