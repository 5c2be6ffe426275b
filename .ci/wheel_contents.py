"""Looks into Linux wheels: what is packed, and what its two modules need from outside.

python .ci/wheel_contents.py WHEEL...
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "fisheyerec"
MODULES = {"torch op": r"fisheyerec/_C\.abi3\.so", "NumPy door": r"fisheyerec/_numpy\.cpython-\d+-[\w-]+\.so"}

# What every Linux has, and libgomp, which torch's wheel brings.
SYSTEM = r"lib(c|m|gcc_s|pthread|dl)\.so\.\d|libstdc\+\+\.so\.6|ld-linux-[\w-]+\.so\.\d|libgomp\.so\.1"
NEEDS = {"torch op": rf"({SYSTEM}|libc10\.so|libtorch_cpu\.so)", "NumPy door": rf"({SYSTEM})"}
RUNPATH = "$ORIGIN/../torch/lib"

# Python's part of the stable ABI that the torch op may use, and the C++ interface of torch, which is not stable.
LIMITED_API = {"PyModule_Create2"}
UNSTABLE_TORCH = re.compile(r"_Z\w*?(2at|3c10|5torch)\d")
BUILD_PATH = re.compile(rb"(?<![\w.<>-])(?:/[\w.+-]+)+\.(?:cpp|h)\b")


def readelf(option: str, module: Path) -> str:
    """Give what readelf prints."""
    command = ["readelf", "--wide", option, str(module)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def check_archive(names: set[str]) -> None:
    """The package as it lies in the source tree and two compiled modules: no library, source or test."""
    files = {name for name in names if ".dist-info/" not in name}
    for kind, pattern in MODULES.items():
        found = {name for name in files if re.fullmatch(pattern, name)}
        assert len(found) == 1, f"expected one {kind}, {pattern}, got {sorted(found)}"
        files -= found
    source = (path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    expected = {path.relative_to(PACKAGE.parent).as_posix() for path in source if path.suffix != ".so"}
    assert files == expected, f"missing: {sorted(expected - files)}; too much: {sorted(files - expected)}"


def check_module(kind: str, module: Path) -> None:
    """It needs what is on every machine and torch's libraries, and knows nothing of where it was built."""
    dynamic = readelf("--dynamic", module)
    needed = re.findall(r"\(NEEDED\).*\[(.*)\]", dynamic)
    assert needed, f"{kind}: readelf shows no needed library"
    strange = [name for name in needed if not re.fullmatch(NEEDS[kind], name)]
    assert strange == [], f"{kind} needs {strange}"
    runpaths = re.findall(r"\((?:RPATH|RUNPATH)\).*\[(.*)\]", dynamic)
    assert runpaths == [RUNPATH], f"{kind}: expected RUNPATH {RUNPATH}, got {runpaths}"
    paths = set(BUILD_PATH.findall(module.read_bytes()))
    assert paths == set(), f"{kind} holds paths of the machine it was built on: {sorted(paths)}"
    print(f"{kind}: {module.name}, {module.stat().st_size / 1e6:.2f} MB, needs {' '.join(needed)}")


def check_stable(module: Path) -> None:
    """One binary for every Python and every torch: only their stable interfaces are used."""
    undefined = re.findall(r" UND (\S+)$", readelf("--dyn-syms", module), re.MULTILINE)
    python = {name for name in undefined if re.match(r"_?Py", name)}
    assert python, "the torch op uses nothing of Python: are these its symbols?"
    assert python <= LIMITED_API, f"the torch op uses {sorted(python - LIMITED_API)} of Python"
    torch = [name for name in undefined if UNSTABLE_TORCH.match(name)]
    assert torch == [], f"the torch op uses torch's C++ interface: {torch}"


def check(wheel: Path) -> None:
    """Raise AssertionError at the first thing that is not as it should be."""
    with zipfile.ZipFile(wheel) as archive, tempfile.TemporaryDirectory() as folder:
        names = {name for name in archive.namelist() if not name.endswith("/")}
        check_archive(names)
        for kind, pattern in MODULES.items():
            (name,) = (name for name in names if re.fullmatch(pattern, name))
            module = Path(archive.extract(name, folder))
            check_module(kind, module)
            if kind == "torch op":
                check_stable(module)
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.2f} MB, {len(names)} files")


if __name__ == "__main__":
    for wheel in sys.argv[1:]:
        check(Path(wheel))
