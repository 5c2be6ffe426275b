"""How fast is the op, against what people use today? Agreement first, then medians, all contenders in one run.

    python benchmarks/bench_rectify.py --threads 2 --json results.json --page docs/performance.md --readme README.md

Contenders take turns within each round, so that a machine that slows down slows all of them; quote the ratios.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from pages import machine, write_between_markers
from torch.nn.functional import grid_sample, interpolate

import fisheyerec as fr
from fisheyerec import _ops, reference

CONTENDERS = {
    "op": "fisheyerec",
    "reference": "pure torch: the grid anew on each call, then grid_sample (`fisheyerec.reference`)",
    "grid_sample": "grid_sample on a ready grid",
    "cv2": "OpenCV: map, then remap",
    "cv2_remap": "OpenCV: remap with ready fixed-point maps",
    "cv2_undistort": "cv2.fisheye.undistortImage",
    "bilinear": "fisheyerec, bilinear instead of nearest",
    "one_thread": "fisheyerec on one thread",
    "on_the_fly": "fisheyerec, `rectify` instead of a ready `Plan`",
    "rectify": "fisheyerec, rectify instead of distort",
    "clone": "the floor: a copy of the picture",
}


Contenders = dict[str, Callable[[], object]]


@dataclass
class Row:
    """One line of the table: what was done, and the times of those who did it."""

    work: str
    shape: tuple[int, ...]
    dtype: str
    layout: str
    direction: str
    threads: int
    contenders: Callable[[], Contenders] = field(repr=False)  # made when the row's turn comes: some hold gigabytes
    times_ms: dict[str, list[float]] = field(default_factory=dict, repr=False)

    def measure(self, seconds: float) -> None:
        """Warm up, then let the contenders take turns until the time is over."""
        contenders = self.contenders()
        for call in contenders.values():
            call()
        self.times_ms = {name: [] for name in contenders}
        end = time.perf_counter() + seconds
        rounds = 0
        while rounds < 5 or (time.perf_counter() < end and rounds < 300):
            for name, call in contenders.items():
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


def tensors(shape: tuple[int, int, int, int], layout: str, backward: bool, direction: str) -> Contenders:
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

    run: Contenders = {
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
    return run


def smooth_noise(shape: tuple[int, int, int, int]) -> torch.Tensor:
    """Give pictures as smooth as photographs: gradients of white noise would not agree in float32 with anything."""
    batch, channels, height, width = shape
    coarse = torch.rand(batch, channels, max(2, height // 16), max(2, width // 16))
    return interpolate(coarse, (height, width), mode="bicubic", align_corners=False)


def pictures(height: int, width: int, threads: int) -> Contenders:
    """Compare on an 8 bit RGB picture through the NumPy door."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8), (0, 0), 2)
    fisheye, view = cameras(height, width)
    K, D = fisheye.to_opencv()
    fixed_maps = cv2_maps(fisheye, view, cv2.CV_16SC2)
    ours = fr.numpy.rectify(picture, fisheye, view).image
    theirs = cv2.remap(picture, *fixed_maps, cv2.INTER_LINEAR)
    assert np.abs(ours.astype(int) - theirs).mean() < 0.5, "the op disagrees with OpenCV"
    return {
        "op": lambda: fr.numpy.rectify(picture, fisheye, view, threads=threads),
        "cv2_remap": lambda: cv2.remap(picture, *fixed_maps, cv2.INTER_LINEAR),
        "cv2_undistort": lambda: cv2.fisheye.undistortImage(
            picture, K, D, Knew=view.to_matrix(), new_size=(width, height)
        ),
        "clone": picture.copy,
    }


