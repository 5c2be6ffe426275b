"""One camera from what several pictures tell, and the videos of a camera that nobody calibrated."""

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch

import fisheyerec as fr
from fisheyerec import file_rectifiers
from fisheyerec.file_rectifiers import BlindRectifier, CalibratedRectifier, ViewOptions
from fisheyerec.folders import Task
from fisheyerec.lens_chart import camera_from_chart, chart_of
from fisheyerec.pooling import pool, robust_mean
from fisheyerec.rectifier import PhotoEstimate

av = pytest.importorskip("av", reason="PyAV is not installed")

from clips import CAMERA, SIZE, decoded, make_clip, packets_of, psnr, turn_on_its_side, turned  # noqa: E402

from fisheyerec import video  # noqa: E402


def told(camera, confidence=0.5, distorted=True, sigma=0.01):
    return PhotoEstimate(camera, confidence, distorted, 1.0, 0.1, True, sigma**2 * np.eye(8), None)


def shifted(amount):
    chart = chart_of(CAMERA)
    chart[4] += amount
    return fr.FisheyeCamera(camera_from_chart(torch.from_numpy(chart), SIZE).numpy(), SIZE)


def test_the_robust_mean_of_what_agrees_is_the_product_of_gaussians():
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((3, 2, 2))
    covariances = roots @ roots.transpose(0, 2, 1)
    mean, covariance = robust_mean(np.tile([1.0, -2.0], (3, 1)), covariances)
    np.testing.assert_allclose(mean, [1, -2])
    weight = (4 + 2) / 4  # of a value that is where the mean is
    np.testing.assert_allclose(covariance, np.linalg.inv(weight * np.linalg.inv(covariances).sum(0)), rtol=1e-5)
    unsure = np.array([np.eye(1), 4 * np.eye(1)])
    near, _ = robust_mean(np.array([[0.0], [0.01]]), unsure)
    np.testing.assert_allclose(near, 0.01 / 5, rtol=1e-3)


def test_frames_that_are_wrong_hardly_move_the_camera():
    good = [told(shifted(amount)) for amount in (-0.01, 0.0, 0.01)]
    wild = [told(shifted(0.4)), told(shifted(0.5), 0.1, sigma=0.1), told(shifted(0.5), 0.1, distorted=False)]
    found = pool(good + wild)
    assert found.distorted
    np.testing.assert_allclose(chart_of(found.camera), chart_of(shifted(0)), atol=0.02)


def test_whether_a_camera_distorts_is_voted_on():
    estimates = [told(CAMERA, 0.4), told(CAMERA, 0.4), told(CAMERA, 0.9, distorted=False)]
    assert not pool(estimates).distorted
    assert pool([*estimates, told(CAMERA, 0.4)]).distorted


def test_pictures_of_different_sizes_are_not_pooled():
    with pytest.raises(ValueError, match="of one size"):
        pool([told(CAMERA, 0.4), told(CAMERA.scale(2), 0.4)])
    with pytest.raises(ValueError, match="of one size"):
        pool([])


class Told:
    """Stands for a Rectifier."""

    distorted, camera = True, CAMERA
    frames: list

    def estimate(self, photo, *, refine):
        assert photo.shape == (*self.camera.image_size, 3)
        self.frames.append(photo)
        return told(self.camera, 0.9, self.distorted)


@pytest.fixture
def network(monkeypatch):
    network = Told()
    network.frames = []
    monkeypatch.setattr(file_rectifiers, "_load", lambda weights: network)
    return network


def test_a_clip_of_an_unknown_camera(clip, network, tmp_path):
    rectifier = BlindRectifier(ViewOptions(fov_deg=90), quality=90)
    report = rectifier(Task(clip, tmp_path / "out.mp4"), on_frame=lambda done, total: None)
    assert len(network.frames) == video.SAMPLED_FRAMES
    assert all(psnr(frame, turned(0)) < 60 for frame in network.frames[1:])  # they differ
    view = fr.PinholeCamera.from_fov(90, SIZE)
    np.testing.assert_allclose(chart_of(report.camera), chart_of(CAMERA), atol=1e-3)
    expected = fr.numpy.rectify(decoded(clip)[5], report.camera, view, padding="border").image
    assert psnr(decoded(tmp_path / "out.mp4")[5], expected) > 34


def test_a_clip_without_distortion_is_taken_over_as_it_is(clip, network, tmp_path):
    network.distorted = False
    turn_on_its_side(clip, tmp_path / "in.mp4", 2)
    report = BlindRectifier(ViewOptions())(
        Task(tmp_path / "in.mp4", tmp_path / "out.mp4"), on_frame=lambda done, total: None
    )
    assert report.summary.startswith("as it was")
    for kind in ("video", "audio"):
        before, after = packets_of(clip, kind), packets_of(tmp_path / "out.mp4", kind)
        assert [data for _, data in before] == [data for _, data in after]
    with av.open(str(tmp_path / "out.mp4")) as out:
        assert abs(next(out.decode(video=0)).rotation) == 180


def test_a_clip_of_an_unknown_camera_whose_pixels_are_not_square(network, tmp_path):
    """The camera is estimated on what players show, and reported for what is stored."""
    network.camera = CAMERA.resize((180, 320))
    make_clip(tmp_path / "in.mkv", times=np.arange(3) / 24, context={"sample_aspect_ratio": Fraction(4, 3)})
    report = BlindRectifier(ViewOptions(fov_deg=90), quality=90)(
        Task(tmp_path / "in.mkv", tmp_path / "out.mp4"), on_frame=lambda done, total: None
    )
    assert network.frames[0].shape == (180, 320, 3)
    assert (report.camera.image_size, report.view.image_size) == (SIZE, (180, 320))
    np.testing.assert_allclose(chart_of(report.camera), chart_of(CAMERA), atol=1e-3)
    expected = fr.numpy.rectify(decoded(tmp_path / "in.mkv")[1], CAMERA, report.view, padding="border").image
    assert psnr(decoded(tmp_path / "out.mp4")[1], expected) > 32


def test_samples_lie_evenly(clip):
    found = video.sample_frames(clip, 4)
    expected = [turned(number / 4) for number in (3, 9, 15, 21)]
    for frame, scene in zip(found, expected, strict=True):
        assert psnr(frame, scene) > 30


def test_settings_can_be_written_down():
    for rectifier in (CalibratedRectifier(CAMERA, ViewOptions()), BlindRectifier(ViewOptions(), weights=Path("a"))):
        json.dumps(rectifier.settings())
