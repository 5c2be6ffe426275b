"""The record of what was done in a folder, so that a run that ended early can be taken up again."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from .cameras import Camera
from .folders import Task
from .replacement import replacement

MANIFEST = "manifest.jsonl"


class Manifest:
    """One JSON object a line for each file that was worked on, in the order that they were finished.

    Each has `input` as it was given, its `size` and `mtime_ns`, `output` relative to the folder, `settings`, the
    `camera` of the input and the `view` of the output, `seconds`, and `error`, null where all went well. The last line
    about an output counts.

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
        """Tell whether the output is there and was made without error, with these settings, of the input as it is.

        Whether an input has changed is told by its size and time of modification, as make and rsync do.
        """
        entry = self._last.get(self._name(task))
        if entry is None or entry.get("error") is not None or not task.target.exists():
            return False
        found = {"settings": json.loads(json.dumps(settings)), **_state(task.source)}
        return all(entry.get(key) == value for key, value in found.items())

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


def _state(path: Path) -> dict[str, int | None]:
    try:
        status = os.stat(path)
    except OSError:
        return {"size": None, "mtime_ns": None}
    return {"size": status.st_size, "mtime_ns": status.st_mtime_ns}
