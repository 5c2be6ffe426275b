"""A network, pictures and runs so small that tests can train.

As a script it trains as `RUN` says and kills itself, or takes its part in a step of several processes.
"""

from __future__ import annotations

import csv
import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file
from torch import nn

import fisheyerec as fr
from fisheyerec.network import CompactBaseNetwork, FishEyeRecNet, SceneParsingNetwork

pytest.importorskip("lightning_fabric", reason="training needs fisheyerec[train]")

from lightning_fabric import Fabric

from fisheyerec.training import checkpoints
from fisheyerec.training import train as training
from fisheyerec.training.batches import AugmentedPairs, Batch, collate
from fisheyerec.training.sources import DecodedSource, Source, Sources
from fisheyerec.training.synthesis import SyntheticPairs
from fisheyerec.training.train import MODERN, RONG, TrainingOptions

CLASSES = 3
SIDE = 64
RUN = TrainingOptions(
    num_classes=CLASSES, steps=8, batch_size=4, log_every=3, validate_every=4, checkpoint_every=2, validation_pairs=4
)
RUN_RONG = dataclasses.replace(RUN, network="rong", recipe=RONG)
TIMES = {"pictures_per_s", "eta_s"}


class TinyEstimation(nn.Module):
    """Reads what the real ones read, and drops out, so that training depends on chance."""

    def __init__(self, maps):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Flatten(),
            nn.Linear(64 * (3 + maps), 16),
            nn.BatchNorm1d(16),
            nn.ReLU(),
            nn.Dropout(1 / 2),
            nn.Linear(16, 16),
        )

    def forward(self, image, features, parsing):
        maps = [nn.functional.avg_pool2d(image, 8), features]
        return self.layers(torch.cat(maps if parsing is None else [*maps, parsing], 1))


def tiny(design):
    """A network of all components for pictures of 64x64 that takes a step in milliseconds."""
    classes = design["num_classes"] if design["scene_parsing"] else 0
    parsing = SceneParsingNetwork(8, (8, 8), (8, 8, 8), classes, shrink=8) if classes else None
    return FishEyeRecNet(CompactBaseNetwork((8, 8, 8, 8, 8)), parsing, TinyEstimation(8 + classes), SIDE, False, design)


def draw_sources(count=4, labelled=3):
    """Soft blots of colour with labels 0 to CLASSES, the last sources without labels."""
    rng = np.random.default_rng(0)
    decoded = []
    for number in range(count):
        blots = Image.fromarray(rng.integers(0, 256, (6, 7, 3), dtype=np.uint8))
        labels = Image.fromarray(rng.integers(0, CLASSES + 1, (6, 7), dtype=np.uint8))
        size = (98, 84)
        pixels = np.asarray(blots.resize(size, Image.Resampling.BICUBIC))
        decoded.append(DecodedSource(pixels, np.asarray(labels.resize(size, 0)) if number < labelled else None))
    return Sources([Source(f"blots {number}", Path(f"{number}.png")) for number in range(count)], decoded)


def draw_batch():
    """Eight pairs with their straight pictures; two have no labels."""
    pairs = AugmentedPairs(SyntheticPairs(draw_sources(), size=(SIDE, SIDE)), augment=False)
    return collate([pairs[index] for index in range(8)])


def run_training(folder, options=RUN, **settings):
    return training.train(folder, draw_sources(), draw_sources(2), options, **{"workers": 0} | settings)


def last_checkpoint(folder):
    (path,) = checkpoints.list_checkpoints(folder)
    return checkpoints.load_checkpoint(path)


def rows_of(folder):
    with open(folder / "log.csv", newline="") as stream:
        return [{k: v for k, v in row.items() if k not in TIMES} for row in csv.DictReader(stream)]


def assert_same(a, b, where=""):
    """Equal to the last bit, through all nesting."""
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for number, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_same(one, other, f"{where}/{number}")
    else:
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, where


def assert_same_run(folder, other):
    assert_same(last_checkpoint(folder), last_checkpoint(other))
    assert rows_of(folder) == rows_of(other)
    assert_same(load_file(folder / "best.safetensors"), load_file(other / "best.safetensors"))


def start(*arguments, **environment):
    """Run this file as a script, in its own process."""
    home = str(Path(fr.__file__).resolve().parents[1])
    path = os.pathsep.join(filter(None, [home, os.environ.get("PYTHONPATH")]))
    command = [sys.executable, __file__, *map(str, arguments)]
    return subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **environment})


def train_and_die(folder):
    """Train as RUN says, its pairs made by another process, and be killed halfway through the checkpoint of step 6."""
    FishEyeRecNet.from_design = staticmethod(tiny)
    torch.set_num_threads(1)
    save = torch.save

    def save_or_die(state, path):
        if state["step"] == 6:
            path.write_bytes(b"half of")
            os.kill(os.getpid(), signal.SIGKILL)
        save(state, path)

    torch.save = save_or_die
    run_training(folder, workers=1)


def gradients_of_a_step(fabric, batch, share):
    """Gradients of `compact` in inference mode: each process would normalise its part by its own mean and spread."""
    torch.manual_seed(0)
    network = FishEyeRecNet.compact(CLASSES).eval()
    model, optimizer = fabric.setup(network, torch.optim.SGD(network.parameters(), 0.0))
    recipe = dataclasses.replace(MODERN, rectification=1.0, parsing=1.0, clip=0.0)
    training._step(fabric, network, model, optimizer, batch, share, recipe, 0, False)
    return {name: parameter.grad for name, parameter in network.named_parameters()}


def take_share(folder):
    """Make a step with this process's part of a batch, in two parts."""
    torch.set_num_threads(1)
    fabric = Fabric(accelerator="cpu", devices=2, strategy="ddp")
    fabric.launch()
    rank = fabric.global_rank
    batch = Batch(*(tensor[rank::2] for tensor in torch.load(folder / "batch.pt")))
    torch.save(gradients_of_a_step(fabric, batch, 2), folder / f"{rank}.pt")


if __name__ == "__main__":
    {"killed": train_and_die, "share": take_share}[sys.argv[1]](Path(sys.argv[2]))
