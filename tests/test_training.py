"""Training: what is minimised, against formulas; runs that are killed, shared out or given nonsense; the command.

Run as a script, this file trains as `RUN` says and kills itself, or takes its part in a step of several processes.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import os
import pickle
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import nn
from typer.testing import CliRunner

import fisheyerec as fr
from fisheyerec import lens_chart
from fisheyerec.cli import app
from fisheyerec.network import PICTURE_MEAN, CompactBaseNetwork, FishEyeRecNet, LensEstimate, SceneParsingNetwork

lightning_fabric = pytest.importorskip("lightning_fabric", reason="training needs fisheyerec[train]")

from lightning_fabric import Fabric  # noqa: E402  after what asks whether it is there, as is what follows
from lightning_fabric.plugins.precision import MixedPrecision  # noqa: E402

from fisheyerec.training import checkpoints, losses  # noqa: E402
from fisheyerec.training import train as training  # noqa: E402
from fisheyerec.training.augmentation import crop, turn  # noqa: E402
from fisheyerec.training.batches import AugmentedPairs, Batch, collate, load_batches  # noqa: E402
from fisheyerec.training.log import TrainingLog  # noqa: E402
from fisheyerec.training.sources import DecodedSource, Source, Sources  # noqa: E402
from fisheyerec.training.synthesis import SyntheticPairs  # noqa: E402
from fisheyerec.training.train import MODERN, PAPER, RONG, TrainingOptions  # noqa: E402

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


def run_training(folder, options=RUN, **settings):
    return training.train(folder, draw_sources(), draw_sources(2), options, **{"workers": 0} | settings)


@pytest.fixture(autouse=True)
def one_thread(threads):
    threads(1)


@pytest.fixture
def tiny_network(monkeypatch):
    monkeypatch.setattr(FishEyeRecNet, "from_design", staticmethod(tiny))


@pytest.fixture
def batch():
    """Eight pairs with their straight pictures; two have no labels."""
    pairs = AugmentedPairs(SyntheticPairs(draw_sources(), size=(SIDE, SIDE)), augment=False)
    return collate([pairs[index] for index in range(8)])


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
    """This file as a script, in its own process."""
    home = str(Path(fr.__file__).resolve().parents[1])
    path = os.pathsep.join(filter(None, [home, os.environ.get("PYTHONPATH")]))
    command = [sys.executable, __file__, *map(str, arguments)]
    return subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **environment})


# --- What is minimised ----------------------------------------------------------------------------


def test_l_r_is_equation_6_a_pixel():
    rng = np.random.default_rng(0)
    image, truth = rng.random((2, 2, 3, 4, 5))
    by_hand = sum(np.linalg.norm(truth[b, :, y, x] - image[b, :, y, x]) ** 2 for b, y, x in np.ndindex(2, 4, 5))
    loss = losses.rectification_loss(torch.tensor(image), torch.tensor(truth))
    assert float(loss) == pytest.approx(by_hand / 40, rel=1e-12)


@pytest.mark.parametrize("shrink", [1, 2])
def test_l_sp_is_the_cross_entropy_of_what_is_labelled(shrink):
    rng = np.random.default_rng(0)
    logits = rng.normal(size=(2, CLASSES, 4, 6)).astype(np.float32)
    labels = rng.integers(0, CLASSES + 1, (2, 4 * shrink, 6 * shrink), dtype=np.uint8)
    coarse = labels[:, shrink // 2 :: shrink, shrink // 2 :: shrink]
    terms = [
        np.log(np.exp(logits[b, :, y, x]).sum()) - logits[b, coarse[b, y, x] - 1, y, x]
        for b, y, x in np.ndindex(coarse.shape)
        if coarse[b, y, x]
    ]
    loss = losses.parsing_loss(torch.tensor(logits), torch.tensor(labels))
    assert float(loss) == pytest.approx(np.mean(terms), rel=1e-5)


def test_what_is_not_labelled_teaches_nothing():
    logits = torch.randn(2, CLASSES, 4, 4, requires_grad=True)
    labels = torch.zeros(2, 4, 4, dtype=torch.uint8)
    labels[0, 1, 2] = 2
    losses.parsing_loss(logits, labels).backward()
    taught = logits.grad.abs().sum(1) > 0
    assert taught.nonzero().tolist() == [[0, 1, 2]]
    logits.grad = None
    loss = losses.parsing_loss(logits, torch.zeros_like(labels))
    loss.backward()
    assert loss == 0
    assert torch.equal(logits.grad, torch.zeros_like(logits))


def cameras(count=6):
    mean, basis = lens_chart.population()
    generator = torch.Generator().manual_seed(0)
    charts = mean + torch.randn(count, 8, generator=generator, dtype=torch.float64) @ basis.mT
    return charts, lens_chart.camera_from_chart(charts, (SIDE, SIDE))


def with_view(params):
    camera = fr.FisheyeCamera(params, (SIDE, SIDE))
    return camera, fr.PinholeCamera.edge_matched(camera, (SIDE, SIDE))


def test_displacement_is_nothing_for_the_truth_and_numpys_for_the_rest():
    _, params = cameras()
    truth = params.roll(1, 0)
    # Distances are rounded off below a thousandth of a pixel, so that they have a gradient at the truth.
    assert losses.displacement(*with_view(params), params).max() <= 1.001e-3
    measured = losses.displacement(*with_view(params), truth, points_a_side=4)
    centres = (np.arange(4) + 0.5) * SIDE / 4 - 0.5
    pixels = np.stack(np.meshgrid(centres, centres), -1).reshape(-1, 2)
    for index in range(len(params)):
        positions = []
        for each in (params[index], truth[index]):
            fx, fy, cx, cy, *k = each.tolist()
            _, view = with_view(each[None].numpy()[0])
            focal, _, centre_x, centre_y = view.params
            X, Y = ((pixels - (centre_x, centre_y)) / focal).T
            r = np.hypot(X, Y)
            theta = np.arctan(r)
            theta_d = theta + sum(k_i * theta ** (2 * i + 3) for i, k_i in enumerate(k))
            positions.append(np.stack([fx * theta_d * X / r + cx, fy * theta_d * Y / r + cy], -1))
        expected = np.linalg.norm(positions[0] - positions[1], axis=-1).mean()
        assert float(measured[index]) == pytest.approx(expected, rel=1e-4)


def test_displacement_leads_back_to_the_truth():
    _, params = cameras(2)
    wrong = (params * 1.01).requires_grad_()
    loss = losses.displacement(*with_view(wrong), params).sum()
    loss.backward()
    assert wrong.grad.isfinite().all()
    nearer = wrong.detach() - 1e-3 * loss.detach() * wrong.grad / wrong.grad.square().sum()
    assert losses.displacement(*with_view(nearer), params).sum() < loss


def test_the_loss_on_the_lens_is_least_at_the_truth():
    charts, params = cameras()
    mean, basis = lens_chart.population()
    truth = (lens_chart.chart_from_camera(params, (SIDE, SIDE)) - mean) @ torch.linalg.inv(basis).mT
    nothing = torch.zeros_like(truth)

    def loss(deviation, log_sigma=nothing):
        estimate = LensEstimate(mean + deviation @ basis.mT, None, deviation, log_sigma)
        return losses.lens_loss(estimate, params, (SIDE, SIDE))

    assert loss(truth) < 1e-20
    assert loss(truth + 0.1) > 0
    # The expected error that is likeliest is the true one.
    errors = [loss(truth + 0.1, nothing + math.log(sigma)) for sigma in (0.05, 0.1, 0.2)]
    assert errors[1] < min(errors[0], errors[2])
    # A camera whose chart does not exist teaches nothing.
    folded = params.clone()
    folded[:, 4:] = torch.tensor([-0.6, 0.0, 0.0, 0.0])
    log_sigma = torch.zeros_like(truth)
    estimate = LensEstimate(charts.clone().requires_grad_(), None, nothing, log_sigma.requires_grad_())
    losses.lens_loss(estimate, folded, (SIDE, SIDE)).backward()
    known = lens_chart.chart_from_camera(folded, (SIDE, SIDE)).isfinite()
    assert not known[:, lens_chart.PROFILE].all(-1).any()
    assert torch.equal(estimate.chart.grad[~known], torch.zeros(int((~known).sum()), dtype=torch.float64))


@pytest.mark.parametrize("recipe", [MODERN, PAPER])
def test_the_total_is_the_weighted_sum(batch, recipe):
    torch.manual_seed(0)
    network = tiny({"num_classes": CLASSES, "scene_parsing": True}).eval()
    total, _ = training.compute_losses(network, batch, recipe)
    output = network(batch.fisheye / 255)
    parsing = sum(losses.parsing_loss(each, batch.labels) for each in (output.first_parsing, output.parsing)) / 2
    if recipe is PAPER:
        expected = 1 * losses.rectification_loss(output.image, batch.rectified / 255) + 15 * parsing
    else:
        expected = (
            recipe.lens * losses.lens_loss(output.estimate, batch.camera, (SIDE, SIDE))
            + recipe.landing * losses.displacement(output.camera, output.view, batch.camera).mean()
            + recipe.parsing * parsing
        )
    assert total.item() == pytest.approx(expected.item(), rel=1e-5)
    frozen, _ = training.compute_losses(network, batch, recipe, frozen_parsing=True)
    rest = (expected - recipe.parsing * parsing).item()
    assert frozen.item() == pytest.approx(rest, abs=1e-6 * expected.item())


def test_one_batch_is_learnt_by_heart(batch):
    """Within 40 steps of `compact`: from about 2 px to less than 0.4 px in 64."""
    torch.manual_seed(0)
    four = Batch(*(tensor[:4] for tensor in batch))
    network = FishEyeRecNet.compact(CLASSES)
    optimizer = torch.optim.AdamW(network.parameters(), 3e-4)
    history = []
    for _ in range(40):
        optimizer.zero_grad()
        total, parts = training.compute_losses(network, four, MODERN)
        total.backward()
        optimizer.step()
        history.append((total.item(), parts["landing"].item()))
    assert history[0][1] > 1
    assert history[-1][1] < 0.4
    assert history[-1][0] < history[0][0] / 4


# --- Batches --------------------------------------------------------------------------------------


@pytest.mark.parametrize("workers", [1, 2])
def test_batches_are_the_same_whoever_makes_them(workers):
    dataset = AugmentedPairs(SyntheticPairs(draw_sources(), recipe="wide", size=(32, 32), rectified=False), True)
    here = list(load_batches(dataset, range(1, 4), 4))
    there = list(load_batches(dataset, range(1, 4), 4, workers=workers))
    assert_same(here, there)
    assert_same(here[2:], list(load_batches(dataset, range(3, 4), 4)))
    assert not torch.equal(here[0].fisheye, here[1].fisheye)
    shares = [list(load_batches(dataset, range(1, 4), 4, rank=rank, world_size=2)) for rank in range(2)]
    for whole, *parts in zip(here, *shares, strict=True):
        for field, one, other in zip(whole, *parts, strict=True):
            assert torch.equal(field, torch.stack([one, other], 1).flatten(0, 1))


def test_every_other_picture_gets_the_margins_of_another_shape():
    rng = np.random.default_rng(0)
    picture, labels = np.full((64, 64, 3), 7, np.uint8), np.ones((64, 64), np.uint8)
    heights = []
    for _ in range(200):
        cropped, cropped_labels = crop(rng, picture, labels)
        inside = (cropped == 7).all((1, 2))
        assert np.array_equal(inside, inside[::-1])
        assert np.array_equal(cropped_labels, np.repeat(inside[:, None], 64, 1))
        # What the network subtracts leaves nothing of a margin.
        assert np.abs(cropped[~inside] / 255 - PICTURE_MEAN).max(initial=0) <= 0.5 / 255
        heights.append(inside.sum())
    assert 80 < heights.count(64) < 130
    assert 32 <= min(heights) < 36
    assert crop(rng, picture, None)[1] is None


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("quarter_turns", range(4))
def test_a_turned_picture_has_the_turned_camera(quarter_turns, mirror):
    """Where a ray was seen, its turned ray is seen in the turned picture."""
    height, width = 48, 64
    camera = np.array([30.0, 31.0, 29.5, 22.25, 0.05, -0.01, 0.002, 0.0])
    y, x = np.mgrid[:height, :width]
    picture = np.stack([x, y, x + y], -1).astype(np.uint8)
    turned, labels, turned_camera = turn(picture, picture[..., 0], camera, quarter_turns, mirror)
    rows, columns = turned.shape[:2]
    assert (rows, columns) == ((height, width) if quarter_turns % 2 == 0 else (width, height))
    assert np.array_equal(labels, turned[..., 0])
    target = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).astype(float)
    rays, valid = fr.FisheyeCamera(turned_camera, (rows, columns)).unproject(target)
    assert valid.all()
    for _ in range(quarter_turns):  # back, clockwise with y down: what is up was to the right
        rays = np.stack([-rays[..., 1], rays[..., 0], rays[..., 2]], -1)
    if mirror:
        rays = rays * (-1, 1, 1)
    source, _ = fr.FisheyeCamera(camera, (height, width)).project(rays)
    np.testing.assert_allclose(turned[..., :2], source, rtol=0, atol=1e-6)


# --- Runs that end early --------------------------------------------------------------------------


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


# --- Checkpoints and the log ------------------------------------------------------------------------


def save(folder, step, value=1.0):
    return checkpoints.save_checkpoint(folder, step, {"w": torch.tensor([value])}, {"step": step}, {"seed": 0})


def test_a_checkpoint_replaces_the_older_once_it_is_whole(tmp_path, monkeypatch):
    old = save(tmp_path, 9)

    def fail(*arguments):
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", fail)
        with pytest.raises(OSError, match="no space"):
            save(tmp_path, 10)
    assert checkpoints.list_checkpoints(tmp_path) == [old]
    new = save(tmp_path, 10, 2.0)
    assert sorted(tmp_path.iterdir()) == [new]
    weights, state, options = checkpoints.load_checkpoint(new)
    assert (weights["w"].tolist(), state, options) == ([2.0], {"step": 10}, {"seed": 0})


@pytest.mark.parametrize("name", ["weights.safetensors", "state.pt", "options.json"])
@pytest.mark.parametrize("spoil", [None, b"", b"nonsense", "half"])
def test_a_broken_checkpoint_is_called_so(tmp_path, name, spoil):
    path = save(tmp_path, 1)
    file = path / name
    whole = file.read_bytes()
    file.unlink()
    if spoil is not None:
        file.write_bytes(whole[: len(whole) // 2] if spoil == "half" else spoil)
    with pytest.raises(ValueError, match=r"expected a complete checkpoint in .*step-00000001, got a broken one"):
        checkpoints.load_checkpoint(path)


class Attack:
    def __reduce__(self):
        return print, ("code from a checkpoint ran",)


def test_no_code_of_a_checkpoint_runs(tmp_path, capsys):
    path = save(tmp_path, 1)
    with open(path / "state.pt", "wb") as stream:
        pickle.dump(Attack(), stream)
    with pytest.raises(ValueError, match="broken one"):
        checkpoints.load_checkpoint(path)
    torch.save({"step": Attack()}, path / "state.pt")
    with pytest.raises(ValueError, match="broken one"):
        checkpoints.load_checkpoint(path)
    assert capsys.readouterr().out == ""


def test_the_log_goes_on_after_half_a_row(tmp_path):
    log = TrainingLog(tmp_path, writes=True)
    log.begin(0)
    for step in (10, 20, 30):
        log.write({"step": step, "loss": 1 / step})
    log.close()
    with open(log.path, "a") as stream:
        stream.write("4")
    log.begin(20)
    log.write({"step": 30, "loss": 0.5})
    log.close()
    with open(log.path, newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["step"], row["loss"]) for row in rows] == [("10", "0.1"), ("20", "0.05"), ("30", "0.5")]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["events", "log.csv"]


def test_only_one_process_writes(tmp_path):
    log = TrainingLog(tmp_path / "run", writes=False)
    log.begin(0)
    log.write({"step": 1})
    log.show(1, {"nothing": np.zeros((2, 2, 3), np.uint8)})
    log.close()
    assert list(tmp_path.iterdir()) == []


# --- Recipes and ablations ------------------------------------------------------------------------


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


# --- Sharing a batch --------------------------------------------------------------------------------


def gradients_of_a_step(fabric, batch, share):
    """Gradients of `compact` in inference mode: each process would normalise its part by its own mean and spread."""
    torch.manual_seed(0)
    network = FishEyeRecNet.compact(CLASSES).eval()
    model, optimizer = fabric.setup(network, torch.optim.SGD(network.parameters(), 0.0))
    recipe = dataclasses.replace(MODERN, rectification=1.0, parsing=1.0, clip=0.0)
    training._step(fabric, network, model, optimizer, batch, share, recipe, 0, False)
    return {name: parameter.grad for name, parameter in network.named_parameters()}


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


def take_share(folder):
    """Make a step with this process's part of a batch, in two parts."""
    torch.set_num_threads(1)
    fabric = Fabric(accelerator="cpu", devices=2, strategy="ddp")
    fabric.launch()
    rank = fabric.global_rank
    batch = Batch(*(tensor[rank::2] for tensor in torch.load(folder / "batch.pt")))
    torch.save(gradients_of_a_step(fabric, batch, 2), folder / f"{rank}.pt")


