"""Refining a camera on lines: derivatives, recovery, and leaving alone what lines cannot tell."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

cv2 = pytest.importorskip("cv2")

import fisheyerec as fr  # noqa: E402  after cv2 is known to be there
import fisheyerec.numpy  # noqa: E402
from fisheyerec import refinement, sightlines  # noqa: E402
from fisheyerec.lens_chart import camera_from_chart, chart_of  # noqa: E402
from fisheyerec.refinement import Prior, refine, wide_prior  # noqa: E402
from fisheyerec.sightlines import Pieces, Sight  # noqa: E402
from fisheyerec.straightness import find_pieces, straightness  # noqa: E402

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"

# Central differences of what float64 gives to about 1e-11: (relative to the largest).
DIFFERENCE = 1e-5

CAMERAS = {
    "mild": ([150.0, 150.6, 125.0, 130.5, -0.02, 0.004, -0.001, 0.0], (256, 256)),
    "strong_off_centre": ([103.0, 103.4, 131.4, 123.9, 0.03, -0.01, 0.0, 0.0], (256, 256)),
    "over_180": ([90.0, 90.0, 127.9, 126.0, 0.01, 0.002, 0.0, 0.0], (256, 256)),
    "oblong": ([150.0, 150.2, 164.0, 115.0, 0.02, 0.0, -0.003, 0.001], (240, 320)),
}


@cache
def room(name, fine=3):
    """A box papered with checks, seen from within through a camera: every edge is straight."""
    params, (height, width) = CAMERAS[name]
    camera = fr.FisheyeCamera(params, (height, width))
    y, x = np.mgrid[0 : height * fine, 0 : width * fine]
    rays, valid = camera.resize((height * fine, width * fine)).unproject(np.stack([x, y], -1).astype(float))
    turn = cv2.Rodrigues(np.array([0.2, -0.5, 0.1]))[0]
    rays = np.where(valid[..., None], rays, 1.0) @ turn.T
    axis = np.abs(rays).argmax(-1)
    walls = rays / np.abs(rays).max(-1, keepdims=True)
    parity = (np.floor(walls * 1.7 + 0.3).sum(-1) + axis).astype(int) % 2
    grey = np.where(valid, 70 + 90 * parity + 15 * axis, 0).astype(np.uint8)
    return camera, cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)


def bend_of_true_lines(truth, estimate):
    """RMS bend, in % of the length, of lines of the scene that the true camera shows and the other straightens."""
    rng = np.random.default_rng(0)
    bends = []
    for ends in rng.uniform(-0.8, 0.8, (40, 2, 2)):
        line = ends[0] + np.linspace(0, 1, 15)[:, None] * (ends[1] - ends[0])
        seen, _ = truth.project(np.concatenate([line, np.ones((15, 1))], -1))
        rays, valid = estimate.unproject(seen)
        assert valid.all()
        plane = rays[:, :2] / rays[:, 2:]
        plane -= plane.mean(0)
        least = np.linalg.eigvalsh(plane.T @ plane / 15)[0]
        bends.append(100 * np.sqrt(max(least, 0)) / np.linalg.norm(plane[-1] - plane[0]))
    return float(np.sqrt(np.mean(np.square(bends))))


def start(image_size):
    """The middle of the wide prior as a camera."""
    return fr.FisheyeCamera(camera_from_chart(torch.as_tensor(wide_prior().mean), image_size).numpy(), image_size)


# --- Derivatives ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CAMERAS)
def test_derivatives_of_the_incidence(name):
    params, size = CAMERAS[name]
    params = np.array(params)
    rng = np.random.default_rng(1)
    points = rng.uniform(5, 235, (50, 2))
    normals = rng.normal(size=(50, 3))

    def e(params, points):
        return Sight(params, size, points).incidence(normals).e

    sight = Sight(params, size, points)
    incidence = sight.incidence(normals)
    assert sight.seen.all()
    by_camera = sight.by_camera(incidence)
    for i in range(8):
        step = np.zeros(8)
        step[i] = 1e-5 * max(1.0, abs(params[i]))
        numeric = (e(params + step, points) - e(params - step, points)) / (2 * step[i])
        assert np.abs(by_camera[:, i] - numeric).max() < DIFFERENCE * max(np.abs(numeric).max(), 1e-3)
    for i in range(2):
        step = np.zeros(2)
        step[i] = 1e-4
        numeric = (e(params, points + step) - e(params, points - step)) / 2e-4
        assert np.abs(incidence.by_point[:, i] - numeric).max() < DIFFERENCE * np.abs(numeric).max()


def test_the_gradient_is_that_of_the_cost():
    """With the lines eliminated, and no camera favoured because it shrinks the distances."""
    _, image = room("strong_off_centre")
    pieces, size = find_pieces(image)
    search = refinement._Search(pieces, wide_prior(), size)
    deviation = np.sqrt(np.diag(wide_prior().covariance))
    chart = chart_of(CAMERA := room("strong_off_centre")[0]) + 0.05 * deviation * np.array([1, -1, 1, -1, 1, 1, -1, 1])
    assert CAMERA.image_size == size
    _, gradient = search.system(chart, 0.5)
    numeric = []
    for i in range(8):
        step = np.zeros(8)
        step[i] = 1e-3 * deviation[i]
        numeric.append((search.cost(chart + step, 0.5) - search.cost(chart - step, 0.5)) / (4 * step[i]))
    error = (gradient - numeric) * deviation
    # |de/dp| is held while a line is fitted, so that the fit is not quite the least of the cost
    assert np.abs(error).max() < 0.01 * np.abs(np.array(numeric) * deviation).max()


# --- Lines ----------------------------------------------------------------------------------------


def test_pieces_of_one_line_are_merged_across_gaps_and_others_are_not():
    params, size = CAMERAS["over_180"]
    camera = fr.FisheyeCamera(params, size)

    def image_of(height, spans):
        lines = [np.stack([np.linspace(a, b, 12), np.full(12, height), np.full(12, 1.0)], -1) for a, b in spans]
        return [camera.project(line)[0] for line in lines]

    found = image_of(0.5, [(-2.5, -0.4), (0.1, 0.9), (1.5, 2.0)]) + image_of(0.62, [(-1.0, 1.0)])
    pieces = Pieces(np.concatenate(found), np.arange(5) * 12)
    groups = sightlines.merge(pieces, np.array(params), size, tolerance=0.3, straight=0.3)
    assert sorted(sorted(group.tolist()) for group in groups) == [[0, 1, 2], [3]]


def test_parallel_lines_meet_where_their_direction_points():
    params, size = CAMERAS["strong_off_centre"]
    camera = fr.FisheyeCamera(params, size)
    direction = np.array([0.3, -0.1, 1.0]) / np.linalg.norm([0.3, -0.1, 1.0])
    rng = np.random.default_rng(0)
    anchors = rng.uniform(-1, 1, (9, 3)) + np.array([0, 0, 2])
    found = [camera.project(a + np.linspace(-0.6, 0.8, 15)[:, None] * direction)[0] for a in anchors]
    pieces = Pieces(np.concatenate(found), np.arange(10) * 15)
    fit = sightlines.fit_lines(pieces, np.array(params), size)
    vanishing, family = sightlines.find_vanishing_points(pieces, fit, straight=0.3, tolerance=0.01)
    assert abs(vanishing[0] @ direction) > 1 - 1e-6
    assert (family == 0).all()


# --- The whole ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CAMERAS)
def test_a_room_gives_its_camera_away(name):
    truth, image = room(name)
    before = start(truth.image_size)
    result = refine(image, before)
    assert result.accepted
    assert result.straightness_after < result.straightness_before
    assert result.lines > 10
    bent = bend_of_true_lines(truth, before)
    assert bend_of_true_lines(truth, result.camera) < max(0.03, 0.05 * bent)
    if name != "mild":  # there the principal point is worth a projective map, which leaves lines straight
        assert np.abs(result.camera.params[2:4] - truth.params[2:4]).max() < 1


def test_a_wrong_prior_gives_way_to_the_lines():
    truth, image = room("over_180")
    mean = wide_prior().mean + np.array([0.3, 0.25, 0.15, -0.5, -1.0, 0, 0, 0])
    sure = Prior(mean, np.diag(np.full(8, 0.01**2)))
    result = refine(image, start(truth.image_size), prior=sure)
    assert bend_of_true_lines(truth, result.camera) < 0.1


def test_a_camera_that_ends_within_the_picture_is_no_place_to_start_from():
    truth, image = room("strong_off_centre")
    folded = fr.FisheyeCamera([120.0, 120.0, 127.5, 127.5, -0.3, -0.01, 0.0, 0.0], (256, 256))
    result = refine(image, folded)
    assert result.accepted
    assert bend_of_true_lines(truth, result.camera) < 0.05


def test_the_covariance_tells_what_lines_tell():
    """The profile is found, the field of view is not."""
    _, image = room("strong_off_centre")
    before, after = (
        np.sqrt(np.diag(c)) for c in (wide_prior().covariance, refine(image, start((256, 256))).covariance)
    )
    assert (after[:3] < 0.1 * before[:3]).all()
    assert after[4] > 2 * after[:3].max()


def test_colour_and_grey_are_the_same_and_so_is_every_run():
    truth, image = room("oblong")
    first, second, third = (
        refine(picture, start(truth.image_size)) for picture in (image, image, np.repeat(image[..., None], 3, -1))
    )
    assert first.camera.params.tolist() == second.camera.params.tolist() == third.camera.params.tolist()


@pytest.mark.parametrize("shape", [(256, 256), (1, 1), (3, 2), (64, 200, 3)])
def test_without_edges_nothing_happens(shape):
    camera = start(shape[:2])
    result = refine(np.full(shape, 90, np.uint8), camera)
    assert result.camera is camera
    assert not result.accepted
    assert result.lines == 0
    assert np.isnan(result.straightness_before)
    assert np.isnan(result.straightness_after)


def test_real_curves_do_not_pull_the_camera_away():
    """Wheels and arches: the camera that is known stays known."""
    truth = room("strong_off_centre")[0]
    image = np.full((768, 768), 80, np.uint8)
    rng = np.random.default_rng(0)
    for x, y in rng.uniform(100, 660, (14, 2)):
        cv2.circle(image, (int(x), int(y)), int(rng.uniform(60, 110)), int(rng.uniform(110, 250)), 6, cv2.LINE_AA)
    image = cv2.resize(image, (256, 256), interpolation=cv2.INTER_AREA)
    known = Prior(chart_of(truth), 0.2**2 * wide_prior().covariance)
    result = refine(image, truth, prior=known)
    assert bend_of_true_lines(truth, result.camera) < 0.3  # doing nothing to the distortion: 2


def test_only_a_bent_picture_is_distorted():
    truth, image = room("strong_off_centre")
    assert refine(image, start((256, 256))).distorted
    straight = fr.PinholeCamera.from_fov(80, (256, 256))
    flat = fr.numpy.rectify(image, truth, straight).image
    assert not refine(flat, start((256, 256))).distorted
    assert not refine(np.zeros((256, 256), np.uint8), truth).distorted


def test_straightness_is_a_share_of_the_length():
    truth, image = room("strong_off_centre")
    assert straightness(image, truth) < 0.08
    assert straightness(image, None) > 0.5
    assert straightness(np.zeros((50, 60), np.uint8), None) != straightness(image, None)


@pytest.mark.parametrize(
    ("name", "goal"), [("gopro_chessboard/GOPR0041.jpg", 0.1), ("wide_chessboard/Fisheye1_13.jpg", 0.25)]
)
def test_a_photographed_chessboard_becomes_straight(name, goal):
    folder, file = name.split("/")
    if not (SHARED / "fisheye" / folder / "images" / file).exists():
        pytest.skip("needs ../shared/data/fisheye")
    image = cv2.imread(str(SHARED / "fisheye" / folder / "images" / file), cv2.IMREAD_GRAYSCALE)
    corners = json.loads((SHARED / "fisheye" / folder / "corners.json").read_text())["corners"][file]
    result = refine(image, start(image.shape))
    rays, valid = result.camera.unproject(np.array(corners).reshape(6, 8, 2))
    seen = valid & (rays[..., 2] > np.cos(np.radians(75)))
    bends = []
    for line, whole in zip([*rays, *rays.swapaxes(0, 1)], [*seen.all(1), *seen.all(0)], strict=True):
        if whole:
            plane = line[:, :2] / line[:, 2:]
            plane = plane - plane.mean(0)
            least = np.linalg.eigvalsh(plane.T @ plane / len(plane))[0]
            bends.append(100 * np.sqrt(max(least, 0)) / np.linalg.norm(plane[-1] - plane[0]))
    assert len(bends) > 5
    assert np.sqrt(np.mean(np.square(bends))) < goal


GREY = np.zeros((8, 9), np.uint8)
CAMERA = fr.FisheyeCamera([5, 5, 4, 3.5, 0, 0, 0, 0], (8, 9))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: refine([[1]], CAMERA), TypeError, "refine(): expected image as a NumPy array, got list"),
        (
            lambda: refine(GREY.astype(float), CAMERA),
            ValueError,
            "refine(): expected image of dtype uint8, got float64",
        ),
        (lambda: refine(GREY[None], CAMERA), ValueError, "expected image of shape (H, W) or (H, W, 3), got (1, 8, 9)"),
        (lambda: refine(GREY[:0], CAMERA), ValueError, "expected image of shape (H, W) or (H, W, 3), got (0, 9)"),
        (lambda: refine(GREY, None), TypeError, "refine(): expected camera as a FisheyeCamera, got NoneType"),
        (
            lambda: refine(GREY.T, CAMERA),
            ValueError,
            "refine(): expected camera of the image's size (9, 8), got (8, 9)",
        ),
        (
            lambda: refine(GREY, fr.FisheyeCamera(np.ones((2, 8)), (8, 9))),
            ValueError,
            "refine(): expected one camera, got a batch of 2",
        ),
        (lambda: refine(GREY, CAMERA, prior=3), TypeError, "refine(): expected prior as (mean, covariance), got 3"),
        (lambda: refine(GREY, CAMERA, prior=(np.zeros(8), np.eye(7))), ValueError, "(8, 8), got (8,) and (7, 7)"),
        (lambda: refine(GREY, CAMERA, prior=(np.zeros(8), -np.eye(8))), ValueError, "positive definite covariance"),
        (lambda: straightness(GREY, 1), TypeError, "straightness(): expected camera as a FisheyeCamera, got int"),
    ],
)
def test_misuse_is_named_in_one_line(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
