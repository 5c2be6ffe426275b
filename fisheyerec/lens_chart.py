"""The lens chart: eight well-conditioned numbers that stand for a fisheye camera, and the way to them and back.

k1..k4 are a poor thing to learn or to optimise: very different coefficients draw the same picture. What a single photo
shows is how tan(theta) grows from the principal point outwards, up to a common factor: a lens and a field of view that
scale tan(theta) together give the same straight picture. So with R half the picture's longer side and the angle
function

    g(theta) = log tan(theta), continued along its tangent beyond 75 degrees, so that any theta has one,

the chart of a camera is

    0..3   g(theta(rho)) - g(theta(R)) at rho = RADII * R    what straightens: the profile
    4      g(theta(R))                                       the field of view, which curvature hardly tells
    5, 6   (cx - centre) / R, (cy - centre) / R              the principal point
    7      log(fy / fx)                                      the aspect of the pixels

where theta(rho) is the angle seen rho pixels from the principal point, along x. A chart is the same for a picture and
its resized copy. Everything here is differentiable.
"""

from __future__ import annotations

import functools
import json
import math
from importlib.resources import files

import numpy as np
import torch
from torch import Tensor

from . import pixel, reference
from .cameras import FisheyeCamera

RADII = (1 / 4, 1 / 2, 3 / 4, math.sqrt(2))
"""Where the profile is read, in units of R; the last is the corner of a square picture."""

# Where in a chart these stand.
PROFILE, FIELD_OF_VIEW, PRINCIPAL_POINT, ASPECT = slice(0, 4), 4, slice(5, 7), 7
SIZE = 8
"""How many numbers a chart has."""

_THETA_TANGENT = math.radians(75)
_G_TANGENT = math.log(math.tan(_THETA_TANGENT))
_SLOPE_TANGENT = 1 / (math.sin(_THETA_TANGENT) * math.cos(_THETA_TANGENT))
_THETA_LIMIT = math.radians(150)  # no lens is wider at the corner; keeps whatever a network emits finite
# Slopes of theta_d over the picture stay above this fraction of their mean.
_MIN_SLOPE = 0.05
_BEYOND = 1.05  # in units of the profile's widest angle: how far the lens surely rises
# Weight of the fit's pull towards the equidistant lens: enough to decide between coefficients that draw the same.
_RIDGE = 1e-9


def angle_to_g(theta: Tensor) -> Tensor:
    """Give g(theta) for angles in (0, pi)."""
    inner = theta.clamp(max=_THETA_TANGENT)
    return torch.where(
        theta < _THETA_TANGENT, inner.tan().log(), _G_TANGENT + (theta - _THETA_TANGENT) * _SLOPE_TANGENT
    )


def angle_from_g(g: Tensor) -> Tensor:
    """Give the theta whose g this is."""
    inner = g.clamp(max=_G_TANGENT).exp().atan()
    return torch.where(g < _G_TANGENT, inner, _THETA_TANGENT + (g - _G_TANGENT) / _SLOPE_TANGENT)


