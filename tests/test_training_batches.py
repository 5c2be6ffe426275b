"""Batches: the same whoever makes them, cut and turned with their cameras."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny_training import assert_same, draw_sources

import fisheyerec as fr
from fisheyerec.network import PICTURE_MEAN
from fisheyerec.training.augmentation import crop, turn
from fisheyerec.training.batches import AugmentedPairs, load_batches
from fisheyerec.training.synthesis import SyntheticPairs

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("workers", [1, 2])
def test_batches_are_the_same_whoever_makes_them(workers):
    dataset = AugmentedPairs(SyntheticPairs(draw_sources(), recipe="wide", size=(32, 32), rectified=False), True)
    here = list(load_batches(dataset, range(1, 4), 4))
    there = list(load_batches(dataset, range(1, 4), 4, workers=workers))
    assert_same(here, there)
    assert_same(here[2:], list(load_batches(dataset, range(3, 4), 4)))
    assert not torch.equal(here[0].fisheye, here[1].fisheye)
    shares = [list(load_batches(dataset, range(1, 4), 4, rank=rank, world_size=2)) for rank in range(2)]
    for whole, *parts in zip(here, *shares, strict=True):
        for field, one, other in zip(whole, *parts, strict=True):
            assert torch.equal(field, torch.stack([one, other], 1).flatten(0, 1))


def test_every_other_picture_gets_the_margins_of_another_shape():
    rng = np.random.default_rng(0)
    picture, labels = np.full((64, 64, 3), 7, np.uint8), np.ones((64, 64), np.uint8)
    heights = []
    for _ in range(200):
        cropped, cropped_labels = crop(rng, picture, labels)
        inside = (cropped == 7).all((1, 2))
        assert np.array_equal(inside, inside[::-1])
        assert np.array_equal(cropped_labels, np.repeat(inside[:, None], 64, 1))
        # What the network subtracts leaves nothing of a margin.
        assert np.abs(cropped[~inside] / 255 - PICTURE_MEAN).max(initial=0) <= 0.5 / 255
        heights.append(inside.sum())
    assert 80 < heights.count(64) < 130
    assert 32 <= min(heights) < 36
    assert crop(rng, picture, None)[1] is None


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("quarter_turns", range(4))
def test_a_turned_picture_has_the_turned_camera(quarter_turns, mirror):
    """Where a ray was seen, its turned ray is seen in the turned picture."""
    height, width = 48, 64
    camera = np.array([30.0, 31.0, 29.5, 22.25, 0.05, -0.01, 0.002, 0.0])
    y, x = np.mgrid[:height, :width]
    picture = np.stack([x, y, x + y], -1).astype(np.uint8)
    turned, labels, turned_camera = turn(picture, picture[..., 0], camera, quarter_turns, mirror)
    rows, columns = turned.shape[:2]
    assert (rows, columns) == ((height, width) if quarter_turns % 2 == 0 else (width, height))
    assert np.array_equal(labels, turned[..., 0])
    target = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).astype(float)
    rays, valid = fr.FisheyeCamera(turned_camera, (rows, columns)).unproject(target)
    assert valid.all()
    for _ in range(quarter_turns):  # back, clockwise with y down: what is up was to the right
        rays = np.stack([-rays[..., 1], rays[..., 0], rays[..., 2]], -1)
    if mirror:
        rays = rays * (-1, 1, 1)
    source, _ = fr.FisheyeCamera(camera, (height, width)).project(rays)
    np.testing.assert_allclose(turned[..., :2], source, rtol=0, atol=1e-6)
