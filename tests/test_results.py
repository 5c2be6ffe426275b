"""The tables of the paper: what is stored comes back as Markdown, and what cannot be measured is said."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import fisheyerec as fr
from fisheyerec.training.evaluate import Evaluation, PictureResult, evaluate_methods, load_methods
from fisheyerec.training.pairs import MANIFEST, camera_entry, write_png
from fisheyerec.training.records import read_records, write_records

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import pages  # noqa: E402
import results  # noqa: E402
import table1  # noqa: E402
import table2  # noqa: E402


def result(number, method, psnr, *, estimated=True, error=None):
    """Of picture `number`; each two of a source, kinds in turn."""
    return PictureResult(
        picture=f"{number:06d}_fisheye.png",
        source=f"s{number // 2}",
        kind=table1.KINDS[number % 5],
        method=method,
        params=np.arange(1.0, 9) if estimated else None,
        error=error,
        ms=1.0,
        psnr=psnr,
        ssim=psnr / 40,
        psnr_valid=psnr + 1,
        ssim_valid=psnr / 39,
        valid=1.0,
        displacement_px=(30 - psnr) / 2,
        displacement_median_px=(30 - psnr) / 3,
        label_miou=0.7,
        fov_error_deg=-3.0 if estimated else float("nan"),
        parameter_errors=dict.fromkeys(fr.FisheyeCamera.parameter_names, 0.25 if estimated else float("nan")),
    )


@pytest.fixture
def stored(tmp_path):
    """A folder of results: ten pictures, five methods, one of which fails on two pictures and gives up on one more."""
    measured = []
    for number in range(10):
        measured += [
            result(number, "identity", 17.0, estimated=False),
            result(number, "bukhari", 16.0, estimated=number > 2, error="ValueError: no" if number < 2 else None),
            result(number, "network", 19.0 + number % 2),
            result(number, "wide", 18.5),
            result(number, "oracle-centred", 20.0),
        ]
    setting = {
        "date": "2026-01-02",
        "machine": "a machine",
        "skipped": {"lost.png": "gone"},
        "trained_on": {
            "identity": None,
            "network": {"network": "compact", "pictures": 112000},
            "wide": {"network": "paper", "pictures": 24000},
        },
    }
    methods = ["identity", "bukhari", "network", "wide", "oracle-centred"]
    table1.store(tmp_path, Evaluation(methods, 11, measured, setting["skipped"]), setting)
    compact, paper = table2.networks()
    times = table2.Watch()
    for turn in range(5):
        times.add("method", "network", "", 0.04 + 0.01 * turn)
        times.add("method", "network", "with files", 0.07)
        times.add("method", "bukhari", "", 1.5)
        times.add("method", "bukhari", "with files", 1.6)
        times.add("network", paper, "float32", 0.5)
        times.add("network", compact, "float32", 0.02)
        times.add("stage", compact, "trunk", 0.011)
    times.add("ready", compact, "float32", 1.25)
    table = {"date": "2026-01-02", "machine": "a machine", "threads": 2, "torch": "2.13", "pictures": 50}
    table |= {"failures": {"paper, torch.compile": "no compiler"}, "records": times.records()}
    (tmp_path / table2.TIMES).write_text(json.dumps(table))
    return tmp_path


def cells(table, title):
    """The cells of the row that begins so."""
    (line,) = [line for line in table.splitlines() if line.startswith(f"| {title} |")]
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def heads(table):
    return [cell.strip() for cell in table.splitlines()[0].strip("|").split("|")]


def test_every_table_is_a_table(stored):
    for tables in (table1.tables(*table1.load(stored)), table2.tables(table2.load(stored))):
        for text in tables.values():
            first, rule, *rows = text.splitlines()
            assert set(rule) <= set("|- ")
            assert rows
            assert {line.count("|") for line in (rule, *rows)} == {first.count("|")}


def test_table_1_shows_what_was_measured_beside_the_paper(stored):
    main = table1.tables(*table1.load(stored))["main"]
    trained, psnr, ssim, displacement, missed, *paper = cells(main, "ours, network alone")
    assert trained == "compact, 112,000 pictures"
    assert psnr == "19.50 [19.50, 19.50]"  # each source has both pictures: between sources nothing varies
    assert ssim.startswith("0.487 ")
    assert displacement.startswith("5.25 ")
    assert (missed, paper) == ("0 of 10", ["14.96", "0.4129"])
    assert cells(main, "Bukhari and Dailey 2013")[4:] == ["3 of 10 (2 failed)", "11.47", "0.2429"]
    assert cells(main, "Zhang et al. 2015") == ["", "not measured", "", "", "", "12.52", "0.2972"]
    assert cells(main, "wide")[0] == "paper, 24,000 pictures"
    assert cells(main, "do nothing")[4] == ""
    assert not any(line.startswith("| true camera |") for line in main.splitlines())


def test_the_other_tables_of_accuracy(stored):
    tables = table1.tables(*table1.load(stored))
    assert cells(tables["differences"], "Bukhari and Dailey 2013")[0] == "-3.50 [-3.50, -3.50]"
    assert cells(tables["differences"], "true camera, principal point in the middle")[2] == "-0.25 [-0.25, -0.25]"
    assert "ours, network alone" not in tables["differences"]
    assert heads(tables["kinds"])[1:] == [
        "stereographic (2)",
        "equidistant (2)",
        "equisolid (2)",
        "orthographic (2)",
        "real profiles (2)",
    ]
    assert cells(tables["kinds"], "do nothing") == ["17.0 [17.0, 17.0], 6.50 px"] * 5
    assert cells(tables["beside"], "wide") == ["19.50", "0.474", "3.83", "0.700", "3.0"]
    assert cells(tables["beside"], "do nothing")[-1] == ""
    assert cells(tables["parameters"], "wide") == ["0.250"] * 8
    assert "do nothing" not in tables["parameters"]


def test_table_2_judges_its_goals(stored):
    tables = table2.tables(table2.load(stored))
    assert cells(tables["methods"], "ours, network alone") == ["0.06 ± 0.01", "0.07 ± 0", "1.31 (K80)"]
    assert cells(tables["methods"], "Zhang et al. 2015") == ["not measured", "", "80.07 (Intel i5-4200U)"]
    assert cells(tables["goals"], "paper() in float32") == ["0.65 s", "0.5 s", "reached"]
    assert cells(tables["goals"], "compact, the network itself") == ["0.06 s", "0.02 s", "reached"]
    assert cells(tables["goals"], "bukhari, classical") == ["1 s", "1.5 s", "missed"]
    assert "bfloat16" not in tables["goals"]
    assert "| compact (shipped) | float32 | 20 ± 0 | 1.2 |" in tables["networks"]
    assert "trunk | 11 ± 0 |" in tables["stages"]


def test_the_page_says_what_it_is_made_of(stored):
    page = results.page(*table1.load(stored), table2.load(stored))
    assert "middle is still 5.0 px off, at 20.0 dB" in page
    assert "Budgets are not equal" in page
    assert "would reach" not in page
    assert "1 of 11 pairs could not be read" in page
    assert "- not measured: paper, torch.compile: no compiler" in page
    evaluation, setting = table1.load(stored)
    setting["trained_on"]["wide"] = setting["trained_on"]["network"]
    evaluation.skipped = {}
    evaluation.results = [r for r in evaluation.results if r.method != "oracle-centred"]
    evaluation.methods.remove("oracle-centred")
    page = results.page(evaluation, setting, table2.load(stored))
    assert "Budgets are equal" in page
    assert "would reach" in page
    assert "could not be read" not in page
    assert "still (not measured) px off" in page


def test_the_page_is_written_beside_its_results(stored, monkeypatch):
    shown = []
    monkeypatch.setattr(results, "contact_sheet", lambda path, methods: shown.append((path, methods)))
    readme = stored / "README.md"
    readme.write_text(f"before\n<!-- made by: {results.COMMAND} -->\nold\n<!-- end -->\nafter\n")
    assert results.main(["--results", str(stored), "--readme", str(readme)]) == 0
    assert shown == [(stored / "contact_sheet.jpg", ["bukhari", "network"])]
    assert stored.with_suffix(".md").read_text().startswith("# Results")
    text = readme.read_text()
    assert "old" not in text
    assert text.startswith("before\n")
    assert text.endswith("<!-- end -->\nafter\n")
    assert cells(text, "ours, network alone")[-1] == "0.06"


def test_the_sheet_shows_drawn_scenes_with_their_truth(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "SIZE", (48, 48))
    monkeypatch.setattr(results, "DRAWN", results.DRAWN[2:3])
    results.draw_pairs(tmp_path)
    (truth,) = evaluate_methods(tmp_path, load_methods(["oracle"])).results
    (nothing,) = evaluate_methods(tmp_path, load_methods(["identity"])).results
    assert truth.psnr > nothing.psnr + 5
    assert (truth.kind, truth.error) == ("stereographic", None)
    results.contact_sheet(tmp_path / "sheet.jpg", ["identity", "mean-lens"])
    assert (tmp_path / "sheet.jpg").exists()


# --- Commands -------------------------------------------------------------------------------------


@pytest.fixture
def pairs(tmp_path):
    """Three plain pairs, of two sources."""
    folder = tmp_path / "pairs"
    folder.mkdir()
    camera = fr.FisheyeCamera.from_projection("equidistant", 120, (40, 40))
    lines = []
    for number in range(3):
        pixels = np.random.default_rng(number).integers(0, 256, (40, 40, 3), dtype=np.uint8)
        write_png(folder / f"{number}.png", pixels)
        entry = {"fisheye": f"{number}.png", "rectified": f"{number}.png", "labels": None, "source": f"s{number // 2}"}
        entry |= {"camera": camera_entry(camera), "kind": "equidistant"}
        entry["view"] = camera_entry(fr.PinholeCamera.edge_matched(camera, (40, 40)))
        lines.append(json.dumps(entry))
    (folder / MANIFEST).write_text("\n".join(lines))
    return folder


def table1_arguments(pairs, *more):
    folder = pairs.parent
    paths = {"--pairs": pairs, "--sources": folder / "none", "--records": folder / "records.csv"}
    return [str(word) for item in paths.items() for word in item] + list(map(str, more))


def test_table_1_goes_on_and_ends_the_same(pairs, capsys):
    out = pairs.parent / "out"
    arguments = table1_arguments(pairs, "--method", "identity,oracle,mean-lens", "--out", out)
    assert table1.main(arguments) == 0
    assert "| true camera |" in capsys.readouterr().out
    whole, records = (out / table1.RECORDS).read_bytes(), (pairs.parent / "records.csv").read_text()
    (pairs.parent / "records.csv").write_text(records[: len(records) // 2])
    (out / table1.RECORDS).unlink()
    assert table1.main(arguments) == 0
    assert [r.psnr for r in read_records(out / table1.RECORDS)] == [r.psnr for r in table1.load(out)[0].results]
    assert table1.main(arguments) == 0
    untimed = []
    for content in (whole, (out / table1.RECORDS).read_bytes()):
        (out / "some.csv.gz").write_bytes(content)
        records = read_records(out / "some.csv.gz")
        write_records(out / "some.csv", [PictureResult(**vars(r) | {"ms": 0.0}) for r in records])
        untimed.append((out / "some.csv").read_text())
    assert untimed[0] == untimed[1]


def test_a_part_of_the_test_set_is_not_stored_unless_told(pairs):
    assert table1.parse([]).out == table1.RESULTS
    assert table1.parse(["--limit", "20"]).out is None
    assert table1.parse(["--limit", "20", "--out", "x"]).out == Path("x")


def test_weights_are_named(pairs):
    parsed = table1.parse(
        ["--weights", "ours -SL=a=b.safetensors", "--weights", "other=c", "--method", " oracle, lines,"]
    )
    assert parsed.weights == [("ours -SL", Path("a=b.safetensors")), ("other", Path("c"))]
    assert parsed.method == ["oracle", "lines"]
    rows = [row.method for row in table1.rows_of(dict(parsed.weights))]
    assert rows.index("ours") < rows.index("other") < rows.index("oracle-centred")
    shipped = next(row for row in table1.ROWS if row.method == "network")
    assert table1.trained_on(shipped, {})["network"] == "compact"
    assert table1.trained_on(table1.Row("identity", "do nothing"), {}) is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--weights", "path"], "expected NAME=PATH, got 'path'"),
        (["--weights", "=path"], "expected NAME=PATH"),
        (["--limit", "0"], "expected a number of at least 1, got '0'"),
        (["--jobs", "many"], "expected a number of at least 1, got 'many'"),
    ],
)
def test_arguments_that_are_refused(arguments, message, capsys):
    with pytest.raises(SystemExit) as stop:
        table1.parse(arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def one_line(capsys):
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text


def test_table_1_says_in_one_line_what_is_wrong(pairs, capsys):
    assert table1.main(table1_arguments(pairs, "--method", "magic")) == 2
    assert one_line(capsys).startswith("table1.py: expected methods out of identity, ")
    assert table1.main(table1_arguments(pairs, "--method", "own", "--weights", "own=nowhere.safetensors")) == 2
    assert "nowhere.safetensors" in one_line(capsys)
    assert table1.main(table1_arguments(pairs.parent / "empty", "--method", "oracle")) == 2
    assert "expected a folder of pictures" in one_line(capsys)


def test_table_1_counts_what_it_skipped(pairs, capsys):
    (pairs / "1.png").unlink()
    assert table1.main(table1_arguments(pairs, "--method", "oracle", "--limit", "3")) == 1
    assert "table1.py: skipped 1.png: " in capsys.readouterr().err
    for number in (0, 2):
        (pairs / f"{number}.png").write_bytes(b"")
    (pairs.parent / "records.csv").unlink()
    assert table1.main(table1_arguments(pairs, "--method", "oracle", "--limit", "3")) == 2
    assert "none of 3 pairs could be read" in capsys.readouterr().err


def test_the_page_says_in_one_line_what_is_wrong(stored, capsys):
    (stored / table2.TIMES).unlink()
    assert results.main(["--results", str(stored)]) == 2
    assert one_line(capsys).startswith("results.py: ")
    (stored / table1.RECORDS).write_bytes(b"none")
    assert results.main(["--results", str(stored)]) == 2
    assert table1.RECORDS in one_line(capsys)


# --- Times ----------------------------------------------------------------------------------------


def test_a_twin_computes_the_same_with_other_parts():
    torch.manual_seed(0)
    network = fr.FishEyeRecNet.compact(4).eval()
    parts = dict(network.named_children())
    image = torch.rand(1, 3, 64, 64)
    with torch.inference_mode():
        there = network(image)
        for variant in ("float32", "float32, weights channels_last"):
            precision, change = table2.VARIANTS[variant]
            twin = table2._twin(network, image, change)
            there_again = table2._forward(twin, image, precision)
            torch.testing.assert_close(there_again.estimate.chart, there.estimate.chart, rtol=0, atol=1e-4)
        half = table2._twin(network, image, table2._weights_in_bfloat16)
        assert table2._forward(half, image, torch.bfloat16).image.shape == (1, 3, 64, 64)
    assert dict(network.named_children()) == parts
    assert {p.dtype for p in network.parameters()} == {torch.float32}
    assert {p.dtype for p in half.parameters()} == {torch.bfloat16}


def test_a_variant_that_cannot_be_made_is_named(monkeypatch):
    def refuse(part):
        raise RuntimeError("no\ncompiler")

    monkeypatch.setattr(table2, "VARIANTS", {"refused": (torch.float32, refuse)})
    watch, network = table2.Watch(), fr.FishEyeRecNet.compact(4).eval()
    with torch.inference_mode():
        failures = table2.time_variants(watch, "compact", network, torch.rand(1, 3, 64, 64), 1, True)
    assert failures == {"compact, refused": "RuntimeError: no compiler"}
    assert watch.records() == []


def test_markers_that_are_not_there_are_an_error(tmp_path):
    (tmp_path / "page.md").write_text("nothing here")
    with pytest.raises(ValueError, match="expected"):
        pages.write_between_markers(tmp_path / "page.md", "a command", "text")
