"""Many files, one after the other or several at a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import NamedTuple

from .file_rectifiers import FileRectifier, FileReport
from .folders import Task

OnFrame = Callable[[Task, int, int | None], None]


class Outcome(NamedTuple):
    """What became of a task."""

    task: Task
    seconds: float
    report: FileReport | None
    """None where the file failed."""
    error: str | None
    """One line that says what went wrong, if something did."""


class _Interrupted(Exception):
    """The run is over: leave the file that is being written."""


def run(
    tasks: Sequence[Task],
    rectifier: FileRectifier,
    *,
    jobs: int = 1,
    on_frame: OnFrame = lambda task, done, total: None,
) -> Generator[Outcome, None, None]:
    """Rectify files and give what became of each, in the order that they are finished.

    Threads, not processes: the kernels, Pillow and PyAV work outside Python's lock, and a network is loaded once.
    Only the main thread hears Ctrl-C, so that a file is never left half-way: where the iteration is given up, pictures
    in progress are finished, videos broken off and removed.

    Args:
        tasks: what to do.
        rectifier: what does it.
        jobs: how many files at a time.
        on_frame: called from other threads with the task, the frames that are done and how many there will be, as far
            as is known; for videos only.
    """
    stopped = threading.Event()

    def work(task: Task) -> Outcome:
        def proceed(done: int, total: int | None) -> None:
            if stopped.is_set():
                raise _Interrupted
            on_frame(task, done, total)

        return rectify_file(task, rectifier, on_frame=proceed)

    waiting: set[Future[Outcome]] = set()
    with ThreadPoolExecutor(jobs) as pool:
        try:
            for task in tasks:
                waiting.add(pool.submit(work, task))
                if len(waiting) >= 2 * jobs:
                    finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in finished)
            while waiting:
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in finished)
        finally:
            stopped.set()
            pool.shutdown(cancel_futures=True)


def rectify_file(task: Task, rectifier: FileRectifier, *, on_frame: Callable[[int, int | None], None]) -> Outcome:
    """Rectify a file and tell what became of it, whatever it raises."""
    start = time.perf_counter()
    try:
        report = rectifier(task, on_frame=on_frame)
    except Exception as error:  # decoders raise anything on a broken file, and the rest is to be done
        return Outcome(task, time.perf_counter() - start, None, one_line(error))
    return Outcome(task, time.perf_counter() - start, report, report.complaint)


def one_line(error: Exception) -> str:
    """Say what went wrong in one line."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    message = " ".join(str(error).split())
    return message if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: {message}"