def repeated_frames(height: int, width: int, threads: int) -> Contenders:
    """Compare a plan for frames of one camera with rectifying each anew."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8), (0, 0), 2)
    fisheye, view = cameras(height, width)
    plan = fr.numpy.Plan(fisheye, view, threads=threads)
    fixed_maps = cv2_maps(fisheye, view, cv2.CV_16SC2)

    def on_the_fly() -> np.ndarray:
        return fr.numpy.rectify(picture, fisheye, view, threads=threads).image

    assert np.array_equal(plan(picture).image, on_the_fly()), "the plan disagrees with the op"
    return {
        "op": lambda: plan(picture),
        "on_the_fly": on_the_fly,
        "cv2_remap": lambda: cv2.remap(picture, *fixed_maps, cv2.INTER_LINEAR),
    }


def nearest_labels(height: int, width: int, dtype: str, threads: int) -> Contenders:
    """Compare labels, which are copied from the nearest pixel, with a picture of bytes."""
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 150, (height, width), dtype=dtype)
    picture = rng.integers(0, 256, (height, width), dtype=np.uint8)
    fisheye, view = cameras(height, width)
    fixed_maps = cv2_maps(fisheye, view)

    def nearest() -> np.ndarray:
        return fr.numpy.rectify(labels, fisheye, view, interpolation="nearest", threads=threads).image

    run: Contenders = {
        "op": nearest,
        "bilinear": lambda: fr.numpy.rectify(picture, fisheye, view, threads=threads),
        "clone": labels.copy,
    }
    if dtype == "uint8":
        theirs = cv2.remap(labels, *fixed_maps, cv2.INTER_NEAREST)
        assert (nearest() == theirs).mean() > 0.999, "the op disagrees with OpenCV"
        run["cv2_remap"] = lambda: cv2.remap(labels, *fixed_maps, cv2.INTER_NEAREST)
    return run


def one_thread_and_more(height: int, width: int, threads: int) -> Contenders:
    """Compare the threads asked for with one."""
    image = smooth_noise((1, 3, height, width))
    cameras_and_view = cameras(height, width)

    def one_thread() -> None:
        torch.set_num_threads(1)
        fr.rectify(image, *cameras_and_view)
        torch.set_num_threads(threads)

    return {"op": lambda: fr.rectify(image, *cameras_and_view), "one_thread": one_thread}


def both_directions(height: int, width: int) -> Contenders:
    """Compare distort, which inverts the lens at each pixel, with rectify."""
    image = smooth_noise((1, 3, height, width))
    fisheye, view = cameras(height, width)
    return {"op": lambda: fr.distort(image, view, fisheye), "rectify": lambda: fr.rectify(image, fisheye, view)}


def grey_level_errors(height: int, width: int) -> list[dict[str, object]]:
    """Give the mean and the largest error of 8 bit pictures against float64, before its rounding."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8), (0, 0), 1)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    fisheye, view = cameras(height, width)
    fixed_maps = cv2_maps(fisheye, view, cv2.CV_16SC2)
    exact, valid = fr.numpy.rectify(picture.astype(np.float64), fisheye, view)
    results = {
        "op": fr.numpy.rectify(picture, fisheye, view).image,
        "cv2_remap": cv2.remap(picture, *fixed_maps, cv2.INTER_LINEAR),
        "rounding alone": np.floor(exact + 0.5),
    }
    inside = cv2.erode(valid.astype(np.uint8), np.ones((3, 3))) > 0  # OpenCV's edges follow another rule
    errors = {name: np.abs(result - exact)[inside] for name, result in results.items()}
    return [{"who": name, "mean": float(error.mean()), "max": float(error.max())} for name, error in errors.items()]


