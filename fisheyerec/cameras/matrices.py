"""Camera matrices K, as OpenCV and others have them."""

from __future__ import annotations

from typing import Any

import numpy as np

from .camera import is_tensor


def checked_matrix(where: str, K: Any) -> Any:
    """Give K as an array or a tensor; raise ValueError in the name of `where` for another shape or a skew."""
    K = K if is_tensor(K) else np.asarray(K, dtype=np.float64)
    if K.ndim not in (2, 3) or tuple(K.shape[-2:]) != (3, 3):
        raise ValueError(f"{where}: expected K of shape (3, 3) or (B, 3, 3), got {tuple(K.shape)}")
    if bool((abs(K[..., 0, 1]) > 1e-9 * abs(K[..., 0, 0])).any()):
        raise ValueError(f"{where}: expected a camera matrix without skew, got K[0][1] = {float(K[..., 0, 1].max())}")
    return K


def matrix_columns(K: Any) -> list[Any]:
    """Give fx, fy, cx, cy of K (..., 3, 3)."""
    return [K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]]


def camera_matrix(params: np.ndarray) -> np.ndarray:
    """Give K (3, 3) of parameters that begin with fx, fy, cx, cy."""
    fx, fy, cx, cy = params[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
