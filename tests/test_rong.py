"""Rong et al.'s classification: division models as lenses, labels of lenses, a network that learns and its files."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional

import fisheyerec as fr
from fisheyerec import lens_chart
from fisheyerec.baselines import rong
from fisheyerec.baselines.division import DivisionModel
from fisheyerec.network import LensClasses
from fisheyerec.weights import save_network

losses = pytest.importorskip("fisheyerec.training.losses", reason="training needs fisheyerec[train]")

SIZE = (192, 192)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return rong.RongNetwork().eval()


@pytest.fixture(scope="module")
def weights(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "rong.safetensors"
    save_network(network, path, {})
    return path


# --- Division models --------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(256, 256), (480, 640), (640, 480)])
@pytest.mark.parametrize("coefficient", [-0.65, -0.3, -0.1, 0.0, 0.1])
def test_a_division_camera_divides(coefficient, size):
    """tan(theta) of its rays is r / (1 + lambda r^2), up to a factor and the error of the fit, in every direction."""
    camera = rong.camera_from_division(coefficient, size)
    half_diagonal = max(size) / math.sqrt(2)
    middle = (np.array(size[::-1]) - 1) / 2
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (200, 2)) * (np.array(size[::-1]) - 1)
    rays, valid = camera.unproject(points)
    assert valid.all()
    assert camera.fit_error_px < 2e-4 * half_diagonal
    r = np.linalg.norm(points - middle, axis=-1) / half_diagonal
    scale = np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2] / (r / (1 + coefficient * r**2))
    np.testing.assert_allclose(scale, np.median(scale), rtol=2e-3)


def test_a_division_model_is_a_stereographic_lens():
    """tan(theta / 2) = sqrt(-lambda) r where that sees more than the mean lens."""
    camera = rong.camera_from_division(-0.5, (256, 256))
    fov = 4 * math.atan(math.sqrt(0.5 / 2))  # across the side, r = 1 / sqrt(2) at its end
    stereographic = fr.FisheyeCamera.from_projection("stereographic", math.degrees(fov), (256, 256))
    points = np.stack([np.linspace(127.5, 255.5, 30), np.linspace(127.5, 255.5, 30)[::-1]], -1)
    np.testing.assert_allclose(camera.unproject(points)[0], stereographic.unproject(points)[0], atol=2e-3)


def test_the_fit_error_is_the_distance_between_both_models():
    camera = rong.camera_from_division(0.1, (256, 256))
    points = np.stack(np.meshgrid(np.linspace(-0.5, 255.5, 65), np.linspace(-0.5, 255.5, 65)), -1)
    q = (points - 127.5) / (128 * math.sqrt(2))
    tan = q / (1 + 0.1 * (q**2).sum(-1, keepdims=True)) * math.sqrt(2) * (1 + 0.1 / 2)  # 1 at the side
    side = math.exp(lens_chart.population()[0][lens_chart.FIELD_OF_VIEW])
    there, valid = camera.project(np.concatenate([side * tan, np.ones_like(tan[..., :1])], -1))
    assert valid.all()
    assert camera.fit_error_px == pytest.approx(np.linalg.norm(there - points, axis=-1).max(), rel=1e-6)


@pytest.mark.parametrize("coefficient", [-0.2, -0.5])
def test_a_division_model_is_the_same_camera_in_either_words(coefficient):
    ours = rong.camera_from_division(coefficient, (256, 256))
    model = DivisionModel(np.zeros(2), math.sqrt(-coefficient)).camera((256, 256))
    np.testing.assert_allclose(ours.params, model.params, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("coefficient", [-1.0, -2.0, math.nan, math.inf])
def test_what_is_no_division_model_of_the_whole_picture_is_refused(coefficient):
    with pytest.raises(ValueError, match=r"camera_from_division\(\): expected a finite coefficient above -1, got"):
        rong.camera_from_division(coefficient, SIZE)


def test_every_class_is_a_lens_that_rises_over_the_picture():
    corner = np.array([[-0.5, -0.5], [191.5, 191.5]])
    for coefficient in rong.COEFFICIENTS:
        camera = rong.camera_from_division(coefficient, SIZE)
        assert np.isfinite(camera.params).all()
        rays, valid = camera.unproject(corner)
        assert valid.all()
        assert camera.theta_max > np.arccos(rays[:, 2]).max()
        assert camera.fit_error_px < 0.02


# --- Labels -----------------------------------------------------------------------------------------


def one_hot(label, count):
    return torch.where(torch.arange(count) == label[:, None], 50.0, 0.0)


def test_the_label_of_a_class_is_the_class(network):
    """Whatever the field of view, the principal point and the aspect of the lens that has its profile."""
    label = torch.arange(len(rong.COEFFICIENTS))
    charts = network.classes.clone()
    charts[:, lens_chart.FIELD_OF_VIEW] -= 0.01
    charts[:, lens_chart.PRINCIPAL_POINT] += 0.02
    charts[:, lens_chart.ASPECT] += 0.01
    params = lens_chart.camera_from_chart(charts, SIZE)
    right = LensClasses(network.classes, one_hot(label, len(label)), network.classes)
    assert losses.classification_loss(right, params, SIZE) < 1e-6
    off = LensClasses(network.classes, one_hot((label + 1) % len(label), len(label)), network.classes)
    assert losses.classification_loss(off, params, SIZE) > 49


def test_the_label_is_the_nearest_division_model(network):
    """For an equidistant lens, against a search over what its rectified radii are."""
    camera = fr.FisheyeCamera.from_projection("equidistant", 100, SIZE)
    rho = 96 * np.array([*lens_chart.RADII, 1.0])
    tan = np.tan(rho / camera.params[0])
    r = rho / (96 * math.sqrt(2))
    r_u = r / (1 + rong.COEFFICIENTS[:, None] * r**2)
    difference = np.log(r_u / r_u[:, -1:]) - np.log(tan / tan[-1])
    label = torch.tensor([np.square(difference).sum(-1).argmin()])
    assert 0 < label < 50
    params = torch.as_tensor(camera.params)[None]
    right = LensClasses(network.classes[label], one_hot(label, 51), network.classes)
    assert losses.classification_loss(right, params, SIZE) < 1e-6


def test_a_lens_without_chart_teaches_nothing(network):
    good = torch.as_tensor(fr.FisheyeCamera.from_projection("equidistant", 100, SIZE).params)
    folded = torch.as_tensor(np.array([96.0, 96, 95.5, 95.5, -0.6, 0, 0, 0]))
    logits = torch.randn(2, 51, generator=torch.Generator().manual_seed(0), requires_grad=True)
    both = losses.classification_loss(
        LensClasses(network.classes[:2], logits, network.classes), torch.stack([good, folded]), SIZE
    )
    alone = losses.classification_loss(LensClasses(network.classes[:1], logits[:1], network.classes), good[None], SIZE)
    assert both == alone
    both.backward()
    assert logits.grad[0].abs().sum() > 0
    assert torch.equal(logits.grad[1], torch.zeros(51))
    none = losses.classification_loss(LensClasses(network.classes[:1], logits[1:], network.classes), folded[None], SIZE)
    assert none == 0


# --- The network ------------------------------------------------------------------------------------


def test_four_pictures_are_learnt_by_heart():
    torch.manual_seed(0)
    network = rong.RongNetwork()
    pictures = torch.rand(4, 3, 192, 192)
    params = lens_chart.camera_from_chart(network.classes[[2, 19, 36, 49]], SIZE)
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3)
    for _ in range(20):
        optimizer.zero_grad()
        output = network(pictures, straighten=False)
        losses.classification_loss(output.estimate, params, SIZE).backward()
        optimizer.step()
    assert output.estimate.logits.argmax(-1).tolist() == [2, 19, 36, 49]
    assert torch.equal(output.camera.params, lens_chart.camera_from_chart(output.estimate.chart, SIZE))


def test_the_classes_begin_in_order():
    """As evenly spaced as their coefficients: what one picture's features say is one number."""
    weight = rong.RongNetwork().classifier[-1].weight.detach()
    steps = weight.diff(dim=0)
    torch.testing.assert_close(steps, steps[:1].expand_as(steps), atol=1e-6, rtol=0)
    assert steps[0].abs().max() > 1e-3
    assert weight.mean(0).abs().max() < 1e-6


