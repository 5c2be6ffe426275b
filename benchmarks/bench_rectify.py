"""How fast is the op, against what people use today? Agreement first, then medians, all contenders in one run.

    python benchmarks/bench_rectify.py --threads 2 --json results.json --markdown docs/performance.md

Contenders take turns within each round, so that a machine that slows down slows all of them; quote the ratios.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn.functional import grid_sample, interpolate

import fisheyerec as fr
from fisheyerec import reference

CONTENDERS = {
    "op": "fisheyerec",
    "reference": "pure torch: theta_max and grid anew on each call, then grid_sample",
    "grid_sample": "grid_sample on a ready grid",
    "cv2": "OpenCV: map, then remap",
    "cv2_remap": "OpenCV: remap with ready fixed-point maps",
    "cv2_undistort": "cv2.fisheye.undistortImage",
    "clone": "the floor: a copy of the picture",
}


@dataclass
class Row:
    """One line of the table: what was done, and the times of those who did it."""

    work: str
    shape: tuple[int, ...]
    dtype: str
    layout: str
    direction: str
    threads: int
    run: dict[str, Callable[[], object]] = field(repr=False)
    times_ms: dict[str, list[float]] = field(default_factory=dict, repr=False)

    def measure(self, seconds: float) -> None:
        """Warm up, then let the contenders take turns until the time is over."""
        for call in self.run.values():
            call()
        self.times_ms = {name: [] for name in self.run}
        end = time.perf_counter() + seconds
        rounds = 0
        while rounds < 5 or (time.perf_counter() < end and rounds < 300):
            for name, call in self.run.items():
                start = time.perf_counter()
                call()
                self.times_ms[name].append((time.perf_counter() - start) * 1e3)
            rounds += 1

    def record(self) -> dict[str, object]:
        """Give the row as JSON: medians as NAME_ms, quartiles as NAME_iqr_ms."""
        record: dict[str, object] = {
            "work": self.work,
            "shape": list(self.shape),
            "dtype": self.dtype,
            "layout": self.layout,
            "direction": self.direction,
            "threads": self.threads,
            "rounds": len(self.times_ms["op"]),
        }
        for name, times in self.times_ms.items():
            low, middle, high = statistics.quantiles(times, n=4)
            record[f"{name}_ms"] = middle
            record[f"{name}_iqr_ms"] = high - low
        return record


def cameras(height: int, width: int) -> tuple[fr.FisheyeCamera, fr.PinholeCamera]:
    """Give a real wide lens, scaled to the picture, and its edge-matched view."""
    gopro = [565.232442, 566.234638, 650.286812, 499.105033, 0.06752805, -0.00583651, -0.00425955, 0.00671125]
    camera = fr.FisheyeCamera(gopro, (960, 1280)).resize((height, width))
    return camera, fr.PinholeCamera.edge_matched(camera, (height, width))


def tensor_row(shape: tuple[int, int, int, int], layout: str, backward: bool, direction: str, threads: int) -> Row:
    """Compare on a float32 batch."""
    batch, channels, height, width = shape
    memory_format = torch.channels_last if layout == "channels_last" else torch.contiguous_format
    image = smooth_noise(shape).contiguous(memory_format=memory_format)
    fisheye, view = cameras(height, width)
    source, target = (fisheye, view) if direction == "rectify" else (view, fisheye)
    params = {
        "source": torch.as_tensor(source.params)[None].float(),
        "target": torch.as_tensor(target.params)[None].float(),
    }
    options = (source.model, target.model, height, width, "bilinear", "zeros")
    x, y = (torch.from_numpy(m) for m in maps(source, target))
    grid = (
        torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], -1)[None]
        .expand(batch, -1, -1, -1)
        .contiguous()
    )

    def forward(compute: Callable[..., tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
        return compute(image, params["source"], params["target"], None, *options)[0]

    def op() -> torch.Tensor:
        return fr.resample(
            image, type(source)(params["source"], source.image_size), type(target)(params["target"], target.image_size)
        )[0]

    run: dict[str, Callable[[], object]] = {
        "op": op,
        "reference": lambda: forward(reference.resample),
        "grid_sample": lambda: grid_sample(image, grid, align_corners=False),
    }
    expected = forward(reference.resample)
    assert (op() - expected).abs().max() < 1e-3 * max(1, width / 256), "the op disagrees with the reference"
    if backward:
        weights = torch.rand_like(expected)
        image.requires_grad_()
        grid.requires_grad_()
        for tensor in params.values():
            tensor.requires_grad_()
        forwards = dict(run)

        def with_backward(call: Callable[[], torch.Tensor], leaves: list[torch.Tensor]) -> Callable[[], object]:
            return lambda: torch.autograd.grad(call(), leaves, weights)

        leaves = [image, *params.values()]
        run = {
            name: with_backward(call, [image, grid] if name == "grid_sample" else leaves)
            for name, call in forwards.items()
        }
        for ours, theirs in zip(run["op"](), run["reference"](), strict=True):
            assert torch.allclose(ours, theirs, rtol=1e-2, atol=1e-2 * float(theirs.abs().max())), "gradients disagree"
    else:
        if channels <= 4 and direction == "rectify":  # cv2.fisheye makes no maps for the other direction
            pictures = image.permute(0, 2, 3, 1).contiguous().numpy()
            run["cv2"] = lambda: [cv2.remap(p, *cv2_maps(source, target), cv2.INTER_LINEAR) for p in pictures]
        run["clone"] = lambda: image.clone()
    work = "forward + backward" if backward else "forward"
    return Row(work, shape, "float32", layout, direction, threads, run)


def smooth_noise(shape: tuple[int, int, int, int]) -> torch.Tensor:
    """Give pictures as smooth as photographs: gradients of white noise would not agree in float32 with anything."""
    batch, channels, height, width = shape
    coarse = torch.rand(batch, channels, max(2, height // 16), max(2, width // 16))
    return interpolate(coarse, (height, width), mode="bicubic", align_corners=False)


def picture_row(height: int, width: int, threads: int) -> Row:
    """Compare on an 8 bit RGB picture through the NumPy door."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8), (0, 0), 2)
    fisheye, view = cameras(height, width)
    K, D = fisheye.to_opencv()
    fixed_maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), view.to_matrix(), (width, height), cv2.CV_16SC2)
    ours = fr.numpy.rectify(picture, fisheye, view).image
    theirs = cv2.remap(picture, *fixed_maps, cv2.INTER_LINEAR)
    assert np.abs(ours.astype(int) - theirs).mean() < 0.5, "the op disagrees with OpenCV"
    run: dict[str, Callable[[], object]] = {
        "op": lambda: fr.numpy.rectify(picture, fisheye, view, threads=threads),
        "cv2_remap": lambda: cv2.remap(picture, *fixed_maps, cv2.INTER_LINEAR),
        "cv2_undistort": lambda: cv2.fisheye.undistortImage(
            picture, K, D, Knew=view.to_matrix(), new_size=(width, height)
        ),
        "clone": picture.copy,
    }
    return Row("forward", (height, width, 3), "uint8", "HWC", "rectify", threads, run)


