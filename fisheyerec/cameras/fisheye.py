"""The fisheye camera, from the conventions of others and fitted to their models."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np

from .. import lens_models, pixel
from ..camera_files import CameraFile, read_camera_file
from ..camera_files.record import checked
from .camera import Camera, checked_image_size, checked_params, is_tensor, namespace
from .matrices import camera_matrix, checked_matrix, matrix_columns

# How far off a lens of another model may be where it is fitted worst, commonly in a corner, where calibrations are
# themselves no better: those of one camera in four models differ there by 1 to 26 px (tests/test_lens_models.py).
# Brown and Conrady's polynomial is refused most: calibrated on a fisheye lens it folds within the picture, and where it
# does not, is off by pixels of its own.
MAX_FIT_ERROR_PX = 1.0


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
    def _from_file(
        cls, path: str | os.PathLike[str], file: CameraFile, max_fit_error_px: float = MAX_FIT_ERROR_PX
    ) -> Self:
        if file.model not in lens_models.MODELS:
            return super()._from_file(path, file)
        return cls._fitted(f"{cls.__name__}.load(): {os.fspath(path)!r}", file, max_fit_error_px)

    @property
    def theta_max(self) -> Any:
        """The first extremum of theta_d in (0, pi], or pi: rays further off the axis are invalid; () or (B,).

        A tensor where the parameters are one.
        """
        params = self.params
        if not isinstance(params, np.ndarray):
            from .. import reference

            return reference.theta_max(params)
        from .. import _numpy

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
        K = checked_matrix(where, K)
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
        columns = [*matrix_columns(K), *(D[..., i] for i in range(4))]
        return cls(namespace(K).stack(columns, -1), image_size)

    def to_opencv(self) -> tuple[np.ndarray, np.ndarray]:
        """Give K (3, 3) and D (4,) for `cv2.fisheye`, in float64."""
        params = self._single("to_opencv")
        return camera_matrix(params), params[4:].copy()

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
        P_d = checked_params(cls, P_d)
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
