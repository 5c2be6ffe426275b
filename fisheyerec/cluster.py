"""Many files on the machines of a Ray cluster, through Ray Data: the twin of `bulk`.

    driver: tasks in batches -> Ray Data -> workers, a process and a core each, one file after the other
    driver: outcomes <- Ray Data <- batches, as they are finished

Ray gives the work of a lost worker or machine to another, as often as it takes. A ledger, which outlives workers,
counts how often work on a file was begun and not ended, so that a file that takes every worker down ends as a failure.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import re
import signal
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

from . import __version__
from .bulk import Outcome, one_line, rectify_file
from .file_rectifiers import FileRectifier, is_video
from .folders import Task
from .replacement import remove_leftovers

# Ray reads these when it is imported. Its core writes to standard error what it raises as well, or makes good itself.
_SETTINGS = {
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
    "RAY_DATA_DISABLE_PROGRESS_BARS": "1",
    "RAY_DATA_LOG_LEVEL": "ERROR",
    "RAY_DEDUP_LOGS_SKIP_REGEX": "worker died or was killed|retries remaining",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",  # of a local cluster, else whatever else the machine does comes first
}
for _name, _value in _SETTINGS.items():
    os.environ.setdefault(_name, _value)

try:
    import ray
    import ray.data
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("Ray is missing: pip install 'fisheyerec[ray]'", name="ray") from error

ATTEMPTS = 3
"""How many workers a file may take down before it counts as failed."""

_ADDRESS = re.compile(r"local|auto|(?P<host>[^/\s]+):(?P<port>\d+)")
_REACHABLE_WITHIN = 10  # s; Ray itself tries for minutes
_OBJECT_STORE_BYTES = 80 << 20  # about the least that Ray takes: names of files and cameras are all that is in it
_LARGEST_BATCH = 16  # files: to hand over several costs Ray little more than one, but a lost batch is done again
_BATCHES_A_WORKER = 8  # at least, so that all end at about the same time
_LAST_PICTURE_WITHIN = 30  # s, after the run was given up
_READING_THREADS, _LAST_READ_WITHIN = ("StreamingExecutor", "iter_threaded"), 10  # names that Ray Data gives; s
_FRAMES_BETWEEN_LOOKS = 32  # whether the run is over


def check_address(address: str) -> None:
    """Refuse what is no address of a cluster.

    Raises:
        ValueError: it is not "local", "auto" or HOST:PORT.
    """
    if not _ADDRESS.fullmatch(address):
        raise ValueError(f"expected a Ray cluster as local, auto or HOST:PORT, got {address!r}")


@contextlib.contextmanager
def connected(address: str, jobs: int | None) -> Iterator[None]:
    """Connect this process to a cluster for the length of a block; see `run`.

    Raises:
        ValueError: address is none.
        ConnectionError: the cluster cannot be reached.
    """
    check_address(address)
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if address == "local":
        options |= {"num_cpus": jobs or os.cpu_count(), "object_store_memory": _OBJECT_STORE_BYTES}
        options |= {"include_dashboard": False}
    try:
        match = _ADDRESS.fullmatch(address)
        if match is not None and match["host"] is not None:
            socket.create_connection((match["host"], int(match["port"])), _REACHABLE_WITHIN).close()
        # Workers look for modules in the folder that Ray is started from, which may be one of the sources.
        with _silent_stderr(), contextlib.chdir(os.sep):
            ray.init(address=address, **options)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))  # where Ray has hung a stack trace
    except Exception as error:  # of all kinds, RuntimeError for another version of Ray or Python among them
        raise ConnectionError(f"expected a Ray cluster at {address}, got none: {one_line(error)}") from error
    try:
        yield
    finally:
        # Ray ends this process, with status 1, where one of its threads still reads as the cluster is taken down.
        for thread in threading.enumerate():
            if thread.name.startswith(_READING_THREADS):
                thread.join(_LAST_READ_WITHIN)
        ray.shutdown()


def run(
    tasks: Sequence[Task], rectifier: FileRectifier, *, address: str | None = None, jobs: int | None = None
) -> Generator[Outcome, None, None]:
    """Rectify files on a cluster and give what became of each, in the order that batches of them are finished.

    Every machine must see the files under the same names, and have this version of fisheyerec; relative names count
    from the current folder of this process. A network is loaded once a worker. What a lost worker had in hand is done
    again by another, and what it left half-written is removed at the end. Where the iteration is given up, pictures in
    progress are finished, videos broken off and removed.

    Args:
        tasks: what to do; the folders of the targets exist.
        rectifier: what does it; sent to the workers.
        address: "local" for a cluster of this machine's cores that ends with the run, "auto" for the one that this
            machine belongs to, HOST:PORT of the head of one, or None where this process is connected already.
        jobs: how many workers, each on one core; one for every core of the cluster if None.

    Raises:
        ValueError: address is none.
        ConnectionError: the cluster cannot be reached or was lost, or a machine of it lacks the folder or this version.
    """
    if not tasks:
        return
    try:
        with contextlib.nullcontext() if address is None else connected(address, jobs):
            _check_machines(tasks[0].target.parent)
            yield from _outcomes(tasks, rectifier, jobs)
    except ray.exceptions.RayError as error:
        raise ConnectionError(f"the Ray cluster failed: {one_line(error)}") from error
    finally:
        remove_leftovers(target for task in tasks for _, target in task.files)


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Send to nowhere what C++ writes to standard error; to choose the level of its log does not silence all of it."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _check_machines(folder: Path) -> None:
    """Refuse machines that would fail at every file, or write them to a folder of their own with the same name."""

    @ray.remote(num_cpus=0)
    def look(name: str) -> tuple[str | None, bool]:  # a function within another is sent whole: the package may lack
        try:
            from fisheyerec import __version__
        except ImportError:
            return None, False
        return __version__, os.path.exists(name)

    folder.stat()  # one that is not there is told by its own name
    with tempfile.NamedTemporaryFile(prefix=".", dir=folder.absolute()) as mark:
        machines = {node["NodeID"]: node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]}
        views = [
            look.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote(mark.name)
            for node in machines
        ]
        for machine, (version, sees) in zip(machines.values(), ray.get(views), strict=True):
            if version != __version__:
                raise ConnectionError(
                    f"expected fisheyerec {__version__} on {machine} of the Ray cluster, got {version or 'none'}"
                )
            if not sees:
                raise ConnectionError(f"expected a folder that {machine} of the Ray cluster sees too, got {folder}")


def _outcomes(tasks: Sequence[Task], rectifier: FileRectifier, jobs: int | None) -> Generator[Outcome, None, None]:
    workers = min(jobs or int(ray.cluster_resources().get("CPU", 1)), len(tasks))
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    ledger: Any = ray.remote(_Ledger).options(num_cpus=0, scheduling_strategy=here).remote()
    # Pickled here, since Arrow has no paths, and no texts that are not Unicode, as names of files may be.
    batches = [{"tasks": pickle.dumps(batch)} for batch in _batches(tasks, workers)]
    # Nothing is sent ahead, to workers or from them: Ray may keep what is finished until what comes after it is, too.
    dataset = ray.data.from_items(batches, override_num_blocks=len(batches)).map(
        cast(Any, _Worker),
        fn_constructor_args=(rectifier, ledger, os.getcwd()),
        compute=ray.data.ActorPoolStrategy(size=workers, max_tasks_in_flight_per_actor=1),
        num_cpus=1,
    )
    rows: Any = iter(dataset.iter_batches(batch_size=None, prefetch_batches=0))
    with ThreadPoolExecutor(1) as reader:  # Ray ends workers at once where Ctrl-C meets it reading
        try:
            while (row := reader.submit(next, rows, None).result()) is not None:
                for outcomes in row["outcomes"]:
                    yield from pickle.loads(outcomes)
        finally:  # as in `bulk`, pictures in progress are finished
            ray.get(ledger.stop.remote())
            end = time.monotonic() + _LAST_PICTURE_WITHIN
            while time.monotonic() < end and ray.get(ledger.in_hand.remote()) > 0:
                time.sleep(0.05)
            # Before Ray is shut down, lest it starts again to tidy up; what it says then must not hide a Ctrl-C.
            reader.submit(rows.close).exception()


def _batches(tasks: Sequence[Task], workers: int) -> list[list[Task]]:
    """Share tasks out: each video by itself, pictures a few at a time."""
    size = max(1, min(_LARGEST_BATCH, len(tasks) // (_BATCHES_A_WORKER * workers)))
    videos = [task for task in tasks if is_video(task.source)]
    pictures = [task for task in tasks if not is_video(task.source)]
    return [[video] for video in videos] + [pictures[i : i + size] for i in range(0, len(pictures), size)]


class _Interrupted(Exception):
    """The run is over: leave the file that is being written."""


class _Worker:
    """Rectifies batches, in a process of its own on any machine.

    Args:
        rectifier: what does it.
        ledger: the handle of a `_Ledger`.
        folder: what relative names count from, where this machine has it.
    """

    def __init__(self, rectifier: FileRectifier, ledger: Any, folder: str) -> None:
        with contextlib.suppress(OSError):
            os.chdir(folder)
        self._rectifier, self._ledger = rectifier, ledger

    def __call__(self, row: dict[str, bytes]) -> dict[str, bytes]:
        return {"outcomes": pickle.dumps([self._rectify(task) for task in pickle.loads(row["tasks"])])}

    def _rectify(self, task: Task) -> Outcome:
        def proceed(done: int, total: int | None) -> None:
            if done % _FRAMES_BETWEEN_LOOKS == 0 and ray.get(self._ledger.is_stopped.remote()):
                raise _Interrupted

        refusal = ray.get(self._ledger.begin.remote(task))
        if refusal is not None:
            return Outcome(task, 0, None, f"{task.source}: {refusal}")
        outcome = rectify_file(task, self._rectifier, on_frame=proceed)
        self._ledger.end.remote(task)
        return outcome


class _Ledger:
    """Knows what is worked on, how many workers it has taken down, and whether the run is over."""

    def __init__(self) -> None:
        self._begun: Counter[Task] = Counter()
        self._stopped = False

    def begin(self, task: Task) -> str | None:
        """Note that work on a task begins, or say why it must not."""
        if self._stopped:
            return "the run is over"
        if self._begun[task] == ATTEMPTS:
            del self._begun[task]
            return f"{ATTEMPTS} workers died of it"
        self._begun[task] += 1
        return None

    def end(self, task: Task) -> None:
        """Note that work on a task has ended."""
        del self._begun[task]

    def stop(self) -> None:
        """Let nothing more begin."""
        self._stopped = True

    def is_stopped(self) -> bool:
        """Tell whether workers should leave what they have begun."""
        return self._stopped

    def in_hand(self) -> int:
        """Give how many tasks are worked on."""
        return len(self._begun)
