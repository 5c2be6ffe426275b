"""Pictures that do not fill their frame: the circle they end at, and the lens that is found by it."""

import io
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import fisheyerec as fr
from fisheyerec.image_circle import ImageCircle, find_image_circle, without_rim
from fisheyerec.lens_chart import FIELD_OF_VIEW, angle_from_g, camera_from_chart
from fisheyerec.pooling import pool
from fisheyerec.rectifier import Rectifier
from fisheyerec.refinement import circle_prior, wide_prior
from fisheyerec.straightness import find_pieces

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
import scenes

SIZE = (384, 512)
CIRCLE = ImageCircle(262.0, 188.0, 180.0)
# The half field of view that the circle's rim sees.
RIM = math.radians(91)


def outside(circle, size=SIZE):
    y, x = np.mgrid[: size[0], : size[1]]
    return np.hypot(x - circle.x, y - circle.y) > circle.radius


def noisy(image, seed=0):
    noise = np.random.default_rng(seed).normal(3, 2, image.shape)
    return (image + noise).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def bright():
    """A picture that is nowhere black."""
    return np.random.default_rng(5).integers(90, 250, (*SIZE, 3)).astype(np.uint8)


@pytest.fixture(scope="module")
def camera():
    """An equidistant lens around the circle."""
    focal = CIRCLE.radius / RIM
    return fr.FisheyeCamera([focal, focal, CIRCLE.x, CIRCLE.y, 0, 0, 0, 0], SIZE)


@pytest.fixture(scope="module")
def photo(camera):
    """The drawn room through that lens, as a camera saves it."""
    picture = scenes.render_camera(scenes.room(seed=1), camera.unproject, SIZE, supersample=1).image.copy()
    picture[outside(CIRCLE)] = 0
    return jpeg(noisy(picture))


@pytest.fixture(scope="module")
def rectifier():
    return Rectifier.from_pretrained()


def jpeg(image):
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "jpeg", quality=85)
    return np.asarray(Image.open(stream))


# --- The circle ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "circle",
    [
        CIRCLE,
        ImageCircle(255.5, 191.5, 120.0),
        ImageCircle(240.0, 200.0, 230.0),  # cut above and below
        ImageCircle(258.0, 190.0, 285.0),  # cut on all sides
        ImageCircle(150.0, 191.5, 148.0),
    ],
    ids=["whole", "small", "cut_twice", "cut_all_around", "aside"],
)
def test_a_circle_is_found(bright, circle):
    image = bright.copy()
    image[outside(circle)] = 0
    for picture in (image, jpeg(noisy(image))):
        assert find_image_circle(picture) == pytest.approx(circle, abs=0.015 * circle.radius)


def test_writing_in_a_corner_and_dark_things_at_the_rim_do_not_hide_it(bright):
    image = bright.copy()
    image[150:200, 80:140] = 0
    image[outside(CIRCLE)] = 0
    image[4:12, 4:60:3] = (200, 30, 30)
    assert find_image_circle(noisy(image)) == pytest.approx(CIRCLE, abs=2)


def without_circle():
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    noise = np.random.default_rng(6)
    bright = noise.integers(90, 250, (*SIZE, 3)).astype(np.uint8)

    def blackened(where):
        image = bright.copy()
        image[where] = 0
        return image

    yield "full", bright
    yield "black", np.zeros_like(bright)
    yield "night", noise.integers(0, 30, (*SIZE, 3)).astype(np.uint8)
    yield "letterbox", blackened(np.abs(y - 191.5) > 140)
    yield "frame", blackened((np.abs(y - 191.5) > 150) | (np.abs(x - 255.5) > 200))
    yield "ellipse", blackened(np.hypot((x - 255.5) / 250, (y - 191.5) / 180) > 1)
    yield "diamond", blackened(np.abs(x - 255.5) + np.abs(y - 191.5) > 190)
    yield "grey_surround", np.where(outside(CIRCLE)[..., None], 80, bright).astype(np.uint8)
    yield "porthole", blackened(outside(ImageCircle(255.5, 191.5, 60)))
    yield "one_pixel", bright[:1, :1]


@pytest.mark.parametrize("image", [pytest.param(image, id=name) for name, image in without_circle()])
def test_no_circle_is_found_where_there_is_none(image):
    assert find_image_circle(image) is None


def test_squares_lie_as_they_say():
    for square, corner in ((CIRCLE.inscribed, 1.0), (CIRCLE.circumscribed, math.sqrt(2))):
        half = square.side / 2
        middle = np.array([square.x0, square.y0]) + half - 1 / 2
        np.testing.assert_allclose(middle, CIRCLE[:2])
        assert math.hypot(half, half) == pytest.approx(corner * CIRCLE.radius, abs=0.75)


def test_a_circle_of_a_larger_copy():
    larger = CIRCLE.resize(3)
    camera = fr.FisheyeCamera([100, 100, CIRCLE.x, CIRCLE.y, 0, 0, 0, 0], SIZE).resize((3 * SIZE[0], 3 * SIZE[1]))
    assert larger == pytest.approx((*camera.params[2:4], 540))


# --- What it tells ------------------------------------------------------------------------------------