def resident_mb(name: str) -> float:
    """Read VmRSS, what the process holds now, or VmHWM, the most it held (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 1024


def peak_growth(call: Callable[[], object]) -> float:
    """Give by how many MB the process grows at most during a call."""
    call()  # libraries load what they need
    ctypes.CDLL(None).malloc_trim(0)  # or memory that was freed and kept would hide what is asked for
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = resident_mb("VmRSS")
    call()
    return resident_mb("VmHWM") - before


def memory(shape: tuple[int, int, int, int]) -> list[dict[str, object]]:
    """Give the peak growth of op and reference, and the size of what they have to give back."""
    height, width = shape[2:]
    fisheye, view = cameras(height, width)
    image, weights = torch.rand(shape), torch.rand(shape)
    source, target = (torch.as_tensor(c.params)[None].float() for c in (fisheye, view))
    options = (fisheye.model, view.model, height, width, "bilinear", "zeros")
    picture, mask = image.nbytes / 2**20, shape[0] * height * width / 2**20
    records: list[dict[str, object]] = []
    for backward in (False, True):
        leaves = [t.clone().requires_grad_(backward) for t in (image, source, target)]

        def run(
            resample: Callable[..., tuple[torch.Tensor, torch.Tensor]], leaves: list[torch.Tensor] = leaves
        ) -> object:
            out = resample(*leaves, None, *options)
            return (out, torch.autograd.grad(out[0], leaves, weights)) if leaves[0].requires_grad else out

        records.append(
            {
                "work": "forward + backward" if backward else "forward",
                "shape": list(shape),
                "results_mb": picture + mask + (picture if backward else 0),
                "op_mb": peak_growth(lambda: run(_ops.resample)),
                "reference_mb": peak_growth(lambda: run(reference.resample)),
            }
        )
    return records


def maps(source: fr.cameras.Camera, target: fr.cameras.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Give float32 maps: where the target's pixels lie in the source."""
    height, width = target.image_size
    points = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    out = np.nan_to_num(source.project(target.unproject(points)[0])[0], nan=-1e4).astype(np.float32)
    return np.ascontiguousarray(out[..., 0]), np.ascontiguousarray(out[..., 1])


def cv2_maps(
    source: fr.cameras.Camera, target: fr.cameras.Camera, kind: int = cv2.CV_32FC1
) -> tuple[np.ndarray, np.ndarray]:
    """Let OpenCV make the maps of a rectification."""
    height, width = target.image_size
    K, D = source.to_opencv()
    return cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), target.to_matrix(), (width, height), kind)


TENSOR_SHAPES = [(1, 3, 256, 256), (8, 3, 256, 256), (8, 64, 256, 256), (2, 150, 256, 256), (1, 3, 1080, 1920)]
PICTURE_SIZES = [(1080, 1920), (2160, 3840)]


def rows(threads: int) -> list[Row]:
    """List the table's rows."""
    listed: list[Row] = []

    def add(work: str, shape: tuple[int, ...], dtype: str, layout: str, direction: str, *contenders: Any) -> None:
        listed.append(Row(work, shape, dtype, layout, direction, threads, partial(*contenders)))

    def add_tensors(shape: tuple[int, int, int, int], layout: str, direction: str) -> None:
        for backward in (False, True):
            work = "forward + backward" if backward else "forward"
            add(work, shape, "float32", layout, direction, tensors, shape, layout, backward, direction)

    for shape in TENSOR_SHAPES:
        for layout in ("contiguous", "channels_last"):
            add_tensors(shape, layout, "rectify")
    large = TENSOR_SHAPES[-1]
    size = large[2:]
    add_tensors(large, "contiguous", "distort")
    for picture in PICTURE_SIZES:
        add("forward", (*picture, 3), "uint8", "HWC", "rectify", pictures, *picture, threads)
    for picture in [(480, 640), *PICTURE_SIZES]:
        add("repeated frames", (*picture, 3), "uint8", "HWC", "rectify", repeated_frames, *picture, threads)
    for dtype in ("uint8", "int64"):
        add("forward, nearest", size, dtype, "HW", "rectify", nearest_labels, *size, dtype, threads)
    add("forward, directions", large, "float32", "contiguous", "distort", both_directions, *size)
    add("forward, threads", large, "float32", "contiguous", "rectify", one_thread_and_more, *size, threads)
    return listed


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


