"""A picture and everything that is known about it, moved together: masks, labels, depth, points, boxes and polygons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import numpy as door
from ._arguments import DISTORT_SAMPLE, RECTIFY_SAMPLE, Names, check_single, rotation_matrix
from .cameras import Camera, FisheyeCamera, is_tensor, namespace
from .outlines import Transfer, moved_points

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
    """A picture and what is known about it, in NumPy arrays or torch tensors; whatever is left out is None.

    Everything comes back as the kind of array it was. Pictures have their channels last in arrays, (H, W, C), and first
    in tensors, (C, H, W). One picture, not a batch: boxes and polygons are as many as there are in each.

    Positions are (x, y) in pixels, integers at pixel centres, so that a box around pixels 3 to 7 spans 2.5 to 7.5.
    COCO and torchvision count from the picture's corner: their boxes and polygons less 1/2 are these.
    """

    image: Any = None
    """(H, W), (H, W, C) or tensor (C, H, W), uint8, uint16 (arrays) or floating; interpolated."""
    labels: Any = None
    """(H, W), (H, W, C) or tensor (C, H, W), of any integer type; never mixed. 0 where nothing is seen."""
    mask: Any = None
    """(H, W), (H, W, N) or tensor (N, H, W), bool, of one or N objects; never mixed."""
    depth: Any = None
    """(H, W) floating or integer, in any unit; never mixed, as between two surfaces there is none. 0 is unknown."""
    depth_kind: str = "z"
    """"z", along the camera's axis, or "distance", along each pixel's ray."""
    points: Any = None
    """(..., 2)."""
    boxes: Any = None
    """(N, 4) as (x0, y0, x1, y1)."""
    polygons: Sequence[Any] | None = None
    """N arrays (M, 2), M >= 3, each one closed outline."""

    valid: Any = None
    """(H, W) bool: which pixels show anything; None for all."""
    points_valid: Any = None
    """(...) bool: which points are seen; the others are NaN."""
    boxes_visible: Any = None
    """(N,) in [0, 1]: the share of the original box that is seen; a box of which nothing is seen is NaN."""
    polygons_visible: Any = None
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

    Where the image, the depth or the points are tensors, gradients flow from them to what was given, and to the camera,
    the view and the rotation: as in `fisheyerec.rectify`; of depth, for which the lens only chooses pixels, through the
    turn of the axis alone. Boxes and polygons have none.

    Args:
        sample: what is known in the fisheye picture. Where it was moved before, what was not valid stays so.
        camera: the fisheye camera, of image size (H, W).
        view: the view to make, of image size (h, w).
        rotation: (3, 3) camera_from_view, turning the view, as `view_rotation` gives it; None for none.
        padding: what of the image lies outside: "zeros" or "border".
        antialias: whether the image is averaged where it shrinks, as in `fisheyerec.numpy.rectify`.
        tolerance_px: how far a polygon, or the edge of a box, may stray from its curve, at least 0.001.
        threads: how many threads, for arrays; None for OpenMP's default (OMP_NUM_THREADS). Tensors go by torch's.

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
    view_from_camera = rotation
    if rotation is not None:
        matrix = rotation_matrix("distort_sample", rotation)
        view_from_camera = rotation.mT if is_tensor(rotation) else matrix.T
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
    matrix = check_single(names, source, target, source_from_target)
    _check(names.function, sample, tolerance_px)

    def cameras_for(values: Any) -> tuple[Camera, Camera, Any]:
        """The cameras and the rotation in NumPy's terms, or for a tensor as they came, for gradients to reach them."""
        if not is_tensor(values):
            return source.numpy(), target.numpy(), matrix
        turn = source_from_target
        return source, target, turn if turn is None or is_tensor(turn) else namespace(values).as_tensor(matrix)

    def take(name: str, raster: Any, interpolation: str = "nearest") -> tuple[Any, Any]:
        named = names._replace(image=f"sample.{name}")
        outside, average = (padding, antialias) if interpolation == "bilinear" else ("zeros", False)
        return _resampled(named, raster, *cameras_for(raster), interpolation, outside, average, threads)

    moved: dict[str, Any] = {}
    if sample.image is not None:
        moved["image"], moved["valid"] = take("image", sample.image, "bilinear")
    if sample.labels is not None:
        moved["labels"], moved["valid"] = take("labels", sample.labels)
    if sample.mask is not None:
        moved["mask"], moved["valid"] = take("mask", sample.mask)
    if sample.depth is not None:
        depth = sample.depth
        if sample.depth_kind == "z" and matrix is not None:
            seen_from, _, turn = cameras_for(depth)
            depth = _turned_depth(depth, seen_from, turn)
        moved["depth"], moved["valid"] = take("depth", depth)
    if sample.valid is not None:
        moved["valid"], _ = take("valid", sample.valid)

    if sample.points is not None:
        points = _positions(names.function, "points", sample.points, "(..., 2)", 2)
        positions, moved["points_valid"] = moved_points(points, *cameras_for(points))
        moved["points"] = _as(points, positions)
    transfer = Transfer(source, target, matrix, tolerance_px)
    if sample.boxes is not None:
        boxes = _positions(names.function, "boxes", sample.boxes, "(N, 4)", 4)
        outlines, shares = transfer.polygons(_outlines_of_boxes(names.function, _array(boxes)))
        nothing = np.full((1, 2), np.nan)
        spans = [(p.min(0), p.max(0)) for p in (outline if len(outline) else nothing for outline in outlines)]
        moved["boxes"], moved["boxes_visible"] = _as(boxes, np.array(spans).reshape(-1, 4)), _as(boxes, shares)
    if sample.polygons is not None:
        polygons = _polygons(names.function, sample.polygons)
        outlines, shares = transfer.polygons([_array(polygon) for polygon in polygons])
        moved["polygons"] = [_as(polygon, outline) for polygon, outline in zip(polygons, outlines, strict=True)]
        moved["polygons_visible"] = _as(polygons[0], shares) if polygons else shares
    return Sample(depth_kind=sample.depth_kind, **moved)


