"""Edge chains: where edges are found, and where chains begin and end."""

from __future__ import annotations

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2")

from fisheyerec.lines import find_chains  # noqa: E402  after cv2 is known to be there

# A step blurred by the pixel's own square and sampled on a grid: what the parabola leaves, 0.046, with a margin.
EDGE_PX = 0.06


def drawn(inside, size=128, fine=8, dark=60.0, bright=190.0):
    """Draw where inside(x, y) holds, each pixel the mean of fine x fine samples."""
    at = (np.arange(size * fine) + 1 / 2) / fine - 1 / 2
    x, y = np.meshgrid(at, at)
    share = inside(x, y).reshape(size, fine, size, fine).mean((1, 3))
    return np.round(dark + (bright - dark) * share).astype(np.uint8)


def chain(chains, i):
    return chains.points[chains.starts[i] : chains.starts[i + 1]]


@pytest.mark.parametrize("angle_deg", [0, 7, 30, 45, 80, 90, 133, 200, 315])
def test_a_straight_edge_is_one_chain_in_its_place(angle_deg):
    a, b = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    chains = find_chains(drawn(lambda x, y: a * (x - 63.25) + b * (y - 60.75) > 0))
    assert len(chains) == 1
    x, y = chains.points.T
    inner = (np.abs(x - 63.5) < 58) & (np.abs(y - 63.5) < 58)  # reflection at the border bends the edge
    assert inner.sum() > 80
    assert np.abs(a * (x - 63.25) + b * (y - 60.75))[inner].max() < EDGE_PX
    assert (chains.gradients[inner] @ (a, b)).min() > 0.999


def test_a_circle_stays_in_its_place():
    """Smoothing by sigma moves an arc inwards, by sigma^2 / 2r: 0.01 px here."""
    chains = find_chains(drawn(lambda x, y: np.hypot(x - 64.3, y - 62.9) < 45))
    radius = np.hypot(chains.points[:, 0] - 64.3, chains.points[:, 1] - 62.9)
    assert len(chains.points) > 200
    assert np.abs(radius - 45).max() < EDGE_PX + 0.02


def test_corners_part_chains():
    chains = find_chains(drawn(lambda x, y: (np.abs(x - 60.4) < 30.2) & (np.abs(y - 65.1) < 25.3)))
    assert len(chains) == 4
    for i in range(4):
        spread = np.ptp(chain(chains, i), axis=0)
        assert spread.min() < 1.5 < 40 < spread.max()


def test_the_longest_chain_comes_first_and_short_ones_are_left_out():
    image = np.minimum(
        drawn(lambda x, y: (np.abs(y - 30.3) > 6) | (x > 100)), drawn(lambda x, y: (np.abs(y - 90.3) > 6) | (x > 40))
    )
    chains = find_chains(image, min_length=30)
    length = [np.linalg.norm(chain(chains, i)[-1] - chain(chains, i)[0]) for i in range(len(chains))]
    assert length == sorted(length, reverse=True)
    assert len(chains) == 4
    assert len(find_chains(image, min_length=60)) == 2


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (3, 3), (64, 64), (5, 300)])
def test_a_flat_picture_has_none(shape):
    chains = find_chains(np.full(shape, 127, np.uint8))
    assert len(chains) == 0
    assert chains.points.shape == (0, 2)
    assert chains.owners.shape == (0,)


def test_noise_is_no_line():
    image = np.random.default_rng(0).normal(127, 3, (128, 128)).round().astype(np.uint8)
    assert len(find_chains(image, min_length=20)) == 0
