"""How many instructions does a pixel take? Unlike times, these do not change with what else the machine does.

    python benchmarks/count_instructions.py [--markdown FILE]

Runs single-threaded works under valgrind's callgrind, which must be installed, and counts only what happens within the
kernels. valgrind offers AVX2, so that is the instruction set counted on x86-64.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

HEIGHT, WIDTH = 256, 512

WORKS = {
    "rectify uint8 RGB": "rectify(pixels((3,), np.uint8), fisheye, view)",
    "rectify float32 RGB, interleaved": "rectify(pixels((3,), np.float32), fisheye, view)",
    "rectify float32, one plane": "rectify(pixels((), np.float32), fisheye, view)",
    "rectify float32, 64 channels": "rectify(pixels((64,), np.float32), fisheye, view)",
    "rectify labels int64, nearest": "rectify(pixels((), np.int64), fisheye, view, interpolation='nearest')",
    "rectify uint8 RGB, cylindrical": "rectify(pixels((3,), np.uint8), fisheye, cylinder)",
    "rectify uint8 RGB, cylindrical, turned": "rectify(pixels((3,), np.uint8), fisheye, cylinder, rotation=turn)",
    "distort float32, one plane": "distort(pixels((), np.float32), view, fisheye)",
}

PROGRAM = f"""
import numpy as np
import fisheyerec as fr
gopro = [565.232442, 566.234638, 650.286812, 499.105033, 0.06752805, -0.00583651, -0.00425955, 0.00671125]
fisheye = fr.FisheyeCamera(gopro, (960, 1280)).resize(({HEIGHT}, {WIDTH}))
view = fr.PinholeCamera.edge_matched(fisheye, ({HEIGHT}, {WIDTH}))
cylinder, turn = fr.CylindricalView.from_fov(120, ({HEIGHT}, {WIDTH})), fr.view_rotation(10, 5)
pixels = lambda channels, dtype: np.ones(({HEIGHT}, {WIDTH}, *channels), dtype)
rectify = lambda *a, **k: fr.numpy.rectify(*a, **k, threads=1)
distort = lambda *a, **k: fr.numpy.distort(*a, **k, threads=1)
"""


def count(work: str) -> float:
    """Give the instructions per target pixel of one work."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={folder}/out"]
        command += ["--toggle-collect=fisheyerec::resample(*", sys.executable, "-c", PROGRAM + work]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    collected = re.search(r"Collected : (\d+)", done.stderr)
    if collected is None:
        raise RuntimeError(f"count_instructions: callgrind counted nothing: {done.stderr}")
    return int(collected.group(1)) / (HEIGHT * WIDTH)


def main() -> None:
    """Count and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    lines = ["| work | instructions per pixel |", "|---|---|"]
    for name, work in WORKS.items():
        lines.append(f"| {name} | {count(work):.1f} |")
        print(lines[-1], flush=True)
    if arguments.markdown:
        arguments.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