def test_parts_of_a_batch_have_the_gradients_of_the_whole(batch, tolerance):
    fabric = Fabric(accelerator="cpu", devices=1)
    assert len({int(labels.bool().sum()) for labels in batch.labels}) > 2, "unequally labelled"
    whole, parts = (gradients_of_a_step(fabric, batch, share) for share in (8, 2))
    assert_close(whole, parts, tolerance.float32_gradient)


# --- The command ------------------------------------------------------------------------------------


@pytest.fixture
def scenes(tmp_path):
    """A SceneParse150 folder of drawn sources: four to train on and two to look at."""
    root = tmp_path / "scenes"
    drawn = draw_sources(6, 6)
    for number in range(6):
        split = "training" if number < 4 else "validation"
        for kind in ("images", "annotations"):
            (root / kind / split).mkdir(parents=True, exist_ok=True)
        pixels, labels = drawn.decode(number)
        Image.fromarray(pixels).save(root / "images" / split / f"{number}.png")
        Image.fromarray(labels).save(root / "annotations" / split / f"{number}.png")
    return root


@pytest.fixture
def train(tiny_network, scenes, tmp_path):
    """train(*arguments): the command in this process, on the scenes."""
    usual = ["--steps", "4", "--batch-size", "4", "--classes", "3", "--validation-pairs", "2", "--workers", "0"]

    def call(*arguments, source=scenes):
        arguments = [*usual, *map(str, arguments)]
        return CliRunner().invoke(app, ["train", str(source), "-o", str(tmp_path / "run"), *arguments])

    return call


