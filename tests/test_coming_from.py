"""The pages for users of other tools: each pair of snippets agrees as closely as it says, each "yes" shows where."""

from __future__ import annotations

import re
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import torch
from markdown_links import anchor_of

import fisheyerec as fr
from fisheyerec.cli import app

DOCS = Path(__file__).resolve().parents[1] / "docs"
EXAMPLES = DOCS.parent / "examples"

# Page -> how it names the other side.
PAGES = {"coming-from-opencv.md": "OpenCV", "coming-from-kornia.md": "kornia"}
COMPARISON = "compare.md"

BLOCK = re.compile(r"^```python\n# (\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
AGREEMENT = re.compile(r"^Agreement: (\S+) (px|grey levels|% of pixels|relative)\b", re.MULTILINE)


def read(page: str) -> str:
    return (DOCS / page).read_text(encoding="utf-8")


# --- Pairs of snippets ----------------------------------------------------------------------------


class Pair(NamedTuple):
    """A section of a page."""

    setup: str
    theirs: str
    ours: str
    tolerance: float
    unit: str


def pairs(page: str) -> dict[str, Pair]:
    """Heading -> pair, of every section that holds code."""
    opening, *sections = re.split(r"^## ", read(page), flags=re.MULTILINE)
    setup = dict(BLOCK.findall(opening))["setup"]
    found = {}
    for heading, text in (section.split("\n", 1) for section in sections):
        if blocks := dict(BLOCK.findall(text)):
            [(tolerance, unit)] = AGREEMENT.findall(text)
            found[heading] = Pair(setup, blocks[PAGES[page]], blocks["fisheyerec"], float(tolerance), unit)
    return found


def result_of(setup: str, code: str) -> np.ndarray:
    names: dict[str, Any] = {}
    exec(setup, names)
    exec(code, names)
    result = names["result"]
    return np.asarray(result.detach() if isinstance(result, torch.Tensor) else result, dtype=np.float64)


def difference(theirs: np.ndarray, ours: np.ndarray, unit: str) -> float:
    """The largest difference, or the share of pixels that differ, in the unit; infinite where one alone is NaN."""
    assert theirs.shape == ours.shape
    assert theirs.size
    if unit == "% of pixels":
        return float(100 * (theirs != ours).mean())
    both_unknown = np.isnan(theirs) & np.isnan(ours)
    largest = float(np.where(both_unknown, 0, np.nan_to_num(np.abs(theirs - ours), nan=np.inf)).max())
    return largest / float(np.nanmax(np.abs(theirs))) if unit == "relative" else largest


PAIRS = [(page, heading) for page in PAGES for heading in pairs(page)]


@pytest.mark.parametrize(("page", "heading"), PAIRS, ids=[heading for _, heading in PAIRS])
def test_both_sides_agree_as_closely_as_the_page_says(page, heading, tmp_path, monkeypatch):
    pair = pairs(page)[heading]
    if PAGES[page] == "kornia":
        pytest.importorskip("kornia")
    if "cv2.omnidir" in pair.theirs and not hasattr(cv2, "omnidir"):
        pytest.skip("cv2.omnidir comes with opencv-contrib-python-headless, in the place of opencv-python-headless")
    (tmp_path / "examples").symlink_to(EXAMPLES)
    monkeypatch.chdir(tmp_path)
    theirs, ours = result_of(pair.setup, pair.theirs), result_of(pair.setup, pair.ours)
    assert difference(theirs, ours, pair.unit) <= pair.tolerance


@pytest.mark.parametrize("page", PAGES)
def test_the_table_of_tasks_lists_the_sections(page):
    listed = re.findall(r"^\| \[(.+?)\]\(#(.+?)\)", read(page), re.MULTILINE)
    assert [task for task, _ in listed] == list(pairs(page))
    assert [anchor for _, anchor in listed] == [anchor_of(heading) for heading in pairs(page)]


def test_a_difference_is_seen():
    """A measure that finds nothing would pass everything above."""
    one = np.array([1.0, np.nan, 3.0])
    assert difference(one, one, "px") == 0
    assert difference(one, one + 0.25, "px") == 0.25
    assert difference(one, one * 1.5, "relative") == 0.5
    assert difference(one, np.ones(3), "px") == np.inf
    assert difference(np.zeros(4), np.eye(4)[0], "% of pixels") == 25


# --- Claims ---------------------------------------------------------------------------------------


def rows() -> list[list[str]]:
    """The numbered rows of the comparison, as their cells."""
    lines = re.findall(r"^\| \d+ \|.*$", read(COMPARISON), re.MULTILINE)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_yes_shows_where():
    assert {len(row) for row in rows()} == {8}
    for number, asked, ours, *_ in rows():
        assert "yes" not in ours or re.fullmatch(r"\[yes\]\([^)]+\)", ours), f"row {number}, {asked}: {ours}"
    assert sum("yes" in ours for _, _, ours, *_ in rows()) > 20


def test_every_row_tells_how_it_was_found():
    notes = re.findall(r"^(\d+)\. ", read(COMPARISON), re.MULTILINE)
    assert [row[0] for row in rows()] == notes == [str(i) for i in range(1, len(notes) + 1)]


@pytest.mark.parametrize("page", [*PAGES, COMPARISON])
def test_what_is_named_exists(page):
    for dotted in re.findall(r"`fr\.([A-Za-z_.]+)", read(page)):
        reduce(getattr, dotted.split("."), fr)
    commands = {command.name or command.callback.__name__ for command in app.registered_commands}
    assert set(re.findall(r"`fisheyerec ([a-z]+)", read(page))) <= commands
