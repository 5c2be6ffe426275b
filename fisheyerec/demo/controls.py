"""What the page's controls mean: from their values to a camera and a view, and how far sliders reach."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..cameras import FisheyeCamera
from ..file_rectifiers import ViewOptions
from ..views import MODES

EXAMPLE_LENS = ("equidistant", 165.0)
"""Projection and field of view in degrees of the lens that the example picture is drawn through."""

DEGREES, BALANCE, LENS = "degrees", "balance", "lens"
"""Framings of a view that are no modes of `view_for`: by a field of view, by a balance, as wide as the lens."""

FRAMINGS = [("Edge-matched", "edge_matched"), ("Keep all", "keep_all"), ("Valid only", "valid_only")]
FRAMINGS += [("Largest valid rectangle", "valid_rectangle"), ("Balance", BALANCE), ("Field of view", DEGREES)]
"""Of a perspective view, each after what it is called on the page."""

WIDE_FRAMINGS = [("As wide as the lens", LENS), ("Field of view", DEGREES)]
"""Of other projections."""

# Focal lengths and principal point in units of the picture's longer side. A lens beyond half of this reaches further.
_REACH = {"f": (0.05, 1.5), "c": (0.0, 1.0), "k": (-1.0, 1.0)}


class Reach(NamedTuple):
    """How far a slider goes, and where it stands."""

    minimum: float
    maximum: float
    value: float


def decimals(parameter: str) -> int:
    """Give how many decimals a parameter of a lens is shown with."""
    return 4 if parameter[0] == "k" else 1


def reaches(camera: FisheyeCamera) -> dict[str, Reach]:
    """Give the sliders of a camera's parameters, by name; those of an unusual lens reach further."""
    side = max(camera.image_size)
    found = {}
    for name, value in zip(camera.parameter_names, map(float, camera.params), strict=True):
        low, high = _REACH[name[0]]
        unit = 1 if name[0] == "k" else side
        bounds = (min(low * unit, 2 * value), max(high * unit, 2 * value), value)
        found[name] = Reach(*(round(number, decimals(name)) for number in bounds))
    return found


def moved(camera: FisheyeCamera, values: Sequence[float]) -> FisheyeCamera:
    """Give a camera whose sliders stand at these values; those that were not moved stand for all decimals."""
    params = [
        float(exact if round(float(exact), decimals(name)) == value else value)
        for name, exact, value in zip(camera.parameter_names, camera.params, values, strict=True)
    ]
    return FisheyeCamera(params, camera.image_size)


def ideal_camera(projection: str, fov_deg: float, image_size: tuple[int, int]) -> FisheyeCamera:
    """Give the camera of an ideal projection, for an orthographic one of at most the 180 degrees that it can have."""
    widest = 180 if projection == "orthographic" else fov_deg
    return FisheyeCamera.from_projection(projection, min(fov_deg, widest), image_size)


def view_options(
    projection: str,
    framing: str,
    fov_deg: float,
    balance: float,
    wide_framing: str,
    wide_fov_deg: float,
    pan_deg: float,
    tilt_deg: float,
    roll_deg: float,
) -> ViewOptions:
    """Give the view that the controls ask for.

    Args:
        projection: one of `views.PROJECTIONS`.
        framing: of a perspective view, a value of FRAMINGS.
        fov_deg: its field of view across the width, for DEGREES.
        balance: in [0, 1], for BALANCE.
        wide_framing: of other projections, a value of WIDE_FRAMINGS.
        wide_fov_deg: their field of view, for DEGREES.
        pan_deg: to the right.
        tilt_deg: upwards.
        roll_deg: clockwise.
    """
    if projection != "pinhole":
        framing, fov_deg = wide_framing, wide_fov_deg
    return ViewOptions(
        mode=framing if framing in MODES else None,
        fov_deg=fov_deg if framing == DEGREES else None,
        balance=balance if framing == BALANCE else None,
        projection=projection,
        pan_deg=pan_deg,
        tilt_deg=tilt_deg,
        roll_deg=roll_deg,
    )
