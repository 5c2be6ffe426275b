"""What happens to a fisheye picture between lens and file, drawn by chance, so that a network does not rely on it."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, ImageFilter

from ..network import PICTURE_MEAN
from .losses import UNLABELLED

_MARGIN = np.round(255 * np.array(PICTURE_MEAN)).astype(np.uint8)
_WIDEST_SHAPE = 2.0


def crop(
    rng: np.random.Generator, fisheye: np.ndarray, labels: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Make every other square picture a photo of another shape in a square with margins, as the network sees one."""
    if rng.random() < 1 / 2:
        return fisheye, labels
    height = len(fisheye)
    margin = round(height * (1 - 1 / rng.uniform(1, _WIDEST_SHAPE)) / 2)
    outside = np.ones(height, dtype=bool)
    outside[margin : height - margin] = False
    fisheye = np.where(outside[:, None, None], _MARGIN, fisheye)
    return fisheye, None if labels is None else np.where(outside[:, None], UNLABELLED, labels).astype(np.uint8)


def turn(
    fisheye: np.ndarray, labels: np.ndarray | None, camera: np.ndarray, quarter_turns: int, mirror: bool
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Mirror a picture left to right, turn it counter-clockwise by quarters, and its labels and camera with it.

    Args:
        fisheye: (H, W, 3); labels (H, W) or None; camera (8,) fx, fy, cx, cy, k1..k4.
        labels: see fisheye.
        camera: see fisheye.
        quarter_turns: how many, in 0..3.
        mirror: whether to mirror, before the turns.
    """
    fx, fy, cx, cy, *k = camera
    width, height = fisheye.shape[1], fisheye.shape[0]
    if mirror:
        fisheye, labels = fisheye[:, ::-1], None if labels is None else labels[:, ::-1]
        cx = width - 1 - cx
    for _ in range(quarter_turns):
        fx, fy, cx, cy = fy, fx, cy, width - 1 - cx
        width, height = height, width
    fisheye = np.rot90(fisheye, quarter_turns)
    labels = None if labels is None else np.ascontiguousarray(np.rot90(labels, quarter_turns))
    return np.ascontiguousarray(fisheye), labels, np.array([fx, fy, cx, cy, *k])


def develop(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Vary exposure, contrast, white balance, sharpness, noise and JPEG compression of a picture (H, W, 3) uint8."""
    if rng.random() < 0.8:
        gamma = np.exp(rng.normal(0, 0.25))
        gain = np.exp(rng.normal(0, 0.15) + rng.normal(0, 0.08, 3))
        levels = (np.arange(256) / 255) ** gamma
        curves = np.clip(255 * gain * levels[:, None], 0, 255).round().astype(np.uint8)
        picture = np.stack([curves[:, c][picture[..., c]] for c in range(3)], -1)
    if rng.random() < 0.1:
        grey = np.asarray(Image.fromarray(picture).convert("L"))
        picture = np.repeat(grey[..., None], 3, -1)
    if rng.random() < 0.2:
        blur = ImageFilter.GaussianBlur(rng.uniform(0.3, 0.9))
        picture = np.asarray(Image.fromarray(picture).filter(blur))
    if rng.random() < 0.3:
        noise = rng.standard_normal(picture.shape, dtype=np.float32) * np.float32(rng.uniform(1, 8))
        picture = np.clip(picture + noise, 0, 255).round().astype(np.uint8)
    if rng.random() < 0.4:
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "JPEG", quality=int(rng.integers(40, 96)))
        picture = np.asarray(Image.open(file))
    return picture