def maps(source: fr.cameras.Camera, target: fr.cameras.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Give float32 maps: where the target's pixels lie in the source."""
    height, width = target.image_size
    points = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    out = np.nan_to_num(source.project(target.unproject(points)[0])[0], nan=-1e4).astype(np.float32)
    return np.ascontiguousarray(out[..., 0]), np.ascontiguousarray(out[..., 1])


def cv2_maps(source: fr.cameras.Camera, target: fr.cameras.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Let OpenCV make the maps of a rectification."""
    height, width = target.image_size
    K, D = source.to_opencv()
    return cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), target.to_matrix(), (width, height), cv2.CV_32FC1)


TENSOR_SHAPES = [(1, 3, 256, 256), (8, 3, 256, 256), (8, 64, 256, 256), (2, 150, 256, 256), (1, 3, 1080, 1920)]
PICTURE_SIZES = [(1080, 1920), (2160, 3840)]


def rows(threads: int) -> list[Callable[[], Row]]:
    """List the table's rows, each made when its turn comes, as some hold gigabytes."""
    makers: list[Callable[[], Row]] = []
    for shape in TENSOR_SHAPES:
        for layout in ("contiguous", "channels_last"):
            for backward in (False, True):
                makers.append(lambda s=shape, m=layout, b=backward: tensor_row(s, m, b, "rectify", threads))
    for backward in (False, True):
        makers.append(lambda b=backward: tensor_row((1, 3, 1080, 1920), "contiguous", b, "distort", threads))
    for height, width in PICTURE_SIZES:
        makers.append(lambda h=height, w=width: picture_row(h, w, threads))
    return makers


def table(records: list[dict[str, object]]) -> str:
    """Render records as a Markdown table: median ± half the distance between the quartiles, in ms."""
    names = [name for name in CONTENDERS if any(f"{name}_ms" in record for record in records)]
    lines = ["| work | shape | layout | " + " | ".join(names) + " |", "|---" * (3 + len(names)) + "|"]
    for record in records:
        cells = []
        for name in names:
            value = record.get(f"{name}_ms")
            ratio = f" ({value / record['op_ms']:.1f}x)" if value and name != "op" else ""
            spread = f" ± {record[f'{name}_iqr_ms'] / 2:.1g}" if value else ""
            cells.append(f"{value:.3g}{spread}{ratio}" if value else "")
        work = f"{record['direction']}, {record['work']}"
        shape = f"{record['dtype']} {tuple(record['shape'])}"
        lines.append(f"| {work} | {shape} | {record['layout']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--seconds", type=float, default=2.0, help="per row")
    parser.add_argument("--only", default="", help="rows whose description contains this")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path, help="write the table as a page")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    where = f"{machine()}, {arguments.threads} threads, torch {torch.__version__}, OpenCV {cv2.__version__}"
    print(f"{where}\nmedians ± half the distance between quartiles, in ms; in brackets the ratio to fisheyerec (op)\n")
    records = []
    for make in rows(arguments.threads):
        row = make()
        if arguments.only not in f"{row.direction} {row.work} {row.dtype} {row.shape} {row.layout}":
            continue
        row.measure(arguments.seconds)
        records.append(row.record())
        print(table(records[-1:]).splitlines()[-1], flush=True)
    legend = "\n".join(f"- `{name}`: {description}" for name, description in CONTENDERS.items())
    print(f"\n{table(records)}\n\n{legend}")
    if arguments.markdown:
        page = (
            "# Performance\n\n"
            "Made by `python benchmarks/bench_rectify.py --threads 2 --markdown docs/performance.md`.\n\n"
            f"{date.today()}: {where}. Medians ± half the distance between\n"
            "quartiles, in ms; in brackets the ratio to fisheyerec (`op`).\n"
            "Contenders take turns within one run, after each was found to agree with the others.\n\n"
            f"{table(records)}\n\n{legend}\n"
        )
        arguments.markdown.write_text(page)
    if arguments.json:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()
