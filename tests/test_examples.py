"""The example scripts do what their docstrings promise."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from fisheyerec.pictures import read_picture

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
sys.path.insert(0, str(EXAMPLES))

import feature_maps  # noqa: E402
import fisheye_frames  # noqa: E402
import recover_lens  # noqa: E402


def test_a_trained_network_sees_fisheye_frames_through_the_layer(tmp_path, capsys):
    accuracy = fisheye_frames.main(steps=200, count=128, picture=str(tmp_path / "shapes.png"))
    assert accuracy.perspective > 0.95
    assert accuracy.fisheye < accuracy.perspective - 0.1
    assert accuracy.rectified > accuracy.perspective - 0.02
    assert accuracy.difference < 0.05
    assert f"{accuracy.fisheye:.1%}" in capsys.readouterr().out
    assert read_picture(tmp_path / "shapes.png").pixels.shape == (64 + 128 + 64 + 3 * 4 + 4, 8 * 128 + 4, 3)


def test_a_lens_is_recovered_by_gradient_descent(tmp_path, capsys):
    recovery = recover_lens.main(picture=str(tmp_path / "chart.png"))
    assert recovery.before_px > 10
    assert recovery.after_px < 0.1
    assert f"{recovery.before_px:.2f} px" in capsys.readouterr().out
    _, first_guess, recovered = np.split(read_picture(tmp_path / "chart.png").pixels, [324, 712], axis=1)
    cyan = [((p[..., 0] == 0) & (p[..., 1] > 200)).sum() for p in (first_guess, recovered)]
    assert cyan[0] > 1000
    assert cyan[1] < 10


def test_feature_maps_are_rectified_in_the_middle_of_a_network(capsys):
    overlaps = feature_maps.main(steps=200, count=256)
    assert overlaps.true_lens > overlaps.resized + 0.1
    assert overlaps.learnt_lens > overlaps.resized + 0.1
    assert overlaps.before_px > 2
    assert overlaps.after_px < 0.5
    assert f"{overlaps.learnt_lens:.2f} overlap" in capsys.readouterr().out


def test_feature_maps_stay_channels_last_on_the_way_through():
    model = feature_maps.network(
        feature_maps.LearntRectification(feature_maps.VIEW, feature_maps.CAMERA.resize((32, 32)))
    )
    layouts = {}
    for name, module in model.named_children():
        module.register_forward_hook(lambda _, inputs, out, name=name: layouts.update({name: (inputs[0], out)}))
    model(torch.rand(2, 1, 64, 64)).sum().backward()
    features, rectified = layouts["4"]
    for maps in (features, rectified):
        assert maps.is_contiguous(memory_format=torch.channels_last)
        assert not maps.is_contiguous()
    assert (model[4].steps.grad != 0).all()
