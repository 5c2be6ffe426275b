"""Writing a folder of synthetic pairs, on several cores, so that a run that was killed can be taken up again."""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from ..cameras import FisheyeCamera, PinholeCamera
from .pairs import MANIFEST, camera_entry, write_png, write_text
from .sources import SourceError
from .synthesis import SyntheticPairs

SETTINGS = "synthesis.json"


class Written(NamedTuple):
    """What a run came to."""

    pairs: int
    """How many pairs the folder holds."""
    failures: dict[str, str]
    """What went wrong with the sources that could not be read, by their names; their pairs are left out."""


def write_pairs(
    pairs: SyntheticPairs,
    folder: str | os.PathLike[str],
    count: int,
    *,
    jobs: int = 1,
    resume: bool = False,
    on_pair: Callable[[int], None] = lambda total: None,
) -> Written:
    """Write the first pairs of a sequence as PNG files with a manifest.

    A line is added to the manifest once its pictures are complete, in the order of the sequence, so a run that was
    killed leaves a folder that can be read, and resuming gives the same bytes as a run that was not. The folder is the
    same for any number of jobs.

    Args:
        pairs: what to write.
        folder: where to; made if need be.
        count: how many pairs.
        jobs: how many threads; the work is done outside Python's lock.
        resume: go on in a folder that holds a part of the same pairs.
        on_pair: called with `count` once a pair is done, be it found, made or failed.

    Raises:
        ValueError: the folder holds pairs and resume is off, or it holds pairs made in another way.
        OSError: the folder cannot be written to.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    done = _take_up(pairs, folder, resume)
    failures: dict[str, str] = {}
    manifest = folder / MANIFEST
    in_order = True
    with open(manifest, "a", encoding="utf-8") as stream:
        last = max(done, default=-1)
        for index, line in _make(pairs, folder, range(count), done, jobs, failures):
            if line is not None:
                stream.write(line)
                stream.flush()
                done[index] = line
                in_order = in_order and index > last
                last = max(last, index)
            on_pair(count)
    if not in_order:  # a source that could not be read last time
        write_text(manifest, "".join(done[index] for index in sorted(done)))
    return Written(len(done), failures)


def _take_up(pairs: SyntheticPairs, folder: Path, resume: bool) -> dict[int, str]:
    """Give the lines of the pairs that are there by their index, after the half-written last line is cut off."""
    settings = json.dumps(_settings(pairs), indent=1) + "\n"
    manifest, settings_path = folder / MANIFEST, folder / SETTINGS
    if manifest.exists():
        if not resume:
            raise ValueError(f"expected a folder without pairs, or --resume, got {manifest}")
        if not settings_path.exists() or settings_path.read_text(encoding="utf-8") != settings:
            raise ValueError(f"expected to resume with the sources and settings of {settings_path}, got others")
    else:
        write_text(settings_path, settings)
        manifest.touch()
    text = manifest.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        write_text(manifest, whole)
    return {int(json.loads(line)["index"]): line for line in whole.splitlines(keepends=True)}


def _settings(pairs: SyntheticPairs) -> dict[str, Any]:
    return {
        "recipe": repr(pairs.recipe),
        "size": list(pairs.size),
        "seed": pairs.seed,
        "split": pairs.split,
        "cameras_per_source": pairs.cameras_per_source,
        "sources": [source.name for source in pairs.sources],
    }


def _make(
    pairs: SyntheticPairs, folder: Path, indices: range, done: dict[int, str], jobs: int, failures: dict[str, str]
) -> Iterator[tuple[int, str | None]]:
    """Make pairs in threads and give their lines in order; None for those that are there already or failed."""
    waiting: deque[tuple[int, Future[str] | None]] = deque()

    def next_line() -> tuple[int, str | None]:
        index, future = waiting.popleft()
        try:
            return index, None if future is None else future.result()
        except SourceError as error:
            failures[error.source] = str(error)
            return index, None

    with ThreadPoolExecutor(jobs) as pool:
        for index in indices:
            waiting.append((index, None if index in done else pool.submit(_write, pairs, folder, index)))
            if len(waiting) >= 4 * jobs:
                yield next_line()
        while waiting:
            yield next_line()


def _write(pairs: SyntheticPairs, folder: Path, index: int) -> str:
    pair = pairs[index]
    stem = f"{index:06d}"
    pictures = {"fisheye": pair.fisheye, "rectified": pair.rectified, "labels": pair.labels}
    names = {key: None if pixels is None else f"{stem}_{key}.png" for key, pixels in pictures.items()}
    for key, pixels in pictures.items():
        if pixels is not None:
            write_png(folder / f"{stem}_{key}.png", pixels)
    entry = {
        **names,
        "camera": camera_entry(FisheyeCamera(pair.camera, pairs.size)),
        "view": camera_entry(PinholeCamera(pair.view, pairs.size)),
        "source": pair.source,
        "kind": pair.kind,
        "index": index,
    }
    return json.dumps(entry) + "\n"
