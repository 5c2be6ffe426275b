"""The record of what was done in a folder, so that a run that ended early can be taken up again."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, TypeVar

from .cameras import Camera, FisheyeCamera, PinholeCamera
from .folders import Task
from .replacement import replacement
from .wide_views import CylindricalView, EquirectangularView, PaniniView, StereographicView

MANIFEST = "manifest.jsonl"

_VIEWS: dict[str, type[Camera]] = {
    view.model: view for view in (PinholeCamera, CylindricalView, EquirectangularView, StereographicView, PaniniView)
}

T = TypeVar("T", bound=Camera)


class Manifest:
    """One JSON object a line for each file that was worked on, in the order that they were finished.

    Each has `input` as it was given, its `size` and `mtime_ns`, `output` relative to the folder, `companions` with
    their `kind`, `input`, `size`, `mtime_ns` and `output` as they were given, `settings`, the `camera` of the input and
    the `view` of the output, null where it came out as it went in, `seconds`, and `error`, null where all went well.
    The last line about an output counts.

    Args:
        folder: where the manifest lies or will lie.

    Raises:
        ValueError: a manifest that is none.
        OSError: it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / MANIFEST
        self._last: dict[str, dict[str, Any]] = {}
        self._has_torn_line = False
        if not self.path.exists():
            return
        text = self.path.read_text(encoding="utf-8")
        lines = text.split("\n")
        self._has_torn_line = lines.pop() != ""  # the process was killed while it wrote
        for number, line in enumerate(lines, 1):
            try:
                entry = json.loads(line)
                self._last[entry["output"]] = entry
            except (ValueError, TypeError, KeyError) as error:
                raise ValueError(f"expected a manifest of rectified files, got {self.path}, line {number}") from error

    def is_done(self, task: Task, settings: dict[str, Any]) -> bool:
        """Tell whether all outputs are there and were made without error, with these settings, of inputs as they are.

        Whether an input has changed is told by its size and time of modification, as make and rsync do.
        """
        entry = self._last.get(self._name(task))
        if entry is None or entry.get("error") is not None:
            return False
        if not all(target.exists() for _, target in task.files):
            return False
        moved = entry.get("companions", [])
        if not all(companion in moved for companion in _companion_entries(task)):
            return False
        found = {"settings": json.loads(json.dumps(settings)), **_state(task.source)}
        return all(entry.get(key) == value for key, value in found.items())

    def cameras(self, task: Task) -> tuple[FisheyeCamera, Camera | None]:
        """Give the camera and the view of a file that is done."""
        entry = self._last[self._name(task)]
        view = entry["view"]
        return _camera(FisheyeCamera, entry["camera"]), None if view is None else _camera(_VIEWS[view["model"]], view)

    def add(
        self,
        task: Task,
        settings: dict[str, Any],
        *,
        seconds: float,
        camera: Camera | None = None,
        view: Camera | None = None,
        error: str | None = None,
    ) -> None:
        """Write down that a file was worked on; complete on the disk before the next line begins.

        Raises:
            OSError: the manifest cannot be written.
        """
        entry: dict[str, Any] = {
            "input": str(task.source),
            **_state(task.source),
            "output": self._name(task),
            "companions": _companion_entries(task),
            "settings": settings,
            "camera": None if camera is None else camera_entry(camera),
            "view": None if view is None else camera_entry(view),
            "seconds": round(seconds, 4),
            "error": error,
        }
        if self._has_torn_line:
            text = self.path.read_text(encoding="utf-8")
            with replacement(self.path) as temporary:
                temporary.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")
            self._has_torn_line = False
        with open(self.path, "a", encoding="utf-8") as stream:
            stream.write(json.dumps(entry) + "\n")
        self._last[entry["output"]] = entry

    def _name(self, task: Task) -> str:
        return task.target.relative_to(self.folder).as_posix()


def camera_entry(camera: Camera) -> dict[str, Any]:
    """Give a camera as a camera file holds it: model, width, height and parameters by name."""
    height, width = camera.image_size
    parameters = dict(zip(camera.parameter_names, map(float, camera.params), strict=True))
    return {"model": camera.model, "width": width, "height": height, **parameters}


def _camera(model: type[T], entry: dict[str, Any]) -> T:
    return model([entry[name] for name in model.parameter_names], (entry["height"], entry["width"]))


def _companion_entries(task: Task) -> list[dict[str, Any]]:
    return [
        {"kind": kind, "input": str(source), **_state(source), "output": str(target)}
        for kind, source, target in task.companions
    ]


def _state(path: Path) -> dict[str, int | None]:
    try:
        status = os.stat(path)
    except OSError:
        return {"size": None, "mtime_ns": None}
    return {"size": status.st_size, "mtime_ns": status.st_mtime_ns}
