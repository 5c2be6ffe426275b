"""Checks of what users pass to the op, in their words, shared by the torch and the NumPy door."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .cameras import Camera, is_tensor

INTERPOLATIONS = ("bilinear", "nearest")
PADDINGS = ("zeros", "border")


class Names(NamedTuple):
    """How a public function calls the op's three main arguments."""

    function: str
    image: str
    source: str
    target: str


RECTIFY = Names("rectify", "image", "camera", "view")
DISTORT = Names("distort", "picture", "view", "camera")
RESAMPLE = Names("resample", "image", "source", "target")
RECTIFY_SAMPLE = Names("rectify_sample", "image", "camera", "view")
DISTORT_SAMPLE = Names("distort_sample", "image", "view", "camera")
PLAN = Names("Plan", "image", "source", "target")


def check_interpolation(function: str, interpolation: str) -> None:
    """Raise ValueError unless the name is known."""
    if interpolation not in INTERPOLATIONS:
        raise ValueError(f"{function}(): expected interpolation in {INTERPOLATIONS}, got {interpolation!r}")


def check_antialias(function: str, antialias: bool, interpolation: str) -> None:
    """Raise ValueError where labels would be averaged."""
    if antialias and interpolation != "bilinear":
        raise ValueError(f"{function}(): expected interpolation 'bilinear' for antialias, got {interpolation!r}")


def check_padding(function: str, padding: str) -> None:
    """Raise ValueError unless the name is known."""
    if padding not in PADDINGS:
        raise ValueError(f"{function}(): expected padding in {PADDINGS}, got {padding!r}")


def check_camera(function: str, name: str, camera: Any) -> None:
    """Raise TypeError unless this is a camera."""
    if not isinstance(camera, Camera):
        raise TypeError(f"{function}(): expected {name} as a camera, got {type(camera).__name__}")


def check_single(names: Names, source: Any, target: Any, source_from_target: Any) -> np.ndarray | None:
    """Raise unless these are two single cameras and a rotation, and give that as (3, 3) numbers."""
    for name, camera in ((names.source, source), (names.target, target)):
        check_camera(names.function, name, camera)
        if camera.params.ndim != 1:
            raise ValueError(f"{names.function}(): expected one {name}, got a batch of {camera.params.shape[0]}")
    return None if source_from_target is None else rotation_matrix(names.function, source_from_target)


def rotation_matrix(function: str, rotation: Any) -> np.ndarray:
    """Give a rotation as (3, 3) numbers, those of a tensor without its gradients, or raise."""
    if is_tensor(rotation):
        rotation = rotation.detach().cpu()
    try:
        matrix = np.asarray(rotation, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{function}(): expected rotation as (3, 3) numbers, got {rotation!r:.60}") from None
    if matrix.shape != (3, 3):
        raise ValueError(f"{function}(): expected rotation of shape (3, 3), got {matrix.shape}")
    return matrix


def check_size(names: Names, size: tuple[int, ...], source: Camera) -> None:
    """Raise ValueError unless the image is of the size that its camera was calibrated for."""
    if size != source.image_size:
        raise ValueError(
            f"{names.function}(): expected {names.image} of the size of {names.source}, {source.image_size}, got "
            f"{size}; {names.source}.resize() gives the camera of a resized picture"
        )


def check_interpolates(names: Names, interpolates: bool, interpolation: str, dtype: object, taken: str) -> None:
    """Raise ValueError where a dtype of labels meets an interpolation that would mix them."""
    if not interpolates and interpolation != "nearest":
        raise ValueError(
            f"{names.function}(): expected {names.image} of a floating dtype{taken} for {interpolation}, "
            f"got {dtype}; labels want interpolation='nearest'"
        )
