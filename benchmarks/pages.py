"""Markdown pages that hold measured numbers."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Give a Markdown table."""
    heads = list(heads)
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def write_between_markers(path: Path, command: str, text: str) -> None:
    """Replace what lies between `<!-- made by: COMMAND -->` and the next `<!-- end -->`.

    Raises:
        ValueError: the file has no such markers.
    """
    start, end = f"<!-- made by: {command} -->\n", "<!-- end -->"
    before, found, rest = path.read_text(encoding="utf-8").partition(start)
    _, ends, after = rest.partition(end)
    if not (found and ends):
        raise ValueError(f"expected {start.strip()} and, further down, {end} in {path}")
    path.write_text(f"{before}{start}{text}\n{end}{after}", encoding="utf-8")


def machine() -> str:
    """Name the CPU."""
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    if sys.platform == "darwin":
        return subprocess.run(
            ["sysctl", "-n", "machdep.cpu.brand_string"], capture_output=True, text=True
        ).stdout.strip()
    return platform.processor() or platform.machine()
