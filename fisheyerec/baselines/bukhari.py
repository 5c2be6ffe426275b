"""Bukhari and Dailey, "Automatic radial distortion estimation from a single image", JMIV 45 (2013) 31-45.

Edge chains; a circular arc in each by sampling three points and refitting; the division model and its centre from
triples of arcs by RANSAC; refinement.

Where this had to choose: chains are those of lines.py, which end at corners, so that each has one arc at most. The
support of a model is not the number of arcs near it but the sum of their lengths, each less the more its points miss
the best line under the model. What is refined are model and lines together, over the arcs that support it. The centre
is kept only where it is known better than lenses are off centre anyway; else the picture's own takes its place, about
which each arc alone tells a model. There is no estimate where the strength is hardly known.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ..cameras import FisheyeCamera
from .arcs import Arcs, find_arcs, find_chains
from .division import CENTRE_MAX, DivisionModel, clipped, misfits, model_of_three, refine, strength_about

_ARC_TOLERANCE_PX = 1.0
_MIN_LENGTH = 0.15  # of an arc, in half diagonals
_MOST_ARCS = 60
_TRIPLES = 500
_CUT_PX = 0.3  # RMS distance of an arc from a line that halves its support


def estimate(image: np.ndarray) -> FisheyeCamera | None:
    """Estimate the camera of a picture (H, W, 3) RGB uint8; None where no arcs tell it."""
    rng = np.random.default_rng(0)
    arcs = find_arcs(*find_chains(image), tolerance_px=_ARC_TOLERANCE_PX, min_length=_MIN_LENGTH, rng=rng)
    arcs = arcs.subset(np.arange(min(len(arcs), _MOST_ARCS)))
    model = model_of_triples(arcs, rng) or model_about_centre(arcs)
    return None if model is None else model.camera((image.shape[0], image.shape[1]))


def model_of_triples(arcs: Arcs, rng: np.random.Generator) -> DivisionModel | None:
    """Give the model of the three arcs that is supported best, refined, if its centre can be told."""
    triples = np.array(list(combinations(range(len(arcs)), 3)), dtype=np.intp).reshape(-1, 3)
    centres, strengths = model_of_three(arcs.circles[rng.permutation(triples)[:_TRIPLES]])
    usable = (np.linalg.norm(centres, axis=-1) < CENTRE_MAX) & (strengths > 0)
    if not usable.any():
        return None
    model = _best_supported(arcs, centres[usable], strengths[usable])
    misfit = misfits(arcs.pieces, model.centre[None], np.array([model.strength]))[0]
    supporting = arcs.subset(np.nonzero(misfit < (_CUT_PX * arcs.pixel) ** 2)[0])
    if len(supporting) < 3:
        return None
    refined = refine(model, supporting.pieces, free_centre=True)
    return refined.model if refined.tells_centre and refined.tells_strength else None


def model_about_centre(arcs: Arcs) -> DivisionModel | None:
    """Give the model about the picture's centre that is supported best, refined, if its strength can be told."""
    if not len(arcs):
        return None
    strengths = strength_about(arcs.circles, np.zeros(2))
    model = _best_supported(arcs, np.zeros((len(strengths), 2)), strengths)
    refined = refine(model, arcs.pieces, cut=_CUT_PX * arcs.pixel, free_centre=False)
    return refined.model if refined.tells_strength else None


def _best_supported(arcs: Arcs, centres: np.ndarray, strengths: np.ndarray) -> DivisionModel:
    strengths = clipped(strengths)
    misfit = misfits(arcs.pieces, centres, strengths)
    best = (arcs.pieces.lengths / (1 + misfit / (_CUT_PX * arcs.pixel) ** 2)).sum(-1).argmax()
    return DivisionModel(centres[best], float(strengths[best]))