def test_the_command_trains_and_says_how_it_goes(train, tmp_path):
    result = train("--steps", 51)
    assert result.exit_code == 0, result.output
    lines = result.stderr.splitlines()
    assert [line.split(":")[0] for line in lines] == ["step 50/51", "step 51/51"]
    assert "pictures/s" in lines[0]
    assert "left" in lines[0]
    assert "dB" in lines[1]
    assert result.stdout == f"{tmp_path / 'run' / 'best.safetensors'}: the best weights by validation\n"
    assert (tmp_path / "run" / "best.safetensors").exists()


def test_the_command_has_the_defaults_of_the_library(train, tmp_path, monkeypatch):
    asked = {}

    def note(folder, sources, validation_sources, options, **settings):
        asked.update(options=options, **settings)
        return folder

    monkeypatch.setattr(training, "train", note)
    sources = [path for path in (tmp_path / "scenes").iterdir() if path.is_dir()]
    assert sources
    assert CliRunner().invoke(app, ["train", str(tmp_path / "scenes"), "-o", str(tmp_path / "run")]).exit_code == 0
    assert asked["options"] == TrainingOptions()
    options = "--network paper --recipe paper --no-scene-parsing --no-parsing-loss --accumulate 2 --seed 5"
    assert train(*options.split(), "--vgg16", "v.pth", "--start-from", "w.safetensors").exit_code == 0
    assert asked["options"] == TrainingOptions(
        network="paper",
        num_classes=3,
        scene_parsing=False,
        recipe=dataclasses.replace(PAPER, parsing=0.0),
        steps=4,
        batch_size=4,
        accumulate=2,
        seed=5,
        validation_pairs=2,
    )
    assert (asked["vgg16"], asked["start_from"], asked["workers"]) == (Path("v.pth"), Path("w.safetensors"), 0)


