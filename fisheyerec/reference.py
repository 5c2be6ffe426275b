"""The op in plain torch: the specification that tests compare against, and the path for devices other than the CPU.

`resample` has the signature of the compiled op and gives the same result, by building the sampling grid and calling
`torch.nn.functional.grid_sample`. It is several times slower and holds several pictures' worth of memory.

Conventions (pixel centres, axes, parameter order): csrc/geometry/pixel.h and ARCHITECTURE.md.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from .pixel import HALF_PIXEL


def project(model: str, params: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Project rays into the image of a camera.

    Args:
        model: "pinhole", "kannala_brandt", "cylindrical", "equirectangular", "stereographic" or "panini".
        params: (..., P), broadcast against the rays' leading dimensions; P is 8 for Kannala-Brandt, 5 for Panini, or 4.
        rays: (..., 3), x right, y down, z forward, of any length.

    Returns:
        points (..., 2) in pixels, and valid (...), False where the camera does not see the ray; points there are NaN.
    """
    points, valid = _PROJECT[model](params, rays)
    return _where_usable(params, points, valid)


def unproject(model: str, params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Lift image points to rays, the inverse of `project`.

    Args:
        model: as for `project`.
        params: (..., P), broadcast against the points' leading dimensions.
        points: (..., 2) in pixels.

    Returns:
        rays (..., 3), of unit length for a fisheye, with z = 1 for a pinhole, else of other lengths, and valid (...).
    """
    rays, valid = _UNPROJECT[model](params, points)
    return _where_usable(params, rays, valid)


def theta_max(params: Tensor) -> Tensor:
    """Find the first extremum of theta_d in (0, pi], or pi where it rises all the way; (..., 8) -> (...)."""
    with torch.no_grad():
        # Look for the first place that does not rise, then look again, more finely, right before it.
        steps = torch.linspace(0, 1, 4097, dtype=params.dtype, device=params.device)
        low = torch.zeros_like(params[..., :1])
        width = torch.full_like(low, math.pi)
        for refinement in range(5 if params.dtype == torch.float64 else 2):  # 12 bits each
            falling = ~(_theta_d_derivative(low + width * steps, params.unsqueeze(-2)) > 0)
            first = falling.to(torch.int8).argmax(-1, keepdim=True)  # 0 where nothing falls: theta_d' = 1 at theta = 0
            if refinement == 0:
                folds = first > 0
            width = width / 4096
            low = low + width * (first - 1).clamp(min=0)
        limit = torch.where(folds, low, math.pi)[..., 0]
        return torch.where(params.isfinite().all(-1), limit, 0.0)


def _theta_d(theta: Tensor, params: Tensor) -> Tensor:
    k1, k2, k3, k4 = params[..., 4:].unbind(-1)
    u = theta * theta
    return theta * (1 + u * (k1 + u * (k2 + u * (k3 + u * k4))))


def _theta_d_derivative(theta: Tensor, params: Tensor) -> Tensor:
    k1, k2, k3, k4 = params[..., 4:].unbind(-1)
    u = theta * theta
    return 1 + u * (3 * k1 + u * (5 * k2 + u * (7 * k3 + u * (9 * k4))))


def _length(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """sqrt(x^2 + y^2) and whether it is 0; the length given there is 1, so that its gradient stays finite."""
    squared = x * x + y * y
    zero = squared == 0
    return torch.where(zero, 1.0, squared).sqrt(), zero


def _theta_from_theta_d(distance: Tensor, params: Tensor) -> tuple[Tensor, Tensor]:
    """Invert theta_d by bisection, differentiated by the implicit function theorem."""
    limit = theta_max(params)
    with torch.no_grad():
        in_range = distance <= _theta_d(limit, params)
        low, high = torch.zeros_like(distance), limit.expand_as(distance)
        for _ in range(60 if params.dtype == torch.float64 else 30):
            middle = (low + high) / 2
            below = _theta_d(middle, params) < distance
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        theta = (low + high) / 2
        slope = _theta_d_derivative(theta, params)
        slope = torch.where(slope > 0, slope, math.inf)
    # One Newton step at the solution: its value is theta, its gradients are the theorem's.
    return theta - (_theta_d(theta, params) - distance) / slope, in_range


def _project_pinhole(params: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    fx, fy, cx, cy = params.unbind(-1)
    x, y, z = rays.unbind(-1)
    valid = z > 0
    inverse_z = 1 / torch.where(valid, z, 1.0)
    return torch.stack([cx + fx * x * inverse_z, cy + fy * y * inverse_z], -1), valid


def _unproject_pinhole(params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    fx, fy, cx, cy = params.unbind(-1)
    x, y = (points[..., 0] - cx) / fx, (points[..., 1] - cy) / fy
    return torch.stack([x, y, torch.ones_like(x)], -1), torch.ones_like(x, dtype=torch.bool)


def _project_kannala_brandt(params: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    fx, fy, cx, cy = params[..., :4].unbind(-1)
    x, y, z = rays.unbind(-1)
    r, on_axis = _length(x, y)
    theta = torch.where(on_axis, 0.0, torch.atan2(r, z))
    scale = torch.where(on_axis, 1 / torch.where(z == 0, 1.0, z), _theta_d(theta, params) / r)
    valid = (theta <= theta_max(params)) & (~on_axis | (z > 0))
    return torch.stack([cx + fx * x * scale, cy + fy * y * scale], -1), valid


def _unproject_kannala_brandt(params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    fx, fy, cx, cy = params[..., :4].unbind(-1)
    x, y = (points[..., 0] - cx) / fx, (points[..., 1] - cy) / fy
    length, on_axis = _length(x, y)
    distance = torch.where(on_axis, 0.0, length)
    theta, valid = _theta_from_theta_d(distance, params)
    scale = torch.where(on_axis, 1.0, theta.sin() / length)
    rays = torch.stack([x * scale, y * scale, theta.cos()], -1)
    return rays, valid


def _to_pixels(params: Tensor, u: Tensor, v: Tensor) -> Tensor:
    fx, fy, cx, cy = params[..., :4].unbind(-1)
    return torch.stack([cx + fx * u, cy + fy * v], -1)


def _from_pixels(params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    fx, fy, cx, cy = params[..., :4].unbind(-1)
    return (points[..., 0] - cx) / fx, (points[..., 1] - cy) / fy


def _project_cylindrical(params: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = rays.unbind(-1)
    h, on_cylinder_axis = _length(x, z)
    longitude = torch.atan2(x, torch.where(on_cylinder_axis, 1.0, z))
    return _to_pixels(params, longitude, y / h), ~on_cylinder_axis


def _unproject_cylindrical(params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    longitude, v = _from_pixels(params, points)
    return torch.stack([longitude.sin(), v, longitude.cos()], -1), longitude.abs() <= math.pi


def _project_equirectangular(params: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = rays.unbind(-1)
    h, at_pole = _length(x, z)
    longitude = torch.atan2(x, torch.where(at_pole, 1.0, z))
    latitude = torch.atan2(y, torch.where(at_pole, 0.0, h))
    return _to_pixels(params, longitude, latitude), ~at_pole | (y != 0)


def _unproject_equirectangular(params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    longitude, latitude = _from_pixels(params, points)
    h = latitude.cos()
    rays = torch.stack([h * longitude.sin(), latitude.sin(), h * longitude.cos()], -1)
    return rays, (longitude.abs() <= math.pi) & (latitude.abs() <= math.pi / 2)


def _project_stereographic(params: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = rays.unbind(-1)
    squared = x * x + y * y
    valid = (z > 0) | (squared > 0)
    length = torch.where(valid, squared + z * z, 1.0).sqrt()
    ahead = 2 / (length + z.clamp(min=0))
    behind = 2 * (length - z.clamp(max=0)) / torch.where(squared > 0, squared, 1.0)
    scale = torch.where(z < 0, behind, ahead)
    return _to_pixels(params, scale * x, scale * y), valid


def _unproject_stereographic(params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    u, v = _from_pixels(params, points)
    rays = torch.stack([u, v, 1 - (u * u + v * v) / 4], -1)
    return rays, rays.isfinite().all(-1)


def _project_panini(params: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = rays.unbind(-1)
    d = params[..., 4]
    h, on_cylinder_axis = _length(x, z)
    depth = d * h + z
    valid = ~on_cylinder_axis & (depth > 0) & (h + d * z > 0) & (d >= 0)
    scale = (d + 1) / torch.where(valid, depth, 1.0)
    return _to_pixels(params, scale * x, scale * y), valid


def _unproject_panini(params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    u, v = _from_pixels(params, points)
    d = params[..., 4]
    k = (u / (d + 1)) ** 2
    square = 1 + k * (1 - d * d)
    valid = (square >= 0) & (d >= 0)
    z = (torch.where(valid, square, 1.0).sqrt() - k * d) / (1 + k)
    q = (d + z) / (d + 1)
    return torch.stack([q * u, q * v, z], -1), valid


def _where_usable(params: Tensor, vectors: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    valid = valid & vectors.isfinite().all(-1) & params.isfinite().all(-1)
    return torch.where(valid[..., None], vectors, math.nan), valid


_PROJECT = {
    "pinhole": _project_pinhole,
    "kannala_brandt": _project_kannala_brandt,
    "cylindrical": _project_cylindrical,
    "equirectangular": _project_equirectangular,
    "stereographic": _project_stereographic,
    "panini": _project_panini,
}
_UNPROJECT = {
    "pinhole": _unproject_pinhole,
    "kannala_brandt": _unproject_kannala_brandt,
    "cylindrical": _unproject_cylindrical,
    "equirectangular": _unproject_equirectangular,
    "stereographic": _unproject_stereographic,
    "panini": _unproject_panini,
}


def resample(
    image: Tensor,
    source: Tensor,
    target: Tensor,
    source_from_target: Tensor | None,
    source_model: str,
    target_model: str,
    height: int,
    width: int,
    interpolation: str,
    padding: str,
) -> tuple[Tensor, Tensor]:
    """Resample images from a source camera into a target camera.

    Args:
        image: (B, C, H, W), floating, or integer without gradients.
        source: (B or 1, P) parameters of the camera that took the image.
        target: (B or 1, P) parameters of the camera to see it through.
        source_from_target: (B or 1, 3, 3) rotation of target rays into the source camera, or None.
        source_model: as for `project`; target_model likewise.
        target_model: see source_model.
        height: of the result; width likewise.
        width: see height.
        interpolation: "bilinear" or "nearest".
        padding: "zeros" or "border".

    Returns:
        image (B, C, height, width) of the input's dtype, and valid (B, 1, height, width) bool.
    """
    batch, _, image_height, image_width = image.shape
    exact = not image.is_floating_point() and interpolation == "nearest"  # labels, up to 2^53
    dtype = torch.float64 if exact or image.dtype == torch.float64 else torch.float32
    source, target = (p.to(image.device, dtype)[:, None, None] for p in (source, target))

    rows = torch.arange(height, dtype=dtype, device=image.device)
    columns = torch.arange(width, dtype=dtype, device=image.device)
    points = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)[None]
    finite = source.isfinite().all(-1) & target.isfinite().all(-1)
    rays, seen = unproject(target_model, target, points)
    rays = torch.where(seen[..., None], rays, 0.0)  # before the rotation, whose gradient would take up their NaN
    if source_from_target is not None:
        rotation = source_from_target.to(image.device, dtype)[:, None, None]
        finite = finite & rotation.isfinite().all(-1).all(-1)
        rays = (rotation @ rays[..., None])[..., 0]
    points, hit = project(source_model, source, rays)
    live = (hit & finite & seen).expand(batch, height, width)
    points = points.expand(batch, height, width, 2)

    x, y = points.unbind(-1)
    valid = live & _inside(x, image_width) & _inside(y, image_height)
    if interpolation == "nearest":
        x, y = torch.floor(x + HALF_PIXEL), torch.floor(y + HALF_PIXEL)
        x, y = torch.where(valid, x.clamp(max=image_width - 1), x), torch.where(valid, y.clamp(max=image_height - 1), y)
    # grid_sample without align_corners spans [-1, 1] from edge to edge: x = -1/2 at -1 and W - 1/2 at 1.
    grid = torch.stack([(2 * x + 1) / image_width - 1, (2 * y + 1) / image_height - 1], -1)
    grid = torch.where(live[..., None], grid, -10.0)
    sampled = grid_sample(image.to(dtype), grid, interpolation, padding, align_corners=False)
    sampled = torch.where(live[:, None], sampled, 0.0)
    if image.dtype == torch.uint8 and not exact:
        sampled = torch.floor(sampled + 0.5)  # round half up
    return sampled.to(image.dtype), valid[:, None]


def _inside(x: Tensor, size: int) -> Tensor:
    return (x >= -HALF_PIXEL) & (x <= size - HALF_PIXEL)
