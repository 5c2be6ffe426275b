"""Files that belong to a picture, moved with it by the same camera and view: labels, masks, depth and points."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from . import point_files, rasters
from .annotations import Sample, rectify_sample
from .cameras import Camera, FisheyeCamera
from .folders import Companion
from .point_files import read_points, write_points
from .rasters import check_holds, read_raster, write_raster

SUFFIXES = {
    "labels": rasters.SUFFIXES,
    "mask": rasters.SUFFIXES,
    "depth": rasters.SUFFIXES,
    "distance": rasters.SUFFIXES,
    "points": point_files.SUFFIXES,
}
"""Kinds of companions -> suffixes of their files. Depth lies along the camera's axis, distance along each ray."""


def moved(
    companions: Sequence[Companion], camera: FisheyeCamera, view: Camera | None, rotation: np.ndarray | None
) -> list[Callable[[], None]]:
    """Read and move the companions of a picture, and give what writes each: nothing is written where one is amiss.

    Args:
        companions: of one picture.
        camera: the camera of the picture, at its size.
        view: the view that is made of it; None where it stays as it is.
        rotation: (3, 3) camera_from_view; None for none.

    Raises:
        ValueError: a file that is broken, of another size than the picture, or of numbers that mean something else.
        OSError: a file cannot be read.
    """

    def move(sample: Sample) -> Sample:
        return sample if view is None else rectify_sample(sample, camera, view, rotation=rotation)

    return [
        _moved_points(companion, move) if companion.kind == "points" else _moved_raster(companion, move, camera)
        for companion in companions
    ]


def _moved_points(companion: Companion, move: Callable[[Sample], Sample]) -> Callable[[], None]:
    table = read_points(companion.source)
    return functools.partial(
        write_points, companion.target, replace(table, points=move(Sample(points=table.points)).points)
    )


def _moved_raster(companion: Companion, move: Callable[[Sample], Sample], camera: Camera) -> Callable[[], None]:
    raster = read_raster(companion.source)
    (height, width), (expected_height, expected_width) = raster.values.shape[:2], camera.image_size
    if (height, width) != camera.image_size:
        raise ValueError(
            f"expected {companion.source} in the size of its picture, {expected_width}x{expected_height}, "
            f"got {width}x{height}"
        )
    name, given = companion.kind, raster.values
    sample: dict[str, Any] = {name: given}
    if companion.kind == "mask":
        sample = {name: given != 0}
    elif companion.kind == "distance":
        name = "depth"
        sample = {name: given, "depth_kind": "distance"}
    try:
        values = getattr(move(Sample(**sample)), name)
        check_holds(companion.target, values)
    except ValueError as error:
        raise ValueError(f"{companion.source}: {error}") from error
    palette = None if companion.kind == "mask" else raster.palette
    return functools.partial(write_raster, companion.target, rasters.Raster(values, palette))
