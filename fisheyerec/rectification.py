"""The op for users of torch: rectify, its mirror distort, and the layer of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from . import _ops, antialiasing
from ._arguments import (
    DISTORT,
    RECTIFY,
    RESAMPLE,
    Names,
    check_antialias,
    check_camera,
    check_interpolates,
    check_interpolation,
    check_padding,
    check_size,
)
from .cameras import Camera, FisheyeCamera

_FLOATS = (torch.float64, torch.float32, torch.bfloat16, torch.float16)


@dataclass(frozen=True, repr=False)
class Rectification:
    """A resampled picture and what it was made with."""

    image: Tensor
    """(B, C, h, w), of the input's dtype and memory format."""
    valid: Tensor
    """(B, 1, h, w) bool: where the view meets the source picture within the lens' range."""
    camera: Camera
    """The fisheye camera."""
    view: Camera
    """The view."""

    def __repr__(self) -> str:
        image, valid = self.image, self.valid
        return (
            f"Rectification(image={tuple(image.shape)} {image.dtype} on {image.device}, valid={tuple(valid.shape)}, "
            f"camera={self.camera!r}, view={self.view!r})"
        )


def rectify(
    image: Tensor,
    camera: FisheyeCamera,
    view: Camera,
    *,
    rotation: Tensor | None = None,
    interpolation: str = "bilinear",
    padding: str = "zeros",
    antialias: bool = False,
) -> Rectification:
    """Show a fisheye picture as another view sees it: the paper's rectification layer (Eqs. 3, 4).

    Differentiable in image, camera.params, view.params and rotation. Equivalent to `reference.resample`, without ever
    holding a sampling grid.

    Args:
        image: (B, C, H, W), float64, float32, bfloat16, float16 or uint8; nearest takes integers too.
            B = 1 is repeated for a batch of cameras or views.
        camera: the fisheye camera, of image size (H, W); one, or one for each image.
        view: the view to make, of image size (h, w); one, or one for each image.
        rotation: (3, 3) or (B, 3, 3), camera_from_view: turns the view's rays into the camera's frame, as
            `view_rotation` gives it from pan, tilt and roll.
        interpolation: "bilinear" or "nearest" (labels).
        padding: what lies outside the picture: "zeros" or "border".
        antialias: whether to average where the picture shrinks; slower by the square of how much it does, at most 64.
            How finely is chosen from the numbers of each pair of cameras: a constant to gradients, a break in the graph
            of `torch.compile`, and nothing that `torch.export` and `vmap` can do.

    Returns:
        A Rectification; rays beyond the lens' monotonic range are 0 in its image and False in its mask.

    Raises:
        TypeError: an argument of another type.
        ValueError: another shape, dtype or name, or an integer image that requires gradients.
    """
    out, valid = resample_named(RECTIFY, image, camera, view, rotation, interpolation, padding, antialias)
    return Rectification(out, valid, camera, view)


def distort(
    picture: Tensor,
    view: Camera,
    camera: FisheyeCamera,
    *,
    rotation: Tensor | None = None,
    interpolation: str = "bilinear",
    padding: str = "zeros",
    antialias: bool = False,
) -> Rectification:
    """Show a picture as a fisheye camera would have taken it, the mirror of `rectify`.

    Args:
        picture: (B, C, h, w), as `image` of `rectify`.
        view: the camera that took the picture, of image size (h, w).
        camera: the fisheye camera to imitate.
        rotation: (3, 3) or (B, 3, 3), camera_from_view, as in `rectify`.
        interpolation: "bilinear" or "nearest" (labels).
        padding: what lies outside the picture: "zeros" or "border".
        antialias: whether to average where the picture shrinks, as in `rectify`.

    Returns:
        A Rectification that holds the fisheye picture (B, C, H, W) and its mask.

    Raises:
        TypeError, ValueError: as `rectify`.
    """
    view_from_camera = None if rotation is None else _rotations("distort", rotation).transpose(-1, -2)
    out, valid = resample_named(DISTORT, picture, view, camera, view_from_camera, interpolation, padding, antialias)
    return Rectification(out, valid, camera, view)


def resample(
    image: Tensor,
    source: Camera,
    target: Camera,
    *,
    source_from_target: Tensor | None = None,
    interpolation: str = "bilinear",
    padding: str = "zeros",
    antialias: bool = False,
) -> tuple[Tensor, Tensor]:
    """Resample images from any camera into any other: the one op behind `rectify` and `distort`.

    Args:
        image: (B, C, H, W).
        source: the camera that took the image; one, or one for each image.
        target: the camera to see it through; one, or one for each image.
        source_from_target: (3, 3) or (B, 3, 3) rotation of the target's rays into the source's frame.
        interpolation: "bilinear" or "nearest".
        padding: "zeros" or "border".
        antialias: whether to average where the picture shrinks, as in `rectify`.

    Returns:
        image (B, C, h, w), and valid (B, 1, h, w) bool.

    Raises:
        TypeError, ValueError: as `rectify`.
    """
    return resample_named(RESAMPLE, image, source, target, source_from_target, interpolation, padding, antialias)


