"""Averaging where pictures shrink, against pictures of sixteen times as many samples each way."""

import numpy as np
import pytest

import fisheyerec as fr
import fisheyerec.numpy as door
from fisheyerec import antialiasing, pixel

CAMERA = fr.FisheyeCamera.from_projection("equidistant", 170, image_size=(480, 640))
VIEW = fr.PinholeCamera.from_fov(100, image_size=(360, 480))


def zone_plate(size):
    """Rings that grow finer outwards, to 2.5 pixels a ring in the corners."""
    height, width = size
    x, y = np.meshgrid(np.arange(width) - pixel.centre(width), np.arange(height) - pixel.centre(height))
    farthest = np.hypot(width, height) / 2
    return (0.5 + 0.5 * np.cos(np.pi * (x * x + y * y) / farthest / 2.5)).astype(np.float32)


def truth(function, picture, source, target):
    """The mean of 16 x 16 samples within each pixel."""
    height, width = target.image_size
    large = getattr(door, function)(picture, source, target.resize((16 * height, 16 * width))).image
    return large.reshape(height, 16, width, 16).mean((1, 3))


def inner(valid):
    """What does not touch the border, where pixels are partly empty."""
    return np.logical_and.reduce([np.roll(valid, step, axis) for step in (1, 0, -1) for axis in (0, 1)])


def psnr(a, b, where):
    return -10 * np.log10(np.square(a.astype(np.float64) - b)[where].mean())


# Function, source, target, and how many dB at least.
CASES = {
    "rectify_to_a_third": ("rectify", CAMERA, VIEW.resize((90, 120)), 42),
    "rectify_to_a_tenth": ("rectify", CAMERA, VIEW.resize((36, 48)), 50),
    "distort_to_a_third": ("distort", VIEW, CAMERA.resize((120, 160)), 48),
    # By more than eight times: the source is averaged down first.
    "rectify_to_a_thirtieth": ("rectify", CAMERA, VIEW.resize((12, 16)), 28),
}


@pytest.mark.parametrize(("function", "source", "target", "least"), CASES.values(), ids=CASES)
def test_a_zone_plate_is_as_good_as_with_256_samples_a_pixel(function, source, target, least):
    picture = zone_plate(source.image_size)
    expected = truth(function, picture, source, target)
    plain, valid = getattr(door, function)(picture, source, target)
    averaged, seen = getattr(door, function)(picture, source, target, antialias=True)
    np.testing.assert_array_equal(seen, valid)
    assert averaged.dtype == picture.dtype
    assert psnr(averaged, expected, inner(valid)) > least > psnr(plain, expected, inner(valid)) + 15


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32, np.float64])
@pytest.mark.parametrize("channels", [None, 1, 3, 5])
def test_flat_pictures_stay_flat_in_every_type(dtype, channels):
    shape = CAMERA.image_size if channels is None else (*CAMERA.image_size, channels)
    picture = np.full(shape, 201 if dtype == np.uint8 else 0.75, dtype)
    out, valid = door.rectify(picture, CAMERA, VIEW.resize((36, 48)), antialias=True)
    assert (out.dtype, out.shape) == (picture.dtype, (36, 48, *shape[2:]))
    assert valid.all()
    np.testing.assert_allclose(out.astype(np.float64), picture.flat[0], rtol=1e-3 if dtype == np.float16 else 1e-6)


def test_the_same_bits_where_nothing_shrinks():
    picture = zone_plate(CAMERA.image_size)
    view = VIEW.resize((720, 960))
    plain, averaged = (door.rectify(picture, CAMERA, view, antialias=a) for a in (False, True))
    np.testing.assert_array_equal(plain.image, averaged.image)


def test_turned_views_average_as_well():
    picture, view = zone_plate(CAMERA.image_size), VIEW.resize((90, 120))
    rotation = fr.view_rotation(pan_deg=20, roll_deg=30)
    large = door.rectify(picture, CAMERA, view.resize((16 * 90, 16 * 120)), rotation=rotation).image
    expected = large.reshape(90, 16, 120, 16).mean((1, 3))
    averaged, valid = door.rectify(picture, CAMERA, view, rotation=rotation, antialias=True)
    assert psnr(averaged, expected, inner(valid)) > 40


def test_large_pictures_are_made_in_bands(monkeypatch):
    picture = np.random.default_rng(0).random(CAMERA.image_size)
    view = VIEW.resize((37, 48))
    whole = door.rectify(picture, CAMERA, view, antialias=True).image
    monkeypatch.setattr(antialiasing, "_BAND", 64 * 48 * 5)
    in_bands = door.rectify(picture, CAMERA, view, antialias=True).image
    np.testing.assert_allclose(in_bands, whole, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("factor", [1, 2, 3, 8, 13])
def test_blocks_are_averaged_the_last_over_what_there_is(factor, dtype):
    picture = (np.random.default_rng(0).random((26, 41, 3)) * 255).astype(dtype)
    out = antialiasing.reduce(picture, factor)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            block = picture[row * factor : (row + 1) * factor, column * factor : (column + 1) * factor]
            mean = block.astype(np.float64).mean((0, 1))
            expected = np.floor(mean + 0.5) if dtype == np.uint8 else mean
            np.testing.assert_allclose(out[row, column], expected, rtol=1e-6)
    assert out.shape == (-(-26 // factor), -(-41 // factor), 3)


def test_a_source_averaged_down_keeps_its_places():
    """A ramp: averages of blocks lie where the blocks' centres are."""
    picture = np.tile(np.linspace(0, 1, 640, dtype=np.float32), (480, 1))
    view = VIEW.resize((36, 48))
    plain, averaged = (door.rectify(picture, CAMERA, view, antialias=a).image for a in (False, True))
    np.testing.assert_allclose(averaged, plain, atol=1e-3)


def test_labels_are_never_averaged():
    labels = np.zeros(CAMERA.image_size, np.uint8)
    with pytest.raises(ValueError, match="expected interpolation 'bilinear' for antialias, got 'nearest'"):
        door.rectify(labels, CAMERA, VIEW, interpolation="nearest", antialias=True)


def test_a_lens_that_sees_nothing_gives_zeros():
    camera = fr.FisheyeCamera([np.nan, 26, 25.3, 18.1, 0, 0, 0, 0], (37, 52))
    out, valid = door.rectify(np.ones((37, 52)), camera, VIEW, antialias=True)
    assert not valid.any()
    assert (out == 0).all()
