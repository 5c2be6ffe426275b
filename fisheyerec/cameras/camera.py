"""What every camera model shares: parameters, points to rays and back, scaling, cropping, files.

A camera holds its parameters as a NumPy array or a torch tensor, whichever it was given, for one camera (P,) or a
batch (B, P). With tensors everything here is differentiable; with arrays torch is never imported.
Pixel convention, axes and parameter order: csrc/geometry/pixel.h and ARCHITECTURE.md.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from .. import pixel
from ..camera_files import CameraFile, read_camera_file, write_camera_file

if TYPE_CHECKING:
    import torch

    Array = np.ndarray | torch.Tensor


def is_tensor(value: object) -> bool:
    """Tell whether a value is a torch tensor, without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def namespace(array: Any) -> Any:
    """Give the module, torch or numpy, whose functions take this array; their names agree for what is used here."""
    return sys.modules["torch"] if is_tensor(array) else np


class Camera:
    """What every camera model shares: a model name, parameters and an image size.

    Args:
        params: (P,) or (B, P) floating array, tensor or sequence; order in `parameter_names`.
        image_size: (height, width) in pixels.

    Raises:
        TypeError: params are not numbers, or image_size is not a pair of integers.
        ValueError: params of another shape or an integer dtype, or image_size below 1.
    """

    model: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]

    def __init__(self, params: Any, image_size: tuple[int, int]) -> None:
        self.params: Array = checked_params(type(self), params)
        self.image_size = checked_image_size(type(self), image_size)

    def __repr__(self) -> str:
        height, width = self.image_size
        shape = tuple(self.params.shape)
        if shape != (len(self.parameter_names),):
            return f"{type(self).__name__}(params={shape}, image_size=({height}, {width}))"
        values = self.params if isinstance(self.params, np.ndarray) else self.params.detach()
        numbers = (f"{n}={float(p):.6g}" for n, p in zip(self.parameter_names, values, strict=True))
        return f"{type(self).__name__}({', '.join(numbers)}, image_size=({height}, {width}))"

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, image_size: tuple[int, int] | None = None) -> Self:
        """Read a camera from a lens file of any format named in docs (house JSON or YAML, OpenCV, kalibr, COLMAP...).

        Args:
            path: the file.
            image_size: (height, width), needed where the format does not hold it.

        Raises:
            ValueError: the file is not such a lens file, or holds another camera model.
            OSError: the file cannot be read.
        """
        return cls._from_file(path, read_camera_file(path, image_size=image_size))

    @classmethod
    def _from_file(cls, path: str | os.PathLike[str], file: CameraFile) -> Self:
        if file.model != cls.model:
            raise ValueError(f"{cls.__name__}.load(): expected a {cls.model} camera in {path}, got {file.model}")
        return cls(np.array(file.params), (file.height, file.width))

    def save(self, path: str | os.PathLike[str], *, format: str = "fisheyerec") -> None:
        """Write the camera to a lens file, whole or not at all.

        Args:
            path: the file, with a suffix that the format has.
            format: "fisheyerec" (.json or .yaml, exact to the last bit), or for a fisheye or pinhole camera "opencv",
                "kalibr", "colmap", "gyroflow" or "ros".

        Raises:
            ValueError: a batch of cameras, a format that is unknown or does not hold the model, or another suffix.
            OSError: the file cannot be written; an older file is left as it was.
        """
        values = self._single("save").tolist()
        height, width = self.image_size
        write_camera_file(path, CameraFile(self.model, width, height, tuple(values)), format=format)

    def project(self, rays: Any) -> tuple[Any, Any]:
        """Project rays into the image.

        Args:
            rays: (..., 3), x right, y down, z forward, of any length; for a batch of cameras (B, ..., 3).

        Returns:
            points (..., 2) in pixels, and valid (...) bool; invalid points are NaN.

        Raises:
            ValueError: rays of another shape.
        """
        return self._transform("project", rays, "rays", 3)

    def unproject(self, points: Any) -> tuple[Any, Any]:
        """Lift image points to rays.

        Args:
            points: (..., 2) in pixels as (x, y); for a batch of cameras (B, ..., 2).

        Returns:
            rays (..., 3), of unit length for a fisheye, with z = 1 for a pinhole and of other lengths for other views,
            and valid (...) bool; invalid rays are NaN.

        Raises:
            ValueError: points of another shape.
        """
        return self._transform("unproject", points, "points", 2)

    def _transform(self, function: str, vectors: Any, name: str, size: int) -> tuple[Any, Any]:
        where = f"{type(self).__name__}.{function}()"
        if not is_tensor(vectors):
            vectors = np.asarray(vectors)
        batched = self.params.ndim == 2
        shape = tuple(vectors.shape)
        if not shape or shape[-1] != size or (batched and (len(shape) < 2 or shape[0] != self.params.shape[0])):
            expected = f"({self.params.shape[0]}, ..., {size})" if batched else f"(..., {size})"
            raise ValueError(f"{where}: expected {name} of shape {expected}, got {shape}")
        if is_tensor(vectors) or is_tensor(self.params):
            import torch

            from .. import reference

            vectors, params = torch.as_tensor(vectors), torch.as_tensor(self.params)
            params = params.to(vectors.device, torch.promote_types(params.dtype, vectors.dtype))
            if batched:
                params = params.reshape(params.shape[0], *[1] * (len(shape) - 2), params.shape[1])
            return getattr(reference, function)(self.model, params, vectors.to(params.dtype))  # type: ignore[no-any-return]
        from .. import _numpy

        kernel = getattr(_numpy, function)
        if not batched:
            out, valid = kernel(self.model, self.params, vectors.reshape(-1, size))
            return out.reshape(*shape[:-1], out.shape[-1]), valid.reshape(shape[:-1])
        parts = [
            type(self)(p, self.image_size)._transform(function, v, name, size)
            for p, v in zip(self.params, vectors, strict=True)
        ]
        return np.stack([p[0] for p in parts]), np.stack([p[1] for p in parts])

    def resize(self, image_size: tuple[int, int]) -> Self:
        """Give the camera of the same picture resized to (height, width): the same rays at the same relative places."""
        height, width = checked_image_size(type(self), image_size)
        scale_y, scale_x = height / self.image_size[0], width / self.image_size[1]
        fx, fy, cx, cy, *k = self._columns()
        columns = [fx * scale_x, fy * scale_y, pixel.scale(cx, scale_x), pixel.scale(cy, scale_y), *k]
        return self._with(columns, (height, width))

    def scale(self, factor: float) -> Self:
        """Give the camera of the same picture `factor` times as large, its size rounded to whole pixels."""
        height, width = (max(1, round(size * factor)) for size in self.image_size)
        fx, fy, cx, cy, *k = self._columns()
        return self._with(
            [fx * factor, fy * factor, pixel.scale(cx, factor), pixel.scale(cy, factor), *k], (height, width)
        )

    def crop(self, x0: float, y0: float, image_size: tuple[int, int]) -> Self:
        """Give the camera of the part of the picture whose upper left pixel is (x0, y0); it may reach outside."""
        fx, fy, cx, cy, *k = self._columns()
        return self._with([fx, fy, cx - x0, cy - y0, *k], image_size)

    def numpy(self) -> Self:
        """Give the same camera with its parameters as a float64 NumPy array."""
        params: Any = self.params
        params = params.detach().cpu().numpy() if is_tensor(params) else params
        return type(self)(np.asarray(params, dtype=np.float64), self.image_size)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Give the same camera with its parameters as a tensor, moved or cast as by `torch.Tensor.to`."""
        import torch

        return type(self)(torch.as_tensor(self.params).to(*args, **kwargs), self.image_size)

    def _columns(self) -> list[Any]:
        return [self.params[..., i] for i in range(len(self.parameter_names))]

    def _with(self, columns: Sequence[Any], image_size: tuple[int, int]) -> Self:
        return type(self)(namespace(self.params).stack(columns, -1), image_size)

    def _single(self, function: str) -> np.ndarray:
        if self.params.ndim != 1:
            raise ValueError(
                f"{type(self).__name__}.{function}(): expected one camera, got a batch of {self.params.shape[0]}"
            )
        return np.asarray(self.numpy().params)


def checked_params(cls: type[Camera], params: Any) -> Any:
    """Give (P,) or (B, P) as an array or a tensor; raise TypeError unless they are numbers, ValueError for a shape."""
    count = len(cls.parameter_names)
    if not is_tensor(params):
        try:
            params = np.asarray(params)
        except ValueError as error:
            raise ValueError(
                f"{cls.__name__}(): expected params of shape ({count},) or (B, {count}), got a ragged list"
            ) from error
        if isinstance(params.dtype.type(), np.integer):
            params = params.astype(np.float64)
        if params.dtype.kind != "f":
            raise TypeError(f"{cls.__name__}(): expected params as numbers, got an array of {params.dtype}")
    elif not params.is_floating_point():
        raise ValueError(f"{cls.__name__}(): expected params of a floating dtype, got {params.dtype}")
    shape = tuple(params.shape)
    if len(shape) not in (1, 2) or shape[-1] != count:
        raise ValueError(
            f"{cls.__name__}(): expected params of shape ({count},) or (B, {count}) "
            f"({', '.join(cls.parameter_names)}), got {shape}"
        )
    return params


def checked_image_size(cls: type[Camera], image_size: Any) -> tuple[int, int]:
    """Give (height, width) as integers; raise TypeError unless they are two, ValueError unless they are above 0."""
    try:
        height, width = image_size
        if height != int(height) or width != int(width):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise TypeError(
            f"{cls.__name__}(): expected image_size as two integers (height, width), got {image_size!r}"
        ) from None
    if height < 1 or width < 1:
        raise ValueError(f"{cls.__name__}(): expected image_size of at least (1, 1), got {image_size!r}")
    return int(height), int(width)