def resample_named(
    names: Names,
    image: Tensor,
    source: Camera,
    target: Camera,
    source_from_target: Tensor | None,
    interpolation: str,
    padding: str,
    antialias: bool,
) -> tuple[Tensor, Tensor]:
    """Resample in the name of another function of the package, and in its words where it raises."""
    function = names.function
    _check_image(names, image)
    check_interpolation(function, interpolation)
    check_antialias(function, antialias, interpolation)
    check_padding(function, padding)
    interpolates = image.is_floating_point() or image.dtype == torch.uint8
    check_interpolates(names, interpolates, interpolation, image.dtype, " or uint8")
    check_camera(function, names.source, source)
    check_camera(function, names.target, target)
    check_size(names, tuple(image.shape[-2:]), source)
    parameters: dict[str, Tensor] = {
        f"{names.source}.params": _rows(source.params),
        f"{names.target}.params": _rows(target.params),
    }
    if source_from_target is not None:
        parameters["rotation"] = _rotations(function, source_from_target)
    batch = image.shape[0]
    for name, tensor in parameters.items():
        # Not `in`, which torch.compile answers wrongly where a batch may be of any size.
        if tensor.shape[0] != 1 and tensor.shape[0] != batch:
            if batch != 1:
                shape = ", ".join(["B", *map(str, tensor.shape[1:])])
                raise ValueError(
                    f"{function}(): expected {name} of shape ({shape}) with B = {batch} (the {names.image} batch), "
                    f"got {tuple(tensor.shape)}"
                )
            batch = tensor.shape[0]
    if batch != image.shape[0]:
        image = image.expand(batch, -1, -1, -1)
    source_params, target_params = list(parameters.values())[:2]
    rotations = parameters.get("rotation")
    out, valid = _ops.resample(
        image[:, :1].detach() if antialias else image,
        source_params,
        target_params,
        rotations,
        source.model,
        target.model,
        *target.image_size,
        interpolation,
        padding,
    )
    if antialias:
        cameras = (type(source)(source_params, source.image_size), type(target)(target_params, target.image_size))
        out = _averaged(image, *cameras, rotations, padding)
    return out, valid


@torch.compiler.disable
def _averaged(image: Tensor, source: Camera, target: Camera, rotations: Tensor | None, padding: str) -> Tensor:
    """Resample with averaging, as antialiasing.py describes it, each picture as if it came alone.

    All parameters are batches of one or of the image's B.
    """
    # Levels are looked up on the CPU. In double precision, the places in enlarged pictures are those of the NumPy door.
    given = [source.params, target.params, *([] if rotations is None else [rotations])]
    rows = [torch.as_tensor(tensor).cpu().double() for tensor in given]
    count = max(tensor.shape[0] for tensor in rows)
    parts = []
    for i in range(count):
        params, target_params, *turn = (tensor[i : i + 1] if tensor.shape[0] == count else tensor for tensor in rows)
        rotation = turn[0] if turn else None
        one, other = type(source)(params, source.image_size), type(target)(target_params, target.image_size)
        turned = None if rotation is None else rotation[0].detach().numpy()
        shrink, factor = antialiasing.levels(_first(one), _first(other), turned)
        pictures = _reduced(image if count == 1 else image[i : i + 1], shrink)
        params = torch.as_tensor(antialiasing.shrunk_camera(one, shrink).params)
        models, bands = (source.model, target.model), []
        for band in antialiasing.bands(other, factor, max(1, pictures.shape[0])):
            arguments = (params, torch.as_tensor(band.params), rotation, *models, *band.image_size)
            bands.append(_reduced(_ops.resample(pictures, *arguments, "bilinear", padding)[0], factor))
        parts.append(torch.cat(bands, -2))
    return torch.cat(parts)


def _first(camera: Camera) -> Camera:
    return type(camera)(camera.params[0], camera.image_size)


def _reduced(image: Tensor, factor: int) -> Tensor:
    """Average blocks of pixels, (..., H, W): `antialiasing.reduce` with gradients."""
    if factor == 1 or image.numel() == 0:
        return image[..., ::factor, ::factor]
    if image.dtype == torch.uint8:
        return torch.floor(_reduced(image.float(), factor) + 0.5).to(torch.uint8)
    return avg_pool2d(image, factor, ceil_mode=True, count_include_pad=False)


