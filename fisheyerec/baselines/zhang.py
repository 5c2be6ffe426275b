"""Zhang, Yao, Xia, Li, Zhang and Liu, "Line-based multi-label energy optimization for fisheye image rectification and
calibration", CVPR 2015.

Circular arcs from edge chains; short arcs that belong to one line are merged, and what is none dropped, by labelling
arcs with circles at least energy; three of the long arcs that result tell the lens, all of them refine it.

Where this had to choose: the labels are the circles of the longest arcs and "no line"; an arc's cost is its length
times the mean of min(d^2 / t^2, 1) over its points' distances d from the circle, or a constant; neighbours, which cost
the shorter one's length times a factor if labelled differently, are arcs whose ends are near and point at each other.
Circles are fitted anew to their arcs and labelled again. The camera on the unit sphere that the article takes three
arcs through is the stereographic one, whose lines are circles indeed: the division model, with its focal length and
principal point. The three are those whose model the others support best; the principal point is kept only where it is
known better than lenses are off centre anyway, else the strength alone is told, about the picture's centre. The last
step is not Levenberg and Marquardt's but Gauss-Newton's, with lines eliminated: three unknowns remain.
"""

from __future__ import annotations

import numpy as np

from ..cameras import FisheyeCamera
from ..sightlines import Pieces
from .arcs import Arcs, distance, find_arcs, find_chains, refit, taubin
from .consensus import consensus
from .labelling import alpha_expansion

_ARC_TOLERANCE_PX = 1.0
_SHORT, _LONG = 0.08, 0.25  # of arcs before and after merging, in half diagonals
_MOST_ARCS, _MOST_LABELS = 100, 40
_NEAR_PX = 0.7  # t
_NO_LINE = 0.5  # of the cost of an arc whose points are all off the circle
_NEIGHBOURS = 0.25  # of the shorter one's length
_GAP = 0.4  # between neighbours' ends, in half diagonals
_GAP_SINE = 0.3  # of the turn into the gap and out of it
_TOUCHING_PX = 4.0  # a gap so small has no direction
_ROUNDS = 3


def estimate(image: np.ndarray) -> FisheyeCamera | None:
    """Estimate the camera of a picture (H, W, 3) RGB uint8; None where no arcs tell it."""
    rng = np.random.default_rng(0)
    arcs = find_arcs(*find_chains(image), tolerance_px=_ARC_TOLERANCE_PX, min_length=_SHORT, rng=rng)
    if not len(arcs):
        return None
    merged = merge(arcs.subset(np.arange(min(len(arcs), _MOST_ARCS))))
    model = consensus(merged.subset(np.nonzero(merged.pieces.lengths > _LONG)[0]), rng)
    return None if model is None else model.camera((image.shape[0], image.shape[1]))


def merge(arcs: Arcs) -> Arcs:
    """Merge arcs, longest first, that one circle labels, and drop those that none does; longest first again."""
    pairs = neighbours(arcs)
    lengths = arcs.pieces.lengths
    weights = _NEIGHBOURS * lengths[pairs].min(-1)
    circles = arcs.circles[:_MOST_LABELS]
    for _ in range(_ROUNDS):
        d = distance(circles, arcs.pieces.points[:, None]) / (_NEAR_PX * arcs.pixel)
        misfit = arcs.pieces.sums(np.minimum(d * d, 1)) / arcs.pieces.counts[:, None]
        unary = lengths[:, None] * np.concatenate([misfit, np.full((len(arcs), 1), _NO_LINE)], -1)
        labels = alpha_expansion(unary, pairs, weights)
        groups = [np.nonzero(labels == label)[0] for label in np.unique(labels[labels < len(circles)])]
        if not groups:
            return arcs.subset(np.zeros(0, dtype=np.intp))
        pieces = arcs.pieces.joined(groups)
        circles = refit(taubin(pieces), pieces)
    pieces = in_order(pieces)
    merged = Arcs(pieces, circles, arcs.pixel)
    return merged.subset(np.argsort(-pieces.lengths, kind="stable"))


def neighbours(arcs: Arcs) -> np.ndarray:
    """Give the pairs (P, 2) of arcs with ends that are near and point at each other."""
    pieces = arcs.pieces
    ends = pieces.points[np.stack([pieces.starts[:-1], pieces.starts[1:] - 1], -1)]  # (K, 2, 2)
    a, b, c, _ = arcs.circles.T[:, :, None]
    outwards = np.stack([-(2 * a * ends[..., 1] + c), 2 * a * ends[..., 0] + b], -1)
    outwards /= np.linalg.norm(outwards, axis=-1, keepdims=True)
    outwards *= np.sign((outwards * (ends - ends[:, ::-1])).sum(-1, keepdims=True))
    ends, outwards, owners = ends.reshape(-1, 2), outwards.reshape(-1, 2), np.repeat(np.arange(len(arcs)), 2)
    gaps = ends[None] - ends[:, None]
    far = np.linalg.norm(gaps, axis=-1)
    reach = np.maximum(far, _TOUCHING_PX * arcs.pixel)
    # From end i to end j: how far j lies ahead and aside of where i points.
    ahead = (gaps * outwards[:, None]).sum(-1) / reach
    aside = np.abs(gaps[..., 0] * outwards[:, None, 1] - gaps[..., 1] * outwards[:, None, 0]) / reach
    faces = (aside < _GAP_SINE) & ((ahead > 0) | (far < reach))
    near = (far < _GAP) & faces & faces.T & ((outwards @ outwards.T) < 0)
    i, j = np.nonzero(near & (owners[:, None] < owners))
    return np.unique(np.stack([owners[i], owners[j]], -1), axis=0)


def in_order(pieces: Pieces) -> Pieces:
    """Put the points of each piece in their order along its longer axis."""
    local = pieces.points - (pieces.sums(pieces.points) / pieces.counts[:, None])[pieces.owners]
    _, axes = np.linalg.eigh(pieces.sums(local[:, :, None] * local[:, None, :]))
    along = (local * axes[pieces.owners, :, 1]).sum(-1)
    return Pieces(pieces.points[np.lexsort((along, pieces.owners))], pieces.starts)
