"""Sizes of pictures as they are typed."""

from __future__ import annotations

import re


def parse_size(size: str | None) -> tuple[int, int] | None:
    """Read WIDTHxHEIGHT as (height, width)."""
    if size is None:
        return None
    match = re.fullmatch(r"([1-9]\d{0,5})x([1-9]\d{0,5})", size)
    if match is None:
        raise ValueError(f"expected --size as WIDTHxHEIGHT such as 1280x720, got {size!r}")
    return int(match[2]), int(match[1])
