"""COCO's run-length encoding of masks: lengths of runs of 0 and 1 in turn, down the columns, as numbers or as text.

The text writes each length, from the third on less the one two before it, in characters of five bits, the lowest first,
a sixth bit saying that more follow (rleToString of pycocotools' maskApi.c).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_FIRST = 48  # the character of 0
_DIGIT, _MORE, _SIGN = 0x1F, 0x20, 0x10


def decode(counts: Sequence[int] | str, size: tuple[int, int]) -> np.ndarray:
    """Give the mask (height, width) bool.

    Raises:
        ValueError: runs that do not make up the size, or a text that is none of runs.
    """
    runs = np.array(_lengths(counts) if isinstance(counts, str) else counts, dtype=np.int64)
    height, width = size
    if runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width:
        raise ValueError(f"expected runs of {height} x {width} pixels in all, got {int(runs.sum())}")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def encode(mask: np.ndarray, *, as_text: bool) -> list[int] | str:
    """Give the runs of a mask (height, width) bool."""
    pixels = np.concatenate([[False], mask.T.ravel()])
    turns = np.flatnonzero(pixels[1:] != pixels[:-1])
    runs: list[int] = np.diff([0, *turns, mask.size]).tolist()
    return _text(runs) if as_text else runs


def _lengths(text: str) -> list[int]:
    lengths: list[int] = []
    value, shift = 0, 0
    for character in text:
        code = ord(character) - _FIRST
        if not 0 <= code <= _DIGIT | _MORE:
            raise ValueError(f"expected characters from {chr(_FIRST)!r} to 'o' in runs, got {character!r}")
        value |= (code & _DIGIT) << shift
        shift += 5
        if code & _MORE:
            continue
        if code & _SIGN:
            value -= 1 << shift
        lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
        value, shift = 0, 0
    return lengths


def _text(lengths: Sequence[int]) -> str:
    characters = []
    for i, length in enumerate(lengths):
        value = length - lengths[i - 2] if i > 2 else length
        more = True
        while more:
            digit = value & _DIGIT
            value >>= 5
            more = value != (-1 if digit & _SIGN else 0)
            characters.append(chr(digit + (_MORE if more else 0) + _FIRST))
    return "".join(characters)
