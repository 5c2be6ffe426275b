"""Table 2 of the paper: seconds for a picture of 256x256, of each method, each stage and each network.

    python benchmarks/table2.py --threads 2

Methods take turns picture by picture, over the pictures that `benchmarks/table1.py` judges. `--compile` adds
torch.compile, which needs a C++ compiler where it runs, and minutes. `benchmarks/results.py` makes the page.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import table1
import torch
from pages import machine, table
from torch import Tensor, nn

import fisheyerec as fr
from fisheyerec import reference
from fisheyerec.pictures import Picture, write_picture
from fisheyerec.refinement import refine
from fisheyerec.straightness import straightness
from fisheyerec.training.evaluate import METHODS, Method, load_methods, straighten
from fisheyerec.training.pairs import read_manifest, write_text
from fisheyerec.training.sources import read_rgb

TIMES = "table2.json"
FEWEST_PICTURES = 50
CLASSES = 150  # of ADE20K, which the paper's network parses

PAPER_S = {
    "bukhari": "62.53 (Intel i5-4200U)",
    "zhang": "80.07 (Intel i5-4200U)",
    "rong": "0.87 (K80)",
    "network": "1.31 (K80)",
}
NOT_TIMED = ("identity", "oracle", "oracle-centred")
CLASSICAL = ("bukhari", "zhang", "aleman-flores", "lines")


@dataclass
class Times:
    """Seconds of many turns."""

    group: str
    name: str
    variant: str
    turns_s: list[float] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """Give the median and the distance between the quartiles."""
        low, middle, high = np.percentile(self.turns_s, [25, 50, 75]).tolist()
        names = {"group": self.group, "name": self.name, "variant": self.variant}
        return {**names, "turns": len(self.turns_s), "median_s": middle, "iqr_s": high - low}


class Watch:
    """Collects what takes how long."""

    def __init__(self) -> None:
        self._times: dict[tuple[str, str, str], Times] = {}

    def add(self, group: str, name: str, variant: str, seconds: float) -> None:
        """Add one turn."""
        key = group, name, variant
        self._times.setdefault(key, Times(*key)).turns_s.append(seconds)

    def time(self, group: str, name: str, variant: str, call: Callable[[], Any]) -> Any:
        """Call, add how long it took, and give what came."""
        start = time.perf_counter()
        result = call()
        self.add(group, name, variant, time.perf_counter() - start)
        return result

    def records(self) -> list[dict[str, Any]]:
        """Give all that was collected."""
        return [times.record() for times in self._times.values()]


# --- Methods --------------------------------------------------------------------------------------


def time_methods(watch: Watch, paths: list[Path], methods: dict[str, Method]) -> None:
    """Time estimating and rectifying, with reading the PNG and writing a JPEG, and without."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "straight.jpg"
        for turn, path in enumerate([paths[0], *paths]):
            for name, method in methods.items():
                start = time.perf_counter()
                picture = read_rgb(path)
                read = time.perf_counter()
                straight = _rectified(picture, method)
                made = time.perf_counter()
                write_picture(output, Picture(straight))
                written = time.perf_counter()
                if turn:  # the first one loads and warms up
                    watch.add("method", name, "", made - read)
                    watch.add("method", name, "with files", written - start)
            if turn % 10 == 0:
                print(f"methods: {turn} of {len(paths)} pictures", file=sys.stderr, flush=True)


def _rectified(picture: np.ndarray, method: Method) -> np.ndarray:
    camera, view = method(picture), fr.PinholeCamera.from_fov(90, picture.shape[:2])
    if camera is not None:
        view = fr.PinholeCamera.edge_matched(camera, picture.shape[:2])
    return straighten(picture, camera, view)[0]


