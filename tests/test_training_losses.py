"""What training minimises, against formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tiny_training import CLASSES, SIDE, tiny

import fisheyerec as fr
from fisheyerec import lens_chart
from fisheyerec.network import FishEyeRecNet, LensEstimate
from fisheyerec.training import losses
from fisheyerec.training import train as training
from fisheyerec.training.batches import Batch
from fisheyerec.training.train import MODERN, PAPER

pytestmark = pytest.mark.usefixtures("one_thread")


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
