"""Runs: killed, stopped and gone on with; recipes and ablations."""

from __future__ import annotations

import dataclasses
import math
import signal

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_training import RUN, RUN_RONG, assert_same_run, draw_sources, last_checkpoint, rows_of, run_training, start
from torch import nn

pytest.importorskip("lightning_fabric", reason="training needs fisheyerec[train]")

from lightning_fabric import Fabric
from lightning_fabric.plugins.precision import MixedPrecision

from fisheyerec.training import checkpoints
from fisheyerec.training import train as training
from fisheyerec.training.train import MODERN, PAPER

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_killed_run_goes_on_as_if_it_had_not_been(tiny_network, tmp_path):
    """kill -9 while a checkpoint is written, at step 6; steps 5 and 6 are made again."""
    run_training(tmp_path / "unbroken")
    killed = start("killed", tmp_path / "killed")
    assert killed.wait(100) == -signal.SIGKILL
    left = sorted(path.name for path in (tmp_path / "killed").iterdir())
    assert ".unfinished" in left
    assert [path.name for path in checkpoints.list_checkpoints(tmp_path / "killed")] == ["step-00000004"]
    assert [row["step"] for row in rows_of(tmp_path / "killed")] == ["3", "4", "6"]
    run_training(tmp_path / "killed")
    assert_same_run(tmp_path / "unbroken", tmp_path / "killed")
    assert [row["step"] for row in rows_of(tmp_path / "killed")] == ["3", "4", "6", "8"]
    assert not (tmp_path / "killed" / ".unfinished").exists()


@pytest.mark.parametrize("options", [RUN, RUN_RONG], ids=lambda options: options.network)
def test_a_stopped_run_goes_on_as_if_it_had_not_been(tiny_network, tmp_path, options):
    """In the middle of a row of the log and of a round of checkpoints."""
    run_training(tmp_path / "unbroken", options)
    made = []
    run_training(tmp_path / "stopped", options, on_step=lambda step, _: made.append(step), stop=lambda: made[-1] == 5)
    assert made == [1, 2, 3, 4, 5]
    assert [path.name for path in checkpoints.list_checkpoints(tmp_path / "stopped")] == ["step-00000005"]
    run_training(tmp_path / "stopped", options)
    assert_same_run(tmp_path / "unbroken", tmp_path / "stopped")


def test_a_finished_run_is_left_as_it_is(tiny_network, tmp_path):
    run_training(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.glob("*/*.*")}
    assert run_training(tmp_path, on_step=lambda *_: pytest.fail("a step was made")) == tmp_path / "best.safetensors"
    assert {path: content for path in before if (content := path.read_bytes())} == before


def test_the_gradient_scaler_goes_on_too(tiny_network, tmp_path):
    def train_in_halves(folder, **settings):
        scaler = torch.amp.GradScaler("cpu", init_scale=16.0, growth_interval=3)
        fabric = Fabric(accelerator="cpu", devices=1, plugins=MixedPrecision("16-mixed", "cpu", scaler))
        run_training(folder, fabric=fabric, **settings)

    train_in_halves(tmp_path / "unbroken")
    made = []
    train_in_halves(tmp_path / "stopped", on_step=lambda step, _: made.append(step), stop=lambda: made[-1] == 5)
    _, state, _ = last_checkpoint(tmp_path / "stopped")
    assert state["precision"]["scale"] == 32
    train_in_halves(tmp_path / "stopped")
    assert_same_run(tmp_path / "unbroken", tmp_path / "stopped")


def test_a_loss_that_is_not_finite_ends_training_and_spoils_nothing(tiny_network, tmp_path):
    nonsense = dataclasses.replace(RUN, recipe=dataclasses.replace(MODERN, lens=math.nan))
    with pytest.raises(FloatingPointError, match=r"train\(\): expected a finite loss .* got nan .* at step 0"):
        run_training(tmp_path, nonsense)
    assert checkpoints.list_checkpoints(tmp_path) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, "seed = 0, got 1"),
        ({"steps": 9}, "steps = 8, got 9"),
        ({"recipe": PAPER}, "has recipe = {'name': 'modern'"),
    ],
)
def test_another_run_needs_another_folder(tiny_network, tmp_path, change, message):
    run_training(tmp_path)
    with pytest.raises(ValueError, match=rf"train\(\): expected the options of the checkpoint .*{message}") as raised:
        run_training(tmp_path, dataclasses.replace(RUN, **change))
    assert "\n" not in str(raised.value)


