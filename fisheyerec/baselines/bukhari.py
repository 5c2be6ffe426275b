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

import numpy as np

from ..cameras import FisheyeCamera
from .arcs import find_arcs, find_chains
from .consensus import consensus

_ARC_TOLERANCE_PX = 1.0
_MIN_LENGTH = 0.15  # of an arc, in half diagonals
_MOST_ARCS = 60


def estimate(image: np.ndarray) -> FisheyeCamera | None:
    """Estimate the camera of a picture (H, W, 3) RGB uint8; None where no arcs tell it."""
    rng = np.random.default_rng(0)
    arcs = find_arcs(*find_chains(image), tolerance_px=_ARC_TOLERANCE_PX, min_length=_MIN_LENGTH, rng=rng)
    arcs = arcs.subset(np.arange(min(len(arcs), _MOST_ARCS)))
    model = consensus(arcs, rng)
    return None if model is None else model.camera((image.shape[0], image.shape[1]))