@dataclass
class Goal:
    """A ratio of two medians in one row, and how large it is to be (or how small)."""

    text: str
    row: str
    slow: str
    fast: str
    limit: float
    at_least: bool = True

    def check(self, records: list[dict[str, object]]) -> str | None:
        """Give the goal's line of the table, or None where its row was not measured."""
        record = next((r for r in records if describe(r).startswith(self.row)), None)
        if record is None or f"{self.slow}_ms" not in record:
            return None
        ratio = record[f"{self.slow}_ms"] / record[f"{self.fast}_ms"]
        reached = ratio >= self.limit if self.at_least else ratio <= self.limit
        wanted = f"{'at least' if self.at_least else 'at most'} {self.limit:g}x"
        return f"| {self.text} | {wanted} | {ratio:.2f}x | {'reached' if reached else 'missed'} |"


def goals() -> list[Goal]:
    """List what the op is meant to reach."""
    small, batch, large = "float32 (1, 3, 256, 256)", "float32 (8, 3, 256, 256)", "float32 (1, 3, 1080, 1920)"
    features = "float32 (8, 64, 256, 256)"
    listed = []
    for shape in (small, batch, large):
        row = f"rectify, forward | {shape} | contiguous"
        listed.append(Goal(f"forward {shape} against pure torch", row, "reference", "op", 8))
        listed.append(Goal(f"forward {shape} against grid_sample alone", row, "grid_sample", "op", 3))
    for shape, limit in ((small, 8), (large, 8), (features, 5)):
        row = f"rectify, forward + backward | {shape} | contiguous"
        listed.append(Goal(f"forward + backward {shape} against pure torch", row, "reference", "op", limit))
    row = f"rectify, forward + backward | {features} | channels_last"
    listed.append(Goal(f"the same, channels_last {features}", row, "reference", "op", 5))
    row = f"rectify, forward | {features} | channels_last"
    listed.append(Goal(f"forward channels_last {features} against a copy", row, "op", "clone", 1.15, at_least=False))
    for height, width in PICTURE_SIZES:
        row = f"rectify, forward | uint8 ({height}, {width}, 3) | HWC"
        listed.append(Goal(f"uint8 RGB {height}p against remap with ready maps", row, "cv2_remap", "op", 2))
        listed.append(Goal(f"uint8 RGB {height}p against undistortImage", row, "cv2_undistort", "op", 20))
        row = f"rectify, repeated frames | uint8 ({height}, {width}, 3) | HWC"
        listed.append(Goal(f"a plan for frames of {height}p against on the fly", row, "on_the_fly", "op", 1))
    for dtype in ("uint8", "int64"):
        row = f"rectify, forward, nearest | {dtype}"
        listed.append(Goal(f"nearest {dtype} against bilinear uint8", row, "bilinear", "op", 1))
    listed.append(Goal("one thread to two at 1080p", "rectify, forward, threads", "one_thread", "op", 1.8))
    listed.append(Goal("distort against rectify at 1080p", "distort, forward, directions", "op", "rectify", 2, False))
    return listed


def describe(record: dict[str, object]) -> str:
    """Name a row: its first three columns in the table."""
    return f"{record['direction']}, {record['work']} | {record['dtype']} {tuple(record['shape'])} | {record['layout']}"


README_ROWS = {
    "rectify, forward | float32 (1, 3, 256, 256) | contiguous": "float32 (1, 3, 256, 256)",
    "rectify, forward + backward | float32 (1, 3, 256, 256) | contiguous": "the same, forward + all gradients",
    "rectify, forward | float32 (8, 64, 256, 256) | channels_last": "features (8, 64, 256, 256), channels_last",
    "rectify, forward + backward | float32 (8, 64, 256, 256) | channels_last": "the same, forward + all gradients",
    "rectify, forward | float32 (1, 3, 1080, 1920) | contiguous": "float32 (1, 3, 1080, 1920)",
    "rectify, forward + backward | float32 (1, 3, 1080, 1920) | contiguous": "the same, forward + all gradients",
    "rectify, forward | uint8 (1080, 1920, 3) | HWC": "uint8 RGB 1080p",
    "rectify, forward | uint8 (2160, 3840, 3) | HWC": "uint8 RGB 2160p",
}
README_COLUMNS = ("op", "reference", "grid_sample", "cv2_remap", "cv2_undistort")


