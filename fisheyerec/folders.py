"""Which files to work on, and where each result goes."""

from __future__ import annotations

import functools
import glob
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple


class Companion(NamedTuple):
    """A file that belongs to a picture, and the one to make from it."""

    kind: str
    source: Path
    target: Path


class Task(NamedTuple):
    """One file to make from another, and what moves along."""

    source: Path
    target: Path
    companions: tuple[Companion, ...] = ()

    @property
    def files(self) -> list[tuple[Path, Path]]:
        """What is read and what is made of it: first its own."""
        return [(self.source, self.target), *((source, target) for _, source, target in self.companions)]


class Plan(NamedTuple):
    """What to do."""

    tasks: list[Task]
    folder: Path | None
    """The folder that the targets lie in; None where one file makes one file."""


class _Found(NamedTuple):
    root: Path
    files: list[Path]


def plan(
    inputs: Sequence[Path], output: Path, *, suffixes: Collection[str], target_suffix: Callable[[str], str]
) -> Plan:
    """Find files, and name what is made of each.

    A folder is searched to the bottom for files of the given suffixes, except hidden ones, folders behind symbolic
    links, and the output folder. A name that does not exist and has wildcards is a glob pattern, `**` for any depth.
    One file goes to one file, or below the output if that is a folder. Several keep their paths below the deepest
    folder that all inputs have in common. Where another suffix would make one name of two, as for a.jpg and a.png,
    both keep their old suffix before the new one.

    Args:
        inputs: files, folders and patterns. A file that does not exist is planned all the same.
        output: a file or a folder.
        suffixes: what to look for in folders and patterns, such as ".jpg", in lower case.
        target_suffix: gives the suffix of what is made of a file with this suffix.

    Raises:
        ValueError: nothing was found, or what was to be made would replace an input or something else to be made.
        OSError: a folder cannot be read.
    """
    if len(inputs) == 1 and not output.is_dir() and not inputs[0].is_dir() and not _is_pattern(inputs[0]):
        tasks, folder = [Task(inputs[0], output)], None
    else:
        tasks, folder = _into_folder([_find(path, output, suffixes) for path in inputs], output, target_suffix), output
    if not tasks:
        raise ValueError(f"expected files to work on, got none in {', '.join(map(str, inputs))}")
    _check_targets(tasks)
    return Plan(tasks, folder)


def accompany(planned: Plan, kind: str, source: Path, target: Path, suffixes: Sequence[str]) -> Plan:
    """Give each picture its companion of a kind, such as its label map, and name what is made of that.

    Args:
        planned: the pictures.
        kind: what the companions are.
        source: a folder, in which they have the relative names of the pictures, with suffixes of their own; or the file
            of the only picture. One that does not exist is planned all the same.
        target: a folder, in which what is made of them has the same names; or, from a file, a file.
        suffixes: what files of this kind have, in lower case, the commonest first.

    Raises:
        ValueError: one file for several pictures, several for one, another suffix, or what was to be made would replace
            an input or something else to be made.
        OSError: a folder cannot be read.
    """
    if source.is_dir():
        found = _companions_in(source, planned, suffixes)
        targets = [target / file.relative_to(source) for file in found]
    elif len(planned.tasks) == 1:
        found, targets = [source], [target / source.name if target.is_dir() else target]
    else:
        raise ValueError(f"expected a folder of {kind} for {len(planned.tasks)} files, got {source}")
    for file in (*found, *targets):
        if file.suffix.lower() not in suffixes:
            raise ValueError(f"expected {kind} in a file with a suffix such as {suffixes[0]}, got {file}")
    tasks = [
        task._replace(companions=(*task.companions, Companion(kind, *paths)))
        for task, *paths in zip(planned.tasks, found, targets, strict=True)
    ]
    _check_targets(tasks)
    return planned._replace(tasks=tasks)


def _companions_in(folder: Path, planned: Plan, suffixes: Sequence[str]) -> list[Path]:
    @functools.cache
    def by_stem(parent: Path) -> dict[str, list[Path]]:
        files = defaultdict(list)
        for file in sorted(parent.iterdir()) if parent.is_dir() else []:
            if file.suffix.lower() in suffixes:
                files[file.stem].append(file)
        return files

    found = []
    for source, target, _ in planned.tasks:
        below = Path() if planned.folder is None else target.parent.relative_to(planned.folder)
        namesake = folder / below / source.name
        files = by_stem(namesake.parent).get(source.stem, [namesake.with_suffix(suffixes[0])])
        if len(files) > 1 and namesake not in files:
            raise ValueError(f"expected one companion of {source}, got {files[0]} and {files[1]}")
        found.append(namesake if namesake in files else files[0])
    return found


def _is_pattern(path: Path) -> bool:
    return not os.path.lexists(path) and glob.has_magic(str(path))


def _find(path: Path, output: Path, suffixes: Collection[str]) -> _Found:
    if path.is_dir():
        return _Found(path, list(_search(path, output, suffixes)))
    if not _is_pattern(path):
        return _Found(path.parent, [path])
    parts = path.parts
    fixed = next(number for number, part in enumerate(parts) if glob.has_magic(part))
    matches = (Path(match) for match in sorted(glob.glob(str(path), recursive=True)))
    below = output.absolute()
    files = [match for match in matches if match.suffix.lower() in suffixes and not match.is_dir()]
    return _Found(Path(*parts[:fixed]), [file for file in files if below not in file.absolute().parents])


def _search(folder: Path, output: Path, suffixes: Collection[str]) -> Iterator[Path]:
    def refuse(error: OSError) -> None:
        raise error

    for parent, folders, names in os.walk(folder, onerror=refuse):
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") and not _is_same(os.path.join(parent, name), output)
        )
        for name in sorted(names):
            if not name.startswith(".") and os.path.splitext(name)[1].lower() in suffixes:
                yield Path(parent, name)


def _is_same(one: str, other: Path) -> bool:
    return os.path.exists(one) and other.exists() and os.path.samefile(one, other)


def _into_folder(found: Sequence[_Found], output: Path, target_suffix: Callable[[str], str]) -> list[Task]:
    common = os.path.commonpath([os.path.abspath(each.root) for each in found])
    sources = {os.path.abspath(file): file for each in found for file in each.files}
    targets = {}
    for absolute in sources:
        relative = Path(os.path.relpath(absolute, common))
        targets[absolute] = output / relative.with_suffix(target_suffix(relative.suffix))
    count = Counter(targets.values())
    for absolute, target in targets.items():
        if count[target] > 1:
            targets[absolute] = target.with_name(Path(absolute).name + target.suffix)
    return [Task(source, targets[absolute]) for absolute, source in sources.items()]


def _check_targets(tasks: Sequence[Task]) -> None:
    made: dict[Path, Path] = {}
    for source, target in (file for task in tasks for file in task.files):
        if target in made:
            raise ValueError(f"expected an output for each input, got {target} for {made[target]} and {source}")
        made[target] = source
    sources = {_identity(source) for source in made.values()} - {None}
    for target in made:
        if _identity(target) in sources:
            raise ValueError(f"expected an output other than the picture itself, got {target}")


def _identity(path: Path) -> tuple[int, int] | None:
    """What names of the same file have in common; None where there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
