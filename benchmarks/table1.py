"""Table 1 of the paper on an open protocol: every method over the same synthetic pairs.

    python benchmarks/table1.py --jobs 2 --weights "ours -SL=runs/sl/best.safetensors"

Makes the test set, unless it is there, as `fisheyerec synthesize ../shared/data/scenes --sources 100 --split validation
--seed 1` does, judges the methods as `fisheyerec evaluate` does, and stores one row a picture and method in
docs/results. A run that was killed goes on by the same command; `benchmarks/results.py` makes the page.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Iterator
from datetime import date
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pages import machine, table

from fisheyerec.training.evaluate import METHODS, Evaluation, PictureResult, values_of
from fisheyerec.training.judging import judge_folder
from fisheyerec.training.metrics import bootstrap_interval
from fisheyerec.training.pairs import MANIFEST, write_text
from fisheyerec.training.records import read_records, write_records
from fisheyerec.training.sources import Sources
from fisheyerec.training.synthesis import SyntheticPairs
from fisheyerec.training.writing import write_pairs
from fisheyerec.weights import read_notes

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
WORK = ROOT / "build" / "table1"
RECORDS, SETTING = "table1.csv.gz", "table1.json"

SOURCES, CAMERAS_PER_SOURCE = 100, 10
SEED = 1  # the first pairs of seed 0 were looked at while methods were made
KINDS = ("stereographic", "equidistant", "equisolid", "orthographic", "profile")


class Row(NamedTuple):
    """A row of the table."""

    method: str
    """Its name for `--method`."""
    title: str
    paper: tuple[float, float] | None = None
    """PSNR and SSIM of Table 1 in the paper."""
    weights: str | None = None
    """The file within the package that it was trained into."""


REFERENCE = "network"
"""What the others are compared with, picture by picture."""

ROWS = (
    Row("identity", "do nothing"),
    Row("mean-lens", "the mean lens for every picture"),
    Row("bukhari", "Bukhari and Dailey 2013", (11.47, 0.2429)),
    Row("rong", "Rong et al. 2016", (13.08, 0.3356), "baselines/rong.safetensors"),
    Row("zhang", "Zhang et al. 2015", (12.52, 0.2972)),
    Row("aleman-flores", "Alemán-Flores et al. 2014"),
    Row("lines", "ours, lines alone"),
    Row("ours -SPN -SL", "ours -SPN -SL", (14.39, 0.3903)),
    Row("ours -SL", "ours -SL", (14.47, 0.3932)),
    Row(REFERENCE, "ours, network alone", (14.96, 0.4129), "pretrained.safetensors"),
    Row("ours", "ours with refinement on lines", None, "pretrained.safetensors"),
    Row("oracle-centred", "true camera, principal point in the middle"),
    Row("oracle", "true camera"),
)


def rows_of(methods: Iterable[str]) -> list[Row]:
    """Give all rows of ROWS, and before the true cameras one for each further method."""
    known = {row.method for row in ROWS}
    further = [Row(method, method) for method in methods if method not in known]
    place = [row.method for row in ROWS].index("oracle-centred")
    return [*ROWS[:place], *further, *ROWS[place:]]


# --- Measuring ------------------------------------------------------------------------------------


def make_pairs(folder: Path, sources: Path, count: int, jobs: int) -> None:
    """Make the first pairs of the test set, where they are not there yet.

    Raises:
        ValueError: neither sources nor pairs, or pairs that were made in another way.
        OSError: a folder that cannot be written to.
    """
    if not sources.is_dir() and (folder / MANIFEST).exists():
        return
    pairs = SyntheticPairs(
        Sources.open(sources, split="validation"),
        split="validation",
        seed=SEED,
        cameras_per_source=CAMERAS_PER_SOURCE,
    )
    written = write_pairs(pairs, folder, min(count, len(pairs)), jobs=jobs, resume=True)
    for message in written.failures.values():
        print(f"table1.py: {message}", file=sys.stderr)


def trained_on(row: Row, weights: dict[str, Path]) -> dict[str, Any] | None:
    """Tell which network a row has and how many pictures it was trained on; None for one without weights."""
    path = weights.get(row.method)
    if path is None and row.weights is not None:
        path = Path(str(files("fisheyerec") / row.weights))
    if path is None or not path.exists():
        return None
    notes = read_notes(path)
    return {"network": notes["options"]["network"], "pictures": notes["log"]["pictures"]}


def measure(arguments: argparse.Namespace) -> tuple[Evaluation, dict[str, Any]]:
    """Judge what was asked for; what came out, and how."""
    weights = dict(arguments.weights)
    rows = rows_of(weights)
    methods = arguments.method or [row.method for row in rows if row.method in METHODS or row.method in weights]
    count = arguments.limit or SOURCES * CAMERAS_PER_SOURCE
    make_pairs(arguments.pairs, arguments.sources, count, arguments.jobs)
    start, pictures = time.monotonic(), 0

    def on_picture(total: int) -> None:
        nonlocal pictures
        pictures += 1
        if pictures % 20 == 0 or pictures == total:
            print(f"{pictures} of {total} pictures, {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)

    evaluation = judge_folder(
        arguments.pairs,
        methods,
        arguments.records,
        weights=weights,
        jobs=arguments.jobs,
        limit=count,
        on_picture=on_picture,
    )
    setting = {
        "date": date.today().isoformat(),
        "machine": machine(),
        "skipped": evaluation.skipped,
        "trained_on": {row.method: trained_on(row, weights) for row in rows if row.method in methods},
    }
    return evaluation, setting


def store(folder: Path, evaluation: Evaluation, setting: dict[str, Any]) -> None:
    """Store all that the page is made from."""
    folder.mkdir(parents=True, exist_ok=True)
    write_records(folder / RECORDS, evaluation.results)
    write_text(folder / SETTING, json.dumps(setting, indent=1) + "\n")


def load(folder: Path) -> tuple[Evaluation, dict[str, Any]]:
    """Read what `store` stored.

    Raises:
        ValueError: other or broken files.
        OSError: a file cannot be read.
    """
    results = read_records(folder / RECORDS)
    setting = json.loads((folder / SETTING).read_text(encoding="utf-8"))
    methods = list(dict.fromkeys(result.method for result in results))
    count = len({result.picture for result in results}) + len(setting["skipped"])
    return Evaluation(methods, count, results, setting["skipped"]), setting


# --- Rendering ------------------------------------------------------------------------------------


def tables(evaluation: Evaluation, setting: dict[str, Any]) -> dict[str, str]:
    """Render what was measured: Markdown tables "main", "differences", "kinds", "beside" and "parameters"."""
    summary = evaluation.summary()["methods"]
    rows = rows_of(evaluation.methods)
    measured = [row for row in rows if row.method in summary]
    return {
        "main": main_table(rows, summary, setting["trained_on"]),
        "differences": differences_table(measured, evaluation),
        "kinds": kinds_table(measured, evaluation),
        "beside": beside_table(measured, summary),
        "parameters": parameters_table(measured, summary),
    }


def main_table(rows: list[Row], summary: dict[str, Any], trained: dict[str, Any]) -> str:
    """Render the paper's Table 1: measured here, and the paper's own figures."""
    heads = [
        "method",
        "trained on",
        "PSNR, dB",
        "SSIM",
        "displacement, px",
        "no estimate",
        "paper: PSNR",
        "paper: SSIM",
    ]
    lines = []
    for row in rows:
        paper = [f"{row.paper[0]:.2f}", f"{row.paper[1]:.4f}"] if row.paper else ["", ""]
        if row.method not in summary:
            if row.paper:  # a row of the paper shows that it is missing
                lines.append([row.title, "", "not measured", "", "", "", *paper])
            continue
        figures = summary[row.method]
        seen = trained.get(row.method)
        lines.append(
            [
                row.title,
                f"{seen['network']}, {seen['pictures']:,} pictures" if seen else "",
                interval(figures, "psnr", ".2f"),
                interval(figures, "ssim", ".3f"),
                interval(figures, "displacement_px", ".2f"),
                _missed(row, figures),
                *paper,
            ]
        )
    return table(heads, lines)


def _missed(row: Row, figures: dict[str, Any]) -> str:
    """Tell how often there was no estimate, of those how often because the method failed."""
    if row.method == "identity":
        return ""
    failed = f" ({figures['failed']} failed)" if figures["failed"] else ""
    return f"{figures['no_estimate']} of {figures['count']}{failed}"


def interval(figures: dict[str, Any], measure: str, form: str) -> str:
    """Render a mean with its 95 % interval."""
    if figures[measure] is None:
        return ""
    low, high = figures["intervals"][measure]
    return f"{figures[measure]:{form}} [{low:{form}}, {high:{form}}]"


def differences_table(rows: list[Row], evaluation: Evaluation) -> str:
    """Render the mean difference to REFERENCE over the same pictures, with its 95 % interval over sources."""
    by_picture = {result.picture: result for result in evaluation.of(REFERENCE)}
    lines = []
    for row in rows:
        results = [result for result in evaluation.of(row.method) if result.picture in by_picture]
        if row.method == REFERENCE or not results:
            continue
        references = [by_picture[result.picture] for result in results]
        cells = _differences(results, references, (("psnr", "+.2f"), ("ssim", "+.3f"), ("displacement_px", "+.2f")))
        lines.append([row.title, *cells])
    return table(["method", "PSNR, dB", "SSIM", "displacement, px"], lines)


def _differences(
    results: list[PictureResult], references: list[PictureResult], measures: Iterable[tuple[str, str]]
) -> Iterator[str]:
    sources = [result.source for result in results]
    for measure, form in measures:
        differences = values_of(results, measure) - values_of(references, measure)
        low, high = bootstrap_interval(differences, sources)
        yield f"{np.nanmean(differences):{form}} [{low:{form}}, {high:{form}}]"


def kinds_table(rows: list[Row], evaluation: Evaluation) -> str:
    """Render PSNR and displacement by kind of lens."""
    summary = evaluation.summary()["methods"]
    counts = {kind: max(summary[r.method]["kinds"].get(kind, {"count": 0})["count"] for r in rows) for kind in KINDS}
    kinds = [kind for kind in KINDS if counts[kind]]
    heads = [f"{'real profiles' if kind == 'profile' else kind} ({counts[kind]})" for kind in kinds]
    lines = []
    for row in rows:
        of_kind = summary[row.method]["kinds"]
        cells = [f"{interval(of_kind[k], 'psnr', '.1f')}, {of_kind[k]['displacement_px']:.2f} px" for k in kinds]
        lines.append([row.title, *cells])
    return table(["method", *heads], lines)


def beside_table(rows: list[Row], summary: dict[str, Any]) -> str:
    """Render the further measures."""
    measures = {
        "psnr_valid": ("PSNR where valid, dB", ".2f"),
        "ssim_valid": ("SSIM where valid", ".3f"),
        "displacement_median_px": ("median displacement, px", ".2f"),
        "label_miou": ("mIoU of labels", ".3f"),
        "fov_error_deg": ("field of view off by, degrees", ".1f"),
    }
    lines = []
    for row in rows:
        values = {name: summary[row.method][name] for name in measures}
        cells = ["" if values[name] is None else f"{values[name]:{form}}" for name, (_, form) in measures.items()]
        lines.append([row.title, *cells])
    return table(["method", *(head for head, _ in measures.values())], lines)


def parameters_table(rows: list[Row], summary: dict[str, Any]) -> str:
    """Render the median relative errors of the parameters."""
    lines = []
    for row in rows:
        errors = summary[row.method]["parameter_errors"]
        if any(error is not None for error in errors.values()):
            lines.append([row.title, *("" if error is None else f"{error:.3f}" for error in errors.values())])
    return table(["method", *summary[rows[0].method]["parameter_errors"]], lines)


# --- The command ----------------------------------------------------------------------------------


def named_path(text: str) -> tuple[str, Path]:
    """Read NAME=PATH."""
    name, separator, path = text.partition("=")
    if not (separator and name.strip() and path):
        raise argparse.ArgumentTypeError(f"expected NAME=PATH, got {text!r}")
    return name.strip(), Path(path)


def names(text: str) -> list[str]:
    """Read names that are separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def at_least_one(text: str) -> int:
    """Read a positive number."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number of at least 1, got {text!r}")
    return int(text)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=Path, default=WORK / "pairs", help="the test set, made if need be")
    parser.add_argument("--sources", type=Path, default=ROOT.parent / "shared" / "data" / "scenes")
    parser.add_argument("--records", type=Path, default=WORK / "records.csv", help="grows picture by picture")
    parser.add_argument("--method", type=names, help="only these, separated by commas")
    parser.add_argument(
        "--weights", type=named_path, action="append", default=[], help="a trained network by this name: NAME=PATH"
    )
    parser.add_argument("--limit", type=at_least_one, help="only the first so many pictures")
    parser.add_argument("--jobs", type=at_least_one, default=1, help="processes, of one thread each where several")
    parser.add_argument("--out", type=Path, help="docs/results; with --limit nowhere unless told")
    parsed = parser.parse_args(arguments)
    if parsed.out is None and parsed.limit is None:
        parsed.out = RESULTS
    return parsed


def main(arguments: list[str] | None = None) -> int:
    """Measure, print and store."""
    parsed = parse(arguments)
    try:
        evaluation, setting = measure(parsed)
        if parsed.out is not None:
            store(parsed.out, evaluation, setting)
    except (ValueError, OSError, ImportError) as error:
        print(f"table1.py: {error}", file=sys.stderr)
        return 2
    for name, reason in evaluation.skipped.items():
        print(f"table1.py: skipped {name}: {reason}", file=sys.stderr)
    if not evaluation.results:
        print(f"table1.py: none of {evaluation.count} pairs could be read", file=sys.stderr)
        return 2
    print("\n\n".join(tables(evaluation, setting).values()))
    print("\ns a picture, of one core where there are several jobs")
    for method in evaluation.methods:
        print(f"{method}: {np.mean([result.ms for result in evaluation.of(method)]) / 1e3:.3f}")
    return 1 if evaluation.skipped else 0


if __name__ == "__main__":
    sys.exit(main())