@pytest.mark.parametrize("shape", [(2, 3, 192, 192), (1, 3, 108, 192), (1, 3, 192, 64)])
def test_what_comes_out(network, shape):
    image = torch.rand(shape)
    output = network(image)
    size = shape[-2:]
    assert output.image.shape == shape
    assert output.camera.image_size == size
    assert output.estimate.logits.shape == (shape[0], 51)
    assert output.parsing is output.first_parsing is output.rectified_parsing is None
    assert network(image, straighten=False).image is None
    middle = np.array(size[::-1]) / 2 - 1 / 2
    np.testing.assert_allclose(output.camera.params[:, 2:4], np.broadcast_to(middle, (shape[0], 2)))


@pytest.mark.parametrize("shape", [(1, 3, 256, 256), (1, 1, 192, 192), (3, 192, 192)])
def test_other_shapes_are_refused(network, shape):
    with pytest.raises(
        ValueError, match=r"RongNetwork\(\): expected image of shape \(B, 3, H, W\), the longer side 192"
    ):
        network(torch.rand(shape))


# --- Pictures and files -----------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(256, 256), (480, 640), (101, 33), (1, 1), (1, 300)])
def test_the_estimate_is_a_camera_of_the_picture(weights, size):
    network = rong.load(weights)
    picture = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    camera = rong.estimate(picture, network)
    assert camera.image_size == size
    assert np.isfinite(camera.params).all()
    np.testing.assert_allclose(camera.params[2:4], (np.array(size[::-1]) - 1) / 2, atol=1e-9)
    assert camera.fit_error_px < 2e-4 * max(size)


def test_weights_come_back(network, weights):
    image = torch.rand(1, 3, 192, 192)
    there, here = (each(image).estimate.logits for each in (rong.load(weights), network))
    assert functional.cosine_similarity(there, here).item() == pytest.approx(1, abs=1e-4)


def test_the_shipped_weights_are_a_method_of_evaluation():
    evaluate = pytest.importorskip("fisheyerec.training.evaluate")
    (method,) = evaluate.load_methods(["rong"]).values()
    grey = np.full((256, 256, 3), 128, np.uint8)
    camera = method(grey)
    assert camera.image_size == (256, 256)
    assert np.array_equal(camera.params, method(grey).params)


def test_other_weights_are_called_so(network, tmp_path):
    with pytest.raises(FileNotFoundError):
        rong.load(tmp_path / "nowhere.safetensors")
    (tmp_path / "nonsense.safetensors").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match=r"expected a safetensors file, got .*nonsense\.safetensors"):
        rong.load(tmp_path / "nonsense.safetensors")
    save_file({"other": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match=r"expected weights of this network in .*other\.safetensors"):
        rong.load(tmp_path / "other.safetensors")
    narrow = network.state_dict() | {"classifier.5.bias": torch.zeros(7)}
    save_file(narrow, tmp_path / "narrow.safetensors")
    with pytest.raises(ValueError, match=r"expected classifier\.5\.bias of shape \(51,\) in .*narrow\.safetensors"):
        rong.load(tmp_path / "narrow.safetensors")
