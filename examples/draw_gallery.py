"""Draws the pictures of the README's gallery and of the guide into docs/images. Run it from the project's root:

python examples/draw_gallery.py [NAME ...]
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import scenes
from scenes import Label

import fisheyerec as fr
from fisheyerec.pictures import Picture, read_picture, write_picture

HERE = Path(__file__).resolve().parent
IMAGES = HERE.parent / "docs" / "images"
GAP = 4  # px of white between panels
HEIGHT = 300  # px, of most panels
QUALITY = 82
INKS = ((255, 196, 0), (0, 200, 255), (255, 96, 160))

# What each class of the street is tinted with.
TINTS = {
    Label.SKY: (80, 150, 255),
    Label.BUILDING: (200, 120, 70),
    Label.ROAD: (130, 90, 170),
    Label.SIDEWALK: (240, 130, 220),
    Label.CAR: (255, 60, 60),
    Label.TREE: (70, 190, 70),
    Label.POLE: (250, 230, 60),
}


def drawn(name: str) -> tuple[np.ndarray, fr.FisheyeCamera]:
    """A fisheye picture of this folder and its camera."""
    return read_picture(HERE / f"{name}.jpg").pixels, fr.FisheyeCamera.load(HERE / f"{name}.json")


def seen(
    picture: np.ndarray, camera: fr.FisheyeCamera, view: fr.PinholeCamera, rotation: np.ndarray | None = None
) -> np.ndarray:
    """A panel: the picture as the view sees it, averaged where it shrinks."""
    return fr.numpy.rectify(picture, camera, view, rotation=rotation, antialias=True).image


def shrunk(picture: np.ndarray, height: int = HEIGHT) -> np.ndarray:
    """A panel: the picture itself at this height."""
    width = round(picture.shape[1] * height / picture.shape[0])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def sheet(*rows: Sequence[np.ndarray]) -> np.ndarray:
    """Panels in rows, with gaps between them."""
    strips = []
    for row in rows:
        panels = [np.pad(panel, ((0, 0), (0, GAP), (0, 0)), constant_values=255) for panel in row]
        strips.append(np.pad(np.concatenate(panels, 1)[:, :-GAP], ((0, GAP), (0, 0), (0, 0)), constant_values=255))
    return np.concatenate(strips)[:-GAP]


def outline(panel: np.ndarray, points: np.ndarray, ink: Sequence[int], *, closed: bool = True, width: int = 2) -> None:
    """Draw a polygon or a chain of (x, y) into a panel, to a fraction of a pixel."""
    fixed = [np.round(points * 16).astype(np.int32)]
    cv2.polylines(panel, fixed, closed, tuple(ink), width, cv2.LINE_AA, shift=4)


def border(view: fr.PinholeCamera) -> np.ndarray:
    """Points around the edge of a view, (N, 2)."""
    height, width = view.image_size
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1], [0, 0]], dtype=float)
    steps = np.linspace(0, 1, 65)[:, None]
    return np.concatenate([a + (b - a) * steps for a, b in itertools.pairwise(corners)])


def straight_lines() -> np.ndarray:
    """The room as taken and made straight: in both, straight strokes between the ends of what is straight."""
    picture, camera = drawn("room")
    size = (384, 512)
    small, view = camera.resize(size), fr.PinholeCamera.edge_matched(camera, size)
    panels = [shrunk(picture, size[0]), seen(picture, camera, view)]
    ends = scenes.room(seed=1).lines(min_angle_deg=30)
    taken, valid = small.project(ends)
    straight, _ = view.project(ends)
    inside = valid.all(-1) & within(taken, size).all(-1) & within(straight, size).all(-1)
    for i in apart(straight[inside], 30):
        for panel, strokes in zip(panels, (taken, straight), strict=True):
            outline(panel, strokes[inside][i], INKS[0], closed=False)
    return sheet(panels)


def within(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Whether points (..., 2) lie in a picture of (height, width)."""
    return ((points > 0) & (points < np.array(size[::-1]) - 1)).all(-1)


def apart(strokes: np.ndarray, distance: float) -> list[int]:
    """Which strokes (N, 2, 2) to keep, the longest first, so that their middles are so far from each other."""
    kept: list[int] = []
    middles = strokes.mean(1)
    for i in np.argsort(-np.linalg.norm(strokes[:, 1] - strokes[:, 0], axis=-1)):
        if all(np.linalg.norm(middles[i] - middles[j]) > distance for j in kept):
            kept.append(int(i))
    return kept


def balance() -> np.ndarray:
    """The room as taken, and at balance 0, 1/2 and 1."""
    picture, camera = drawn("room")
    size = (240, 320)
    views = [fr.view_for(camera, size, balance=share) for share in (0, 0.5, 1)]
    return sheet([shrunk(picture, size[0]), *(seen(picture, camera, view) for view in views)])


