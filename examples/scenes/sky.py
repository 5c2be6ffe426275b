"""What lies beyond the solids: the sky, and a hazy landscape on the horizon."""

from __future__ import annotations

import numpy as np

from .lighting import Sun
from .materials import mix, noise, rgb


def clear_sky(ray: np.ndarray, sun: Sun, cloudiness: float = 0.5) -> np.ndarray:
    """Radiance (N, 3) of a summer sky with clouds along unit rays (N, 3)."""
    height = np.maximum(-ray[:, 1], 0)
    pale, deep = rgb("#d5e3ee"), rgb("#4f86c6")
    colour = mix(np.broadcast_to(pale, ray.shape), deep, height**0.55)
    reach = 1 / (height + 0.12)
    u, v = ray[:, 0] * reach / 9, ray[:, 2] * reach / 9
    cover = noise(u, v) + 0.45 * noise(3.1 * u + 0.3, 3.1 * v) + cloudiness - 1.1
    density = np.clip(cover / 1.6, 0, 1) * np.clip(height / 0.18, 0, 1)
    colour = mix(colour, rgb("#fbfaf7"), 0.85 * density)
    glow = np.maximum(ray @ sun.direction, 0)
    return colour + (0.35 * glow**12 + 1.2 * glow**220)[:, None] * rgb("#fff0d4")


def landscape(ray: np.ndarray, sun: Sun) -> np.ndarray:
    """Radiance (N, 3) along unit rays (N, 3) of a garden seen from a window."""
    colour = clear_sky(ray, sun)
    azimuth = np.arctan2(ray[:, 0], ray[:, 2])
    far_ridge = 0.055 + 0.012 * noise(azimuth / 2.1, 0 * azimuth)
    near_ridge = 0.015 + 0.03 * np.abs(noise(azimuth * 0.9, 0 * azimuth + 0.4))
    slope = -ray[:, 1]
    leaves = 1 + 0.18 * noise(azimuth * 3, slope * 4)
    for ridge, tone in ((far_ridge, rgb("#9db0a4")), (near_ridge, rgb("#6f8a5c"))):
        share = np.clip((ridge - slope) / 0.004 + 0.5, 0, 1)
        colour = mix(colour, tone * leaves[:, None], share)
    lawn = rgb("#8fa968") * (1 + 0.05 * noise(azimuth * 2, slope * 6))[:, None]
    return mix(colour, lawn, np.clip((-0.03 - slope) / 0.01, 0, 1))