def _check_image(names: Names, image: Any) -> None:
    if not isinstance(image, Tensor):
        raise TypeError(
            f"{names.function}(): expected {names.image} as a torch.Tensor, got {type(image).__name__}; "
            "fisheyerec.numpy takes NumPy arrays"
        )
    unknown_floats = image.is_floating_point() and image.dtype not in _FLOATS
    if image.ndim != 4 or image.is_complex() or unknown_floats:
        raise ValueError(
            f"{names.function}(): expected {names.image} of shape (B, C, H, W) and a real dtype of 16 bits or more, or "
            f"integers, got {tuple(image.shape)} {image.dtype}"
        )


def _rows(params: Any) -> Tensor:
    tensor: Tensor = torch.as_tensor(params)
    return tensor if tensor.ndim == 2 else tensor[None]


def _rotations(function: str, rotation: Any) -> Tensor:
    if not isinstance(rotation, Tensor):
        raise TypeError(f"{function}(): expected rotation as a torch.Tensor, got {type(rotation).__name__}")
    if rotation.ndim not in (2, 3) or tuple(rotation.shape[-2:]) != (3, 3) or not rotation.is_floating_point():
        raise ValueError(
            f"{function}(): expected rotation of shape (3, 3) or (B, 3, 3) and a floating dtype, "
            f"got {tuple(rotation.shape)} {rotation.dtype}"
        )
    return rotation if rotation.ndim == 3 else rotation[None]


class DistortionRectification(nn.Module):
    """The paper's distortion rectification layer: `layer(image, params)` -> (B, C, h, w).

    With a camera of its own it is `layer(image)`, to stand in an `nn.Sequential` before a network or within one. No
    state of its own: where view.params or camera.params is an `nn.Parameter`, the layer owns it and learns it.

    Args:
        view: the view that every picture is rectified into.
        camera: the fisheye camera of every picture, or None where each call brings its params.
        interpolation: "bilinear" or "nearest".
        padding: "zeros" or "border".
        antialias: whether to average where pictures shrink, as in `rectify`.

    Raises:
        TypeError: view or camera is not a camera.
        ValueError: unknown interpolation or padding.
    """

    def __init__(
        self,
        view: Camera,
        *,
        camera: FisheyeCamera | None = None,
        interpolation: str = "bilinear",
        padding: str = "zeros",
        antialias: bool = False,
    ) -> None:
        super().__init__()
        check_camera("DistortionRectification", "view", view)
        if camera is not None and not isinstance(camera, FisheyeCamera):
            raise TypeError(
                f"DistortionRectification(): expected camera as a FisheyeCamera or None, got {type(camera).__name__}"
            )
        check_interpolation("DistortionRectification", interpolation)
        check_padding("DistortionRectification", padding)
        check_antialias("DistortionRectification", antialias, interpolation)
        self.view_type, self.view_size = type(view), view.image_size
        # Not buffers: half() and bfloat16() of the model would round the focal lengths by pixels.
        self.view_params = torch.as_tensor(view.params)
        self.camera_params = None if camera is None else torch.as_tensor(camera.params)
        self.camera_size = None if camera is None else camera.image_size
        self.interpolation, self.padding, self.antialias = interpolation, padding, antialias

    @property
    def camera(self) -> FisheyeCamera | None:
        """The fisheye camera of every picture, if the layer has one."""
        if self.camera_params is None or self.camera_size is None:
            return None
        return FisheyeCamera(self.camera_params, self.camera_size)

    @property
    def view(self) -> Camera:
        """The view that pictures are rectified into."""
        return self.view_type(self.view_params, self.view_size)

    def forward(self, image: Tensor, params: Tensor | None = None, rotation: Tensor | None = None) -> Tensor:
        """Rectify a batch.

        Args:
            image: (B, C, H, W).
            params: (B, 8) or (8,): fx, fy, cx, cy, k1..k4 of the fisheye camera, for pictures of the size of image;
                None for the layer's own camera.
            rotation: (3, 3) or (B, 3, 3) camera_from_view, as in `rectify`.

        Returns:
            (B, C, h, w).

        Raises:
            TypeError, ValueError: as `rectify`; params None in a layer without a camera.
        """
        _check_image(RECTIFY, image)
        camera = self.camera if params is None else FisheyeCamera(params, (image.shape[-2], image.shape[-1]))
        if camera is None:
            raise TypeError(
                "DistortionRectification(): expected params, as the layer has no camera of its own, got None"
            )
        options = (self.interpolation, self.padding, self.antialias)
        return resample_named(RECTIFY, image, camera, self.view, rotation, *options)[0]

    def extra_repr(self) -> str:
        """Show the view and the options."""
        own = "" if self.camera is None else f"camera={self.camera!r}, "
        options = f"interpolation={self.interpolation!r}, padding={self.padding!r}, antialias={self.antialias}"
        return f"view={self.view!r}, {own}{options}"