def time_one_call(watch: Watch, paths: list[Path]) -> None:
    """Time what the one call does beside the network: judging how straight lines are, and refining on them."""
    rectifier = fr.Rectifier.from_pretrained()
    for turn, path in enumerate([paths[0], *paths]):
        picture = read_rgb(path)
        camera = rectifier.estimate(picture, refine=False).camera
        stage = partial((watch if turn else Watch()).time, "stage", "one call")
        stage("straightness, told beside the camera", partial(straightness, picture, camera))
        stage("refinement on lines", partial(refine, picture, camera))
        stage("rectification of the photo", partial(fr.numpy.rectify, picture, camera, _view(camera)))


def _view(camera: fr.FisheyeCamera) -> fr.PinholeCamera:
    return fr.PinholeCamera.edge_matched(camera, camera.image_size)


# --- Networks -------------------------------------------------------------------------------------

PARTS = {"base": "trunk", "parsing": "scene parsing", "estimation": "estimation"}


def networks() -> dict[str, Callable[[], fr.FishEyeRecNet]]:
    """Give how the networks are made."""
    return {
        "compact (shipped)": lambda: fr.Rectifier.from_pretrained().network,
        f"paper({CLASSES}), random weights": lambda: fr.FishEyeRecNet.paper(CLASSES).eval(),
    }


def time_stages(watch: Watch, name: str, network: fr.FishEyeRecNet, image: Tensor, turns: int) -> None:
    """Time the parts of a network's forward pass, and the rectification layer in both ways on what it reads there."""
    starts: dict[str, float] = {}
    current = Watch()

    def begin(part: str, *_: Any) -> None:
        starts[part] = time.perf_counter()

    def end(part: str, *_: Any) -> None:
        current.add("stage", name, PARTS[part], time.perf_counter() - starts[part])

    handles = []
    for part in PARTS:
        module = getattr(network, part)
        handles.append(module.register_forward_pre_hook(partial(begin, part)))
        handles.append(module.register_forward_hook(partial(end, part)))
    side = image.shape[-1]
    output = network(image)
    parsing = output.rectified_parsing.softmax(1)
    params = output.camera.params.float(), output.view.params.float()
    options = (output.camera.model, output.view.model, side, side, "bilinear", "zeros")
    for turn in range(turns + 1):
        current = watch if turn else Watch()
        current.time("stage", name, "all of it", lambda: network(image))
        for part, maps in (("picture", image), ("parsing", parsing)):
            call = partial(fr.rectify, maps, output.camera, output.view)
            current.time("stage", name, f"rectification layer, {part}: our op", call)
            call = partial(reference.resample, maps, *params, None, *options)
            current.time("stage", name, f"rectification layer, {part}: grid_sample", call)
    for handle in handles:
        handle.remove()


class Part(NamedTuple):
    """One of the networks within, to be replaced by a faster one."""

    module: nn.Module
    reads: tuple[Tensor, ...]


def _channels_last(part: Part) -> nn.Module:
    return copy.deepcopy(part.module).to(memory_format=torch.channels_last)


def _weights_in_bfloat16(part: Part) -> nn.Module:
    return copy.deepcopy(part.module).to(torch.bfloat16, memory_format=torch.channels_last)


def _exported(part: Part) -> nn.Module:
    return torch.export.export(part.module, part.reads).module()


def _compiled(part: Part) -> nn.Module:
    return torch.compile(part.module)


VARIANTS: dict[str, tuple[torch.dtype, Callable[[Part], nn.Module]]] = {
    "float32": (torch.float32, lambda part: part.module),
    "float32, weights channels_last": (torch.float32, _channels_last),
    "float32, torch.export": (torch.float32, _exported),
    "float32, torch.compile": (torch.float32, _compiled),
    "bfloat16 (autocast)": (torch.bfloat16, lambda part: part.module),
    "bfloat16, weights too": (torch.bfloat16, _weights_in_bfloat16),
    "bfloat16, torch.export": (torch.bfloat16, _exported),
    "bfloat16, torch.compile": (torch.bfloat16, _compiled),
}
"""Precision, and what is done to each network within; the lens between them is little arithmetic in float64."""


