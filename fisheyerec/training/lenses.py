"""Cameras to make pictures with: real lens profiles and the four ideal projections.

lens_profiles.csv.gz holds brand, model, k1..k4 and the diagonal field of view of the calibrations of
gyroflow/lens_profiles (CC0-1.0) that see at least 72 degrees and do not fold inside their own frame.
"""

from __future__ import annotations

import csv
import functools
import gzip
import math
import zlib
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from .. import pixel
from ..cameras import FisheyeCamera
from .recipes import Recipe

PROJECTIONS = ("stereographic", "equidistant", "equisolid", "orthographic")
SPLITS = ("training", "validation", "all")

# theta_d must rise by this, relative to the axis, up to a little beyond the farthest corner.
_MIN_SLOPE = 0.05
_BEYOND_CORNER = 1.02
# Ideal projections are fitted a little further than they are used: a fit is worst at its end.
_BEYOND_FIT = 1.05
_FIT_SIZE = (256, 256)  # any: only k1..k4 are taken


class Profile(NamedTuple):
    """The shape of a real lens."""

    name: str
    k: np.ndarray
    """(4,) k1..k4."""
    theta_max: float
    """Half its diagonal field of view: the polynomial runs wild beyond the angles it was fitted on."""


class DrawnCamera(NamedTuple):
    """A camera and how it came about."""

    params: np.ndarray
    """(8,) float64."""
    theta_c: float
    """The angle that the farthest corner of the picture sees."""
    kind: str
    """One of PROJECTIONS, or "profile"."""


def in_validation(name: str) -> bool:
    """Tell whether a lens or a picture belongs to the validation tenth, by a hash of its name."""
    return zlib.crc32(name.encode()) % 10 == 0


def in_split(name: str, split: str) -> bool:
    """Tell whether a name belongs to "training", "validation" or "all"."""
    return split == "all" or in_validation(name) == (split == "validation")


def check_split(function: str, split: str) -> None:
    """Raise ValueError unless the split is known."""
    if split not in SPLITS:
        raise ValueError(f"{function}(): expected split in {SPLITS}, got {split!r}")


@functools.cache
def load_profiles(split: str) -> tuple[Profile, ...]:
    """Give the shipped profiles of a split; all lenses of one brand and model are on the same side.

    Args:
        split: "training", "validation" or "all".

    Raises:
        ValueError: another split.
    """
    check_split("load_profiles", split)
    packed = files(__package__).joinpath("lens_profiles.csv.gz").read_bytes()
    rows = csv.DictReader(gzip.decompress(packed).decode().splitlines())
    return tuple(
        Profile(
            f"{row['brand']} {row['model']}",
            np.array([float(row[f"k{i}"]) for i in (1, 2, 3, 4)]),
            math.radians(float(row["dfov_deg"])) / 2,
        )
        for row in rows
        if in_split(row["brand"] + row["model"], split)
    )


def draw_camera(
    rng: np.random.Generator, recipe: Recipe, split: str, image_size: tuple[int, int], *, panorama: bool = False
) -> DrawnCamera:
    """Draw a camera whose farthest picture corner sees theta_c and whose theta_d rises up to there.

    Args:
        rng: where chance comes from; how often it is asked varies.
        recipe: the distribution.
        split: whose real lenses.
        image_size: (height, width) of the fisheye picture.
        panorama: whether the source shows any angle.
    """
    low, high = map(math.radians, recipe.panorama_theta_deg if panorama else recipe.theta_deg)
    profiles = load_profiles(split)
    while True:
        if rng.random() < recipe.profile_share:
            kind, (_, k, theta_max) = "profile", profiles[rng.integers(len(profiles))]
            if theta_max < low:
                continue
            theta_c = rng.uniform(low, min(high, theta_max))
            if recipe.blend:
                # Rising curves of the same slope on the axis form a convex set: a mixture is a lens again.
                _, other, other_max = profiles[rng.integers(len(profiles))]
                share = rng.uniform(0, recipe.blend) if theta_c <= other_max else 0
                k = (1 - share) * k + share * other
        else:
            kind = PROJECTIONS[rng.integers(len(PROJECTIONS))]
            theta_c = rng.uniform(low, high)
            fov_deg = math.degrees(2 * theta_c * _BEYOND_FIT)
            if kind == "orthographic" and fov_deg > 180:
                continue
            k = np.asarray(FisheyeCamera.from_projection(kind, fov_deg, _FIT_SIZE).params[4:])
        aspect = 1 + rng.uniform(-recipe.aspect_spread, recipe.aspect_spread)
        centre = rng.normal(0, recipe.centre_spread * max(image_size), 2)
        if _rises(k, _BEYOND_CORNER * theta_c):
            return DrawnCamera(_camera_params(k, theta_c, aspect, centre, image_size), theta_c, kind)


def _rises(k: np.ndarray, theta: float) -> bool:
    u = np.linspace(0, theta, 64) ** 2
    slope = 1 + u * (3 * k[0] + u * (5 * k[1] + u * (7 * k[2] + u * 9 * k[3])))
    return bool(slope.min() > _MIN_SLOPE)


def _camera_params(
    k: np.ndarray, theta_c: float, aspect: float, offset: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    height, width = image_size
    # |offset| added to half the side: the corner opposite to where the principal point moved
    far = math.hypot(width / 2 + abs(offset[0]), (height / 2 + abs(offset[1])) / aspect)
    theta_d = theta_c + sum(k_i * theta_c ** (2 * i + 3) for i, k_i in enumerate(k))
    fx = far / theta_d
    return np.array([fx, fx * aspect, pixel.centre(width) + offset[0], pixel.centre(height) + offset[1], *k])