def test_other_sources_need_another_folder(tiny_network, tmp_path):
    run_training(tmp_path)
    with pytest.raises(ValueError, match=r"expected the sources that the checkpoint .* was trained on, got others"):
        training.train(tmp_path, draw_sources(3), draw_sources(2), RUN, workers=0)


def test_a_batch_must_be_shared_evenly(tmp_path):
    with pytest.raises(ValueError, match="multiple of processes x accumulate = 3, got 4"):
        run_training(tmp_path, dataclasses.replace(RUN, accumulate=3))


def weights_at(folder, steps, options):
    """The weights after each of some steps."""
    seen, made = {}, []
    for step in steps:
        run_training(folder, options, on_step=lambda now, _: made.append(now), stop=lambda step=step: made[-1] == step)
        seen[step], _, _ = last_checkpoint(folder)
    return seen


def test_the_paper_freezes_the_parsing_in_the_second_half(tiny_network, tmp_path):
    seen = weights_at(tmp_path, (3, 4, 8), dataclasses.replace(RUN, recipe=PAPER))
    parsing = [name for name in seen[8] if name.startswith("parsing.")]
    # Between the base's last stages and the loss lies the parsing: too little comes through to see in four steps.
    others = ["base.stages.0.1.weight", "estimation.layers.1.weight", "estimation.layers.5.weight"]
    assert len(parsing) > 10
    for name in parsing:
        assert torch.equal(seen[4][name], seen[8][name]), name
    assert not all(torch.equal(seen[3][name], seen[4][name]) for name in parsing)
    for name in others:
        assert not torch.equal(seen[4][name], seen[8][name]), name
    rows = rows_of(tmp_path)
    assert [bool(row["parsing"]) for row in rows] == [True, True, False, False]


def test_the_paper_divides_its_learning_rate_by_ten_every_200_000_steps():
    optimizer = training._optimizer(nn.Linear(2, 2), PAPER)
    assert isinstance(optimizer, torch.optim.Adagrad)
    rates = []
    for step in (0, 199_999, 200_000, 400_000):
        training._set_learning_rate(optimizer, PAPER, step, 500_000)
        rates.append(optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3, 1e-3, 1e-4, 1e-5])


def test_the_modern_learning_rate_rises_and_falls():
    optimizer = training._optimizer(nn.Linear(2, 2), MODERN)
    rates = []
    for step in range(1000):
        training._set_learning_rate(optimizer, MODERN, step, 1000)
        rates.append(optimizer.param_groups[0]["lr"])
    top = int(np.argmax(rates))
    assert 0 < rates[0] < rates[top] / 50
    assert 90 <= top <= 110
    assert (np.diff(rates[top:]) < 0).all()
    assert rates[-1] < 0.02 * MODERN.learning_rate
    assert rates[top] <= MODERN.learning_rate


def test_ablations_train(tiny_network, tmp_path):
    short = dataclasses.replace(RUN, steps=2, validation_pairs=2)
    run_training(tmp_path / "no parsing", dataclasses.replace(short, scene_parsing=False))
    run_training(tmp_path / "no loss", dataclasses.replace(short, recipe=dataclasses.replace(MODERN, parsing=0.0)))
    for name in ("no parsing", "no loss"):
        assert not rows_of(tmp_path / name)[-1]["parsing"]
    assert not [name for name in last_checkpoint(tmp_path / "no parsing")[0] if name.startswith("parsing.")]


def test_training_begins_with_weights_of_another_run(tiny_network, tmp_path):
    short = dataclasses.replace(RUN, steps=1, validation_pairs=2)
    best = run_training(tmp_path / "first", short)
    still = dataclasses.replace(short, recipe=dataclasses.replace(MODERN, learning_rate=0.0))
    run_training(tmp_path / "second", still, start_from=best)
    begun_with, _, _ = last_checkpoint(tmp_path / "second")
    assert torch.equal(begun_with["base.stages.0.1.weight"], load_file(best)["base.stages.0.1.weight"].float())
    save_file({"other": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match=r"expected weights of this network in .*other\.safetensors"):
        run_training(tmp_path / "third", short, start_from=tmp_path / "other.safetensors")
