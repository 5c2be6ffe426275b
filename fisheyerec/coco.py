"""COCO files: boxes, polygons, masks and keypoints of many pictures, moved as the pictures were.

COCO measures boxes and polygons from the picture's corner, but keypoints are indices of pixels, as points are here.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from . import rle
from .annotations import Sample, rectify_sample
from .cameras import Camera, FisheyeCamera
from .pixel import HALF_PIXEL
from .replacement import replacement

_DECIMALS = 2  # px, as in COCO's own files


class Shown(NamedTuple):
    """A picture that was made from another."""

    source: Path
    """The fisheye picture."""
    file_name: str
    """What the new one is called."""
    camera: FisheyeCamera
    view: Camera | None
    """None where it came out as it went in."""


class Moved(NamedTuple):
    """What became of a COCO file."""

    content: dict[str, Any]
    """The new file's."""
    summary: str
    """What to say of it, in one line."""
    complaints: list[str]
    """A line for each picture that has no annotations because of what the file says, or does not say, of it."""


class CocoFile:
    """A COCO file of object detection.

    Args:
        path: the file.

    Raises:
        ValueError: a file that is none, with the place of what is wrong in it.
        OSError: it cannot be read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            self.content = json.loads(self.path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"expected {self.path} as a COCO file, got no JSON ({error})") from error
        lists = [self.content.get(name) for name in ("images", "annotations")] if isinstance(self.content, dict) else []
        if not (lists and all(isinstance(x, list) and all(isinstance(y, dict) for y in x) for x in lists)):
            raise ValueError(f"expected {self.path} as a COCO file, got no lists of images and annotations")
        self._images: dict[tuple[str, ...], dict[str, Any]] = {}
        for i, image in enumerate(self.content["images"]):
            self._check(isinstance(image.get("id"), int | str), f"images[{i}] with an id", image)
            self._check(isinstance(image.get("file_name"), str), f"images[{i}] with a file_name", image)
            for side in ("width", "height"):
                self._check(isinstance(image.get(side), int), f"images[{i}] with a {side} in pixels", image)
            parts = PurePath(image["file_name"]).parts
            self._check(parts not in self._images, f"images[{i}] with a file_name of its own", image)
            self._images[parts] = image
        sizes = {image["id"]: (image["height"], image["width"]) for image in self._images.values()}
        self._check(len(sizes) == len(self._images), "images with an id each", f"{len(sizes)} ids")
        for i, annotation in enumerate(self.content["annotations"]):
            where, image_id = f"annotations[{i}]", annotation.get("image_id")
            self._check(isinstance(image_id, int | str) and image_id in sizes, f"{where} of an image", annotation)
            try:
                _sample(annotation, sizes[image_id])
            except (TypeError, ValueError, KeyError) as error:
                raise ValueError(f"expected {self.path}, {where} as COCO has them, got {_short(error)}") from error

    def _check(self, holds: bool, expected: str, got: Any) -> None:
        if not holds:
            raise ValueError(f"expected {self.path}: {expected}, got {_short(got)}")

    def image_of(self, picture: Path) -> dict[str, Any] | None:
        """Find the image whose file_name a picture's path ends with."""
        parts = picture.absolute().parts
        tails = (parts[start:] for start in range(len(parts)))
        return next((self._images[tail] for tail in tails if tail in self._images), None)

    def rectified(self, pictures: Sequence[Shown], rotation: np.ndarray | None) -> Moved:
        """Give the file of pictures that were rectified; images that are not among them are left out.

        Boxes follow the bent outline of what they are about, areas are counted anew. An annotation of which the view
        shows nothing is dropped; the others say in `visible` which share of their box is seen, from 0 to 1. Keypoints
        that are not seen become 0, 0, 0. Whatever else the file holds stays as it is.

        Args:
            pictures: what was rectified.
            rotation: (3, 3) camera_from_view; None for none.
        """
        of_image = defaultdict(list)
        for annotation in self.content["annotations"]:
            of_image[annotation["image_id"]].append(annotation)
        images: dict[Any, dict[str, Any]] = {}
        annotations: list[dict[str, Any]] = []
        complaints, dropped = [], 0
        for picture in pictures:
            image = self.image_of(picture.source)
            if image is None:
                complaints.append(f"expected {picture.source} among the images of {self.path}, got no such file_name")
                continue
            if image["id"] in images:
                complaints.append(f"expected one picture called {image['file_name']!r}, got {picture.source} as well")
                continue
            height, width = picture.camera.image_size
            if (image["height"], image["width"]) != (height, width):
                complaints.append(
                    f"expected {picture.source} of {image['width']}x{image['height']} as in {self.path}, "
                    f"got {width}x{height}"
                )
                continue
            height, width = picture.camera.image_size if picture.view is None else picture.view.image_size
            images[image["id"]] = image | {"file_name": picture.file_name, "width": width, "height": height}
            for annotation in of_image[image["id"]]:
                moved = _moved(annotation, picture.camera, picture.view, rotation)
                if moved is None:
                    dropped += 1
                else:
                    annotations.append(moved)
        summary = f"{len(annotations)} annotations in {len(images)} images"
        if dropped:
            summary += f", {dropped} not seen and dropped"
        if left_out := len(self._images) - len(images):
            summary += f", {left_out} images not rectified and left out"
        content = self.content | {"images": list(images.values()), "annotations": annotations}
        return Moved(content, summary, complaints)


