"""Weights files: a network with what is needed to build it again, in one safetensors file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from .network import FishEyeRecNet, LensNetwork


def save_network(network: LensNetwork, path: str | os.PathLike[str], notes: Mapping[str, Any]) -> None:
    """Write a network in float16, complete or not at all.

    Args:
        network: whose `design` says how it was built.
        path: a .safetensors file.
        notes: what else to remember, as JSON can hold it.

    Raises:
        OSError: it cannot be written; an older file is left as it was.
    """
    path = Path(path)
    # Lens charts need their float64: a basis in halves would move pixels.
    tensors = {
        name: (value.half() if value.dtype == torch.float32 else value).detach().cpu().contiguous()
        for name, value in network.state_dict().items()
    }
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        save_file(tensors, temporary, {"design": json.dumps(network.design), "notes": json.dumps(dict(notes))})
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load_network(path: str | os.PathLike[str]) -> FishEyeRecNet:
    """Read a network, ready for inference.

    Args:
        path: a file of `save_network`.

    Raises:
        ValueError: another file, or weights that do not fit the network they name.
        OSError: the file cannot be read.
    """
    tensors, metadata = _read(path)
    try:
        network = FishEyeRecNet.from_design(json.loads(metadata["design"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"load_network(): expected a file of save_network, got {os.fspath(path)!r}") from error
    fill(network, tensors, os.fspath(path))
    return network.eval()


def read_notes(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read what `save_network` was told to remember; errors as `load_network`."""
    metadata = _read(path)[1]
    try:
        return dict(json.loads(metadata["notes"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"read_notes(): expected a file of save_network, got {os.fspath(path)!r}") from error


def fill(network: nn.Module, tensors: Mapping[str, Tensor], origin: str) -> None:
    """Put tensors into a network, strictly, whatever precision they are stored in.

    Raises:
        ValueError: missing, unknown or differently shaped tensors; the message names the first and `origin`.
    """
    expected = network.state_dict()
    for name in [*expected, *tensors]:
        if name not in tensors or name not in expected:
            raise ValueError(f"expected weights of this network in {origin}, got a file that differs in {name!r}")
        if tensors[name].shape != expected[name].shape:
            raise ValueError(
                f"expected {name} of shape {tuple(expected[name].shape)} in {origin}, "
                f"got {tuple(tensors[name].shape)}: another number of classes?"
            )
    network.load_state_dict({name: tensors[name].to(value.dtype) for name, value in expected.items()})


def read_tensors(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Read the tensors of a safetensors file; errors as `load_network`."""
    return _read(path)[0]


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(
            f"expected a safetensors file, got {os.fspath(path)!r} that is none or broken ({error})"
        ) from error
