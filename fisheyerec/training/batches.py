"""Batches to train on: any step's batch can be made by anyone at any time, so that training resumes exactly."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from .augmentation import crop, develop, turn
from .losses import UNLABELLED
from .synthesis import SyntheticPairs


class Batch(NamedTuple):
    """B pairs."""

    fisheye: Tensor
    """(B, 3, H, W) uint8."""
    rectified: Tensor
    """(B, 3, H, W) uint8; (B, 0, H, W) where not asked for."""
    labels: Tensor
    """(B, H, W) uint8, 0 where unlabelled."""
    camera: Tensor
    """(B, 8) float64."""


class AugmentedPairs(Dataset[Batch]):
    """Pairs as batches of one, augmented by chance that depends on their index alone.

    Args:
        pairs: where they come from.
        augment: whether to develop, crop, turn and mirror them; pairs with a straight picture are only developed.
    """

    def __init__(self, pairs: SyntheticPairs, augment: bool) -> None:
        self.pairs, self.augment = pairs, augment

    def __getitem__(self, index: int) -> Batch:
        """Make one pair."""
        pair = self.pairs[index]
        fisheye, labels, camera = pair.fisheye, pair.labels, pair.camera
        if self.augment:
            rng = np.random.default_rng([self.pairs.seed, 2, index])
            fisheye = develop(rng, fisheye)
            if pair.rectified is None:
                fisheye, labels = crop(rng, fisheye, labels)
                fisheye, labels, camera = turn(fisheye, labels, camera, int(rng.integers(4)), bool(rng.integers(2)))
        height, width = fisheye.shape[:2]
        rectified = np.empty((height, width, 0), np.uint8) if pair.rectified is None else pair.rectified
        if labels is None:
            labels = np.full((height, width), UNLABELLED, np.uint8)
        return Batch(
            torch.tensor(fisheye).permute(2, 0, 1)[None],
            torch.tensor(rectified).permute(2, 0, 1)[None],
            torch.tensor(labels)[None],
            torch.tensor(camera)[None],
        )


def collate(samples: list[Batch]) -> Batch:
    """Join batches along their first dimension."""
    return Batch(*(torch.cat(tensors) for tensors in zip(*samples, strict=True)))


def load_batches(
    dataset: AugmentedPairs, steps: range, batch_size: int, *, rank: int = 0, world_size: int = 1, workers: int = 0
) -> Iterator[Batch]:
    """Give the batches of some steps, in order: step s holds pairs s * batch_size and on.

    Args:
        dataset: of pairs.
        steps: which.
        batch_size: of all processes together.
        rank: of this process, which gets every world_size-th pair.
        world_size: how many processes share the batch.
        workers: processes that make the pairs; 0 makes them here. The batches are the same.
    """
    indices = (list(range(s * batch_size + rank, (s + 1) * batch_size, world_size)) for s in steps)
    loader = DataLoader(
        dataset,
        batch_sampler=indices,
        num_workers=workers,
        collate_fn=collate,
        prefetch_factor=4 if workers else None,
        worker_init_fn=_begin_worker,
        generator=torch.Generator(),  # else starting it draws from the generator that drop-out uses
    )
    return iter(loader)


def _begin_worker(worker: int) -> None:
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that trains
