"""Fisheye rectification: one differentiable op that resamples an image from one camera into another.

Names are loaded when first used, so that calibrated NumPy work and the command line never import torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from ._ops import backend_for
    from .annotations import Sample, distort_sample, rectify_sample
    from .cameras import FisheyeCamera, PinholeCamera
    from .network import FishEyeRecNet
    from .rectification import DistortionRectification, Rectification, distort, rectify, resample
    from .rectifier import PhotoEstimate, PhotoRectification, Rectifier
    from .views import load_view, view_for, view_rotation
    from .wide_views import CylindricalView, EquirectangularView, PaniniView, StereographicView

_HOME = {
    "FisheyeCamera": "cameras",
    "PinholeCamera": "cameras",
    "CylindricalView": "wide_views",
    "EquirectangularView": "wide_views",
    "PaniniView": "wide_views",
    "StereographicView": "wide_views",
    "FishEyeRecNet": "network",
    "PhotoEstimate": "rectifier",
    "PhotoRectification": "rectifier",
    "Rectifier": "rectifier",
    "DistortionRectification": "rectification",
    "Rectification": "rectification",
    "Sample": "annotations",
    "distort": "rectification",
    "distort_sample": "annotations",
    "rectify": "rectification",
    "rectify_sample": "annotations",
    "resample": "rectification",
    "backend_for": "_ops",
    "load_view": "views",
    "view_for": "views",
    "view_rotation": "views",
}

__all__ = [
    "CylindricalView",
    "DistortionRectification",
    "EquirectangularView",
    "FishEyeRecNet",
    "FisheyeCamera",
    "PaniniView",
    "PhotoEstimate",
    "PhotoRectification",
    "PinholeCamera",
    "Rectification",
    "Rectifier",
    "Sample",
    "StereographicView",
    "backend_for",
    "distort",
    "distort_sample",
    "load_view",
    "rectify",
    "rectify_sample",
    "resample",
    "view_for",
    "view_rotation",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("fisheyerec")
        except PackageNotFoundError:  # a source tree that was never installed
            return "0+unknown"
    if name in _HOME:
        value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
        globals()[name] = value
        return value
    if name in ("numpy", "reference"):
        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
