"""Other people's methods: arcs, the division model, labelling by minimum cuts, and cameras of drawn scenes."""

from __future__ import annotations

import sys
from functools import cache
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2")

import fisheyerec as fr  # noqa: E402  after cv2 is known to be there
from fisheyerec.baselines import aleman_flores, arcs, bukhari, division, labelling, zhang  # noqa: E402
from fisheyerec.baselines.division import DivisionModel  # noqa: E402
from fisheyerec.sightlines import Pieces  # noqa: E402
from fisheyerec.straightness import straightness  # noqa: E402
from fisheyerec.training.evaluate import METHODS, load_methods  # noqa: E402

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
sys.path.insert(0, str(EXAMPLES))

import scenes  # noqa: E402  beside the package

ESTIMATES = {"bukhari": bukhari.estimate, "zhang": zhang.estimate, "aleman-flores": aleman_flores.estimate}

# Of a picture of 256x256, in half diagonals.
PIXEL = 1 / (128 * 2**0.5)
NOISE = 0.2 * PIXEL

MODELS = {
    "hardly": DivisionModel(np.array([0.0, 0.0]), 0.02),
    "mild": DivisionModel(np.array([0.02, -0.01]), 0.25),
    "strong": DivisionModel(np.array([-0.03, 0.02]), 0.6),
    "half_a_sphere": DivisionModel(np.array([0.01, 0.04]), 1.0),
    "over_180": DivisionModel(np.array([0.0, -0.02]), 1.3),
}


