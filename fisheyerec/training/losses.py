"""What training minimises: the paper's losses, and losses on the lens and on where pixels land."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from .. import lens_chart, pixel
from ..cameras import FisheyeCamera, PinholeCamera
from ..network import LensClasses, LensEstimate

UNLABELLED = 0


def rectification_loss(image: Tensor, rectified: Tensor) -> Tensor:
    """The paper's L_r (Eq. 6): squared difference of the rectified pictures, a mean over pixels, summed over channels.

    Args:
        image: (B, 3, H, W) in [0, 1], I^r.
        rectified: (B, 3, H, W) in [0, 1], the ground truth I^gt.
    """
    return (image - rectified).square().sum(1).mean()


def coarse_labels(labels: Tensor, shrink: int) -> Tensor:
    """Give the labels (B, H, W) of the middle pixel of each cell of shrink x shrink pixels: (B, h, w) int64."""
    return labels[:, shrink // 2 :: shrink, shrink // 2 :: shrink].to(torch.int64)


def parsing_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """The paper's L_sp: cross-entropy of the scene parsing, over labelled pixels.

    Args:
        logits: (B, N, h, w), of the picture's size or a fraction of it.
        labels: (B, H, W) uint8 or int64: 0 unlabelled, 1..N; pictures without labels are all 0.

    Returns:
        A scalar; 0 where nothing is labelled.
    """
    labels = coarse_labels(labels, labels.shape[-1] // logits.shape[-1])
    count = (labels != UNLABELLED).sum().clamp(min=1)
    return functional.cross_entropy(logits.float(), labels - 1, ignore_index=UNLABELLED - 1, reduction="sum") / count


def lens_loss(estimate: LensEstimate, params: Tensor, image_size: tuple[int, int]) -> Tensor:
    """How far the estimated lens is off: smooth L1 of each number of the chart, in its deviations of the population.

    Besides, for networks that emit it, the likelihood of their expected errors, which does not act on the estimate
    itself: a network must not find it cheaper to doubt than to learn.

    Args:
        estimate: of the network, for B pictures.
        params: (B, 8), the true cameras.
        image_size: (height, width).
    """
    mean, basis = (value.to(params.device) for value in lens_chart.population())
    chart = lens_chart.chart_from_camera(params, image_size)
    known = chart.isfinite()
    error = torch.where(known, (estimate.chart - chart) / basis.norm(dim=-1), 0.0)
    weight = _IMPORTANCE.to(error)
    loss = (weight * functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")).sum(-1).mean()
    deviation = (chart - mean) @ torch.linalg.inv(basis).mT
    doubted = torch.where(known.all(-1, keepdim=True), estimate.deviation.detach() - deviation, 0.0)
    scaled = doubted / estimate.log_sigma.exp()
    return loss + _DOUBT * (scaled.square() / 2 + estimate.log_sigma).mean()


# Most to the profile, which curvature shows. Little to what a photo hardly tells: field of view, principal point and
# aspect.
_IMPORTANCE = torch.tensor([0.25, 0.25, 0.25, 0.25, 0.05, 0.02, 0.02, 0.01])
_DOUBT = 0.02


def classification_loss(estimate: LensClasses, params: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Cross-entropy of the class whose profile is nearest to that of the true lens.

    Args:
        estimate: of the network, for B pictures.
        params: (B, 8), the true cameras.
        image_size: (height, width).

    Returns:
        A scalar, the mean over lenses that have a chart; 0 where none has.
    """
    truth = lens_chart.chart_from_camera(params, image_size)[:, lens_chart.PROFILE]
    known = truth.isfinite().all(-1)
    label = torch.cdist(truth[known], estimate.classes[:, lens_chart.PROFILE]).argmin(-1)
    loss = functional.cross_entropy(estimate.logits[known].float(), label, reduction="sum")
    return loss / known.sum().clamp(min=1)


def displacement(camera: FisheyeCamera, view: PinholeCamera, params: Tensor, points_a_side: int = 8) -> Tensor:
    """Mean distance between where the estimated and the true pair of camera and view look for a rectified pixel.

    Differentiable in the estimated camera and view.

    Args:
        camera: the estimate, params (B, 8).
        view: its edge-matched view.
        params: (B, 8), the true cameras.
        points_a_side: how many pixels of the view are looked at, evenly spread, in each direction.

    Returns:
        (B,) in pixels of the fisheye picture, over the points that both cameras see.
    """
    true_camera = FisheyeCamera(params, camera.image_size)
    true_view = PinholeCamera.edge_matched(true_camera, view.image_size)
    height, width = view.image_size
    cells = torch.arange(points_a_side, dtype=torch.float64, device=params.device)
    x = pixel.scale(cells, width / points_a_side)
    y = pixel.scale(cells, height / points_a_side)
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(1, -1, 2).expand(len(params), -1, -1)
    here, seen = camera.project(view.unproject(grid)[0])
    there, truly_seen = true_camera.project(true_view.unproject(grid)[0])
    both = seen & truly_seen
    difference = torch.where(both[..., None], here - there, 0.0)
    distance = (difference.square().sum(-1) + 1e-6).sqrt()
    mean: Tensor = (distance * both).sum(-1) / both.sum(-1).clamp(min=1)
    return mean