def time_variants(
    watch: Watch, name: str, network: fr.FishEyeRecNet, image: Tensor, turns: int, compiles: bool
) -> dict[str, str]:
    """Time the forward pass, picture to lens and straight picture, in all variants; why some could not be made."""
    ready: dict[str, Callable[[], Any]] = {}
    failures = {}
    for variant, (precision, change) in VARIANTS.items():
        if change is _compiled and not compiles:
            continue
        start = time.perf_counter()
        try:
            with _autocast(precision):
                call = partial(_forward, _twin(network, image, change), image, precision)
            call()
        except Exception as error:  # whatever a compiler stumbles over: the others are timed
            failures[f"{name}, {variant}"] = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            continue
        watch.add("ready", name, variant, time.perf_counter() - start)
        print(f"{name}, {variant}: ready", file=sys.stderr, flush=True)
        ready[variant] = call
    for turn in range(turns + 2):
        for variant, call in ready.items():
            (watch if turn >= 2 else Watch()).time("network", name, variant, call)
    return failures


def _twin(network: fr.FishEyeRecNet, image: Tensor, change: Callable[[Part], nn.Module]) -> fr.FishEyeRecNet:
    """Give the same network with other networks within; weights that are not changed are shared: paper() has 0.7 GB."""
    reads: dict[str, tuple[Tensor, ...]] = {}
    handles = [
        getattr(network, part).register_forward_pre_hook(lambda _, read, part=part: reads.update({part: read}))
        for part in PARTS
    ]
    network(image)
    for handle in handles:
        handle.remove()
    twin = copy.copy(network)
    twin._modules = {part: change(Part(getattr(network, part), reads[part])) for part in PARTS}
    return twin


def _autocast(precision: torch.dtype) -> torch.autocast:
    return torch.autocast("cpu", torch.bfloat16, enabled=precision == torch.bfloat16)


def _forward(network: nn.Module, image: Tensor, precision: torch.dtype) -> Any:
    with _autocast(precision):
        return network(image)


# --- Rendering ------------------------------------------------------------------------------------


class Goal(NamedTuple):
    """What a median is to be at most."""

    text: str
    limit_s: float
    group: str
    name: str
    variant: str


def goals() -> list[Goal]:
    """List them."""
    compact, paper = networks()
    listed = [
        Goal("paper() in float32", 0.65, "network", paper, "float32"),
        Goal("paper() in bfloat16, weights cast anew by autocast", 0.35, "network", paper, "bfloat16 (autocast)"),
        Goal("paper() in bfloat16, weights too", 0.35, "network", paper, "bfloat16, weights too"),
        Goal("compact, picture to straight picture", 0.06, "method", "network", ""),
        Goal("compact, the network itself", 0.06, "network", compact, "float32"),
    ]
    return listed + [Goal(f"{name}, classical", 1.0, "method", name, "") for name in CLASSICAL]


def tables(stored: dict[str, Any]) -> dict[str, str]:
    """Render what was measured: Markdown tables "methods", "stages", "networks" and "goals"."""
    records = stored["records"]
    medians = {(r["group"], r["name"], r["variant"]): r for r in records}
    return {
        "methods": _methods_table(medians),
        "stages": _stages_table(records),
        "networks": _networks_table(medians),
        "goals": _goals_table(medians),
    }


def _methods_table(medians: dict[tuple[str, str, str], dict[str, Any]]) -> str:
    lines = []
    for row in table1.rows_of(()):
        alone, whole = (medians.get(("method", row.method, variant)) for variant in ("", "with files"))
        paper = PAPER_S.get(row.method, "")
        if alone and whole:
            lines.append([row.title, _seconds(alone), _seconds(whole), paper])
        elif paper:
            lines.append([row.title, "not measured", "", paper])
    return table(["method", "s", "s, files read and written", "paper, s"], lines)


def _seconds(record: dict[str, Any]) -> str:
    return f"{record['median_s']:.3g} ± {record['iqr_s'] / 2:.1g}"


