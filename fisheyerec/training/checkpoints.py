"""Checkpoints: folders that appear whole or not at all, read without running code from them."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from ..weights import read_tensors

_WEIGHTS, _STATE, _OPTIONS = "weights.safetensors", "state.pt", "options.json"
_UNFINISHED = ".unfinished"


def save_checkpoint(
    folder: Path, step: int, weights: dict[str, Tensor], state: dict[str, Any], options: dict[str, Any]
) -> Path:
    """Write folder/step-NNNNNNNN and then remove older checkpoints.

    Args:
        folder: of the training run.
        step: how many steps were made.
        weights: of the network.
        state: whatever else exact resumption needs; tensors and plain values.
        options: what the run was started with.

    Raises:
        OSError: it cannot be written, or is there already; the older checkpoint is left.
    """
    path = folder / f"step-{step:08d}"
    temporary = folder / _UNFINISHED
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    save_file({name: value.detach().contiguous().cpu() for name, value in weights.items()}, temporary / _WEIGHTS)
    torch.save(state, temporary / _STATE)
    (temporary / _OPTIONS).write_text(json.dumps(options, indent=1) + "\n")
    for name in (_WEIGHTS, _STATE, _OPTIONS):
        _flush(temporary / name)  # the older checkpoint may only go once this one survives a power cut
    temporary.rename(path)
    _flush(folder)
    for old in list_checkpoints(folder):
        if old != path:
            shutil.rmtree(old)
    return path


def list_checkpoints(folder: Path) -> list[Path]:
    """Give the complete checkpoints of a run, oldest first."""
    return sorted(path for path in folder.glob("step-*") if path.is_dir())


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any], dict[str, Any]]:
    """Read a checkpoint.

    Returns:
        weights, state and options as they were saved.

    Raises:
        ValueError: a file in it is missing or broken.
    """
    try:
        weights = read_tensors(path / _WEIGHTS)
        state = torch.load(path / _STATE, map_location="cpu", weights_only=True)
        options = json.loads((path / _OPTIONS).read_text())
    except (OSError, RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as error:
        raise ValueError(f"expected a complete checkpoint in {path}, got a broken one ({error})") from error
    return weights, state, options


def _flush(path: Path) -> None:
    """Bring a file or the entries of a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