def test_a_prior_given_a_measurement_is_that_of_bayes():
    prior, row = wide_prior(), np.array([1.0, 0, 0, 2, 1, 0, 0, 0])
    mean, covariance = prior.given(row, 0.4, 0.3)
    precision = np.linalg.inv(prior.covariance)
    expected = np.linalg.inv(precision + np.outer(row, row) / 0.3**2)
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(mean, expected @ (precision @ prior.mean + row * 0.4 / 0.3**2), rtol=1e-6)


def test_the_prior_within_a_circle_has_its_rim_at_about_90_degrees():
    mean, covariance = circle_prior()
    charts = np.random.default_rng(0).multivariate_normal(mean, covariance, 4000)
    rims = np.degrees(angle_from_g(torch.from_numpy(charts[:, 3] + charts[:, FIELD_OF_VIEW])).numpy())
    # 92.5 +- 7, pulled towards the weaker lenses of the wide prior.
    assert 83 < rims.mean() < 92.5
    assert 4 < rims.std() < 7
    side = CIRCLE.inscribed.side
    camera = fr.FisheyeCamera(camera_from_chart(torch.from_numpy(mean), (side, side)).numpy(), (side, side))
    whole = CIRCLE.inscribed.whole(camera, SIZE)
    ray, seen = whole.unproject([CIRCLE.x + CIRCLE.radius, CIRCLE.y])
    assert seen
    assert math.degrees(math.acos(ray[2])) == pytest.approx(rims.mean(), abs=3)


def test_edges_of_the_rim_are_left_out(photo):
    pieces, _ = find_pieces(photo)
    kept = without_rim(pieces, CIRCLE)
    assert 5 < len(kept) < len(pieces)
    distances = np.hypot(*(kept.points - CIRCLE[:2]).T)
    assert distances.max() < 0.96 * CIRCLE.radius


# --- One call -----------------------------------------------------------------------------------------


def angles_off(found, truth):
    """Degrees, RMS, between rays of the same pixels up to 60 degrees, apart from a common factor of tan(theta)."""
    theta, turn = np.radians(np.meshgrid(np.arange(5, 61, 5.0), np.arange(0, 360, 30.0)))
    rays = np.stack([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)], -1)
    again, _ = found.unproject(truth.project(rays)[0])
    tangents = np.hypot(again[..., 0], again[..., 1]) / again[..., 2]
    scale = np.exp(np.log(np.tan(theta) / tangents).mean())
    return float(np.degrees(np.sqrt(np.mean((np.arctan(scale * tangents) - theta) ** 2))))


def test_one_call_straightens_a_picture_in_a_circle(rectifier, photo, camera):
    result = rectifier(photo)
    assert result.distorted
    assert result.refined
    assert result.image_circle == pytest.approx(CIRCLE, abs=2)
    assert angles_off(result.camera, camera) < 1.5
    assert result.straightness_after < result.straightness_before / 2
    # The rim of the estimate, within what the prior allows.
    ray, _ = result.camera.unproject([CIRCLE.x, CIRCLE.y - CIRCLE.radius])
    assert math.degrees(math.acos(ray[2])) == pytest.approx(math.degrees(RIM), abs=10)


def test_without_refinement_the_circle_alone_tells_the_lens(rectifier, photo, camera):
    found = rectifier.estimate(photo, refine=False)
    assert not found.refined
    assert angles_off(found.camera, camera) < 2


def test_what_lies_beyond_the_circle_is_not_valid(rectifier, photo):
    result = rectifier(photo, projection="stereographic")
    rays, _ = result.view.unproject(np.stack(np.meshgrid(np.arange(512.0), np.arange(384.0)), -1))
    points, seen = result.camera.project(rays)
    within = seen & result.image_circle.contains(points, 0.99)
    beyond = ~(seen & result.image_circle.contains(points, 1.01))
    assert result.valid[within].all()
    assert not result.valid[beyond].any()
    assert beyond.any()


@pytest.mark.parametrize("options", [{"view": "valid_only"}, {"view": "valid_rectangle"}, {"balance": 0}])
def test_a_view_that_promises_only_valid_pixels_has_only_such(rectifier, photo, options):
    assert rectifier(photo, **options).valid.all()


def test_the_circle_is_that_of_the_photo_at_any_size(rectifier, photo, camera):
    larger = np.asarray(Image.fromarray(photo).resize((1024, 768), Image.Resampling.BICUBIC))
    found = rectifier.estimate(larger)
    assert found.image_circle == pytest.approx(CIRCLE.resize(2), abs=6)
    assert angles_off(found.camera, camera.resize((768, 1024))) < 1.5


def test_frames_of_a_circle_are_pooled_within_it(rectifier, photo, camera):
    estimates = [rectifier.estimate(noisy(photo, seed)) for seed in range(3)]
    pooled = pool(estimates)
    assert pooled.image_circle == pytest.approx(CIRCLE, abs=3)
    assert pooled.camera.image_size == SIZE
    assert angles_off(pooled.camera, camera) < 1.5
    # One frame in which the rim was not seen is outvoted.
    lone = rectifier.estimate(
        np.asarray(Image.open(Path(__file__).parents[1] / "examples/room.jpg").resize((512, 384)))
    )
    assert lone.image_circle is None
    mixed = pool([*estimates, lone])
    np.testing.assert_allclose(mixed.camera.params, pooled.camera.params, rtol=1e-6)