def chart_from_camera(params: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Read the chart off fisheye cameras.

    Args:
        params: (..., 8) fx, fy, cx, cy, k1..k4.
        image_size: (height, width) of their pictures.

    Returns:
        (..., 8) float64; NaN where a lens ends within the profile's radii.
    """
    params = params.to(torch.float64)
    fx, fy, cx, cy = params[..., :4].unbind(-1)
    half = _half_side(image_size)
    rho = params.new_tensor([*RADII, 1.0]) * half
    points = torch.stack([cx[..., None] + rho, (cy[..., None]).expand(*cx.shape, len(rho))], -1)
    rays, valid = reference.unproject("kannala_brandt", params[..., None, :], points)
    theta = torch.atan2(torch.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
    g = angle_to_g(torch.where(valid, theta, torch.nan))
    height, width = image_size
    offset_x, offset_y = (cx - pixel.centre(width)) / half, (cy - pixel.centre(height)) / half
    return torch.cat(
        [g[..., :-1] - g[..., -1:], g[..., -1:], torch.stack([offset_x, offset_y, (fy / fx).log()], -1)], -1
    )


def chart_of(camera: FisheyeCamera) -> np.ndarray:
    """Read the chart (8,) off one camera, as an array; NaN as in `chart_from_camera`."""
    return np.asarray(chart_from_camera(torch.as_tensor(camera.numpy().params), camera.image_size).numpy())


def perspective_chart(theta: float = math.pi / 4) -> np.ndarray:
    """Give the chart (8,) of a lens that bends nothing, tan(theta(rho)) = tan(theta(R)) rho / R.

    Args:
        theta: the angle at R, in (0, 75 degrees); no picture tells it.
    """
    return np.array([*np.log(RADII), math.log(math.tan(theta)), 0.0, 0.0, 0.0])


def stretch(chart: np.ndarray) -> float:
    """Tell by how much straightening pulls the corners out, relative to the edges; 0 for a perspective camera.

    More exactly tan(theta) at sqrt(2) R over sqrt(2) tan(theta) at R, less 1.
    """
    return float(np.exp(chart[PROFILE][-1] - np.log(RADII[-1])) - 1)


def camera_from_chart(chart: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Fit fisheye cameras to charts: finite and monotone over the picture, whatever the chart.

    The unknowns a_i = f k_i theta_w^(2i+1) (k_0 = 1) of rho = sum_i a_i (theta / theta_w)^(2i+1) solve a linear least
    squares problem with a slight pull towards the equidistant lens, theta_w being the widest angle of the profile.
    Polynomials that rise form a convex set: where the fit does not, it is blended with the equidistant lens until it
    does; and where the result ends before the picture's corner, the focal length grows until it reaches it.

    Args:
        chart: (..., 8).
        image_size: (height, width) of the pictures.

    Returns:
        params (..., 8) float64.
    """
    chart = chart.to(torch.float64)
    half = _half_side(image_size)
    rho = chart.new_tensor([*RADII, 1.0])  # in units of R
    fov = chart[..., FIELD_OF_VIEW, None]
    g = torch.cat([chart[..., PROFILE] + fov, fov], -1)
    theta = angle_from_g(g).clamp(1e-4, _THETA_LIMIT)
    widest = theta.amax(-1, keepdim=True)
    powers = torch.arange(1, 10, 2, device=chart.device)
    rows = (theta / widest)[..., None] ** powers  # (..., 5, 5)
    equidistant = torch.zeros_like(chart[..., :5])
    equidistant[..., 0] = (rho * theta).sum(-1) / (theta * theta).sum(-1) * widest[..., 0]
    residual = rho - (rows @ equidistant[..., None])[..., 0]
    normal = rows.mT @ rows + _RIDGE * torch.eye(5, dtype=chart.dtype, device=chart.device)
    step = torch.linalg.solve(normal, rows.mT @ residual[..., None])[..., 0]

    # The farthest corner lies beyond the profile where the principal point is off the centre.
    offset = torch.linalg.vector_norm(chart[..., PRINCIPAL_POINT], dim=-1, keepdim=True)
    beyond = _BEYOND + offset
    # slope of equidistant + blend * step, over angles to a little beyond the picture
    u = torch.linspace(0, 1, 64, dtype=chart.dtype, device=chart.device)[:, None] * beyond[..., None]  # (..., 64, 1)
    slope_rows = powers * u ** (powers - 1)  # (..., 64, 5)
    fall = -(slope_rows @ step[..., None])[..., 0].amin(-1)
    base = equidistant[..., 0]
    blend = torch.where(fall > (1 - _MIN_SLOPE) * base, (1 - _MIN_SLOPE) * base / fall.clamp(min=1e-12), 1.0)
    a = equidistant + blend[..., None] * step
    reach = (a * beyond**powers).sum(-1, keepdim=True)
    a = a * ((RADII[-1] + offset) / reach).clamp(min=1)

    coefficients = a / widest**powers  # f, f k1, f k2, ... in units of R
    fx = coefficients[..., 0] * half
    k = coefficients[..., 1:] / coefficients[..., :1]
    height, width = image_size
    offset_x, offset_y = (chart[..., PRINCIPAL_POINT] * half).unbind(-1)
    fy = fx * chart[..., ASPECT].exp()
    return torch.cat(
        [torch.stack([fx, fy, pixel.centre(width) + offset_x, pixel.centre(height) + offset_y], -1), k], -1
    )


def _half_side(image_size: tuple[int, int]) -> float:
    return max(image_size) / 2


@functools.cache
def population() -> tuple[Tensor, Tensor]:
    """Give the population of fisheye lenses that `training.population` measured.

    Returns:
        The mean chart (8,), and a basis (8, 8) whose columns are independent deviations of one sigma: five of profile
        and field of view together, most important first, then those of PRINCIPAL_POINT and ASPECT. Both float64.
    """
    values = json.loads(files(__package__).joinpath("lens_population.json").read_text())
    mean, basis = (torch.tensor(values[name], dtype=torch.float64, device="cpu") for name in ("mean", "basis"))
    return mean, basis
