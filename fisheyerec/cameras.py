"""Cameras: parameters, points to rays and back, scaling, cropping, and other people's conventions.

A camera holds its parameters as a NumPy array or a torch tensor, whichever it was given, for one camera (P,) or a
batch (B, P). With tensors everything here is differentiable; with arrays torch is never imported.
Pixel convention, axes and parameter order: csrc/geometry/pixel.h and ARCHITECTURE.md.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from . import lens_models, pixel
from .camera_files import CameraFile, read_camera_file, write_camera_file
from .camera_files.record import checked

if TYPE_CHECKING:
    import torch

    Array = np.ndarray | torch.Tensor

# The widest view that `PinholeCamera.edge_matched` gives is 120 degrees: beyond, a pinhole picture is mostly stretch.
EDGE_MATCHED_THETA_MAX = math.radians(60)

# How far off a lens of another model may be where it is fitted worst, commonly in a corner, where calibrations are
# themselves no better: those of one camera in four models differ there by 1 to 26 px (tests/test_lens_models.py).
# Brown and Conrady's polynomial is refused most: calibrated on a fisheye lens it folds within the picture, and where it
# does not, is off by pixels of its own.
MAX_FIT_ERROR_PX = 1.0


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
        self.params: Array = _checked_params(type(self), params)
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
        return cls._from_file(path, read_camera_file(path, image_size=image_size), MAX_FIT_ERROR_PX)

    @classmethod
    def _from_file(cls, path: str | os.PathLike[str], file: CameraFile, max_fit_error_px: float) -> Self:
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

            from . import reference

            vectors, params = torch.as_tensor(vectors), torch.as_tensor(self.params)
            params = params.to(vectors.device, torch.promote_types(params.dtype, vectors.dtype))
            if batched:
                params = params.reshape(params.shape[0], *[1] * (len(shape) - 2), params.shape[1])
            return getattr(reference, function)(self.model, params, vectors.to(params.dtype))  # type: ignore[no-any-return]
        from . import _numpy

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


class FisheyeCamera(Camera):
    """A fisheye lens after Kannala and Brandt (cv2.fisheye, "KB4"; Eq. 3 of FishEyeRecNet).

    theta_d = theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9 with theta = atan2(hypot(X, Y), Z), and
    x = fx theta_d X / r + cx, y = fy theta_d Y / r + cy. Fields of view beyond 180 degrees are ordinary.

    Args:
        params: (8,) or (B, 8): fx, fy, cx, cy in pixels, k1, k2, k3, k4.
        image_size: (height, width) of the fisheye picture.
    """

    model = "kannala_brandt"
    parameter_names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

    fit_error_px: float | None = None
    """The largest error of a fitted camera against what it was fitted to; None for one that was not fitted."""

    fit_rms_px: float | None = None
    """The root mean square error over the picture of a camera that `from_model` fitted; None otherwise."""

    fitted_to: str | None = None
    """The model that `from_model` fitted the camera to; None otherwise."""

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        image_size: tuple[int, int] | None = None,
        max_fit_error_px: float = MAX_FIT_ERROR_PX,
    ) -> Self:
        """Read a fisheye camera from a lens file of any format, fitting one where the lens is of another model.

        Args:
            path: the file: of the house (JSON or YAML), OpenCV, ROS, kalibr, COLMAP, gyroflow, OCamCalib or camodocal.
            image_size: (height, width), needed where the format does not hold it.
            max_fit_error_px: the largest error of the fit that is taken, as in `from_model`.

        Returns:
            The camera; its `fit_error_px`, `fit_rms_px` and `fitted_to` are None where the file holds this very model.

        Raises:
            ValueError: the file is not such a lens file, or holds a pinhole or a lens that cannot be fitted so well.
            OSError: the file cannot be read.
        """
        return cls._from_file(path, read_camera_file(path, image_size=image_size), max_fit_error_px)

    @classmethod
    def _from_file(cls, path: str | os.PathLike[str], file: CameraFile, max_fit_error_px: float) -> Self:
        if file.model not in lens_models.MODELS:
            return super()._from_file(path, file, max_fit_error_px)
        return cls._fitted(f"{cls.__name__}.load(): {os.fspath(path)!r}", file, max_fit_error_px)

    @property
    def theta_max(self) -> Any:
        """The first extremum of theta_d in (0, pi], or pi: rays further off the axis are invalid; () or (B,).

        A tensor where the parameters are one.
        """
        params = self.params
        if not isinstance(params, np.ndarray):
            from . import reference

            return reference.theta_max(params)
        from . import _numpy

        limits = np.array([_numpy.theta_max(k) for k in np.atleast_2d(params)[:, 4:]])
        return limits.reshape(params.shape[:-1])[()]

    @classmethod
    def from_opencv(cls, K: Any, D: Any, image_size: tuple[int, int]) -> Self:
        """Take a `cv2.fisheye` calibration.

        Args:
            K: (3, 3) or (B, 3, 3) camera matrix without skew.
            D: k1..k4, of shape (4,), (4, 1), (1, 4) or (B, 4).
            image_size: (height, width) of the calibrated pictures.

        Raises:
            ValueError: other shapes, or a skew.
        """
        where = f"{cls.__name__}.from_opencv()"
        K = _checked_matrix(where, K)
        D = D if is_tensor(D) else np.asarray(D, dtype=np.float64)
        if is_tensor(K) or is_tensor(D):
            import torch

            like = K if is_tensor(K) else D
            K, D = torch.as_tensor(K).to(like), torch.as_tensor(D).to(like)
        batch = tuple(K.shape[:-2])
        count = math.prod(tuple(D.shape))
        if count != 4 * math.prod(batch):
            raise ValueError(f"{where}: expected 4 coefficients k1..k4 in D for each K, got shape {tuple(D.shape)}")
        D = D.reshape(*batch, 4)
        columns = [*_matrix_columns(K), *(D[..., i] for i in range(4))]
        return cls(namespace(K).stack(columns, -1), image_size)

    def to_opencv(self) -> tuple[np.ndarray, np.ndarray]:
        """Give K (3, 3) and D (4,) for `cv2.fisheye`, in float64."""
        params = self._single("to_opencv")
        return _camera_matrix(params), params[4:].copy()

    @classmethod
    def from_paper(cls, P_d: Any, image_size: tuple[int, int], *, equation: int = 3) -> Self:
        """Take the paper's parameter vector P_d = [k1, k2, k3, k4, m_u, m_v, u_0, v_0].

        Args:
            P_d: (8,) or (B, 8).
            image_size: (height, width) of the fisheye picture.
            equation: 3 for theta + sum k_i theta^(2i+1); 2 for k1 theta + k2 theta^3 + k3 theta^5 + k4 theta^7, whose
                k1 is a scale that moves into m_u and m_v.

        Raises:
            ValueError: another shape or equation.
        """
        if equation not in (2, 3):
            raise ValueError(f"{cls.__name__}.from_paper(): expected equation 2 or 3, got {equation}")
        P_d = _checked_params(cls, P_d)
        k1, k2, k3, k4, m_u, m_v, u_0, v_0 = (P_d[..., i] for i in range(8))
        if equation == 2:
            m_u, m_v = m_u * k1, m_v * k1
            k1, k2, k3, k4 = k2 / k1, k3 / k1, k4 / k1, 0 * k4
        return cls(namespace(P_d).stack([m_u, m_v, u_0, v_0, k1, k2, k3, k4], -1), image_size)

    def to_paper(self) -> Any:
        """Give the paper's P_d = [k1..k4, m_u, m_v, u_0, v_0] in the sense of Eq. 3; (8,) or (B, 8)."""
        fx, fy, cx, cy, *k = self._columns()
        return namespace(self.params).stack([*k, fx, fy, cx, cy], -1)

    @classmethod
    def from_projection(cls, projection: str, fov_deg: float, image_size: tuple[int, int]) -> Self:
        """Fit a Kannala-Brandt camera to one of the ideal fisheye projections (Kannala and Brandt, Eqs. 1 to 5).

        Args:
            projection: "equidistant" r = f theta, "stereographic" r = 2f tan(theta/2), "equisolid"
                r = 2f sin(theta/2) or "orthographic" r = f sin(theta).
            fov_deg: field of view across the picture's width, edge to edge; in (0, 360), orthographic in (0, 180].
            image_size: (height, width).

        Returns:
            A centred camera; its `fit_error_px` is the largest distance between both projections within fov_deg.

        Raises:
            ValueError: unknown projection, or a field of view it cannot have.
        """
        where = f"{cls.__name__}.from_projection()"
        if projection not in _PROJECTIONS:
            raise ValueError(f"{where}: expected projection in {sorted(_PROJECTIONS)}, got {projection!r}")
        widest = 180 if projection == "orthographic" else 360
        if not (0 < fov_deg < widest or fov_deg == 180):
            raise ValueError(f"{where}: expected fov_deg in (0, {widest}) for {projection}, got {fov_deg}")
        height, width = checked_image_size(cls, image_size)
        radius, half_fov = _PROJECTIONS[projection], math.radians(fov_deg) / 2

        # Least squares at Chebyshev nodes, close to the best fit in the largest error. The unknowns are f and f k_i.
        nodes = half_fov * np.cos(np.pi * (np.arange(200) + 0.5) / 400)
        powers = (nodes[:, None] / half_fov) ** (2 * np.arange(5) + 1)
        solution = np.linalg.lstsq(powers, radius(nodes), rcond=None)[0] / half_fov ** (2 * np.arange(5) + 1)
        k = solution[1:] / solution[0]
        f = solution[0] * (width / 2) / radius(half_fov)
        camera = cls([f, f, pixel.centre(width), pixel.centre(height), *k], image_size)
        theta = np.linspace(0, half_fov, 2001)
        theta_d = sum(c * theta ** (2 * i + 1) for i, c in enumerate([1, *k]))
        camera.fit_error_px = float(np.abs(f * theta_d - radius(theta) * (width / 2) / radius(half_fov)).max())
        return camera

    @classmethod
    def from_model(
        cls,
        model: str,
        params: Sequence[float],
        image_size: tuple[int, int],
        *,
        max_fit_error_px: float = MAX_FIT_ERROR_PX,
    ) -> Self:
        """Fit a Kannala-Brandt camera to a lens of another model, over the rays that its picture's pixels see.

        Args:
            model: "brown_conrady", "unified", "extended_unified", "double_sphere", "division", "field_of_view",
                "thin_prism_fisheye" or "ocam"; their equations and sources are in lens_models.py. A turn about the
                optical axis that an ocam lens holds is one of its frame, and left out.
            params: the model's parameters, as `camera_files.record.PARAMETERS` names them.
            image_size: (height, width).
            max_fit_error_px: the largest error that is taken.

        Returns:
            A camera; its `fit_error_px` is the largest distance between where both lenses see a ray of the picture,
            its `fit_rms_px` the root mean square, and `fitted_to` the model.

        Raises:
            ValueError: an unknown model, another number of parameters, or a lens that cannot be fitted so well.
        """
        where = f"{cls.__name__}.from_model()"
        if model not in lens_models.MODELS:
            raise ValueError(f"{where}: expected model in {sorted(lens_models.MODELS)}, got {model!r}")
        height, width = checked_image_size(cls, image_size)
        try:
            file = checked(model, width, height, params)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        return cls._fitted(where, file, max_fit_error_px)

    @classmethod
    def _fitted(cls, where: str, file: CameraFile, max_fit_error_px: float) -> Self:
        try:
            fitted = lens_models.fit(file.model, file.params, (file.height, file.width))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        if not fitted.max_error_px <= max_fit_error_px:
            raise ValueError(
                f"{where}: expected a {file.model} lens that kannala_brandt fits within {max_fit_error_px:g} px "
                f"(max_fit_error_px), got {fitted.max_error_px:.3g} px at most and {fitted.rms_error_px:.3g} px RMS: "
                "allow more, or calibrate with cv2.fisheye"
            )
        camera = cls(fitted.params, (file.height, file.width))
        camera.fit_error_px, camera.fit_rms_px = fitted.max_error_px, fitted.rms_error_px
        camera.fitted_to = file.model
        return camera