def lines_seen(model, count=24, points=30, noise=0.0, seed=0):
    """Pictures of straight lines under a division model, inverted in closed form: r = 2 R / (1 + sqrt(1 + 4 m^2 R^2)).

    Lines are great circles of the sphere that the model is the stereographic picture of, so that they go on beyond 180
    degrees: the ray of a point is (q, (1 - m^2 q^2) / (2 m)).
    """
    rng = np.random.default_rng(seed)
    m, pieces = model.strength, []
    while len(pieces) < count:
        ends = rng.uniform(-0.65, 0.65, (2, 2))
        if np.linalg.norm(ends[1] - ends[0]) < 0.5:
            continue
        q = ends - model.centre
        rays = np.concatenate([q, (1 - m * m * (q * q).sum(-1, keepdims=True)) / (2 * m)], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        along = np.linspace(0, 1, points)[:, None]
        rays = rays[0] + along * (rays[1] - rays[0])
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        # Stereographic: q = tan(theta / 2) / m.
        seen = model.centre + rays[:, :2] / (m * (1 + rays[:, 2:]))
        pieces.append(seen + rng.normal(0, 1, seen.shape) * noise)
    return Pieces(np.concatenate(pieces), np.arange(count + 1) * points)


def arc_points(radius, length, noise, seed, points=40):
    angle = (np.linspace(-length, length, points) / 2) / radius
    rng = np.random.default_rng(seed)
    circle = radius * np.stack([np.sin(angle), np.cos(angle) - 1], -1) + (0.3, -0.2)
    return circle + rng.normal(0, noise, circle.shape)


def kasa(points):
    """Half the curvature of the circle x^2 + y^2 + b x + c y + d = 0 of least squared left sides."""
    rows = np.concatenate([points, np.ones((len(points), 1))], -1)
    b, c, d = np.linalg.lstsq(rows, -(points**2).sum(-1), rcond=None)[0]
    return 1 / np.sqrt(b * b + c * c - 4 * d)


@cache
def corridor(projection, fov_deg):
    camera = fr.FisheyeCamera.from_projection(projection, fov_deg, (256, 256))
    return camera, scenes.render_camera(scenes.corridor(1), camera.unproject, camera.image_size, supersample=1).image


# --- Arcs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0.4, 3.0, 1e4])
def test_circles_through_points_have_them_at_distance_zero(radius):
    points = arc_points(radius, 0.5, 0, 0, points=3)
    circle = arcs.circle_through(points)
    a, b, c, d = circle
    np.testing.assert_allclose(b * b + c * c - 4 * a * d, 1, rtol=1e-9)
    np.testing.assert_allclose(abs(2 * a * radius), 1, rtol=1e-5)
    np.testing.assert_allclose(arcs.distance(circle, points), 0, atol=1e-12)
    middle = np.array([0.3, -0.2 - radius])
    outside = middle + np.array([[0, radius + 0.1], [0, radius - 0.1]])
    np.testing.assert_allclose(np.abs(arcs.distance(circle, outside)), 0.1, rtol=1e-5)


def test_a_circle_through_a_straight_row_is_the_line():
    a, *_ = circle = arcs.circle_through(np.array([[0.1, 0.2], [0.2, 0.3], [0.5, 0.6]]))
    assert abs(a) < 1e-9
    np.testing.assert_allclose(np.abs(arcs.distance(circle, np.array([0.0, 0.0]))), 0.1 / 2**0.5, rtol=1e-9)


def test_moved_circles_are_as_far_from_moved_points():
    points = arc_points(0.7, 0.5, 0.1, 1)
    circle, by = arcs.circle_through(points[[0, 20, 39]]), np.array([0.4, -1.2])
    np.testing.assert_allclose(
        arcs.distance(arcs.moved(circle, by), points + by), arcs.distance(circle, points), atol=1e-12
    )


@pytest.mark.parametrize(("radius", "length"), [(1.5, 0.3), (3.0, 0.5), (6.0, 0.8)])
def test_shallow_noisy_arcs_keep_their_curvature(radius, length):
    """Kasa's fit takes a sagitta of a few times the noise for a far smaller circle; this one is right on average."""
    samples = [arc_points(radius, length, 4 * NOISE, seed) for seed in range(200)]
    pieces = Pieces(np.concatenate(samples), np.arange(201) * 40)
    circles = arcs.refit(arcs.taubin(pieces), pieces)
    outwards = np.sign(circles[:, 2])  # c > 0 where the middle of the circle is below
    fitted = np.mean(circles[:, 0] * outwards) * 2 * radius
    assert abs(fitted - 1) < 0.05
    assert np.mean([kasa(points) for points in samples]) * 2 * radius > 1.25


def test_refitting_never_makes_an_arc_worse():
    pieces = Pieces(np.concatenate([arc_points(0.5, 1.0, 0.02, seed) for seed in range(50)]), np.arange(51) * 40)
    rough = arcs.taubin(pieces)
    fine = arcs.refit(rough, pieces)
    before, after = (pieces.sums(arcs.distance(c[pieces.owners], pieces.points) ** 2) for c in (rough, fine))
    assert (after <= before + 1e-15).all()
    assert (after < before - 1e-9).any()


def test_arcs_are_found_among_points_that_are_on_none():
    rng = np.random.default_rng(0)
    true = [arc_points(2.0, 0.6, NOISE, seed) for seed in range(3)]
    for points in true:
        points[::6] += rng.uniform(0.05, 0.1, (7, 2))
    scattered = rng.uniform(-0.5, 0.5, (40, 2))
    chains = Pieces(np.concatenate([*true, scattered]), np.arange(5) * 40)
    found = arcs.find_arcs(chains, PIXEL, tolerance_px=1.0, min_length=0.2, rng=rng)
    assert len(found) == 3
    np.testing.assert_array_equal(found.pieces.counts, 33)
    np.testing.assert_allclose(np.abs(found.circles[:, 0]), 1 / 4, atol=0.05)


def test_straight_chains_are_arcs_too():
    rng = np.random.default_rng(0)
    line = np.linspace(0, 1, 40)[:, None] * (0.6, 0.3) + rng.normal(0, NOISE, (40, 2))
    found = arcs.find_arcs(Pieces(line, np.array([0, 40])), PIXEL, tolerance_px=1.0, min_length=0.2, rng=rng)
    assert len(found) == 1
    assert abs(found.circles[0, 0]) < 0.02


# --- The division model ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
def test_the_centre_has_the_same_power_to_every_line(name):
    model, pieces = MODELS[name], lines_seen(MODELS[name])
    circles = arcs.circle_through(pieces.points.reshape(-1, 30, 2)[:, [0, 15, 29]])
    np.testing.assert_allclose(arcs.distance(circles[pieces.owners], pieces.points), 0, atol=1e-10)
    inverse_lambda = -1 / model.strength**2
    np.testing.assert_allclose(arcs.power(circles, model.centre), circles[:, 0] * inverse_lambda, atol=1e-8)


@pytest.mark.parametrize("name", ["mild", "strong"])
def test_undistorted_lines_are_straight(name):
    model, pieces = MODELS[name], lines_seen(MODELS[name])
    for line in model.undistort(pieces.points).reshape(-1, 30, 2):
        assert np.linalg.svd(line - line.mean(0))[1][1] < 1e-9


@pytest.mark.parametrize("name", ["mild", "strong", "half_a_sphere", "over_180"])
def test_three_arcs_tell_the_model_and_one_its_strength(name):
    model, pieces = MODELS[name], lines_seen(MODELS[name])
    circles = arcs.circle_through(pieces.points.reshape(-1, 30, 2)[:, [0, 15, 29]])
    centres, strengths = division.model_of_three(circles.reshape(-1, 3, 4))
    np.testing.assert_allclose(centres, np.tile(model.centre, (8, 1)), atol=1e-6)
    np.testing.assert_allclose(strengths, model.strength, rtol=1e-6)
    np.testing.assert_allclose(division.strength_about(circles, model.centre), model.strength, rtol=1e-6)


def test_three_arcs_that_tell_nothing_give_no_model():
    row = np.array([[0.0, 1.0, 0.0, d] for d in (0.1, 0.2, 0.3)])  # parallel straight lines
    _, strength = division.model_of_three(row)
    assert np.isnan(strength)
    pincushion = arcs.circle_through(np.array([[[-0.3, 0.35], [0, 0.3], [0.3, 0.35]]]))
    assert division.strength_about(pincushion, np.zeros(2)) == 0


@pytest.mark.parametrize("name", MODELS)
def test_misfits_are_the_distances_that_refinement_leaves(name):
    model, pieces = MODELS[name], lines_seen(MODELS[name], noise=NOISE)
    at_truth = division.misfits(pieces, model.centre[None], np.array([model.strength]))[0]
    refined = division.refine(model, pieces, free_centre=False)
    np.testing.assert_allclose(np.sqrt(at_truth.mean()), NOISE, rtol=0.1)
    np.testing.assert_allclose(refined.mean_square.sum(), at_truth.sum(), rtol=0.02)
    assert (
        division.misfits(pieces, np.zeros((1, 2)), np.array([0.8 * model.strength + 0.1]))[0] > at_truth
    ).mean() > 0.6


@pytest.mark.parametrize("name", MODELS)
def test_refinement_recovers_the_model(name):
    model = MODELS[name]
    start = DivisionModel(np.zeros(2), 0.8 * model.strength + 0.05)
    exact = division.refine(start, lines_seen(model), free_centre=True)
    assert abs(exact.model.strength - model.strength) < 1e-5
    if name == "hardly":
        return  # what does not bend has no centre
    np.testing.assert_allclose(exact.model.centre, model.centre, atol=1e-4)
    noisy = division.refine(start, lines_seen(model, noise=NOISE), free_centre=True)
    error = np.array([*(noisy.model.centre - model.centre), noisy.model.strength**2 - model.strength**2])
    assert error @ np.linalg.solve(noisy.covariance, error) < 16  # chi squared of 3: 99.9 %
    assert abs(error[2]) < 0.02


def test_curves_that_are_no_lines_are_given_up():
    model, pieces = MODELS["strong"], lines_seen(MODELS["strong"], count=12, noise=NOISE)
    curves = [arc_points(0.2, 0.4, NOISE, seed, points=30) for seed in range(4)]
    mixed = Pieces(np.concatenate([pieces.points, *curves]), np.arange(17) * 30)
    start = DivisionModel(model.centre, 0.5)
    robust = division.refine(start, mixed, cut=0.5 * PIXEL, free_centre=False)
    assert abs(robust.model.strength - model.strength) < 0.01
    assert abs(division.refine(start, mixed, free_centre=False).model.strength - model.strength) > 0.02


@pytest.mark.parametrize(
    ("strength", "error_px"),
    [(0.01, 1e-5), (0.25, 1e-5), (0.5, 1e-5), (0.8, 1e-3), (1.0, 2e-3), (1.2, 0.01), (1.5, 0.02)],
)
@pytest.mark.parametrize("size", [(256, 256), (192, 320)])
def test_the_camera_fitted_to_a_model_makes_its_lines_straight(strength, error_px, size):
    model = DivisionModel(np.array([0.03, -0.02]), strength)
    camera = model.camera(size)
    assert camera.image_size == size
    assert camera.fit_error_px < error_px
    half = np.hypot(*size) / 2
    pieces = lines_seen(model)
    pixels = pieces.points * half + ((size[1] - 1) / 2, (size[0] - 1) / 2)
    np.testing.assert_allclose(arcs.normalise(pixels, size, size), pieces.points, atol=1e-12)
    rays, valid = camera.unproject(pixels.reshape(-1, 30, 2))
    assert valid.all()
    off_plane = np.linalg.svd(rays)[1][:, 2] / np.sqrt(30)  # RMS sine of the angle
    assert off_plane.max() * camera.params[0] < 3 * error_px


# --- Votes ----------------------------------------------------------------------------------------


def edges_of(model, noise=0.0):
    pieces = lines_seen(model, count=12, points=60, noise=noise)
    steps = np.gradient(pieces.points.reshape(12, 60, 2), axis=1).reshape(-1, 2)
    return aleman_flores.Edges(pieces.points, steps / np.linalg.norm(steps, axis=-1, keepdims=True), PIXEL)


def test_undistorted_edges_run_along_the_lines():
    model = DivisionModel(np.zeros(2), np.sqrt(0.5 / 1.5))
    corrected = aleman_flores.undistorted(edges_of(model), 0.5)
    np.testing.assert_allclose(corrected.points, model.undistort(edges_of(model).points), atol=1e-12)
    lines = corrected.points.reshape(12, 60, 2)
    along = lines[:, -1] - lines[:, 0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    inner = corrected.tangents.reshape(12, 60, 2)[:, 1:-1]  # at the ends differences are one-sided
    np.testing.assert_allclose(np.abs((inner * along[:, None]).sum(-1)), 1, atol=1e-5)


def test_lines_with_most_votes_are_the_lines_there_are():
    corrected = aleman_flores.undistorted(edges_of(DivisionModel(np.zeros(2), np.sqrt(0.2 / 1.2))), 0.2)
    found = aleman_flores.strongest_lines(corrected)
    for line in corrected.points.reshape(12, 60, 2):
        off = line @ np.stack([np.cos(found.angles), np.sin(found.angles)])[:, :12] - found.distances[:12]
        assert np.abs(off).max(0).min() < 2.5 * PIXEL


@pytest.mark.parametrize("p", [0.0, 0.1, 0.3, 0.6])
def test_the_distortion_with_most_votes_is_near_the_one_there_is(p):
    edges = edges_of(DivisionModel(np.zeros(2), max(np.sqrt(p / (1 + p)), 0.01)), noise=NOISE)
    tried = aleman_flores.DISTORTIONS[:12]
    votes = [aleman_flores.strongest_lines(aleman_flores.undistorted(edges, p)).votes[:10].sum() for p in tried]
    assert abs(tried[int(np.argmax(votes))] - p) < 0.11


# --- Labelling ------------------------------------------------------------------------------------


def small_graph(seed, labels):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 8))
    pairs = np.array(list(combinations(range(count), 2)))
    pairs = pairs[rng.random(len(pairs)) < 0.6]
    return rng.random((count, labels)), pairs, 0.6 * rng.random(len(pairs))