def test_broken_and_missing_pictures_are_named_and_counted(train, scenes):
    (scenes / "images" / "training" / "0.png").write_bytes(b"nonsense")
    (scenes / "annotations" / "training" / "2.png").unlink()
    result = train()
    assert result.exit_code == 0, result.output
    first, second, third, *_ = result.stderr.splitlines()
    assert first.startswith("scenes/images/training/0.png: ")
    assert second.startswith("scenes/images/training/2.png: ")
    assert third == "2 of 4 sources cannot be read and are left out"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--network deep", "expected network in ['compact', 'paper'], got 'deep'"),
        ("--recipe old", "expected --recipe in ['modern', 'paper', 'rong'], got 'old'"),
        ("--network rong", 'and neither with another, got network "rong" with recipe "modern"'),
        ("--recipe rong", 'and neither with another, got network "compact" with recipe "rong"'),
        ("--network rong --recipe rong --vgg16 nowhere.pth", "VGG-16 base"),
        ("--precision 8", "expected --precision of 32-true, bf16-mixed or 16-mixed, got '8'"),
        ("--classes 2", "expected labels up to the number of classes, 2, in"),
        ("--accumulate 3", "expected batch_size as a multiple of processes x accumulate = 3, got 4"),
        ("--validation nowhere", "expected a folder of pictures, got nowhere"),
        ("--vgg16 nowhere.pth", "VGG-16 base"),
        ("--start-from nowhere.safetensors", "nowhere.safetensors"),
    ],
)
def test_bad_options_are_one_line(train, options, message, monkeypatch):
    build = tiny if "deep" not in options else FISHEYEREC_FROM_DESIGN
    monkeypatch.setattr(FishEyeRecNet, "from_design", staticmethod(build))
    result = train(*options.split())
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("fisheyerec train: ")
    assert message in line