def wide_views() -> np.ndarray:
    """A lens of 190 degrees, a perspective of 120, and four views that show more than a perspective can."""
    camera = fr.FisheyeCamera.from_projection("equidistant", fov_deg=190, image_size=(900, 900))
    picture = scenes.render_camera(scenes.street(seed=5), camera.unproject, camera.image_size, 3).image
    y, x = np.mgrid[:900, :900] - 449.5
    picture[np.hypot(x, y) > 450] = 0  # the image circle
    height, width = size = (240, 320)
    views = [
        fr.view_for(camera, size, fov_deg=120),
        fr.view_for(camera, size, projection="cylindrical"),
        fr.view_for(camera, size, projection="equirectangular"),
        fr.view_for(camera, size, projection="stereographic"),
        fr.view_for(camera, size, projection="panini", fov_deg=150),
    ]
    circle = np.pad(shrunk(picture, height), ((0, 0), ((width - height) // 2,) * 2, (0, 0)))
    panels = [circle, *(seen(picture, camera, view) for view in views)]
    return sheet(panels[:3], panels[3:])


def pan_tilt() -> np.ndarray:
    """The street with the outlines of three views that look elsewhere, and these views."""
    picture, camera = drawn("street")
    fisheye = shrunk(picture)
    small = camera.resize(fisheye.shape[:2])
    view = fr.PinholeCamera.from_fov(fov_deg=55, image_size=(HEIGHT, HEIGHT))
    panels = [fisheye]
    for (pan, tilt), ink in zip(((-48, 8), (2, 16), (50, -4)), INKS, strict=True):
        rotation = fr.view_rotation(pan_deg=pan, tilt_deg=tilt)
        rays, _ = view.unproject(border(view))
        outline(fisheye, small.project(rays @ rotation.T)[0], ink)
        panels.append(seen(picture, camera, view, rotation))
        outline(panels[-1], border(view), ink, width=5)
    return sheet(panels)


def annotations() -> np.ndarray:
    """The street with labels, boxes and outlines of its cars, and the same moved along into the straight picture."""
    picture, camera = drawn("street")
    labels = scenes.render_camera(scenes.street(seed=2), camera.unproject, camera.image_size, 1).labels
    cars = np.uint8(labels == Label.CAR)
    cars = cv2.morphologyEx(cars, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    outlines = [c[:, 0].astype(float) for c in cv2.findContours(cars, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]]
    outlines = [c for c in outlines if cv2.contourArea(np.float32(c)) > 800]
    boxes = [[*c.min(0), *c.max(0)] for c in outlines]
    taken = fr.Sample(image=picture, labels=labels, boxes=boxes, polygons=outlines)
    straight = fr.rectify_sample(taken, camera, fr.view_for(camera, camera.image_size, fov_deg=115))
    return sheet([shrunk(annotated(sample), 384) for sample in (taken, straight)])


def annotated(sample: fr.Sample) -> np.ndarray:
    """The sample's picture tinted by its labels, with polygons and boxes."""
    panel = sample.image.copy()
    for label, tint in TINTS.items():
        where = sample.labels == label
        panel[where] = 0.6 * panel[where] + 0.4 * np.array(tint)
    for polygon in sample.polygons:
        if len(polygon):
            outline(panel, polygon, (255, 255, 255), width=3)
    for x0, y0, x1, y1 in sample.boxes:
        if np.isfinite(x0):
            outline(panel, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), INKS[0], width=4)
    return panel


def folding() -> np.ndarray:
    """The room under a calibration that folds within the frame: as taken, by the bare polynomial, and as valid."""
    picture, true = drawn("room")
    # Fitted to 50 degrees off the axis, as if the calibrator's points had ended there, under a k4 that turns it back.
    theta, k4 = np.radians(np.linspace(1, 50, 50)), -0.05
    bend = 2 * np.sin(theta / 2) - theta - k4 * theta**9
    k = np.linalg.lstsq(theta[:, None] ** np.array([3, 5, 7]), bend, rcond=None)[0]
    focal = true.image_size[1] / 2 / (2 * np.sin(np.radians(150 / 2) / 2))
    camera = fr.FisheyeCamera([focal, focal, *true.params[2:4], *k, k4], true.image_size)
    view = fr.view_for(camera, (HEIGHT, HEIGHT * 4 // 3), fov_deg=150)
    K, D = camera.to_opencv()
    maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), view.to_matrix(), view.image_size[::-1], cv2.CV_32FC1)
    bare = cv2.remap(picture, *maps, cv2.INTER_LINEAR)
    return sheet([shrunk(picture), bare, seen(picture, camera, view)])


PICTURES: dict[str, Callable[[], np.ndarray]] = {
    "straight_lines": straight_lines,
    "balance": balance,
    "wide_views": wide_views,
    "pan_tilt": pan_tilt,
    "annotations": annotations,
    "folding": folding,
}


if __name__ == "__main__":
    for name in sys.argv[1:] or PICTURES:
        write_picture(IMAGES / f"{name}.jpg", Picture(PICTURES[name]()), quality=QUALITY)