def write_coco(path: str | os.PathLike[str], content: dict[str, Any]) -> None:
    """Write a COCO file, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    with replacement(path) as temporary:
        temporary.write_text(json.dumps(content), encoding="utf-8")


def _sample(annotation: dict[str, Any], size: tuple[int, int]) -> Sample:
    """Read an annotation of an image of this size (height, width); a segmentation that encloses nothing is none."""
    known: dict[str, Any] = {}
    if annotation.get("bbox"):
        x, y, width, height = _numbers(annotation["bbox"], "bbox")
        if width < 0 or height < 0:
            raise ValueError(f"bbox {annotation['bbox']} of negative size")
        known["boxes"] = np.array([[x, y, x + width, y + height]]) - HALF_PIXEL
    segmentation = annotation.get("segmentation")
    if segmentation and isinstance(segmentation, dict):
        if tuple(segmentation["size"]) != size:
            raise ValueError(f"a mask of size {segmentation['size']} in an image of {list(size)}")
        known["mask"] = rle.decode(segmentation["counts"], size)
    elif segmentation:
        polygons = [_numbers(polygon, "polygon").reshape(-1, 2) - HALF_PIXEL for polygon in segmentation]
        # There are some of one or two points, which enclose nothing.
        known["polygons"] = [polygon for polygon in polygons if len(polygon) >= 3] or None
    if annotation.get("keypoints"):
        points = _numbers(annotation["keypoints"], "keypoints").reshape(-1, 3)
        known["points"] = np.where(points[:, 2:] > 0, points[:, :2], np.nan)
    return Sample(**known)


def _numbers(values: Any, name: str) -> np.ndarray:
    numbers = np.array(values, dtype=np.float64)
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise ValueError(f"{name} {_short(values)}")
    return numbers


def _moved(
    annotation: dict[str, Any], camera: FisheyeCamera, view: Camera | None, rotation: np.ndarray | None
) -> dict[str, Any] | None:
    """What the view shows of an annotation; None for nothing. What has no place in the picture stays as it is."""
    known = _sample(annotation, camera.image_size)
    if view is None or all(x is None for x in (known.boxes, known.mask, known.polygons, known.points)):
        return annotation
    seen = rectify_sample(known, camera, view, rotation=rotation)
    low, high, area = _extent(seen)
    if not (low <= high).all():
        return None
    moved = dict(annotation)
    if seen.boxes is not None and seen.boxes_visible is not None:
        moved["bbox"] = _rounded([*(low + HALF_PIXEL), *(high - low)])
        moved["visible"] = round(float(seen.boxes_visible[0]), 3)
    if "area" in annotation:
        moved["area"] = round(area, _DECIMALS)
    if seen.mask is not None:
        as_text = isinstance(annotation["segmentation"]["counts"], str)
        moved["segmentation"] = {"size": list(view.image_size), "counts": rle.encode(seen.mask, as_text=as_text)}
    elif annotation.get("segmentation"):
        moved["segmentation"] = [_rounded((p + HALF_PIXEL).ravel()) for p in seen.polygons or () if len(p)]
    if seen.points is not None and seen.points_valid is not None:
        flags = np.where(seen.points_valid, annotation["keypoints"][2::3], 0)
        where = np.where(seen.points_valid[:, None], seen.points, 0)
        moved["keypoints"] = [
            value for (x, y), flag in zip(where, flags.tolist(), strict=True) for value in (*_rounded([x, y]), flag)
        ]
        if "num_keypoints" in annotation:
            moved["num_keypoints"] = int((flags > 0).sum())
    return moved


def _extent(seen: Sample) -> tuple[np.ndarray, np.ndarray, float]:
    """Corners (2,) of what is seen of an annotation, NaN for nothing, and its area: by its finest description."""
    if seen.mask is not None:
        rows, columns = np.nonzero(seen.mask)
        points = np.stack([columns, rows], -1)
        around, area = HALF_PIXEL, float(len(points))
    elif seen.polygons is not None:
        points = np.concatenate(seen.polygons)
        around, area = 0.0, sum(_area(polygon) for polygon in seen.polygons)
    elif seen.boxes is not None:
        points = seen.boxes.reshape(2, 2)
        around, area = 0.0, float(np.prod(points[1] - points[0]))
    else:
        points = seen.points[seen.points_valid]
        around, area = 0.0, 0.0
    if len(points) == 0:
        return np.full(2, np.nan), np.full(2, np.nan), 0.0
    return points.min(0) - around, points.max(0) + around, area


def _area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def _rounded(values: Any) -> list[float]:
    return [round(float(value), _DECIMALS) for value in values]


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
