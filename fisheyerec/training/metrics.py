"""How far a result is from the truth: pictures, positions, parameters, labels."""

from __future__ import annotations

import math

import numpy as np

from .. import pixel
from ..cameras import Camera, FisheyeCamera

PEAK = 255
SSIM_WINDOW = 11
_SSIM_SIGMA = 1.5
_C1, _C2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2

_offsets = np.arange(SSIM_WINDOW // 2 + 1)
_weights = np.exp(-(_offsets**2) / (2 * _SSIM_SIGMA**2))
# of the window's centre, and of both pixels at distance 1..5 from it
_KERNEL = _weights / (2 * _weights.sum() - _weights[0])


def psnr(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Give the peak signal-to-noise ratio in dB over all pixels and channels; infinite for equal pictures.

    Args:
        picture, truth: (H, W, C) uint8.
        mask: (H, W) bool, the pixels that count; None for all. NaN where none does.
    """
    squares = (picture.astype(np.float64) - truth) ** 2
    if mask is not None:
        squares = squares[mask]
    if squares.size == 0:
        return math.nan
    error = squares.mean()
    return 10 * math.log10(PEAK**2 / error) if error > 0 else math.inf


def ssim(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Give the structural similarity (Wang et al. 2004), Gaussian window 11x11 of sigma 1.5, mean over channels.

    As skimage.metrics.structural_similarity with gaussian_weights, sigma 1.5, use_sample_covariance=False and
    data_range 255: the mean over the windows that lie within the picture.

    Args:
        picture, truth: (H, W, C) uint8.
        mask: (H, W) bool, the window centres that count; None for all. NaN where none does, and for pictures smaller
            than the window.
    """
    if min(picture.shape[:2]) < SSIM_WINDOW:
        return math.nan
    similarity = np.mean([_ssim_map(picture[..., c], truth[..., c]) for c in range(picture.shape[2])], axis=0)
    if mask is not None:
        margin = SSIM_WINDOW // 2
        similarity = similarity[mask[margin:-margin, margin:-margin]]
    return float(similarity.mean()) if similarity.size else math.nan


def _ssim_map(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    x, y = picture.astype(np.float64), truth.astype(np.float64)
    mean_x, mean_y = _blur(x), _blur(y)
    xx, yy, xy = mean_x * mean_x, mean_y * mean_y, mean_x * mean_y
    # variances' sum and covariance
    variance, covariance = _blur(x * x + y * y) - xx - yy, _blur(x * y) - xy
    return (2 * xy + _C1) * (2 * covariance + _C2) / ((xx + yy + _C1) * (variance + _C2))  # type: ignore[no-any-return]


def _blur(values: np.ndarray) -> np.ndarray:
    """Weigh the Gaussian window around each pixel that has all of it: (H, W) -> (H - 10, W - 10)."""
    margin = len(_KERNEL) - 1
    for _ in range(2):
        count = values.shape[0] - 2 * margin
        out = _KERNEL[0] * values[margin : margin + count]
        for distance in range(1, margin + 1):
            before, after = margin - distance, margin + distance
            out += _KERNEL[distance] * (values[before : before + count] + values[after : after + count])
        values = out.T
    return values


def look_up(camera: FisheyeCamera, view: Camera) -> np.ndarray:
    """Give where each pixel of a view lies in the fisheye picture: (h, w, 2), NaN where the camera does not see it."""
    rays, _ = view.unproject(_positions(view.image_size))
    return np.asarray(camera.project(rays)[0])


def look_up_identity(camera: FisheyeCamera, view: Camera) -> np.ndarray:
    """Give where each pixel of a view lies in the fisheye picture if that is taken for the result: (h, w, 2)."""
    (height, width), (view_height, view_width) = camera.image_size, view.image_size
    x, y = np.moveaxis(_positions(view.image_size), -1, 0)
    return np.stack([pixel.scale(x, width / view_width), pixel.scale(y, height / view_height)], -1)


def displacement(positions: np.ndarray, truth: np.ndarray, identity: np.ndarray) -> np.ndarray:
    """Give the distance (h, w) in fisheye pixels between where an estimate and the truth look for the same pixel.

    Where the estimate looks nowhere it counts as the identity: a method cannot gain by seeing little. NaN where the
    truth looks nowhere.

    Args:
        positions, truth, identity: (h, w, 2), as `look_up` and `look_up_identity` give them.
    """
    seen = np.isfinite(positions).all(-1, keepdims=True)
    return np.asarray(np.linalg.norm(np.where(seen, positions, identity) - truth, axis=-1))


def parameter_errors(camera: FisheyeCamera, truth: FisheyeCamera) -> dict[str, float]:
    """Give |estimate - truth| / |truth| of each of the eight parameters, by name.

    k1..k4 are ill-conditioned: very different ones draw the same picture.
    """
    estimated, true = np.asarray(camera.numpy().params), np.asarray(truth.numpy().params)
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.abs(estimated - true) / np.abs(true)
    return dict(zip(FisheyeCamera.parameter_names, errors.tolist(), strict=True))


def field_of_view_deg(camera: FisheyeCamera) -> float:
    """Give the angle between the rays of opposite picture corners, both diagonals' mean; NaN past the lens' end."""
    height, width = camera.image_size
    left, upper = -pixel.HALF_PIXEL, -pixel.HALF_PIXEL
    right, lower = width - pixel.HALF_PIXEL, height - pixel.HALF_PIXEL
    rays, _ = camera.unproject(np.array([(left, upper), (right, upper), (left, lower), (right, lower)]))
    # Two angles to the axis make a diagonal; the four make both.
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    return math.degrees(theta.sum() / 2)


def mean_iou(labels: np.ndarray, truth: np.ndarray) -> float:
    """Give the intersection over union, mean over the classes of the truth; NaN where all of it is unlabelled.

    Args:
        labels, truth: (H, W) integers, 0 = unlabelled; pixels unlabelled in truth do not count.
    """
    counts = truth > 0
    labels, truth = labels[counts], truth[counts]
    ratios = []
    for label in np.unique(truth):
        estimated, true = labels == label, truth == label
        ratios.append((estimated & true).sum() / (estimated | true).sum())
    return float(np.mean(ratios)) if ratios else math.nan


def bootstrap_interval(
    values: np.ndarray, groups: list[str], *, rounds: int = 1000, seed: int = 0
) -> tuple[float, float]:
    """Give the 95 % interval of the mean, drawing whole groups with replacement.

    Args:
        values: (N,); NaN are left out.
        groups: N names: what pairs made from one source have in common makes them no independent measurements.
        rounds: how many draws.
        seed: where chance starts.
    """
    kept = np.isfinite(values)
    if not kept.any():
        return math.nan, math.nan
    _, members = np.unique(np.array(groups)[kept], return_inverse=True)
    sums, counts = np.bincount(members, values[kept]), np.bincount(members)
    drawn = np.random.default_rng(seed).integers(0, len(sums), (rounds, len(sums)))
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def _positions(size: tuple[int, int]) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(float(size[1])), np.arange(float(size[0]))), -1)