_PROJECTIONS: dict[str, Callable[[Any], Any]] = {
    "equidistant": lambda theta: theta,
    "stereographic": lambda theta: 2 * np.tan(theta / 2),
    "equisolid": lambda theta: 2 * np.sin(theta / 2),
    "orthographic": np.sin,
}


class PinholeCamera(Camera):
    """A perspective view: x = fx X/Z + cx, y = fy Y/Z + cy.

    Args:
        params: (4,) or (B, 4): fx, fy, cx, cy in pixels.
        image_size: (height, width) of the view.
    """

    model = "pinhole"
    parameter_names = ("fx", "fy", "cx", "cy")

    @classmethod
    def from_fov(cls, fov_deg: float, image_size: tuple[int, int]) -> Self:
        """Give a centred view with square pixels that is fov_deg wide, edge to edge.

        Raises:
            ValueError: fov_deg outside (0, 180), which no perspective view can show.
        """
        if not 0 < fov_deg < 180:
            raise ValueError(
                f"{cls.__name__}.from_fov(): expected fov_deg in (0, 180), as a perspective view is narrower than "
                f"180 degrees, got {fov_deg:g}"
            )
        _, width = checked_image_size(cls, image_size)
        return cls.from_focal(width / 2 / math.tan(math.radians(fov_deg) / 2), image_size)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> Self:
        """Give a centred view with square pixels and the given focal length in pixels.

        Raises:
            ValueError: a focal length that is not positive and finite.
        """
        if not (focal > 0 and math.isfinite(focal)):
            raise ValueError(f"{cls.__name__}.from_focal(): expected a focal length above 0, got {focal:g}")
        height, width = checked_image_size(cls, image_size)
        return cls([focal, focal, pixel.centre(width), pixel.centre(height)], image_size)

    @classmethod
    def from_matrix(cls, K: Any, image_size: tuple[int, int]) -> Self:
        """Take a (3, 3) or (B, 3, 3) camera matrix without skew, such as OpenCV's new camera matrix.

        Raises:
            ValueError: another shape, or a skew.
        """
        K = _checked_matrix(f"{cls.__name__}.from_matrix()", K)
        return cls(namespace(K).stack(_matrix_columns(K), -1), image_size)

    def to_matrix(self) -> np.ndarray:
        """Give the (3, 3) camera matrix in float64."""
        return _camera_matrix(self._single("to_matrix"))

    @classmethod
    def edge_matched(cls, camera: FisheyeCamera, image_size: tuple[int, int]) -> Self:
        """Give the standard view of a fisheye camera: its nearest picture edge stays at the edge of the view.

        Centred, with square pixels and focal (size / 2) / tan(theta_e), where theta_e, at most 60 degrees, is the
        smallest angle that the camera gives to the midpoints of the picture's edges. On a view that is not square,
        left and right edges bound its width, upper and lower edges its height. Valid everywhere unless the lens
        folds within the frame. Differentiable in the camera's parameters where these are a tensor.

        Args:
            camera: one camera or a batch.
            image_size: (height, width) of the view.

        Raises:
            TypeError: camera is not a FisheyeCamera.
            ValueError: image_size below 1.
        """
        if not isinstance(camera, FisheyeCamera):
            raise TypeError(
                f"{cls.__name__}.edge_matched(): expected camera as a FisheyeCamera, got {type(camera).__name__}"
            )
        height, width = checked_image_size(cls, image_size)
        source_height, source_width = camera.image_size
        x, y = pixel.centre(source_width), pixel.centre(source_height)
        left, upper = -pixel.HALF_PIXEL, -pixel.HALF_PIXEL
        right, lower = source_width - pixel.HALF_PIXEL, source_height - pixel.HALF_PIXEL
        midpoints = np.array([(left, y), (right, y), (x, upper), (x, lower)])
        params, xp = camera.params, namespace(camera.params)
        points = xp.asarray(midpoints)
        if is_tensor(params):
            points = points.to(params)
        if params.ndim == 2:
            points = xp.broadcast_to(points, (params.shape[0], 4, 2))
        rays, valid = camera.unproject(points)
        widest = EDGE_MATCHED_THETA_MAX * xp.ones_like(params[..., :1])
        # Where an edge lies beyond the lens, its angle is unknown but no smaller than theta_max.
        beyond = camera.theta_max.clip(max=EDGE_MATCHED_THETA_MAX)
        rays = xp.where(valid[..., None], rays, xp.ones_like(rays))
        theta = xp.atan2(xp.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
        theta = xp.where(valid, theta, beyond[..., None])
        theta = xp.where(theta < widest, theta, widest)
        across = xp.minimum(theta[..., 0], theta[..., 1])
        down = xp.minimum(theta[..., 2], theta[..., 3])
        focal = xp.maximum(width / 2 / xp.tan(across), height / 2 / xp.tan(down))
        one = xp.ones_like(focal)
        return cls(xp.stack([focal, focal, pixel.centre(width) * one, pixel.centre(height) * one], -1), image_size)


def load_camera(
    path: str | os.PathLike[str],
    *,
    image_size: tuple[int, int] | None = None,
    max_fit_error_px: float = MAX_FIT_ERROR_PX,
) -> Camera:
    """Read a pinhole or a fisheye camera, whichever a lens file holds; the rest is as in `FisheyeCamera.load`."""
    file = read_camera_file(path, image_size=image_size)
    kind: type[Camera] = PinholeCamera if file.model == PinholeCamera.model else FisheyeCamera
    return kind._from_file(path, file, max_fit_error_px)


def _checked_matrix(where: str, K: Any) -> Any:
    K = K if is_tensor(K) else np.asarray(K, dtype=np.float64)
    if K.ndim not in (2, 3) or tuple(K.shape[-2:]) != (3, 3):
        raise ValueError(f"{where}: expected K of shape (3, 3) or (B, 3, 3), got {tuple(K.shape)}")
    if bool((abs(K[..., 0, 1]) > 1e-9 * abs(K[..., 0, 0])).any()):
        raise ValueError(f"{where}: expected a camera matrix without skew, got K[0][1] = {float(K[..., 0, 1].max())}")
    return K


def _matrix_columns(K: Any) -> list[Any]:
    return [K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]]


def _camera_matrix(params: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = params[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _checked_params(cls: type[Camera], params: Any) -> Any:
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
