"""Pairs of a fisheye picture and its straight counterpart, made from photographs and panoramas.

A photograph's centred rectangle of the fisheye picture's shape is taken as a pinhole picture just wide enough to fill
the fisheye frame: its own corner lies as far off the axis as the farthest corner of the fisheye picture. So nothing is
empty, and no border betrays the lens. From a panorama the angles are true.

Where a picture shrinks its source, it is averaged (antialiasing.py).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .. import antialiasing, pixel
from ..cameras import Camera, FisheyeCamera, PinholeCamera
from ..numpy import resample
from .lenses import check_split, draw_camera
from .panoramas import sample_panorama, view_rotation
from .recipes import RECIPES, Recipe
from .sources import DecodedSource, Sources

# Less than this much of the light is no picture any more.
_DARK = 0.05
_PITCH_MAX, _ROLL_MAX = math.radians(30), math.radians(15)


@dataclass(frozen=True)
class Pair:
    """A fisheye picture, what it looks like straight, and the lens between them."""

    fisheye: np.ndarray
    """(H, W, 3) RGB uint8."""
    rectified: np.ndarray | None
    """(H, W, 3) RGB uint8: the source through the view; None where not asked for."""
    labels: np.ndarray | None
    """(H, W) uint8 of the fisheye picture, 0 = unlabelled; None where the source has none."""
    rectified_labels: np.ndarray | None
    """(H, W) uint8 of the straight picture; None where not asked for."""
    camera: np.ndarray
    """(8,) float64: fx, fy, cx, cy, k1..k4."""
    view: np.ndarray
    """(4,) float64: fx, fy, cx, cy of the camera's edge-matched view."""
    source: str
    """The name of the source."""
    kind: str
    """"profile", "stereographic", "equidistant", "equisolid" or "orthographic"."""
    theta_c: float
    """The angle that the farthest corner of the fisheye picture sees."""


