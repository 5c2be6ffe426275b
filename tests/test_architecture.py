"""The arrows of ARCHITECTURE.md: who may use whom, and where the half pixel may be written."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE, CSRC = ROOT / "fisheyerec", ROOT / "csrc"

# Each module may import those before it. Compiled ones stand where their callers need them.
ORDER = [
    "pixel",
    "replacement",
    "folders",
    "rle",
    "camera_files",
    "_numpy",
    "_C",
    "reference",
    "lens_models",
    "cameras",
    "wide_views",
    "views",
    "outlines",
    "_arguments",
    "_ops",
    "antialiasing",
    "numpy",
    "rectification",
    "annotations",
    "pictures",
    "rasters",
    "point_files",
    "companions",
    "coco",
    "manifest",
    "video",
    "lens_chart",
    "lines",
    "sightlines",
    "image_circle",
    "straightness",
    "refinement",
    "network",
    "weights",
    "rectifier",
    "pooling",
    "file_rectifiers",
    "bulk",
    "cluster",
    "baselines",
    "training",
    "demo",
    "cli",
    "__main__",
]

# Calibrated work on NumPy arrays and the command line start without torch: it may only be imported inside functions.
WITHOUT_TORCH = [
    *("__init__", "pixel", "camera_files", "lens_models", "cameras", "wide_views", "views", "outlines", "_arguments"),
    *(
        "antialiasing",
        "numpy",
        "annotations",
        "pictures",
        "replacement",
        "folders",
        "rasters",
        "point_files",
        "companions",
        "rle",
        "coco",
        "manifest",
        "video",
        "file_rectifiers",
        "bulk",
        "cluster",
        "demo",
        "cli",
        "__main__",
    ),
]

# Few have these as their users.
ONLY_USED_BY = {
    "_C": {"_ops"},
    "_ops": {"rectification"},
    "_numpy": {"lens_models", "cameras", "numpy"},
    "video": {"file_rectifiers", "cli"},
    "cluster": {"cli"},
    "baselines": {"training", "cli"},
    "training": {"baselines", "cli"},
    "demo": {"cli"},
    "cli": {"__main__"},
}


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def name_of(path):
    """The module within the package; a sub-package counts as one."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(tree, *, everywhere):
    """(dots, dotted name) of what is imported, at module level or everywhere, but never for type checking alone."""
    found = []

    def visit(node):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
                continue
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and not everywhere:
                continue
            if isinstance(child, ast.Import):
                found.extend((0, alias.name) for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module:
                found.append((child.level, child.module))
            elif isinstance(child, ast.ImportFrom):
                found.extend((child.level, alias.name) for alias in child.names)
            visit(child)

    visit(tree)
    return found


def siblings(path, *, everywhere):
    """Modules of the package that this one imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    depth = len(path.relative_to(PACKAGE).parts)
    names = set()
    for dots, dotted in imports(tree, everywhere=everywhere):
        first, *rest = dotted.split(".")
        if dots == depth:
            names.add(first)
        elif dots == 0 and first == "fisheyerec" and rest:
            names.add(rest[0])
    return {name for name in names if name in ORDER or (PACKAGE / f"{name}.py").exists() or (PACKAGE / name).is_dir()}


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_python_arrows_go_one_way(path):
    name = name_of(path)
    if name == "__init__":
        # Names are loaded when first used (PEP 562): importing the package imports nothing.
        assert siblings(path, everywhere=True) == set()
        return
    assert name in ORDER, f"{name} is new: give it its place in ORDER and in ARCHITECTURE.md"
    later = {other for other in siblings(path, everywhere=True) - {name} if ORDER.index(other) >= ORDER.index(name)}
    assert later == set(), f"{name} uses {later}, which stands above it"
    for used in siblings(path, everywhere=True) - {name}:
        users = ONLY_USED_BY.get(used)
        assert users is None or name in users, f"{used} is for {users or 'nobody'}, not for {name}"


@pytest.mark.parametrize("name", WITHOUT_TORCH)
def test_torch_is_not_imported_at_module_level(name):
    reached, waiting = set(), [name]
    while waiting:
        module = waiting.pop()
        paths = [path for path in modules() if name_of(path) == module]
        if module in reached or not paths:
            continue
        reached.add(module)
        for path in paths:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            torches = [dotted for dots, dotted in imports(tree, everywhere=False) if dotted.split(".")[0] == "torch"]
            assert torches == [], f"{name} imports torch through {path.name}"
            waiting.extend(siblings(path, everywhere=False))
    assert reached


def test_the_walk_sees_the_imports_there_are():
    """A walk that finds nothing would pass everything above."""
    camera = PACKAGE / "cameras" / "camera.py"
    assert siblings(camera, everywhere=True) >= {"pixel", "camera_files", "_numpy", "reference"}
    assert "reference" not in siblings(camera, everywhere=False)
    assert siblings(PACKAGE / "_ops.py", everywhere=False) >= {"_C", "reference"}


# --- C++ ------------------------------------------------------------------------------------------

C_FILES = sorted(path for path in CSRC.rglob("*") if path.suffix in (".h", ".cpp"))

# The folder -> folders whose files it may include.
MAY_INCLUDE = {
    "geometry": {"geometry"},
    "kernels": {"geometry", "kernels"},
    "torch": {"kernels", "torch"},
    "numpy": {"kernels", "numpy"},
    "tests": {"geometry", "kernels", "tests"},
}

# Libraries by their headers' first part. The standard library's headers have none, and no suffix.
LIBRARIES = {
    "torch": {"torch", "Python.h"},
    "numpy": {"pybind11", "Python.h"},
    "kernels": {"omp.h", "pthread.h", "sys"},
}

# What the maths of one pixel needs: nothing that allocates, locks, prints or throws.
GEOMETRY_HEADERS = {"cmath", "limits", "cstdint", "cstring", "type_traits", "utility"}


def includes(path):
    text = path.read_text(encoding="utf-8")
    return re.findall(r'^\s*#\s*include\s*([<"])([^>"]+)[>"]', text, re.MULTILINE)


@pytest.mark.parametrize("path", C_FILES, ids=lambda path: str(path.relative_to(CSRC)))
def test_includes_go_one_way(path):
    folder = path.relative_to(CSRC).parts[0]
    for kind, header in includes(path):
        if kind == '"':
            target = (path.parent / header).resolve()
            assert target.is_relative_to(CSRC), f"{header} lies outside csrc"
            assert target.exists(), f"{header} does not exist"
            assert target.relative_to(CSRC).parts[0] in MAY_INCLUDE[folder], f"{folder} may not include {header}"
            continue
        library = header.split("/")[0]
        standard = library == header and "." not in header
        if folder == "geometry":
            assert header in GEOMETRY_HEADERS, f"geometry is plain maths, got <{header}>"
        elif folder != "tests":
            assert standard or library in LIBRARIES[folder], f"{folder} may not include <{header}>"


def test_there_are_includes_to_walk():
    assert {path.relative_to(CSRC).parts[0] for path in C_FILES} >= {"geometry", "kernels", "torch", "numpy"}
    assert ('"', "../kernels/resample.h") in includes(CSRC / "torch" / "resample.cpp")


# --- The half pixel -------------------------------------------------------------------------------

HOMES = {"csrc/geometry/pixel.h", "fisheyerec/pixel.py"}

# Halves that mean something else.
OTHER_HALVES = {
    ("csrc/geometry/trigonometry.h", "u * 0.5f"): "the series of the cosine",
    ("csrc/geometry/kannala_brandt.h", "(low + high) * S(0.5)"): "bisection",
    ("csrc/kernels/storage.h", "value + Scalar<T>(0.5)"): "rounding half up to grey levels",
    ("csrc/kernels/sample_bytes.h", "weight * -one - 0.5f"): "rounding weights to whole numbers",
    ("fisheyerec/cameras/fisheye.py", "(np.arange(200) + 0.5) / 400"): "Chebyshev nodes",
    ("fisheyerec/reference.py", "torch.floor(sampled + 0.5)"): "rounding half up to grey levels",
    ("fisheyerec/rectification.py", "_reduced(image.float(), factor) + 0.5"): "rounding half up to grey levels",
    ("fisheyerec/demo/page.py", "self.balance"): "half-way between two views",
    ("fisheyerec/network.py", "nn.Dropout(0.5)"): "the paper's drop-out",
    ("fisheyerec/baselines/aleman_flores.py", "_ANGLE_STEP_DEG"): "half a degree",
    ("fisheyerec/baselines/zhang.py", "_NO_LINE"): "half of what a chain off every circle costs",
    ("fisheyerec/training/train.py", "PAPER = TrainingRecipe"): "half of the steps",
}


def halves(path):
    """Lines of code, comments and texts left out, that hold a literal 0.5 or a hand-made centre (n - 1) / 2."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        lines = text.splitlines()
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        numbers = {t.start[0] for t in tokens if t.type == tokenize.NUMBER and is_half(t.string)}
        code = [line if i in numbers else "" for i, line in enumerate(lines, 1)]
        return [line for line in code if line] + [line for line in lines if is_centre(line.split("#")[0])]
    text = re.sub(r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\])*"', "", text, flags=re.DOTALL)
    number = re.compile(r"(?<![\w.])\d*\.\d+(?:[eE][+-]?\d+)?[fFlL]?(?!\w)")
    return [line for line in text.splitlines() if any(map(is_half, number.findall(line))) or is_centre(line)]


def is_half(literal):
    try:
        return float(literal.rstrip("fFlL")) == 0.5
    except ValueError:
        return False


def is_centre(line):
    return re.search(r"-\s*1(\.0)?\s*\)\s*/\s*2", line) is not None


SOURCES = [*(path for path in C_FILES if "tests" not in path.relative_to(CSRC).parts), *modules()]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_half_pixel_is_written_in_two_files_only(path):
    name = path.relative_to(ROOT).as_posix()
    found = halves(path)
    if name in HOMES:
        assert found, f"{name} is where the half pixel is written"
        return
    for line in found:
        known = any(file == name and snippet in line for file, snippet in OTHER_HALVES)
        assert known, f"{name}: a half pixel belongs in {sorted(HOMES)}; another half is listed here: {line.strip()}"


@pytest.mark.parametrize(("file", "snippet"), OTHER_HALVES, ids=OTHER_HALVES.values())
def test_the_list_of_other_halves_holds_what_there_is(file, snippet):
    assert any(snippet in line for line in halves(ROOT / file)), "no longer there: take it off the list"