@pytest.mark.parametrize("seed", range(30))
def test_minimum_cuts_are_the_best_of_all_cuts(seed):
    costs, pairs, weights = small_graph(seed, 1)
    ones = costs[:, 0] - 0.5

    def cost(x):
        return (ones * x).sum() + (weights * (1 - x[pairs[:, 0]]) * x[pairs[:, 1]]).sum()

    best = min(cost(np.array(x)) for x in product((0, 1), repeat=len(ones)))
    np.testing.assert_allclose(cost(labelling.minimum_cut(ones, pairs, weights)), best, atol=1e-7)


@pytest.mark.parametrize("seed", range(20))
def test_two_labels_are_exact_and_more_within_the_bound(seed):
    for labels in (2, 3):
        unary, pairs, weights = small_graph(seed, labels)
        best = min(
            labelling.energy(unary, pairs, weights, np.array(x)) for x in product(range(labels), repeat=len(unary))
        )
        found = labelling.energy(unary, pairs, weights, labelling.alpha_expansion(unary, pairs, weights))
        assert best - 1e-9 <= found <= (1.0 if labels == 2 else 2.0) * best + 1e-7


def test_without_pairs_each_node_takes_its_cheapest_label():
    unary = np.array([[0.3, 0.1], [0.0, 0.2], [5.0, 4.0]])
    labels = labelling.alpha_expansion(unary, np.zeros((0, 2), dtype=int), np.zeros(0))
    np.testing.assert_array_equal(labels, [1, 0, 1])


