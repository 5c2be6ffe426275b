"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

_TEMPORARY = re.compile(r"\.(?P<name>.*)\.[0-9a-f]{16}\.part(\.\w+)?", re.DOTALL)
_NAME_LENGTH = 60  # characters of up to four bytes; file systems take 255 bytes


@contextmanager
def replacement(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a new name beside a path; the file written there takes the path's place once the block ends well.

    The name has the path's suffix, as some who write go by it.
    Where the block raises, Ctrl-C included, that file is removed and an older one stays as it was. A process that is
    killed leaves a hidden file, see `remove_leftovers`.

    Raises:
        OSError: the file cannot be written, under the name that the caller gave.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name[:_NAME_LENGTH]}.{os.urandom(8).hex()}.part{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())  # else a power cut may leave the new name with no content
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and str(error.filename) == str(temporary):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def remove_leftovers(paths: Iterable[Path]) -> None:
    """Remove what killed processes left of replacements for these paths, of which no other process may be at work."""
    names: dict[Path, set[str]] = {}
    for path in paths:
        names.setdefault(path.parent, set()).add(path.name[:_NAME_LENGTH])
    for folder, known in names.items():
        if folder.is_dir():
            for entry in os.scandir(folder):
                match = _TEMPORARY.fullmatch(entry.name)
                if match is not None and match["name"] in known:
                    os.unlink(entry)
