"""What `fisheyerec rectify` moves along with the pictures: files beside each, and one COCO file for all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

if TYPE_CHECKING:
    import numpy as np

    from ..cameras import Camera, FisheyeCamera
    from ..coco import CocoFile
    from ..folders import Plan, Task

FromTo = tuple[Path, Path] | None


def along(help: str) -> Any:
    """Give an option that takes FROM and TO."""
    return typer.Option(help=help, metavar="FROM TO", rich_help_panel="What moves along with the pictures")


class Annotations(NamedTuple):
    """A COCO file to make from another."""

    source: CocoFile
    target: Path

    def write(
        self,
        planned: Plan,
        cameras: Mapping[Task, tuple[FisheyeCamera, Camera | None]],
        rotation: np.ndarray | None,
    ) -> Sequence[str]:
        """Write the annotations of the pictures whose cameras are known; gives complaints.

        Raises:
            OSError: the file cannot be written.
        """
        from ..coco import Shown, write_coco

        below = planned.folder
        shown = [
            Shown(task.source, (task.target.relative_to(below) if below else Path(task.target.name)).as_posix(), *seen)
            for task in planned.tasks
            if (seen := cameras.get(task)) is not None
        ]
        moved = self.source.rectified(shown, rotation)
        write_coco(self.target, moved.content)
        typer.echo(f"{self.target}: {moved.summary}")
        return moved.complaints


def with_companions(planned: Plan, options: Mapping[str, FromTo]) -> Plan:
    """Give each picture its companions: those of each kind that was asked for."""
    from ..companions import SUFFIXES
    from ..folders import accompany

    for kind, paths in options.items():
        if paths is not None:
            planned = accompany(planned, kind, *paths, SUFFIXES[kind])
    return planned


def annotations_of(planned: Plan, paths: FromTo) -> Annotations | None:
    """Read the COCO file of the pictures; None where there is none."""
    from ..coco import CocoFile

    if paths is None:
        return None
    source, target = paths
    if target.is_dir():
        target = target / source.name
    file = CocoFile(source)
    if target.exists() and target.samefile(source):
        raise ValueError(f"expected an output other than the COCO file itself, got {target}")
    if all(file.image_of(task.source) is None for task in planned.tasks):
        raise ValueError(f"expected {planned.tasks[0].source} among the images of {source}, got no such file_name")
    return Annotations(file, target)
