"""A batch that is shared out, to processes or in parts, has the gradients of the whole."""

from __future__ import annotations

import socket

import pytest
import torch
from tiny_training import gradients_of_a_step, start

pytest.importorskip("lightning_fabric", reason="training needs fisheyerec[train]")

from lightning_fabric import Fabric

pytestmark = pytest.mark.usefixtures("one_thread")


def assert_close(one, other, tolerance):
    assert one.keys() == other.keys()
    # A bias before a softmax over places changes nothing, so that its gradient is all rounding.
    noise = 1e-4 * max(float(gradient.abs().max()) for gradient in one.values())
    for name, gradient in one.items():
        limit = tolerance * max(float(gradient.abs().max()), noise)
        assert float((gradient - other[name]).abs().max()) <= limit, name


def test_two_processes_have_the_gradients_of_one(batch, tmp_path, tolerance):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.save(tuple(batch), tmp_path / "batch.pt")
    where = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "NODE_RANK": "0", "WORLD_SIZE": "2"}
    processes = [start("share", tmp_path, LOCAL_RANK=str(rank), **where) for rank in range(2)]
    whole = gradients_of_a_step(Fabric(accelerator="cpu", devices=1), batch, 8)
    assert [process.wait(100) for process in processes] == [0, 0]
    for rank in range(2):
        assert_close(whole, torch.load(tmp_path / f"{rank}.pt"), tolerance.float32_gradient)


def test_parts_of_a_batch_have_the_gradients_of_the_whole(batch, tolerance):
    fabric = Fabric(accelerator="cpu", devices=1)
    assert len({int(labels.bool().sum()) for labels in batch.labels}) > 2, "unequally labelled"
    whole, parts = (gradients_of_a_step(fabric, batch, share) for share in (8, 2))
    assert_close(whole, parts, tolerance.float32_gradient)
