"""From a file's bytes to keys with values, and from those to numbers; errors name the whole key."""

from __future__ import annotations

import importlib
import json
import os
import re
import reprlib
from types import ModuleType
from typing import Any

from .record import listed, number

# Lens files are small: a film named by mistake is refused before it is read whole.
MAX_BYTES = 16 * 1024 * 1024

# Rounding dust in a camera matrix, in pixels; a real skew is refused rather than dropped silently.
_MATRIX_TOLERANCE = 1e-6


def read_text(path: str | os.PathLike[str]) -> str:
    """Reads a small text file; raises ValueError if it is large or not UTF-8 text."""
    with open(path, "rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ValueError(f"expected a lens file of at most {MAX_BYTES} bytes, got a larger file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError("expected UTF-8 text, got a binary file") from None
    if "\0" in text:  # valid UTF-8, but no lens format holds it
        raise ValueError("expected UTF-8 text, got a binary file")
    return text


def load_entries(text: str) -> object:
    """Parses JSON or YAML into dicts, lists and scalars; raises ValueError if it is neither."""
    start = text.lstrip()
    if start.startswith("<"):
        raise ValueError("expected JSON, YAML or COLMAP text, got XML (OpenCV can write .yml)")
    if start.startswith("{"):
        try:
            return json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"expected JSON, got text its parser refuses: {error}") from None
    yaml = import_yaml()
    # OpenCV up to 4 writes this header, which is no YAML directive.
    text = re.sub(r"\A\s*%YAML:.*", "", text)
    try:
        # BaseLoader leaves every scalar as text and passes over tags such as !!opencv-matrix: no
        # object is ever built, and YAML 1.1's surprises (1e-5 is text, 0640 is octal) do not occur.
        return yaml.load(text, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError) as error:
        problem, mark = getattr(error, "problem", error), getattr(error, "problem_mark", None)
        place = f" (line {mark.line + 1})" if mark else ""
        raise ValueError(f"expected YAML, got text its parser refuses: {problem}{place}") from None


def json_text(entries: dict[str, Any]) -> str:
    """JSON of these keys and values, numbers exact to the last bit."""
    return json.dumps(entries, indent=1) + "\n"


def yaml_text(entries: dict[str, Any]) -> str:
    """YAML of these keys and values, numbers exact to the last bit; raises RuntimeError if PyYAML is not installed."""
    # PyYAML's None: what holds no list or mapping of its own in one line, and so the whole file if that is flat.
    flat = not any(isinstance(value, dict | list) for value in entries.values())
    return str(import_yaml().safe_dump(entries, sort_keys=False, default_flow_style=False if flat else None))


def import_yaml() -> ModuleType:
    """Imports PyYAML; raises RuntimeError if it is not installed."""
    try:
        return importlib.import_module("yaml")
    except ImportError:
        raise RuntimeError("YAML: expected PyYAML to be installed, got no module yaml") from None


class Section:
    """A mapping in a file and where it stands there, so that errors name the whole key."""

    def __init__(self, entries: object, prefix: str = "") -> None:
        if not isinstance(entries, dict):
            place = prefix.rstrip(".") or "top level"
            raise ValueError(f"{place}: expected keys with values, got {reprlib.repr(entries)}")
        self.entries: dict[str, Any] = entries
        self.prefix = prefix

    def __contains__(self, key: str) -> bool:
        return key in self.entries

    def find(self, *keys: str) -> tuple[str, Any]:
        """The full name and the value of the first key there is; raises ValueError for none."""
        for key in keys:
            if key in self.entries:
                return self.prefix + key, self.entries[key]
        wanted = " or ".join(repr(self.prefix + key) for key in keys)
        raise ValueError(f"expected key {wanted}, got {listed(self.entries)}")

    def section(self, key: str) -> Section:
        """The mapping under a key; raises ValueError if there is none."""
        name, value = self.find(key)
        return Section(value, prefix=f"{name}.")

    def text(self, key: str, default: str | None = None) -> str:
        """The words under a key, or the default for none or null; raises ValueError otherwise."""
        if default is not None and self.entries.get(key) is None:
            return default
        name, value = self.find(key)
        if not isinstance(value, str):
            raise ValueError(f"{name}: expected text, got {reprlib.repr(value)}")
        return value

    def number(self, *keys: str) -> float:
        """The number under the first key there is; raises ValueError if it is not one."""
        name, value = self.find(*keys)
        return number(value, name)

    def numbers(self, *keys: str, count: int | None = None) -> list[float]:
        """The numbers of a list, nested rows or OpenCV matrix; raises ValueError if not `count`."""
        name, value = self.find(*keys)
        if isinstance(value, dict) and "data" in value:
            name, value = f"{name}.data", value["data"]
        if not isinstance(value, list):
            raise ValueError(f"{name}: expected a list of numbers, got {reprlib.repr(value)}")
        flat = [item for row in value for item in (row if isinstance(row, list) else [row])]
        if count is not None and len(flat) != count:
            raise ValueError(f"{name}: expected {count} numbers, got {len(flat)}")
        return [number(item, f"{name}[{index}]") for index, item in enumerate(flat)]

    def camera_matrix(self, *keys: str) -> list[float]:
        """fx, fy, cx, cy of a 3x3 camera matrix; raises ValueError if it holds a skew."""
        values = self.numbers(*keys, count=9)
        fx, _, cx, _, fy, cy, *_ = values
        plain = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        if any(abs(a - b) > _MATRIX_TOLERANCE for a, b in zip(values, plain, strict=True)):
            name, _ = self.find(*keys)
            raise ValueError(f"{name}: expected fx 0 cx, 0 fy cy, 0 0 1 (no skew), got {values}")
        return [fx, fy, cx, cy]