def _resampled(
    names: Names,
    raster: Any,
    source: Camera,
    target: Camera,
    source_from_target: Any,
    interpolation: str,
    padding: str,
    antialias: bool,
    threads: int | None,
) -> tuple[Any, Any]:
    """Resample through the door for arrays, channels last, or the one for tensors, channels first."""
    arguments = (source, target, source_from_target, interpolation, padding, antialias)
    if not is_tensor(raster):
        return door.resample_named(names, raster, *arguments, threads)
    from . import rectification

    if raster.ndim not in (2, 3):
        raise ValueError(
            f"{names.function}(): expected {names.image} of shape (H, W) or (C, H, W), got {tuple(raster.shape)}"
        )
    channels = raster[None, None] if raster.ndim == 2 else raster[None]
    out, valid = rectification.resample_named(names, channels, *arguments)
    return (out[0, 0] if raster.ndim == 2 else out[0]), valid[0, 0]


def _turned_depth(depth: Any, source: Camera, source_from_target: Any) -> Any:
    """Depth along the target's axis of what the source's pixels show: z_target = z_source (R^T ray)_z / ray_z.

    0, unknown, where the source itself has no depth along its axis, 90 degrees off it and beyond.
    """
    xp = namespace(depth)
    height, width = depth.shape
    pixels = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), -1)
    rays, valid = source.unproject(depth.new_tensor(pixels, dtype=xp.float64) if is_tensor(depth) else pixels)
    axis = source_from_target[:, 2].to(rays) if is_tensor(depth) else source_from_target[:, 2]
    ahead = valid & (rays[..., 2] > 0)
    rays = xp.where(ahead[..., None], rays, 1)
    turned = xp.where(ahead, depth * (rays @ axis) / rays[..., 2], 0)
    if _kind(depth) != "f":
        limits = xp.iinfo(depth.dtype)
        turned = xp.round(turned).clip(limits.min, limits.max)
    return turned.to(depth.dtype) if is_tensor(depth) else turned.astype(depth.dtype)


