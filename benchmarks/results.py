"""Makes docs/results.md from what `table1.py` and `table2.py` stored, with a contact sheet of drawn scenes.

    python benchmarks/results.py --readme README.md

No photographs are needed: the sheet shows scenes of examples/scenes, which are drawn and judged here.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import table1
import table2
from pages import table, write_between_markers

import fisheyerec as fr
from fisheyerec.training.evaluate import Evaluation, evaluate_methods, load_methods
from fisheyerec.training.pairs import MANIFEST, camera_entry, write_png, write_text
from fisheyerec.training.reports import write_sheet

sys.path.insert(0, str(table1.ROOT / "examples"))
import scenes

COMMAND = "python benchmarks/results.py"
SIZE = (256, 256)
SHEET = "contact_sheet.jpg"
SHOWN = ("bukhari", "zhang", "rong", "aleman-flores", "network", "ours")

# scene, seed, projection, field of view across the width, principal point off the middle. As wide, and as far off, as
# the protocol's: corners are seen at up to 70 degrees.
DRAWN = (
    (scenes.room, 3, "equisolid", 94, (2.0, -3.0)),
    (scenes.street, 4, "equidistant", 95, (-3.0, 2.0)),
    (scenes.corridor, 1, "stereographic", 100, (1.0, 3.0)),
    (scenes.street, 7, "orthographic", 80, (-2.0, -2.0)),
)


# --- The contact sheet ----------------------------------------------------------------------------


def draw_pairs(folder: Path) -> None:
    """Draw the scenes through their lenses and straight, as a folder of pairs."""
    lines = []
    for number, (make, seed, projection, fov_deg, (x, y)) in enumerate(DRAWN):
        camera = fr.FisheyeCamera.from_projection(projection, fov_deg, SIZE)
        params = camera.params.copy()
        params[2:4] += x, y
        camera = fr.FisheyeCamera(params, SIZE)
        view = fr.PinholeCamera.edge_matched(camera, SIZE)
        entry: dict[str, Any] = {"labels": None, "kind": projection}
        for name, through in (("fisheye", camera), ("rectified", view)):
            entry[name] = f"{number}_{name}.png"
            picture = scenes.render_camera(make(seed), through.unproject, SIZE, supersample=3).image
            write_png(folder / entry[name], picture)
        lines.append(json.dumps(entry | {"camera": camera_entry(camera), "view": camera_entry(view)}) + "\n")
    write_text(folder / MANIFEST, "".join(lines))


def contact_sheet(path: Path, methods: list[str]) -> None:
    """Draw scenes, judge methods on them, and lay everything out like Fig. 3 of the paper."""
    with tempfile.TemporaryDirectory() as name:
        draw_pairs(Path(name))
        write_sheet(path, name, evaluate_methods(name, load_methods(methods)))


# --- The page -------------------------------------------------------------------------------------

PAGE = """# Results

Made by `{command}` from what `benchmarks/table1.py` and `benchmarks/table2.py` stored in
[results](results).

## Accuracy: Table 1

{sources} photographs of the validation split of `scenes`, {per_source} cameras each: {count} pictures of 256x256, by
`fisheyerec synthesize` (recipe "standard", seed {seed}). Each method sees one fisheye picture and gives a camera, which
rectifies it into the edge-matched view of that camera. PSNR and SSIM over the full frame; displacement is the mean
distance in fisheye pixels between where truth and estimate look for the same pixel. In brackets the 95 % bootstrap
interval over photographs. No estimate counts as doing nothing. {date}, {machine}.

{main}

What the numbers show, and what they do not:

- **The protocols differ.** The paper's figures are of a test set of its own (ADE20K photographs, its own distortions),
  and it does not say which focal length its rectified pictures have. Its columns are there for the order of the
  methods, not for their values.
- **The principal point costs most of it.** The protocol moves it by N(0, 3 px) each way. The true camera with the
  principal point in the middle is still {centred} px off, at {centred_psnr} dB: about there ends what a method can
  reach that tells the profile and nothing of the principal point, as the mean lens and, so far, the network do.
- **Straightness is judged, not the absolute field of view**, which no single photo tells: a lens and a field of view
  that scale tan theta together draw the same straight picture. The field of view stands in the table below.
- **Budgets are {budgets}**: the column "trained on" says which network a row has, and how many pictures it has seen.
  Rows of unequal budget are not to be compared for what the semantic branch is worth. One seed each.
- **The training set is small**: 2,161 photographs, 986 of them with labels, against the paper's 2,450 with 150 classes.
  No ImageNet weights to begin with.{untrained}
- **The test photographs are streets and facades**, some of them correlated frames of one video. Photographs are for
  research and non-commercial use, and not part of this project.
- The classical methods are written anew from their publications; each file in `fisheyerec/baselines/` says where it had
  to choose. Nobody's original code was run.

Against `{reference}`, picture by picture:

{differences}

By kind of lens (pictures): PSNR in dB, displacement.

