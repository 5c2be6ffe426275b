"""What training leaves behind: checkpoints and the log."""

from __future__ import annotations

import csv
import pickle

import numpy as np
import pytest
import torch

pytest.importorskip("tensorboard", reason="training needs fisheyerec[train]")

from fisheyerec.training import checkpoints
from fisheyerec.training.log import TrainingLog

pytestmark = pytest.mark.usefixtures("one_thread")


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
