"""Looking at a network during training: numbers and pictures of unseen sources through unseen lenses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from .. import lens_chart
from ..network import LensNetwork
from .batches import AugmentedPairs, collate
from .losses import UNLABELLED, coarse_labels, displacement
from .synthesis import SyntheticPairs

_BATCH = 32
_SHOWN = 4


class Validation:
    """Pairs of the standard protocol, made once and kept.

    Args:
        pairs: where they come from, with their straight pictures.
        count: how many.
    """

    def __init__(self, pairs: SyntheticPairs, count: int) -> None:
        dataset = AugmentedPairs(pairs, augment=False)
        self.batch = collate([dataset[index] for index in range(count)])


@dataclass(frozen=True)
class ValidationResult:
    """What `validate` saw."""

    numbers: dict[str, float]
    """Columns of the training log."""
    pictures: dict[str, np.ndarray]
    """(H, W, 3) uint8: input, result and ground truth side by side."""


@torch.no_grad()
def validate(network: LensNetwork, validation: Validation, device: torch.device) -> ValidationResult:
    """Run a network in inference mode over the validation pairs and go back to training mode."""
    network.eval()
    distances, psnrs, charts, hits, labelled = [], [], [], 0, 0
    pictures: dict[str, np.ndarray] = {}
    for start in range(0, len(validation.batch.camera), _BATCH):
        fisheye, rectified, labels, camera = (tensor[start : start + _BATCH].to(device) for tensor in validation.batch)
        output = network(fisheye.float() / 255)
        distances.append(displacement(output.camera, output.view, camera))
        error = (255 * output.image).round() - rectified
        psnrs.append(10 * torch.log10(255**2 / error.square().mean((1, 2, 3)).clamp(min=1e-6)))
        charts.append(output.estimate.chart)
        if output.parsing is not None:
            coarse = coarse_labels(labels, labels.shape[-1] // output.parsing.shape[-1])
            known = coarse != UNLABELLED
            hits += int(((output.parsing.argmax(1) + 1 == coarse) & known).sum())
            labelled += int(known.sum())
        if not pictures:
            rows = [fisheye, (255 * output.image).round().to(torch.uint8), rectified]
            pictures["input, rectified, ground truth"] = _sheet(rows)
    network.train()
    height, width = validation.batch.fisheye.shape[-2:]
    truth = lens_chart.chart_from_camera(validation.batch.camera, (height, width))
    r2 = _explained(torch.cat(charts).cpu(), truth)
    numbers = {
        "validation_displacement_px": float(torch.cat(distances).mean()),
        "validation_psnr": float(torch.cat(psnrs).mean()),
        "validation_profile_r2": float(r2[lens_chart.PROFILE].mean()),
        "validation_offset_r2": float(r2[lens_chart.PRINCIPAL_POINT].mean()),
    }
    if labelled:
        numbers["validation_accuracy"] = hits / labelled
    return ValidationResult(numbers, pictures)


def _explained(estimate: Tensor, truth: Tensor) -> Tensor:
    """The share of the variance of each number of the chart that the estimate explains: (8,)."""
    known = truth.isfinite().all(-1)
    estimate, truth = estimate[known], truth[known]
    return 1 - (estimate - truth).square().mean(0) / truth.var(0, unbiased=False)


def _sheet(rows: list[Tensor]) -> np.ndarray:
    strips = [torch.cat(list(row[:_SHOWN].cpu()), -1) for row in rows]
    return torch.cat(strips, -2).permute(1, 2, 0).numpy()
