"""The compiled door for arrays (csrc/numpy); arguments are checked by its callers."""

from typing import Any

import numpy as np

def resample(
    image: np.ndarray,
    source_model: str,
    source_params: Any,
    target_model: str,
    target_params: Any,
    source_from_target: Any,
    height: int,
    width: int,
    interpolation: str,
    padding: str,
    threads: int,
) -> tuple[np.ndarray, np.ndarray]: ...

class Plan:
    def __init__(
        self,
        source_model: str,
        source_params: Any,
        source_height: int,
        source_width: int,
        target_model: str,
        target_params: Any,
        height: int,
        width: int,
        source_from_target: Any,
        padding: str,
        threads: int,
    ) -> None: ...
    def resample(self, image: np.ndarray, interpolation: str, threads: int) -> np.ndarray: ...
    def valid(self) -> np.ndarray: ...

def project(model: str, params: Any, rays: Any) -> tuple[np.ndarray, np.ndarray]: ...
def unproject(model: str, params: Any, points: Any) -> tuple[np.ndarray, np.ndarray]: ...
def theta_max(k: Any) -> float: ...
