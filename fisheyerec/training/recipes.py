"""What synthetic pairs are drawn from. STANDARD is the protocol that results are reported on, WIDE is to train on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """The distribution of cameras, and how a picture is dressed."""

    name: str
    profile_share: float = 0.65
    """How many cameras are real profiles; the rest are the four ideal projections."""
    theta_deg: tuple[float, float] = (35, 70)
    """The angle theta_c that the farthest corner sees is uniform in this range, where the source is a photograph."""
    panorama_theta_deg: tuple[float, float] = (35, 100)
    """The same where the source is a panorama."""
    centre_spread: float = 3 / 256
    """Standard deviation of the principal point, each way, in units of the picture's longer side."""
    aspect_spread: float = 0.005
    """fy / fx is uniform in 1 +- this."""
    blend: float = 0.0
    """Up to how much of a second lens is mixed into a real profile."""
    circular_share: float = 0.0
    """How many pictures get the vignette and the black rim of an image circle smaller than the sensor."""
    anywhere: bool = False
    """Cut the square anywhere along a photograph's longer side and mirror every other one, instead of the centre."""
    panorama_rounds: int = 1
    """How often a panorama is used where a photograph is used once."""


STANDARD = Recipe("standard")

WIDE = Recipe(
    "wide",
    theta_deg=(33, 72),
    panorama_theta_deg=(35, 105),
    centre_spread=4 / 256,
    aspect_spread=0.01,
    blend=0.3,
    circular_share=0.05,
    anywhere=True,
    panorama_rounds=5,
)

RECIPES = {recipe.name: recipe for recipe in (STANDARD, WIDE)}