FISHEYEREC_FROM_DESIGN = FishEyeRecNet.from_design


def test_pictures_that_are_none_are_one_line(train, tmp_path):
    result = train(source=tmp_path / "nowhere")
    assert result.exit_code == 2
    assert result.stderr == f"fisheyerec train: expected a folder of pictures, got {tmp_path / 'nowhere'}\n"


def test_other_options_for_a_run_that_is_there_are_one_line(train):
    assert train().exit_code == 0
    assert train().exit_code == 0
    result = train("--seed", 1)
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert "seed = 0, got 1" in line


@pytest.mark.parametrize("module", ["lightning_fabric", "tensorboard"])
def test_a_missing_extra_is_one_line(run_python, module):
    """In a process of its own, in which the module cannot be imported."""
    code = f"""
import sys
sys.modules[{module!r}] = None
from fisheyerec.cli import app
app(["train", ".", "-o", "run"])
"""
    result = run_python(code)
    assert result.returncode == 2, result.stderr
    assert result.stderr == f"fisheyerec train: {module} is missing: pip install 'fisheyerec[train]'\n"


def test_ctrl_c_leaves_a_checkpoint_and_one_line(train, tmp_path, monkeypatch):
    seed, handler = training._seed_chance, signal.getsignal(signal.SIGINT)

    def press(number, step, rank):
        seed(number, step, rank)
        if step == 2:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(training, "_seed_chance", press)
        result = train()
    assert result.exit_code == 130, result.output
    (line,) = result.stderr.splitlines()
    assert line.startswith("fisheyerec train: stopped; the same command goes on where")
    assert [path.name for path in checkpoints.list_checkpoints(tmp_path / "run")] == ["step-00000003"]
    assert signal.getsignal(signal.SIGINT) is handler
    assert train().exit_code == 0
    assert [path.name for path in checkpoints.list_checkpoints(tmp_path / "run")] == ["step-00000004"]


if __name__ == "__main__":
    {"killed": train_and_die, "share": take_share}[sys.argv[1]](Path(sys.argv[2]))