def test_pieces_of_one_arc_are_merged_and_others_are_not():
    whole = arc_points(1.5, 1.2, NOISE, 0, points=90)
    other = arc_points(0.8, 0.6, NOISE, 1) + np.array([0.0, 0.5])
    chains = Pieces(np.concatenate([whole[:40], other, whole[44:70], whole[74:]]), np.array([0, 40, 80, 106, 122]))
    rng = np.random.default_rng(0)
    found = arcs.find_arcs(chains, PIXEL, tolerance_px=1.0, min_length=0.08, rng=rng)
    assert len(found) == 4
    merged = zhang.merge(found)
    assert len(merged) == 2
    np.testing.assert_array_equal(merged.pieces.counts, [82, 40])
    np.testing.assert_allclose(merged.pieces.lengths[0], np.linalg.norm(whole[-1] - whole[0]), rtol=1e-9)
    np.testing.assert_allclose(2 * np.abs(merged.circles[:, 0]), [1 / 1.5, 1 / 0.8], rtol=0.05)


# --- Whole methods --------------------------------------------------------------------------------


def test_methods_are_known_to_evaluation():
    assert set(ESTIMATES) <= set(METHODS)
    assert load_methods(ESTIMATES) == ESTIMATES


@pytest.mark.parametrize("lens", [("stereographic", 120), ("equidistant", 100), ("equisolid", 150)], ids=str)
@pytest.mark.parametrize("name", ["bukhari", "zhang"])
def test_a_drawn_corridor_becomes_as_straight_as_by_its_own_camera(name, lens):
    truth, image = corridor(*lens)
    camera = ESTIMATES[name](image)
    assert camera.image_size == (256, 256)
    assert straightness(image, camera) < 1.3 * straightness(image, truth) < straightness(image, None)


