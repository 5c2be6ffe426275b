"""Judging methods in several processes, so that a run that was killed can be taken up again."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import torch

from .evaluate import Evaluation, Method, PictureResult, judge_pair, load_methods
from .pairs import PairFiles, read_manifest, write_text
from .records import HEADER, read_records, to_csv, write_records


def judge_folder(
    folder: str | os.PathLike[str],
    names: list[str],
    records: str | os.PathLike[str],
    *,
    weights: Mapping[str, Path] | None = None,
    jobs: int = 1,
    limit: int | None = None,
    on_picture: Callable[[int], None] = lambda total: None,
) -> Evaluation:
    """Run methods over a folder of pairs; the lines of each picture are added to a CSV once they are known.

    A picture and method that the CSV holds is not judged again: the same call goes on after a run that was killed, adds
    methods to one that was not, and ends with the same file but for the run times. Pairs that could not be read are
    tried again.

    Args:
        folder: pairs with a manifest.
        names: methods out of METHODS and `weights`.
        records: the CSV.
        weights: as for `load_methods`. That a file has changed since is not noticed.
        jobs: how many processes, of one thread each; 1 for this process with the threads it has.
        limit: only the first so many pairs.
        on_picture: called after each pair with how many there are in all.

    Raises:
        ValueError: no folder of pairs, an unknown method, or a CSV that is none or belongs to another folder.
        OSError: the CSV cannot be read or written.
    """
    records = Path(records)
    pairs = read_manifest(folder)
    load_methods(names, weights)  # before any process is started for nothing
    done = {(result.picture, result.method) for result in _take_up(records, pairs)}
    asked = pairs[:limit]
    evaluation = Evaluation(names, len(asked))
    missing = [[name for name in names if (pair.name, name) not in done] for pair in asked]
    with open(records, "a", encoding="utf-8") as stream:
        for pair, outcome in zip(asked, _judge(asked, missing, weights, jobs), strict=True):
            if isinstance(outcome, str):
                evaluation.skipped[pair.name] = outcome
            else:
                stream.write(to_csv(outcome))
                stream.flush()
            on_picture(len(asked))
    results = _in_order(read_records(records), pairs, names)
    write_records(records, results)
    wanted = {pair.name for pair in asked}
    evaluation.results = [result for result in results if result.picture in wanted and result.method in names]
    return evaluation


def _take_up(records: Path, pairs: list[PairFiles]) -> list[PictureResult]:
    """Read what a CSV holds, after its half-written last line is cut off; make it where there is none."""
    if not records.exists():
        write_text(records, HEADER)
    text = records.read_text(encoding="utf-8")
    if not text.endswith("\n"):
        write_text(records, text[: text.rfind("\n") + 1])
    results = read_records(records)
    known = {pair.name: (pair.source, pair.kind) for pair in pairs}
    for result in results:
        if known.get(result.picture) != (result.source, result.kind):
            raise ValueError(f"expected records of the same pairs in {records}, got {result.picture} of other ones")
    return results


def _judge(
    pairs: list[PairFiles], names: list[list[str]], weights: Mapping[str, Path] | None, jobs: int
) -> Iterator[list[PictureResult] | str]:
    """Judge each pair by the methods that are named for it, in order; a reason instead where it cannot be read."""
    needed = list(dict.fromkeys(name for of_pair in names for name in of_pair))
    if not needed:
        yield from ([] for _ in pairs)
        return
    if jobs == 1:
        methods = load_methods(needed, weights)
        yield from (_judge_one(pair, of_pair, methods) for pair, of_pair in zip(pairs, names, strict=True))
        return
    # Spawned: a fork of a process whose OpenMP threads have run may hang.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, initializer=_prepare, initargs=(needed, weights))
    try:
        yield from pool.map(_judge_in_process, pairs, names)
    finally:
        pool.shutdown(cancel_futures=True)


_methods: dict[str, Method] = {}
"""Of a process that `_prepare` began."""


def _prepare(names: list[str], weights: Mapping[str, Path] | None) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _methods.update(load_methods(names, weights))


def _judge_in_process(pair: PairFiles, names: list[str]) -> list[PictureResult] | str:
    return _judge_one(pair, names, _methods)


def _judge_one(pair: PairFiles, names: list[str], methods: Mapping[str, Method]) -> list[PictureResult] | str:
    try:
        return judge_pair(pair, {name: methods[name] for name in names}) if names else []
    except (ValueError, OSError) as error:
        return str(error)


def _in_order(results: Iterable[PictureResult], pairs: list[PairFiles], names: list[str]) -> list[PictureResult]:
    """Sort by the manifest and, within a picture, by `names`; what was not asked for follows in its own order."""
    places = {pair.name: place for place, pair in enumerate(pairs)}
    ranks = {name: rank for rank, name in enumerate(names)}
    return sorted(results, key=lambda result: (places[result.picture], ranks.get(result.method, len(names))))