class SyntheticPairs:
    """An endless sequence of pairs; the same seed and index give the same pair, whoever asks in whichever order.

    A round goes through all sources in an order drawn by chance; the next round draws another one.

    Args:
        sources: the pictures.
        recipe: "standard", "wide" or a Recipe.
        size: (height, width) of both pictures of a pair.
        seed: where chance starts.
        split: whose real lenses: "training", "validation" or "all".
        cameras_per_source: how many pairs in a row are made from one source.
        rectified: whether to make the straight picture.
        rectified_labels: whether to make its labels.

    Raises:
        ValueError: no sources, an unknown recipe or split, a size below 8, or no cameras.
    """

    def __init__(
        self,
        sources: Sources,
        *,
        recipe: str | Recipe = "standard",
        size: tuple[int, int] = (256, 256),
        seed: int = 0,
        split: str = "training",
        cameras_per_source: int = 1,
        rectified: bool = True,
        rectified_labels: bool = False,
    ) -> None:
        check_split("SyntheticPairs", split)
        if isinstance(recipe, str) and recipe not in RECIPES:
            raise ValueError(f"SyntheticPairs(): expected recipe in {sorted(RECIPES)}, got {recipe!r}")
        if len(sources) == 0:
            raise ValueError("SyntheticPairs(): expected at least one source, got none")
        if min(size) < 8:
            raise ValueError(f"SyntheticPairs(): expected size of at least (8, 8), got {size}")
        if cameras_per_source < 1 or seed < 0:
            raise ValueError(
                "SyntheticPairs(): expected cameras_per_source of at least 1 and seed of at least 0, "
                f"got {cameras_per_source} and {seed}"
            )
        self.sources = sources
        self.recipe = RECIPES[recipe] if isinstance(recipe, str) else recipe
        self.size, self.seed, self.split = size, seed, split
        self.cameras_per_source = cameras_per_source
        self.rectified, self.rectified_labels = rectified, rectified_labels
        rounds = [self.recipe.panorama_rounds if source.is_panorama else 1 for source in sources]
        self._numbers = np.repeat(np.arange(len(sources)), rounds)

    def __len__(self) -> int:
        """Give the number of pairs in one round; larger indices are fine."""
        return len(self._numbers) * self.cameras_per_source

    def __iter__(self) -> Iterator[Pair]:
        """Go through one round."""
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, index: int) -> Pair:
        """Make a pair.

        Raises:
            IndexError: a negative index.
            SourceError: the source cannot be read.
        """
        number = self.source_number(index)
        decoded = self.sources.decode(number)
        source = self.sources[number]
        rng = np.random.default_rng([self.seed, 0, index])
        drawn = draw_camera(rng, self.recipe, self.split, self.size, panorama=source.is_panorama)
        camera = FisheyeCamera(drawn.params, self.size)
        view = PinholeCamera.edge_matched(camera, self.size)
        scene: _Photograph | _Panorama
        if source.is_panorama:
            scene = _Panorama.draw(rng, decoded)
        else:
            scene = _Photograph.draw(rng, decoded, self.recipe, self.size, drawn.theta_c)
        fisheye, labels = scene.show(camera), scene.show_labels(camera)
        if rng.random() < self.recipe.circular_share:
            gain = _image_circle(rng, self.size)
            fisheye = (fisheye * gain[..., None]).round().astype(np.uint8)
            labels = None if labels is None else np.where(gain > _DARK, labels, 0).astype(np.uint8)
        return Pair(
            fisheye,
            scene.show(view) if self.rectified else None,
            labels,
            scene.show_labels(view) if self.rectified_labels else None,
            drawn.params,
            np.asarray(view.params),
            source.name,
            drawn.kind,
            drawn.theta_c,
        )

    def source_number(self, index: int) -> int:
        """Tell which of the sources a pair is made from."""
        if index < 0:
            raise IndexError(f"SyntheticPairs: expected an index of at least 0, got {index}")
        turn, place = divmod(index // self.cameras_per_source, len(self._numbers))
        return int(self._numbers[_permutation(len(self._numbers), self.seed, turn)[place]])


@functools.lru_cache(maxsize=16)
def _permutation(count: int, seed: int, turn: int) -> np.ndarray:
    return np.random.default_rng([seed, 1, turn]).permutation(count)


@dataclass(frozen=True)
class _Photograph:
    """A photograph, or a part of one, as the picture of a pinhole camera."""

    pixels: np.ndarray
    labels: np.ndarray | None
    pinhole: PinholeCamera

    @classmethod
    def draw(
        cls, rng: np.random.Generator, decoded: DecodedSource, recipe: Recipe, size: tuple[int, int], theta_c: float
    ) -> _Photograph:
        rows, columns = decoded.pixels.shape[:2]
        scale = min(rows / size[0], columns / size[1])
        height, width = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
        spare = np.array([rows - height, columns - width])
        top, left = rng.integers(0, spare, endpoint=True) if recipe.anywhere else spare // 2
        mirror = -1 if recipe.anywhere and rng.random() < 1 / 2 else 1
        window = (slice(top, top + height), slice(left, left + width))
        pixels = decoded.pixels[window][:, ::mirror]
        labels = None if decoded.labels is None else decoded.labels[window][:, ::mirror]
        focal = math.hypot(height, width) / 2 / math.tan(theta_c)
        return cls(pixels, labels, PinholeCamera.from_focal(focal, (height, width)))

    def show(self, target: Camera) -> np.ndarray:
        """Give the picture that the target camera takes of this photograph."""
        # The smallest step of the whole: averaging the source down by that is sooner done than by its own pixels.
        smallest, _ = antialiasing.steps(target, lambda rays: self.pinhole.project(rays)[0])
        small = antialiasing.shrunk(self.pixels, self.pinhole, max(1, int(smallest)))
        return _resample(*small, target, "bilinear")

    def show_labels(self, target: Camera) -> np.ndarray | None:
        """Give the labels that the target camera sees; they are never mixed."""
        return None if self.labels is None else _resample(self.labels, self.pinhole, target, "nearest")


@dataclass(frozen=True)
class _Panorama:
    """A panorama, and which way the camera looks into it."""

    pixels: np.ndarray
    panorama_from_camera: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator, decoded: DecodedSource) -> _Panorama:
        rotation = view_rotation(
            rng.uniform(-math.pi, math.pi), rng.uniform(-_PITCH_MAX, _PITCH_MAX), rng.uniform(-_ROLL_MAX, _ROLL_MAX)
        )
        return cls(decoded.pixels, rotation)

    def show(self, target: Camera) -> np.ndarray:
        """Give the picture that the target camera takes within this panorama."""
        per_radian = self.pixels.shape[1] / (2 * math.pi)
        smallest, largest = antialiasing.steps(target, lambda rays: per_radian * _unit(rays))
        shrink = max(1, int(smallest))
        while self.pixels.shape[0] % shrink:  # halves and quarters that keep the shape exactly 2:1
            shrink -= 1
        source = antialiasing.reduce(self.pixels, shrink)
        factor = antialiasing.oversampling(largest / shrink)

        rays = _unit(target.unproject(_pixels(target.image_size))[0])
        # einsum: the last bit of a product by BLAS may depend on its threads
        rays = np.einsum("hwi,ji->hwj", rays, self.panorama_from_camera)
        return antialiasing.reduce(sample_panorama(source, rays, factor), factor)

    def show_labels(self, target: Camera) -> np.ndarray | None:
        """Panoramas have no labels."""
        return None


def _resample(picture: np.ndarray, source: Camera, target: Camera, interpolation: str) -> np.ndarray:
    # "border": a principal point off the centre lets the fisheye picture look past its source by a pixel or two.
    averaged = interpolation == "bilinear"
    return resample(
        picture, source, target, interpolation=interpolation, padding="border", antialias=averaged, threads=1
    ).image


def _pixels(size: tuple[int, int]) -> np.ndarray:
    """Give every pixel's position as (x, y)."""
    return np.stack(np.meshgrid(np.arange(float(size[1])), np.arange(float(size[0]))), -1)


def _unit(rays: np.ndarray) -> np.ndarray:
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _image_circle(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """Draw the vignette and rim of an image circle smaller than the sensor, as a gain (H, W) in [0, 1].

    Circle, centre and softness are drawn without looking at the lens, so that they tell nothing about it.
    """
    half = max(size) / 2
    radius, softness = rng.uniform(0.8, 1.25) * half, rng.uniform(0.005, 0.05) * half
    centre = np.array([pixel.centre(size[1]), pixel.centre(size[0])]) + rng.normal(0, 0.03 * half, 2)
    fall = rng.uniform(0, 0.6)
    r = np.linalg.norm(_pixels(size) - centre, axis=-1)
    edge = np.clip((radius - r) / softness, 0, 1)
    return np.asarray((1 - fall * np.minimum(r / radius, 1) ** 2) * edge * edge * (3 - 2 * edge))
