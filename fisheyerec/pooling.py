"""One camera from what several pictures of it tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from .cameras import FisheyeCamera
from .lens_chart import camera_from_chart, chart_of
from .rectifier import PhotoEstimate


def pool(estimates: Sequence[PhotoEstimate]) -> PhotoEstimate:
    """Give the camera that most of several estimates agree on.

    Whether it distorts is voted on, with confidences as weights. The camera of the winners is their weighted median in
    each number of the lens chart: a frame that shows no line, or only bent things, moves it little. Confidence and
    straightness are weighted medians too.

    Args:
        estimates: of pictures of the same size, at least one.

    Raises:
        ValueError: no estimate, or pictures of different sizes.
    """
    sizes = {estimate.camera.image_size for estimate in estimates}
    if len(sizes) != 1:
        raise ValueError(f"pool(): expected estimates of pictures of one size, got sizes {sorted(sizes)}")
    confidence = np.array([estimate.confidence for estimate in estimates])
    votes = np.array([estimate.distorted for estimate in estimates])
    distorted = bool(confidence[votes].sum() >= confidence[~votes].sum())
    winners = [estimate for estimate in estimates if estimate.distorted == distorted]
    weights = confidence[votes == distorted]
    charts = np.array([chart_of(estimate.camera) for estimate in winners])
    chart = torch.from_numpy(np.array([weighted_median(numbers, weights) for numbers in charts.T]))
    size = sizes.pop()
    before = np.array([estimate.straightness_before for estimate in winners])
    after = np.array([estimate.straightness_after for estimate in winners])
    return PhotoEstimate(
        FisheyeCamera(camera_from_chart(chart, size).numpy(), size),
        weighted_median(weights, weights),
        distorted,
        weighted_median(before, weights),
        weighted_median(after, weights),
        any(estimate.refined for estimate in winners),
    )


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Give the value at which half of the weight lies below or at; NaN values count for nothing, alone they give NaN.

    Args:
        values: (N,).
        weights: (N,), positive.
    """
    known = ~np.isnan(values)
    if not known.any():
        return float("nan")
    order = np.argsort(values[known])
    below = np.cumsum(weights[known][order])
    return float(values[known][order][np.searchsorted(below, below[-1] / 2)])
