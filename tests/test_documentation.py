"""The reference in docs/reference has a place for every public name."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import fisheyerec as fr

PACKAGE = Path(fr.__file__).parent
REFERENCE = Path(__file__).resolve().parents[1] / "docs" / "reference"

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