def test_votes_straighten_a_mild_lens():
    """A strong one, which its tolerance of a pixel of the corrected picture disfavours, they do not at 256 px."""
    truth, image = corridor("stereographic", 60)
    after = straightness(image, aleman_flores.estimate(image))
    assert after < 1.1 * straightness(image, truth) < straightness(image, None)


@pytest.mark.parametrize("name", ["bukhari", "zhang"])
def test_the_room_of_the_examples_becomes_straight_at_its_own_size(name):
    image = cv2.cvtColor(cv2.imread(str(EXAMPLES / "room.jpg")), cv2.COLOR_BGR2RGB)
    assert straightness(image, ESTIMATES[name](image)) < 0.2 < straightness(image, None)


NOTHING = {
    "grey": np.full((256, 256, 3), 127, np.uint8),
    "black": np.zeros((256, 256, 3), np.uint8),
    "one pixel": np.full((1, 1, 3), 200, np.uint8),
    "one row": np.tile(np.arange(200, dtype=np.uint8)[None, :, None], (1, 1, 3)),
    "noise": np.random.default_rng(0).normal(127, 3, (128, 128, 3)).round().astype(np.uint8),
}


@pytest.mark.parametrize("picture", NOTHING)
@pytest.mark.parametrize("name", ESTIMATES)
def test_there_is_no_estimate_without_edges(name, picture):
    assert ESTIMATES[name](NOTHING[picture]) is None


@pytest.mark.parametrize("name", ESTIMATES)
def test_a_picture_tells_the_same_twice(name):
    _, image = corridor("stereographic", 120)
    np.testing.assert_array_equal(ESTIMATES[name](image).params, ESTIMATES[name](image.copy()).params)


def test_missing_scipy_is_one_line_that_names_the_extra(run_python):
    code = (
        "import sys; sys.modules['scipy'] = None\n"
        "from fisheyerec.training.evaluate import load_methods\n"
        "load_methods(['bukhari', 'aleman-flores'])\n"
        "from fisheyerec.cli import app\n"
        "app(['evaluate', '--pairs', '.', '--method', 'zhang'])"
    )
    result = run_python(code)
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith("fisheyerec evaluate:")
    assert "fisheyerec[baselines]" in line
