"""What the commands that estimate lenses share: options, and how an estimate is told."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..rectifier import PhotoEstimate, Rectifier

REFINE_HELP = "Refine an estimated lens on the lines of the picture."
SAVE_CAMERA_HELP = "File for the estimated lens (.json, .yaml), of one picture."
WEIGHTS_HELP = "Weights file to estimate with, as train writes it; the package's own if left out."


def load_rectifier(weights: Path | None) -> Rectifier:
    """Load the network; None for the package's own weights."""
    from ..rectifier import Rectifier

    return Rectifier.from_pretrained(weights)


def check_save_camera(images: list[Path], save_camera: Path | None) -> None:
    """Refuse a file for the estimated lens that could not be written, before anything is done."""
    if save_camera is not None and len(images) > 1:
        raise ValueError(f"expected --save-camera with one picture, got {len(images)}")
    if save_camera is not None and save_camera.suffix.lower() not in (".json", ".yaml", ".yml"):
        raise ValueError(f"expected --save-camera with a suffix .json or .yaml, got {save_camera.name!r}")


def describe(estimate: PhotoEstimate) -> str:
    """Tell an estimate in half a line."""
    if not estimate.distorted:
        return f"no fisheye distortion found, lines bend by {estimate.straightness_before:.2f} %"
    names = zip(estimate.camera.parameter_names, estimate.camera.params, strict=True)
    return (
        ", ".join(f"{name} {value:.6g}" for name, value in names)
        + f", confidence {estimate.confidence:.2f}, lines bend by {estimate.straightness_before:.2f} % before and "
        f"{estimate.straightness_after:.2f} % after{'' if estimate.refined else ', not refined'}"
    )
