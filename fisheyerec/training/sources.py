"""The pictures that pairs are made from: photographs with labels, photographs without, panoramas.

A root is a folder in one of three layouts:

    SceneParse150   images/{training,validation}/*.jpg and annotations/{training,validation}/*.png of the same names,
                    8 bit, 0 = unlabelled, 1..N; without annotations/ the photographs have no labels
    panoramas       pictures all exactly twice as wide as high: equirectangular, the zenith in the first row
    photographs     any other folder of pictures

SceneParse150 folders bring their split; elsewhere the hash of a file's name decides, a tenth being validation.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from ..pictures import read_picture
from .lenses import check_split, in_split

SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"}


class SourceError(ValueError):
    """A source that cannot be read; `source` is its name, the message says why and where."""

    def __init__(self, source: str, reason: Exception) -> None:
        super().__init__(f"{source}: {reason}")
        self.source = source


class DecodedSource(NamedTuple):
    """What a source holds."""

    pixels: np.ndarray
    """(H, W, 3) RGB uint8."""
    labels: np.ndarray | None
    """(H, W) uint8, 0 = unlabelled; None without."""


@dataclass(frozen=True)
class Source:
    """One picture to make pairs from."""

    name: str
    """Root folder and path within it."""
    path: Path
    labels_path: Path | None = None
    is_panorama: bool = False

    def decode(self) -> DecodedSource:
        """Read the picture and its labels.

        Raises:
            ValueError: broken files, labels of another size or type, or a panorama that is not 2:1.
            OSError: a file cannot be read.
        """
        pixels = read_rgb(self.path)
        height, width = pixels.shape[:2]
        if self.is_panorama and width != 2 * height:
            raise ValueError(f"expected a panorama twice as wide as high in {self.path}, got {width}x{height}")
        labels = None if self.labels_path is None else read_labels(self.labels_path)
        if labels is not None and labels.shape != (height, width):
            raise ValueError(
                f"expected labels of the picture's size, {width}x{height}, in {self.labels_path}, "
                f"got {labels.shape[1]}x{labels.shape[0]}"
            )
        return DecodedSource(pixels, labels)


class Sources:
    """A sequence of sources, read from their files each time or held decoded in memory.

    Args:
        sources: the pictures.
        decoded: what they hold, in the same order; None to read the files.
    """

    def __init__(self, sources: Iterable[Source], decoded: list[DecodedSource] | None = None) -> None:
        self._sources = list(sources)
        self._decoded = decoded
        self._latest: tuple[int, DecodedSource] | None = None

    @classmethod
    def open(cls, *roots: str | os.PathLike[str], split: str = "training") -> Sources:
        """List the pictures of a split of one or several folders, in the order of their names; nothing is decoded.

        Args:
            roots: folders in one of the layouts above.
            split: "training", "validation" or "all".

        Raises:
            ValueError: an unknown split, a root that is no folder, or one without pictures of this split.
        """
        check_split("Sources.open", split)
        sources: list[Source] = []
        for root in map(Path, roots):
            if not root.is_dir():
                raise ValueError(f"expected a folder of pictures, got {root}")
            found = _scene_parse(root, split) if (root / "images").is_dir() else _plain(root, split)
            if not found:
                raise ValueError(f"expected pictures of the split {split!r} in {root}, got none")
            sources += found
        return cls(sources)

    def __len__(self) -> int:
        return len(self._sources)

    def __getitem__(self, number: int) -> Source:
        return self._sources[number]

    def __iter__(self) -> Iterator[Source]:
        return iter(self._sources)

    def decode(self, number: int) -> DecodedSource:
        """Give what a source holds, from memory where it is.

        Raises:
            SourceError: it cannot be read.
        """
        if self._decoded is not None:
            return self._decoded[number]
        latest = self._latest  # several pairs in a row are made from one source
        if latest is None or latest[0] != number:
            source = self._sources[number]
            try:
                latest = self._latest = (number, source.decode())
            except (ValueError, OSError) as error:
                raise SourceError(source.name, error) from error
        return latest[1]

    def into_memory(
        self, *, jobs: int | None = None, on_failure: Callable[[SourceError], None] | None = None
    ) -> Sources:
        """Decode all pictures once; 1,000 photographs of 600x450 take 0.8 GB.

        Args:
            jobs: threads; None for one a core.
            on_failure: called for each source that cannot be read, which is then left out; None raises instead.

        Raises:
            SourceError: a source cannot be read, where on_failure is None.
        """
        kept: list[Source] = []
        decoded: list[DecodedSource] = []
        with ThreadPoolExecutor(jobs or os.cpu_count()) as pool:
            futures = [pool.submit(self.decode, number) for number in range(len(self))]
            for source, future in zip(self._sources, futures, strict=True):
                try:
                    decoded.append(future.result())
                    kept.append(source)
                except SourceError as error:
                    if on_failure is None:
                        raise
                    on_failure(error)
        return Sources(kept, decoded)


def read_rgb(path: Path) -> np.ndarray:
    """Read a picture of any kind as (H, W, 3) uint8; errors as `read_picture`."""
    pixels = read_picture(path).pixels
    if pixels.dtype != np.uint8:  # 16 bit grey
        pixels = (np.clip(pixels, 0, 65535) / 257).round().astype(np.uint8)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    return np.ascontiguousarray(pixels[..., :3])


def read_labels(path: Path) -> np.ndarray:
    """Read labels (H, W) uint8 as the file stores them: the numbers of a palette picture are its labels.

    Raises:
        ValueError: a broken file, or one that does not hold one 8 bit number for each pixel.
        OSError: the file cannot be read.
    """
    try:
        with Image.open(path) as image:
            labels = np.asarray(image)
    except (OSError, SyntaxError) as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise ValueError(f"expected labels in {path}, got a broken file ({error})") from error
    if labels.ndim != 2 or labels.dtype != np.uint8:
        raise ValueError(f"expected one 8 bit number for each pixel in {path}, got shape {labels.shape} {labels.dtype}")
    return labels


def _scene_parse(root: Path, split: str) -> list[Source]:
    has_labels = (root / "annotations").is_dir()
    found = []
    for folder in ("training", "validation") if split == "all" else (split,):
        for path in _pictures(root / "images" / folder):
            relative = path.relative_to(root / "images")
            labels_path = (root / "annotations" / relative).with_suffix(".png") if has_labels else None
            found.append(Source(_name(root, path), path, labels_path))
    return found


def _plain(root: Path, split: str) -> list[Source]:
    paths = _pictures(root)
    sizes = [size for path in paths if (size := _size(path)) is not None]
    is_panorama = bool(sizes) and all(width == 2 * height for width, height in sizes)
    return [Source(_name(root, path), path, None, is_panorama) for path in paths if in_split(path.name, split)]


def _pictures(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())


def _name(root: Path, path: Path) -> str:
    return f"{root.resolve().name}/{path.relative_to(root).as_posix()}"


def _size(path: Path) -> tuple[int, int] | None:
    """Give (width, height), or None for a file that is no picture, which fails with its name once it is decoded."""
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, SyntaxError):
        return None
