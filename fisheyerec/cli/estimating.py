"""What the commands that estimate lenses share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .messages import check_new

if TYPE_CHECKING:
    from ..rectifier import Rectifier

OVERWRITE_HELP = "Replace files that are there."
REFINE_HELP = "Refine an estimated lens on the lines of the picture."
SAVE_CAMERA_HELP = "File for the estimated lens (.json, .yaml), of one picture."
WEIGHTS_HELP = "Weights file to estimate with, as train writes it; the package's own if left out."


def load_rectifier(weights: Path | None) -> Rectifier:
    """Load the network; None for the package's own weights."""
    from ..rectifier import Rectifier

    return Rectifier.from_pretrained(weights)


def check_save_camera(images: list[Path], save_camera: Path | None, *, overwrite: bool) -> None:
    """Refuse a file for the estimated lens that could not be written, before anything is done."""
    if save_camera is not None and len(images) > 1:
        raise ValueError(f"expected --save-camera with one picture, got {len(images)}")
    if save_camera is not None and save_camera.suffix.lower() not in (".json", ".yaml", ".yml"):
        raise ValueError(f"expected --save-camera with a suffix .json or .yaml, got {save_camera.name!r}")
    if save_camera is not None:
        check_new([save_camera], overwrite=overwrite)