{kinds}

Beside it. Over valid pixels a method that sees little is judged on little. mIoU: the true labels, rectified with the
estimate, against those rectified with the truth.

{beside}

Relative errors of the parameters, medians. k1..k4 are ill-conditioned: very different ones draw the same picture.

{parameters}
{skipped}
![Drawn scenes: input, ground truth, and what each method makes of it](results/{sheet})

Scenes drawn by `examples/scenes`, through lenses of the protocol's range; no photographs. They have more and
longer straight lines than the photographs that were measured.

## Run time: Table 2

Seconds for a picture of 256x256, medians over {pictures} pictures ± half the distance between quartiles: estimating and
rectifying, without and with reading a PNG and writing a JPEG. {times_date}, {times_machine}, {threads} threads, torch
{torch}. The paper's figures are of 2018's machines and of code that was never released.

{methods}

Networks alone, ms a forward pass: picture to lens, straight picture and straight parsing. Weights of `paper()` are
random, for the time only. Exported and compiled are the three networks within, trunk, parsing and estimation; the lens
between them decides by its values, and `torch.export` of the whole is refused. `torch.compile` (`--compile`) needs a
C++ compiler where it runs. The time until a variant is ready includes its first pass, and is paid once a process.

{networks}
{failures}
Where our time goes, in ms: the stages of a forward pass, the rectification layer with our op and with grid_sample
(`fisheyerec.reference`) in its place, and what the one call does beside the network. Judging how straight lines are is
not needed to rectify: the one call tells it beside the camera.

{stages}

{goals}
"""


_UNTRAINED = " Nothing here tells what `FishEyeRecNet.paper()` would reach."


def page(evaluation: Evaluation, setting: dict[str, Any], times: dict[str, Any]) -> str:
    """Render the page."""
    summary = evaluation.summary()["methods"]
    centred = summary.get("oracle-centred", {"displacement_px": None, "psnr": None})
    seen = {(on["network"], on["pictures"]) for on in setting["trained_on"].values() if on}
    failures = [f"- not measured: {variant}: {reason}" for variant, reason in times["failures"].items()]
    skipped = f"\n{len(evaluation.skipped)} of {evaluation.count} pairs could not be read.\n"
    return PAGE.format(
        command=COMMAND,
        sources=len({result.source for result in evaluation.results}),
        per_source=table1.CAMERAS_PER_SOURCE,
        count=evaluation.count,
        seed=table1.SEED,
        date=setting["date"],
        machine=setting["machine"],
        centred=_known(centred["displacement_px"], ".1f"),
        centred_psnr=_known(centred["psnr"], ".1f"),
        untrained="" if "paper" in dict(seen) else _UNTRAINED,
        budgets="equal" if len(seen) <= 1 else "not equal",
        reference=table1.REFERENCE,
        skipped=skipped if evaluation.skipped else "",
        sheet=SHEET,
        pictures=times["pictures"],
        times_date=times["date"],
        times_machine=times["machine"],
        threads=times["threads"],
        torch=times["torch"],
        failures="\n" + "\n".join(failures) + "\n" if failures else "",
        **table1.tables(evaluation, setting),
        **table2.tables(times),
    )


def _known(value: float | None, form: str) -> str:
    return "(not measured)" if value is None else f"{value:{form}}"


def readme_table(evaluation: Evaluation, times: dict[str, Any]) -> str:
    """Render what a newcomer asks for: how good, how fast."""
    summary = evaluation.summary()["methods"]
    seconds = {r["name"]: r["median_s"] for r in times["records"] if (r["group"], r["variant"]) == ("method", "")}
    lines = []
    for row in table1.rows_of(summary):
        if row.method in summary:
            figures = [table1.interval(summary[row.method], m, f) for m, f in (("psnr", ".2f"), ("ssim", ".3f"))]
            figures.append(table1.interval(summary[row.method], "displacement_px", ".2f"))
            lines.append([row.title, *figures, f"{seconds[row.method]:.3g}" if row.method in seconds else ""])
    return table(["method", "PSNR, dB", "SSIM", "displacement, px", "s a picture"], lines)


def main(arguments: list[str] | None = None) -> int:
    """Draw the sheet and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=table1.RESULTS, help="where the tables are stored")
    parser.add_argument("--page", type=Path, help="the folder's name with .md, beside it, if left out")
    parser.add_argument("--readme", type=Path, help="renew the table between the markers of this file")
    parsed = parser.parse_args(arguments)
    try:
        evaluation, setting = table1.load(parsed.results)
        times = table2.load(parsed.results)
        contact_sheet(parsed.results / SHEET, [name for name in SHOWN if name in evaluation.methods])
        write_text(parsed.page or parsed.results.with_suffix(".md"), page(evaluation, setting, times))
        if parsed.readme is not None:
            write_between_markers(parsed.readme, COMMAND, readme_table(evaluation, times))
    except (ValueError, OSError, ImportError) as error:
        print(f"results.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
