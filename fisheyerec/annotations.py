"""A picture and everything that is known about it, moved together: masks, labels, depth, points, boxes and polygons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._arguments import DISTORT_SAMPLE, RECTIFY_SAMPLE, Names, check_single, rotation_matrix
from .cameras import Camera, FisheyeCamera
from .numpy import resample_named
from .outlines import Transfer

TOLERANCE_PX = 0.1
# Far above rounding: below, edges would be divided without end.
SMALLEST_TOLERANCE_PX = 1e-3
DEPTH_KINDS = ("z", "distance")


# The pictures of a sample -> kinds of dtype, in NumPy's letters and in words.
_RASTERS = {
    "image": ("biuf", "a floating dtype, uint8 or uint16"),
    "labels": ("biu", "an integer dtype"),
    "mask": ("b", "dtype bool"),
    "depth": ("iuf", "a floating or integer dtype"),
    "valid": ("b", "dtype bool"),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """A picture and what is known about it; whatever is left out is None.

    Positions are (x, y) in pixels, integers at pixel centres, so that a box around pixels 3 to 7 spans 2.5 to 7.5.
    COCO and torchvision count from the picture's corner: their boxes and polygons less 1/2 are these.
    """

    image: np.ndarray | None = None
    """(H, W) or (H, W, C), uint8, uint16 or floating; interpolated."""
    labels: np.ndarray | None = None
    """(H, W) or (H, W, C), of any integer type; never mixed. 0 where nothing is seen."""
    mask: np.ndarray | None = None
    """(H, W) or (H, W, N) bool, of one or N objects; never mixed."""
    depth: np.ndarray | None = None
    """(H, W) floating or integer, in any unit; never mixed, as between two surfaces there is none. 0 is unknown."""
    depth_kind: str = "z"
    """"z", along the camera's axis, or "distance", along each pixel's ray."""
    points: Any = None
    """(..., 2)."""
    boxes: Any = None
    """(N, 4) as (x0, y0, x1, y1)."""
    polygons: Sequence[Any] | None = None
    """N arrays (M, 2), M >= 3, each one closed outline."""

    valid: np.ndarray | None = None
    """(H, W) bool: which pixels show anything; None for all."""
    points_valid: np.ndarray | None = None
    """(...) bool: which points are seen; the others are NaN."""
    boxes_visible: np.ndarray | None = None
    """(N,) in [0, 1]: the share of the original box that is seen; a box of which nothing is seen is NaN."""
    polygons_visible: np.ndarray | None = None
    """(N,) in [0, 1], of polygons likewise; one of which nothing is seen is (0, 2)."""


def rectify_sample(
    sample: Sample,
    camera: FisheyeCamera,
    view: Camera,
    *,
    rotation: Any = None,
    padding: str = "zeros",
    antialias: bool = False,
    tolerance_px: float = TOLERANCE_PX,
    threads: int | None = None,
) -> Sample:
    """Show a fisheye picture as another view sees it, with everything known about it.

    Points are valid that the view shows. A box becomes the box of what the view shows of it, whose edges are curves
    there; so boxes grow, and do not come back by `distort_sample` as points and polygons do. A polygon becomes what the
    view shows of it, its edges divided to follow their curves. Parts that the view's border cuts apart stay joined by a
    line along it. Boxes and polygons that reach beyond the picture are moved as far as the lens reaches.

    Args:
        sample: what is known in the fisheye picture. Where it was moved before, what was not valid stays so.
        camera: the fisheye camera, of image size (H, W).
        view: the view to make, of image size (h, w).
        rotation: (3, 3) camera_from_view, turning the view, as `view_rotation` gives it; None for none.
        padding: what of the image lies outside: "zeros" or "border".
        antialias: whether the image is averaged where it shrinks, as in `fisheyerec.numpy.rectify`.
        tolerance_px: how far a polygon, or the edge of a box, may stray from its curve, at least 0.001.
        threads: how many threads; None for OpenMP's default (OMP_NUM_THREADS).

    Returns:
        A Sample with what was given, in the view; `valid` (h, w) where a picture of any kind was given.

    Raises:
        TypeError: an argument of another type.
        ValueError: another shape, dtype or name, a batch of cameras, or a box whose x1 < x0 or y1 < y0.
    """
    return _moved(RECTIFY_SAMPLE, sample, camera, view, rotation, padding, antialias, tolerance_px, threads)


def distort_sample(
    sample: Sample,
    view: Camera,
    camera: FisheyeCamera,
    *,
    rotation: Any = None,
    padding: str = "zeros",
    antialias: bool = False,
    tolerance_px: float = TOLERANCE_PX,
    threads: int | None = None,
) -> Sample:
    """Show a sample as a fisheye camera would have taken it: the mirror of `rectify_sample`, with its errors."""
    view_from_camera = None if rotation is None else rotation_matrix("distort_sample", rotation).T
    return _moved(DISTORT_SAMPLE, sample, view, camera, view_from_camera, padding, antialias, tolerance_px, threads)


def _moved(
    names: Names,
    sample: Sample,
    source: Camera,
    target: Camera,
    source_from_target: Any,
    padding: str,
    antialias: bool,
    tolerance_px: float,
    threads: int | None,
) -> Sample:
    rotation = check_single(names, source, target, source_from_target)
    _check(names.function, sample, tolerance_px)

    def take(name: str, raster: np.ndarray, interpolation: str = "nearest") -> tuple[np.ndarray, np.ndarray]:
        named = names._replace(image=f"sample.{name}")
        outside, average = (padding, antialias) if interpolation == "bilinear" else ("zeros", False)
        return resample_named(named, raster, source, target, rotation, interpolation, outside, average, threads)

    moved: dict[str, Any] = {}
    if sample.image is not None:
        moved["image"], moved["valid"] = take("image", sample.image, "bilinear")
    if sample.labels is not None:
        moved["labels"], moved["valid"] = take("labels", sample.labels)
    if sample.mask is not None:
        moved["mask"], moved["valid"] = take("mask", sample.mask)
    if sample.depth is not None:
        depth = sample.depth
        if sample.depth_kind == "z" and rotation is not None:
            depth = _turned_depth(depth, source, rotation)
        moved["depth"], moved["valid"] = take("depth", depth)
    if sample.valid is not None:
        moved["valid"], _ = take("valid", sample.valid)

    transfer = Transfer(source, target, rotation, tolerance_px)
    if sample.points is not None:
        points = _positions(names.function, "points", sample.points, "(..., 2)", 2)
        moved["points"], moved["points_valid"] = transfer.points(points)
    if sample.boxes is not None:
        outlines, shares = transfer.polygons(_outlines_of_boxes(names.function, sample.boxes))
        nothing = np.full((1, 2), np.nan)
        spans = [(p.min(0), p.max(0)) for p in (outline if len(outline) else nothing for outline in outlines)]
        moved["boxes"], moved["boxes_visible"] = np.array(spans).reshape(-1, 4), shares
    if sample.polygons is not None:
        polygons = _outlines_of_polygons(names.function, sample.polygons)
        moved["polygons"], moved["polygons_visible"] = transfer.polygons(polygons)
    return Sample(depth_kind=sample.depth_kind, **moved)


def _turned_depth(depth: np.ndarray, source: Camera, source_from_target: np.ndarray) -> np.ndarray:
    """Depth along the target's axis of what the source's pixels show: z_target = z_source (R^T ray)_z / ray_z.

    0, unknown, where the source itself has no depth along its axis, 90 degrees off it and beyond.
    """
    height, width = depth.shape
    pixels = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), -1)
    rays, valid = source.numpy().unproject(pixels)
    ahead = valid & (rays[..., 2] > 0)
    ratio = (rays @ source_from_target[:, 2]) / np.where(ahead, rays[..., 2], 1)
    turned = np.where(ahead, depth * ratio, 0)
    if depth.dtype.kind != "f":
        limits = np.iinfo(depth.dtype)
        turned = np.rint(turned).clip(limits.min, limits.max)
    return turned.astype(depth.dtype)


def _check(function: str, sample: Any, tolerance_px: Any) -> None:
    if not isinstance(sample, Sample):
        raise TypeError(f"{function}(): expected sample as a Sample, got {type(sample).__name__}")
    for name, (kinds, dtype) in _RASTERS.items():
        raster = getattr(sample, name)
        if raster is None:
            continue
        if not isinstance(raster, np.ndarray):
            raise TypeError(f"{function}(): expected sample.{name} as a NumPy array, got {type(raster).__name__}")
        if raster.dtype.kind not in kinds:
            raise ValueError(f"{function}(): expected sample.{name} of {dtype}, got {raster.dtype}")
        if name in ("depth", "valid") and raster.ndim != 2:
            raise ValueError(f"{function}(): expected sample.{name} of shape (H, W), got {raster.shape}")
    if sample.depth_kind not in DEPTH_KINDS:
        raise ValueError(f"{function}(): expected sample.depth_kind in {DEPTH_KINDS}, got {sample.depth_kind!r}")
    if not (isinstance(tolerance_px, int | float) and tolerance_px >= SMALLEST_TOLERANCE_PX):
        raise ValueError(
            f"{function}(): expected tolerance_px of at least {SMALLEST_TOLERANCE_PX}, got {tolerance_px!r}"
        )


def _positions(function: str, name: str, values: Any, shape: str, columns: int) -> np.ndarray:
    """Numbers as float64, (..., columns); an empty list as (0, columns)."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{function}(): expected sample.{name} as numbers {shape}, got {values!r:.60}") from None
    if array.shape == (0,):
        array = array.reshape(0, columns)
    if array.ndim < 1 or array.shape[-1] != columns or (shape[1] != "." and array.ndim != 2):
        raise ValueError(f"{function}(): expected sample.{name} of shape {shape}, got {array.shape}")
    return array


def _outlines_of_boxes(function: str, values: Any) -> list[np.ndarray]:
    boxes = _positions(function, "boxes", values, "(N, 4)", 4)
    for i in np.flatnonzero((boxes[:, 2:] < boxes[:, :2]).any(-1))[:1]:
        raise ValueError(
            f"{function}(): expected sample.boxes as (x0, y0, x1, y1) with x0 <= x1 and y0 <= y1, "
            f"got {boxes[i].tolist()} at {i}"
        )
    return [box[[[0, 1], [2, 1], [2, 3], [0, 3]]] for box in boxes]


def _outlines_of_polygons(function: str, values: Any) -> list[np.ndarray]:
    if not isinstance(values, Sequence | np.ndarray):
        raise TypeError(f"{function}(): expected sample.polygons as a list of arrays, got {type(values).__name__}")
    polygons = [_positions(function, f"polygons[{i}]", p, "(M, 2)", 2) for i, p in enumerate(values)]
    for i, polygon in enumerate(polygons):
        if len(polygon) in (1, 2):
            raise ValueError(
                f"{function}(): expected sample.polygons[{i}] of shape (M, 2) with M >= 3, got {polygon.shape}"
            )
    return polygons
