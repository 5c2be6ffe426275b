"""Fisheye rectification: one differentiable op that resamples an image from one camera into another.

Names are loaded when first used, so that calibrated NumPy work and the command line never import torch.
"""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ._ops import backend_for
    from .cameras import FisheyeCamera, PinholeCamera
    from .rectification import DistortionRectification, Rectification, distort, rectify, resample

try:
    __version__ = version("fisheyerec")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

_HOME = {
    "FisheyeCamera": "cameras",
    "PinholeCamera": "cameras",
    "DistortionRectification": "rectification",
    "Rectification": "rectification",
    "distort": "rectification",
    "rectify": "rectification",
    "resample": "rectification",
    "backend_for": "_ops",
}

__all__ = [
    "DistortionRectification",
    "FisheyeCamera",
    "PinholeCamera",
    "Rectification",
    "backend_for",
    "distort",
    "rectify",
    "resample",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
        globals()[name] = value
        return value
    if name in ("numpy", "reference"):
        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
