"""Measure the lens population that the network's outputs are normalised by; `python -m` writes lens_population.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from .. import lens_chart
from .lenses import draw_camera
from .recipes import STANDARD

_IMAGE_SIZE = (256, 256)


def measure_population(count: int = 20_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Draw training cameras of the standard recipe and describe their charts.

    Args:
        count: how many cameras.
        seed: of the draw.

    Returns:
        The mean chart (8,), and a basis (8, 8) whose columns are independent deviations of one sigma: the principal
        components of profile and field of view together, then the principal point's x and y, then the aspect.
    """
    rng = np.random.default_rng(seed)
    params = np.stack([draw_camera(rng, STANDARD, "training", _IMAGE_SIZE).params for _ in range(count)])
    charts = lens_chart.chart_from_camera(torch.from_numpy(params), _IMAGE_SIZE).numpy()
    charts = charts[np.isfinite(charts).all(1)]
    mean = charts.mean(0)
    mean[5:] = 0  # no side is favoured
    basis = np.zeros((8, 8))
    values, vectors = np.linalg.eigh(np.cov(charts[:, :5].T))
    vectors *= np.sign(vectors[0])  # eigenvectors have no sign of their own: the innermost radius decides
    basis[:5, :5] = (vectors * np.sqrt(values))[:, ::-1]
    offset = np.sqrt((charts[:, 5:7] ** 2).mean())
    basis[5, 5] = basis[6, 6] = offset
    basis[7, 7] = np.sqrt((charts[:, 7] ** 2).mean())
    return mean, basis


def main() -> None:
    """Write the population beside `lens_chart`."""
    mean, basis = measure_population()
    path = Path(lens_chart.__file__).with_name("lens_population.json")
    path.write_text(json.dumps({"mean": mean.tolist(), "basis": basis.tolist()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
