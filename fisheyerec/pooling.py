"""One camera from what several pictures of it tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from .cameras import FisheyeCamera
from .image_circle import ImageCircle
from .lens_chart import camera_from_chart, chart_of
from .rectifier import PhotoEstimate

# Of Student's t distribution: an estimate that is off by more than its covariance says counts for less.
_DEGREES_OF_FREEDOM = 4
_ITERATIONS = 30
_SMALLEST_VARIANCE = 1e-9  # of a number of the chart; keeps a covariance that is all but certain invertible


def pool(estimates: Sequence[PhotoEstimate]) -> PhotoEstimate:
    """Give the camera that most of several estimates agree on.

    Whether it distorts is voted on, with confidences as weights. The camera of the winners is the location of a
    multivariate t distribution in the lens chart (`robust_mean`): each counts by what it knows, and one that
    contradicts the others by more than it admits counts for little. Confidence and straightness are medians: frames of
    one clip show much the same, so that many are not much surer than one.

    Args:
        estimates: of pictures of the same size, at least one.

    Raises:
        ValueError: no estimate, or pictures of different sizes.
    """
    sizes = {estimate.camera.image_size for estimate in estimates}
    if len(sizes) != 1:
        raise ValueError(f"pool(): expected estimates of pictures of one size, got sizes {sorted(sizes)}")
    votes = sum(estimate.confidence if estimate.distorted else -estimate.confidence for estimate in estimates)
    winners = [estimate for estimate in estimates if estimate.distorted == (votes >= 0)]
    # A chart is of the part of the picture that the lens is judged by.
    circles = [estimate.image_circle for estimate in winners if estimate.image_circle is not None]
    circle = ImageCircle(*np.median(circles, 0).tolist()) if 2 * len(circles) > len(winners) else None
    winners = [estimate for estimate in winners if (estimate.image_circle is None) == (circle is None)]
    charts = np.array([chart_of(estimate.judged_camera) for estimate in winners])
    mean, covariance = robust_mean(charts, np.array([estimate.covariance for estimate in winners]))
    size = sizes.pop()
    judged = size if circle is None else (circle.inscribed.side,) * 2
    camera = FisheyeCamera(camera_from_chart(torch.from_numpy(mean), judged).numpy(), judged)
    return PhotoEstimate(
        camera if circle is None else circle.inscribed.whole(camera, size),
        float(np.median([estimate.confidence for estimate in winners])),
        votes >= 0,
        _median([estimate.straightness_before for estimate in winners]),
        _median([estimate.straightness_after for estimate in winners]),
        any(estimate.refined for estimate in winners),
        covariance,
        circle,
    )


def robust_mean(values: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the mean of vectors of which each has its own covariance, some of them too small.

    Iteratively reweighted, m = (sum w_i P_i)^-1 sum w_i P_i c_i with P_i the inverse covariances and
    w_i = (v + p) / (v + (c_i - m)' P_i (c_i - m)), as Lange, Little and Taylor (1989) fit a t distribution.

    Args:
        values: (N, p), c.
        covariances: (N, p, p).

    Returns:
        The mean (p,), and its covariance (p, p), were the vectors independent.
    """
    size = values.shape[1]
    precisions = np.linalg.inv(covariances + _SMALLEST_VARIANCE * np.eye(size))
    weights = np.ones(len(values))
    for _ in range(_ITERATIONS):
        weighted = weights[:, None, None] * precisions
        covariance = np.linalg.inv(weighted.sum(0))
        mean = covariance @ (weighted @ values[..., None]).sum(0)[:, 0]
        offsets = values - mean
        distances = np.einsum("ni,nij,nj->n", offsets, precisions, offsets)
        weights = (_DEGREES_OF_FREEDOM + size) / (_DEGREES_OF_FREEDOM + distances)
    return mean, covariance


def _median(values: Sequence[float]) -> float:
    """The median of the numbers among the values; NaN where there is none."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.median(known)) if known else float("nan")
