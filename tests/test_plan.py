"""Plan: the bits of rectify, distort and resample, picture after picture."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import fisheyerec as fr
from fisheyerec.numpy import Plan

TURN = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])


def frames(size, channels, dtype, count=3):
    shape = size if channels is None else (*size, channels)
    values = np.random.default_rng(0).uniform(0, 1, (count, *shape))
    return (values * (1 if np.dtype(dtype).kind == "f" else 200)).astype(dtype)


def assert_same(planned, direct):
    np.testing.assert_array_equal(planned.image, direct.image)
    np.testing.assert_array_equal(planned.valid, direct.valid)
    assert planned.image.dtype == direct.image.dtype


@pytest.mark.parametrize(
    ("dtype", "channels", "interpolation"),
    [
        (np.uint8, 3, "bilinear"),
        (np.uint8, None, "bilinear"),
        (np.uint16, 3, "bilinear"),
        (np.float16, 2, "bilinear"),
        (np.float32, 17, "bilinear"),
        (np.uint8, None, "nearest"),
        (np.int64, None, "nearest"),
        (bool, 3, "nearest"),
    ],
)
@pytest.mark.parametrize("padding", ["zeros", "border"])
@pytest.mark.parametrize("rotation", [None, TURN], ids=["straight", "turned"])
def test_real_lenses_to_the_bit(lens, rotation, padding, dtype, channels, interpolation):
    camera = lens.resize((61, 83))
    view = fr.PinholeCamera.from_fov(95, (57, 270))
    plan = Plan(camera, view, source_from_target=rotation, padding=padding)
    for frame in frames((61, 83), channels, dtype):
        direct = fr.numpy.rectify(frame, camera, view, rotation=rotation, padding=padding, interpolation=interpolation)
        assert_same(plan(frame, interpolation=interpolation), direct)


CAMERA = fr.FisheyeCamera([25.0, 26, 25.3, 18.1, 0.05, -0.01, 0, 0], (37, 52))
VIEW = fr.PinholeCamera([16.0, 17, 21.2, 14.9], (31, 43))


def test_the_other_direction():
    plan = Plan(VIEW, CAMERA)
    for picture in frames(VIEW.image_size, 3, np.uint8):
        assert_same(plan(picture), fr.numpy.distort(picture, VIEW, CAMERA))


@pytest.mark.parametrize("turn", [np.s_[::-1], np.s_[:, ::-1], np.s_[..., ::-1]], ids=["rows", "columns", "channels"])
def test_any_strides(turn):
    plan = Plan(CAMERA, VIEW)
    for frame in frames(CAMERA.image_size, 3, np.uint8):
        np.testing.assert_array_equal(plan(frame[turn]).image, plan(np.ascontiguousarray(frame[turn])).image)


def test_one_plan_serves_many_threads():
    plan = Plan(CAMERA, VIEW, threads=1)
    many = frames(CAMERA.image_size, 3, np.uint8, count=40)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda frame: plan(frame).image, many))
    for frame, result in zip(many, results, strict=True):
        np.testing.assert_array_equal(result, fr.numpy.rectify(frame, CAMERA, VIEW).image)


def test_the_mask_is_shared_and_kept_from_harm():
    plan = Plan(CAMERA, VIEW)
    assert plan(frames(CAMERA.image_size, 3, np.uint8)[0]).valid is plan.valid
    with pytest.raises(ValueError, match="read-only"):
        plan.valid[0, 0] = False


def test_cameras_may_change_afterwards():
    params = CAMERA.params.copy()
    plan = Plan(fr.FisheyeCamera(params, CAMERA.image_size), VIEW)
    frame = frames(CAMERA.image_size, 3, np.uint8)[0]
    before = plan(frame).image
    params[:] = np.nan
    np.testing.assert_array_equal(plan(frame).image, before)


BATCH = fr.FisheyeCamera(np.stack([CAMERA.params] * 2), CAMERA.image_size)
GOOD = np.zeros((*CAMERA.image_size, 3), np.uint8)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Plan(CAMERA.params, VIEW), TypeError, r"Plan\(\): expected source as a camera, got ndarray"),
        (lambda: Plan(CAMERA, None), TypeError, r"Plan\(\): expected target as a camera, got NoneType"),
        (lambda: Plan(BATCH, VIEW), ValueError, r"Plan\(\): expected one source, got a batch of 2"),
        (lambda: Plan(CAMERA, VIEW, padding="wrap"), ValueError, r"Plan\(\): expected padding in .*, got 'wrap'"),
        (lambda: Plan(CAMERA, VIEW, threads=0), ValueError, r"Plan\(\): expected threads of at least 1"),
        (
            lambda: Plan(CAMERA, VIEW, source_from_target=[1, 2]),
            ValueError,
            r"Plan\(\): expected rotation of shape \(3, 3\), got \(2,\)",
        ),
        (lambda: Plan(CAMERA, VIEW)([1]), TypeError, r"Plan\(\): expected image as a NumPy array, got list"),
        (lambda: Plan(CAMERA, VIEW)(GOOD[1:]), ValueError, r"Plan\(\): expected image of the size of source"),
        (lambda: Plan(CAMERA, VIEW)(GOOD[..., None]), ValueError, r"Plan\(\): expected image of shape"),
        (lambda: Plan(CAMERA, VIEW)(GOOD.astype(int)), ValueError, r"labels want interpolation='nearest'"),
        (lambda: Plan(CAMERA, VIEW)(GOOD.astype(float)), ValueError, r"got float64; resample\(\) takes it"),
        (lambda: Plan(CAMERA, VIEW)(GOOD, interpolation="cubic"), ValueError, r"expected interpolation in"),
    ],
)
def test_bad_input_is_named(make, error, message):
    with pytest.raises(error, match=message):
        make()