def readme_table(records: list[dict[str, object]]) -> str:
    """Render the rows that a newcomer asks for."""
    titles = ["fisheyerec", "pure torch", "`grid_sample` on a ready grid", "`cv2.remap` on ready maps"]
    titles.append("`cv2.fisheye.undistortImage`")
    lines = ["| ms | " + " | ".join(titles) + " |", "|---" * (1 + len(titles)) + "|"]
    for record in records:
        if title := README_ROWS.get(describe(record)):
            cells = [f"{record[f'{c}_ms']:.3g}" if f"{c}_ms" in record else "" for c in README_COLUMNS]
            lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


COMMAND = "python benchmarks/bench_rectify.py --threads 2 --page docs/performance.md --readme README.md"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--seconds", type=float, default=2.0, help="per row")
    parser.add_argument("--only", default="", help="rows whose description contains this")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", type=Path, help="write everything as a Markdown page")
    parser.add_argument("--readme", type=Path, help="renew the table between the markers of this file")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    where = f"{machine()}, {arguments.threads} threads, torch {torch.__version__}, OpenCV {cv2.__version__}"
    print(f"{where}\nmedians ± half the distance between quartiles, in ms; in brackets the ratio to fisheyerec (op)\n")
    records = []
    for row in rows(arguments.threads):
        if arguments.only not in f"{row.direction} {row.work} {row.dtype} {row.shape} {row.layout}":
            continue
        row.measure(arguments.seconds)
        records.append(row.record())
        print(table(records[-1:]).splitlines()[-1], flush=True)
    legend = "\n".join(f"- `{name}`: {description}" for name, description in CONTENDERS.items())
    judged = "\n".join(line for goal in goals() if (line := goal.check(records)))
    sections = [f"{table(records)}\n\n{legend}"]
    sections.append(f"## Goals\n\n| goal | wanted | measured | |\n|---|---|---|---|\n{judged}")
    if not arguments.only:
        sections.append(exactness_section() + "\n\n" + memory_section())
    text = "\n\n".join(sections)
    print(f"\n{text}")
    if arguments.page:
        page = (
            f"# Performance\n\nMade by `{COMMAND}`.\n\n"
            f"{date.today()}: {where}. Medians ± half the distance between\n"
            "quartiles, in ms; in brackets the ratio to fisheyerec (`op`).\n"
            "Contenders take turns within one run, after each was found to agree with the others.\n"
            "[Decision 0010](decisions/0010-what-bounds-the-op.md) tells what bounds the op where a goal is missed.\n\n"
            f"{text}\n"
        )
        arguments.page.write_text(page, encoding="utf-8")
    if arguments.readme:
        note = f"Medians of {date.today()} on {where}."
        write_between_markers(arguments.readme, COMMAND, f"{readme_table(records)}\n\n{note}")
    if arguments.json:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")


def exactness_section() -> str:
    """Measure and render the errors of 8 bit pictures."""
    lines = [f"| {e['who']} | {e['mean']:.3f} | {e['max']:.3f} |" for e in grey_level_errors(1080, 1920)]
    return (
        "## Exactness\n\nuint8 RGB 1080p against float64, in grey levels, where the picture is whole.\n\n"
        "| who | mean error | largest error |\n|---|---|---|\n" + "\n".join(lines)
    )


def memory_section() -> str:
    """Measure and render peak memory."""
    lines = []
    for m in memory((1, 3, 2160, 3840)):
        cells = " | ".join(f"{m[f'{column}_mb']:.0f}" for column in ("results", "op", "reference"))
        lines.append(f"| {m['work']}, float32 {tuple(m['shape'])} | {cells} |")
    return (
        "## Memory\n\nBy how many MB the process grows at most during a call, beside the size of what is given back:\n"
        "the picture and its mask, and with backward the gradient to the picture.\n\n"
        "| work | results | op | reference |\n|---|---|---|---|\n" + "\n".join(lines)
    )


if __name__ == "__main__":
    main()
