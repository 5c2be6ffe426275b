"""`fisheyerec estimate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .estimating import OVERWRITE_HELP, REFINE_HELP, SAVE_CAMERA_HELP, WEIGHTS_HELP, check_save_camera, load_rectifier
from .messages import fail, for_each

if TYPE_CHECKING:
    from ..rectifier import PhotoEstimate


def estimate(
    images: Annotated[list[Path], typer.Argument(help="Fisheye pictures.", show_default=False)],
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object a line.")] = False,
    refine: Annotated[bool, typer.Option(help=REFINE_HELP)] = True,
    save_camera: Annotated[Path | None, typer.Option("--save-camera", "-o", help=SAVE_CAMERA_HELP)] = None,
    weights: Annotated[Path | None, typer.Option(help=WEIGHTS_HELP)] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help=OVERWRITE_HELP)] = False,
) -> None:
    """Estimate the lens of fisheye pictures from what they show: camera, confidence and straightness.

    Straightness is how much lines bend, in % of their length, in the picture and under the camera.
    """
    from ..file_rectifiers import describe

    try:
        check_save_camera(images, save_camera, overwrite=overwrite)
        rectifier = load_rectifier(weights)
    except (ValueError, OSError) as error:
        raise fail("estimate", error) from error

    def estimate_one(image: Path) -> None:
        found = rectifier.estimate(image, refine=refine)
        if save_camera is not None:
            found.camera.save(save_camera)
        typer.echo(_json_line(image, found) if json else f"{image}: {describe(found)}")

    for_each("estimate", images, estimate_one)


def _json_line(image: Path, estimate: PhotoEstimate) -> str:
    import json
    import math

    from ..manifest import camera_entry

    values = {
        "image": str(image),
        "camera": camera_entry(estimate.camera),
        "confidence": estimate.confidence,
        "distorted": estimate.distorted,
        "straightness_before": estimate.straightness_before,
        "straightness_after": estimate.straightness_after,
    }
    without_lines = [name for name, value in values.items() if isinstance(value, float) and math.isnan(value)]
    return json.dumps(values | dict.fromkeys(without_lines), allow_nan=False)