def _kind(values: Any) -> str:
    """NumPy's letter for the dtype of an array or a tensor."""
    if not is_tensor(values):
        return str(values.dtype.kind)
    if values.dtype == namespace(values).bool:
        return "b"
    return "f" if values.is_floating_point() else "c" if values.is_complex() else "i"


def _array(values: Any) -> np.ndarray:
    return np.asarray(values.detach().cpu() if is_tensor(values) else values, dtype=np.float64)


def _as(given: Any, values: Any) -> Any:
    """Values in the kind of array that was given: a tensor's device, and its dtype."""
    if not is_tensor(given):
        return values
    return namespace(given).as_tensor(values).to(given)


def _check(function: str, sample: Any, tolerance_px: Any) -> None:
    if not isinstance(sample, Sample):
        raise TypeError(f"{function}(): expected sample as a Sample, got {type(sample).__name__}")
    for name, (kinds, dtype) in _RASTERS.items():
        raster = getattr(sample, name)
        if raster is None:
            continue
        if not (isinstance(raster, np.ndarray) or is_tensor(raster)):
            raise TypeError(
                f"{function}(): expected sample.{name} as a NumPy array or a tensor, got {type(raster).__name__}"
            )
        if _kind(raster) not in kinds:
            raise ValueError(f"{function}(): expected sample.{name} of {dtype}, got {raster.dtype}")
        if name in ("depth", "valid") and raster.ndim != 2:
            raise ValueError(f"{function}(): expected sample.{name} of shape (H, W), got {tuple(raster.shape)}")
    if sample.depth_kind not in DEPTH_KINDS:
        raise ValueError(f"{function}(): expected sample.depth_kind in {DEPTH_KINDS}, got {sample.depth_kind!r}")
    if not (isinstance(tolerance_px, int | float) and tolerance_px >= SMALLEST_TOLERANCE_PX):
        raise ValueError(
            f"{function}(): expected tolerance_px of at least {SMALLEST_TOLERANCE_PX}, got {tolerance_px!r}"
        )


def _positions(function: str, name: str, values: Any, shape: str, columns: int) -> Any:
    """Numbers as floats (..., columns), a tensor's as they are, else float64; an empty list as (0, columns)."""
    if is_tensor(values) and _kind(values) in "fi":
        array = values if values.is_floating_point() else values.to(namespace(values).get_default_dtype())
    else:
        try:
            array = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"{function}(): expected sample.{name} as numbers {shape}, got {values!r:.60}") from None
    if tuple(array.shape) == (0,):
        array = array.reshape(0, columns)
    if array.ndim < 1 or array.shape[-1] != columns or (shape[1] != "." and array.ndim != 2):
        raise ValueError(f"{function}(): expected sample.{name} of shape {shape}, got {tuple(array.shape)}")
    return array


def _outlines_of_boxes(function: str, boxes: np.ndarray) -> list[np.ndarray]:
    for i in np.flatnonzero((boxes[:, 2:] < boxes[:, :2]).any(-1))[:1]:
        raise ValueError(
            f"{function}(): expected sample.boxes as (x0, y0, x1, y1) with x0 <= x1 and y0 <= y1, "
            f"got {boxes[i].tolist()} at {i}"
        )
    return [box[[[0, 1], [2, 1], [2, 3], [0, 3]]] for box in boxes]


def _polygons(function: str, values: Any) -> list[Any]:
    if not (isinstance(values, Sequence | np.ndarray) or is_tensor(values)):
        raise TypeError(f"{function}(): expected sample.polygons as a list of arrays, got {type(values).__name__}")
    polygons = [_positions(function, f"polygons[{i}]", p, "(M, 2)", 2) for i, p in enumerate(values)]
    for i, polygon in enumerate(polygons):
        if len(polygon) in (1, 2):
            raise ValueError(
                f"{function}(): expected sample.polygons[{i}] of shape (M, 2) with M >= 3, got {tuple(polygon.shape)}"
            )
    return polygons
