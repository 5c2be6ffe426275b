"""`fisheyerec train`, and what it says."""

from __future__ import annotations

import dataclasses
import os
import signal
from pathlib import Path

import pytest
from PIL import Image
from tiny_training import draw_sources, tiny
from typer.testing import CliRunner

from fisheyerec.cli import app
from fisheyerec.network import FishEyeRecNet
from fisheyerec.training import checkpoints
from fisheyerec.training import train as training
from fisheyerec.training.train import PAPER, TrainingOptions

pytestmark = pytest.mark.usefixtures("one_thread")


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
