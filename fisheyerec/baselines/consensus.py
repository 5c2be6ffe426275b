"""The division model that a picture's arcs agree on (RANSAC, Fischler and Bolles, CACM 24, 1981).

Three arcs tell a model with its centre, one arc tells one about the picture's centre. The support of a model is the
sum of the arcs' lengths, each less the more its points miss the best line under the model.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from .arcs import Arcs
from .division import CENTRE_MAX, DivisionModel, clipped, misfits, model_of_three, refine, strength_about

_TRIPLES = 500
_CUT_PX = 0.3  # RMS distance of an arc from a line that halves its support


def consensus(arcs: Arcs, rng: np.random.Generator) -> DivisionModel | None:
    """Give the model best supported, refined over the arcs; its centre is the picture's where arcs do not tell it.

    None where they hardly tell the strength either.

    Args:
        arcs: of a picture.
        rng: draws the triples, where there are too many for all.
    """
    return model_of_triples(arcs, rng) or model_about_centre(arcs)


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