def _stages_table(records: list[dict[str, Any]]) -> str:
    return table(
        ["where", "stage", "ms"], [[r["name"], r["variant"], _ms(r)] for r in records if r["group"] == "stage"]
    )


def _networks_table(medians: dict[tuple[str, str, str], dict[str, Any]]) -> str:
    lines = []
    for (group, name, variant), record in medians.items():
        if group == "network":
            ready = medians.get(("ready", name, variant))
            lines.append([name, variant, _ms(record), f"{ready['median_s']:.1f}" if ready else ""])
    return table(["network", "variant", "ms", "s until it is ready"], lines)


def _ms(record: dict[str, Any]) -> str:
    return f"{1e3 * record['median_s']:.3g} ± {1e3 * record['iqr_s'] / 2:.1g}"


def _goals_table(medians: dict[tuple[str, str, str], dict[str, Any]]) -> str:
    lines = []
    for goal in goals():
        if record := medians.get((goal.group, goal.name, goal.variant)):
            judged = "reached" if record["median_s"] <= goal.limit_s else "missed"
            lines.append([goal.text, f"{goal.limit_s:g} s", f"{record['median_s']:.3g} s", judged])
    return table(["goal", "at most", "measured", ""], lines)


def load(folder: Path) -> dict[str, Any]:
    """Read what was stored."""
    return dict(json.loads((folder / TIMES).read_text(encoding="utf-8")))


# --- The command ----------------------------------------------------------------------------------


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Time everything."""
    methods = load_methods([name for name in arguments.method or METHODS if name not in NOT_TIMED])
    table1.make_pairs(arguments.pairs, arguments.sources, arguments.pictures, arguments.threads)
    paths = [pair.fisheye for pair in read_manifest(arguments.pairs)[: arguments.pictures]]
    watch, failures = Watch(), {}
    time_methods(watch, paths, methods)
    time_one_call(watch, paths)
    with torch.inference_mode():
        for name, make in networks().items():
            network = make()
            image = torch.rand(1, 3, network.longer_side, network.longer_side)
            time_stages(watch, name, network, image, arguments.turns)
            failures |= time_variants(watch, name, network, image, arguments.turns, arguments.compile)
    return {
        "date": date.today().isoformat(),
        "machine": machine(),
        "threads": arguments.threads,
        "torch": torch.__version__,
        "pictures": len(paths),
        "failures": failures,
        "records": watch.records(),
    }


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    number = table1.at_least_one
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=number, default=torch.get_num_threads())
    parser.add_argument("--pictures", type=number, default=FEWEST_PICTURES, help="how many the methods are timed on")
    parser.add_argument("--turns", type=number, default=20, help="of stages and networks")
    parser.add_argument("--method", type=table1.names, help="only these, separated by commas")
    parser.add_argument("--compile", action="store_true", help="torch.compile too")
    parser.add_argument("--pairs", type=Path, default=table1.WORK / "pairs")
    parser.add_argument("--sources", type=Path, default=table1.ROOT.parent / "shared" / "data" / "scenes")
    parser.add_argument("--out", type=Path, default=table1.RESULTS)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print and store."""
    parsed = parse(arguments)
    torch.set_num_threads(parsed.threads)
    cv2.setNumThreads(parsed.threads)
    try:
        stored = measure(parsed)
        parsed.out.mkdir(parents=True, exist_ok=True)
        write_text(parsed.out / TIMES, json.dumps(stored, indent=1) + "\n")
    except (ValueError, OSError, ImportError) as error:
        print(f"table2.py: {error}", file=sys.stderr)
        return 2
    print(f"{stored['machine']}, {stored['threads']} threads, torch {stored['torch']}, {stored['pictures']} pictures\n")
    print("\n\n".join(tables(stored).values()))
    for variant, reason in stored["failures"].items():
        print(f"table2.py: not measured: {variant}: {reason}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
