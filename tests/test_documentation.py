"""The reference in docs/reference has a place for every public name and command, and no page a dead link."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from markdown_links import dead_links, links_of

import fisheyerec as fr
from fisheyerec.cli import app

PACKAGE = Path(fr.__file__).parent
ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "docs" / "reference"
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("fisheyerec/**/*.md")])

# Of modules that users reach by their name; the others' public names are reached from fisheyerec itself.
INTERNAL = {"fisheyerec.numpy.resample_named"}


def referenced() -> list[str]:
    pages = [page.read_text(encoding="utf-8") for page in sorted(REFERENCE.glob("*.md"))]
    return [name for page in pages for name in re.findall(r"^::: ([\w.]+)$", page, re.M)]


def public_names(source: str) -> set[str]:
    """What a module lists in __all__, or else defines without an underscore."""
    body = ast.parse((PACKAGE / source).read_text(encoding="utf-8")).body
    for node in body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    names = {node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    return {name for name in names if not name.startswith("_")}


def test_every_public_name_has_one_place_in_the_reference():
    names = referenced()
    assert len(names) == len(set(names))
    expected = {f"fisheyerec.{name}" for name in fr.__all__}
    expected |= {f"fisheyerec.numpy.{name}" for name in public_names("numpy.py")}
    expected |= {f"fisheyerec.camera_files.{name}" for name in public_names("camera_files/__init__.py")}
    for method in sorted((PACKAGE / "baselines").glob("*.py")):
        expected |= {
            f"fisheyerec.baselines.{method.stem}.{n}" for n in public_names(f"baselines/{method.name}") & {"estimate"}
        }
    assert expected - INTERNAL - set(names) == set()


def test_every_command_has_one_place_in_the_reference():
    page = (REFERENCE / "command-line.md").read_text(encoding="utf-8")
    expected = [command.name or command.callback.__name__ for command in app.registered_commands]
    assert re.findall(r"^## fisheyerec (\w+)$", page, re.M) == expected
    assert re.findall(r"^`fisheyerec (\w+) --help`$", page, re.M) == expected


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_link_is_dead_in_the_repository(page):
    assert dead_links(page) == []


def test_a_dead_link_is_seen(tmp_path):
    """A search that finds nothing would pass the test above."""
    (tmp_path / "other.md").write_text("# Its title\n\n## A part, of it\n\n```sh\n# no part\n```\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[1](other.md#a-part-of-it) [2](other.md#no-part) [3](none.md) [4](#none) `[5](a)` [6](https://a.b)"
    )
    assert dead_links(page) == ["other.md#no-part", "none.md", "#none"]
    assert sum(len(links_of(page)) for page in PAGES) > 100
