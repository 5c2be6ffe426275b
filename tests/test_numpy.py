"""The NumPy door: the same bits as the torch op, any strides, and never torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import fisheyerec as fr
import fisheyerec.numpy as door

SIZE, VIEW_SIZE = (37, 52), (31, 43)
CAMERA = fr.FisheyeCamera([25.0, 26, 25.3, 18.1, 0.05, -0.01, 0, 0], SIZE)
VIEW = fr.PinholeCamera([16.0, 17, 21.2, 14.9], VIEW_SIZE)
TURN = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
FUNCTIONS = {"rectify": (CAMERA, VIEW), "distort": (VIEW, CAMERA)}


def call(function, image, **options):
    return getattr(door, function)(image, *FUNCTIONS[function], **options)


def by_torch(function, image, rotation=None, **options):
    """The same through the torch op: (H, W) or (H, W, C) there and back."""
    tensor = torch.from_numpy(np.ascontiguousarray(image)).reshape(*image.shape[:2], -1).permute(2, 0, 1)[None]
    rotation = None if rotation is None else torch.from_numpy(rotation)
    result = getattr(fr, function)(tensor, *FUNCTIONS[function], rotation=rotation, **options)
    out = result.image[0].permute(1, 2, 0).numpy()
    return out.reshape(*out.shape[:2], *image.shape[2:]), result.valid[0, 0].numpy()


def picture(shape, dtype, seed=0):
    values = np.random.default_rng(seed).uniform(0, 1, shape)
    largest = {"f": 1, "b": 2}.get(np.dtype(dtype).kind, 100)
    return np.floor(values * largest).astype(dtype) if largest > 1 else values.astype(dtype)


def shape_of(function, channels):
    return (*(SIZE if function == "rectify" else VIEW_SIZE), *([] if channels is None else [channels]))


@pytest.mark.parametrize("turned", [False, True], ids=["straight", "turned"])
@pytest.mark.parametrize("channels", [None, 1, 3, 17])
@pytest.mark.parametrize("padding", ["zeros", "border"])
@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32, np.float64])
@pytest.mark.parametrize("function", FUNCTIONS)
def test_the_same_bits_as_torch(function, dtype, padding, channels, turned):
    image = picture(shape_of(function, channels), dtype)
    options = {"padding": padding, "rotation": TURN if turned else None}
    out, valid = call(function, image, **options)
    expected, seen = by_torch(function, image, **options)
    assert (out.dtype, valid.dtype) == (image.dtype, bool)
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(valid, seen)
    assert valid.any()


@pytest.mark.parametrize("channels", [None, 3, 17])
@pytest.mark.parametrize("padding", ["zeros", "border"])
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("function", FUNCTIONS)
def test_16_bits_are_blended_as_floats_and_rounded_half_up(function, antialias, padding, channels):
    image = np.random.default_rng(1).integers(0, 65536, shape_of(function, channels)).astype(np.uint16)
    image[: image.shape[0] // 2] |= 0xFFF0  # up to the brightest there is
    options = {"padding": padding, "antialias": antialias}
    out, valid = call(function, image, **options)
    expected, seen = call(function, image.astype(np.float32), **options)
    assert out.dtype == np.uint16
    # Averaging rounds twice.
    np.testing.assert_allclose(out.astype(float), np.floor(expected + 0.5), rtol=0, atol=int(antialias))
    np.testing.assert_array_equal(valid, seen)


LABELS = [bool, np.uint8, np.int16, np.int32, np.int64, np.float16, np.float32, np.float64]


@pytest.mark.parametrize("channels", [None, 2])
@pytest.mark.parametrize("padding", ["zeros", "border"])
@pytest.mark.parametrize("dtype", LABELS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_labels_are_the_same_as_by_torch(function, dtype, padding, channels):
    image = picture(shape_of(function, channels), dtype)
    out, valid = call(function, image, padding=padding, interpolation="nearest")
    expected, seen = by_torch(function, image, padding=padding, interpolation="nearest")
    assert out.dtype == image.dtype
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(valid, seen)


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.uint32, np.uint64])
def test_labels_of_types_that_torch_hardly_knows(dtype):
    image = picture(SIZE, np.int64).astype(dtype)
    top = np.iinfo(dtype).max
    image[image > 50] = top
    out, valid = call("rectify", image, interpolation="nearest")
    plain = call("rectify", np.where(image == top, 1000, image.astype(np.int64)), interpolation="nearest").image
    assert out.dtype == image.dtype
    np.testing.assert_array_equal(out == top, plain == 1000)
    assert (out[~valid] == 0).all()


# Each gives a view of a larger or turned array that has the same pixels as the plain one.
STRIDES = {
    "upside_down": lambda x: np.ascontiguousarray(x[::-1])[::-1],
    "mirrored": lambda x: np.ascontiguousarray(x[:, ::-1])[:, ::-1],
    "turned_half": lambda x: np.ascontiguousarray(x[::-1, ::-1])[::-1, ::-1],
    "bgr": lambda x: np.ascontiguousarray(x[..., ::-1])[..., ::-1],
    "all_reversed": lambda x: np.ascontiguousarray(x[::-1, ::-1, ::-1])[::-1, ::-1, ::-1],
    "crop": lambda x: np.pad(x, ((2, 3), (4, 1), (0, 0)))[2:-3, 4:-1],
    "every_second_pixel": lambda x: x.repeat(2, 0).repeat(3, 1)[::2, ::3],
    "fortran": np.asfortranarray,
    "planar": lambda x: np.ascontiguousarray(x.transpose(2, 0, 1)).transpose(1, 2, 0),
    "columns_first": lambda x: np.ascontiguousarray(x.transpose(1, 0, 2)).transpose(1, 0, 2),
    "first_channels": lambda x: np.concatenate([x, x], 2)[..., : x.shape[2]],
    "read_only": lambda x: np.frombuffer(x.tobytes(), x.dtype).reshape(x.shape),
    "repeated": lambda x: np.broadcast_to(x[..., :1], x.shape),
    "field_of_a_record": lambda x: np.rec.fromarrays([x, x.astype("u1")], names="a,b")["a"],
    "unaligned": lambda x: np.frombuffer(b"\0" + x.tobytes(), x.dtype, offset=1).reshape(x.shape),
}


@pytest.mark.parametrize("layout", STRIDES.values(), ids=STRIDES)
@pytest.mark.parametrize(
    ("dtype", "interpolation"), [(np.uint8, "bilinear"), (np.float32, "bilinear"), (np.int64, "nearest")]
)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_any_strides(function, dtype, interpolation, layout, tolerance):
    plain = picture(shape_of(function, 3), dtype)
    image = layout(plain)
    before = image.copy()
    out, valid = call(function, image, interpolation=interpolation)
    expected, seen = call(function, np.ascontiguousarray(image), interpolation=interpolation)
    np.testing.assert_allclose(out, expected, rtol=tolerance.layout, atol=tolerance.layout)
    np.testing.assert_array_equal(valid, seen)
    np.testing.assert_array_equal(image, before)
    assert out.flags.writeable
    assert out.flags.c_contiguous


def test_flat_pictures_with_negative_strides():
    image = picture(SIZE, np.uint8)
    expected = call("rectify", image).image
    np.testing.assert_array_equal(call("rectify", image[::-1, ::-1].copy()[::-1, ::-1]).image, expected)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("threads", [2, 3, 5, None])
def test_bits_do_not_depend_on_threads(threads, dtype, function):
    camera = fr.FisheyeCamera([90.0, 90, 99.5, 79.5, 0.03, -0.01, 0, 0], (160, 200))
    view = fr.PinholeCamera.from_fov(95, (150, 190))
    cameras = (camera, view) if function == "rectify" else (view, camera)
    image = picture((*cameras[0].image_size, 3), dtype)
    alone = getattr(door, function)(image, *cameras, threads=1)
    others = getattr(door, function)(image, *cameras, threads=threads)
    np.testing.assert_array_equal(alone.image, others.image)
    np.testing.assert_array_equal(alone.valid, others.valid)


def test_cameras_with_tensors_are_welcome():
    image = picture(SIZE, np.float32)
    out = door.rectify(image, CAMERA.to(torch.float64), VIEW.to(torch.float64)).image
    np.testing.assert_array_equal(out, call("rectify", image).image)


def test_a_rotation_may_be_a_list_or_float32():
    image = picture(SIZE, np.float32)
    expected = call("rectify", image, rotation=TURN).image
    np.testing.assert_array_equal(call("rectify", image, rotation=TURN.tolist()).image, expected)
    image = picture(VIEW_SIZE, np.float32)
    expected = call("distort", image, rotation=TURN).image
    np.testing.assert_array_equal(call("distort", image, rotation=TURN.tolist()).image, expected)


def test_unusable_numbers_give_zeros():
    camera = fr.FisheyeCamera([np.nan, 26, 25.3, 18.1, 0, 0, 0, 0], SIZE)
    out, valid = door.rectify(picture((*SIZE, 3), np.uint8), camera, VIEW, padding="border")
    assert not valid.any()
    assert (out == 0).all()


def test_the_result_owns_its_memory():
    image = picture((*SIZE, 3), np.uint8)
    out = call("rectify", image).image
    before = out.copy()
    image[:] = 0
    np.testing.assert_array_equal(out, before)


WITHOUT_TORCH = """
import sys
import numpy as np
import fisheyerec as fr

camera = fr.FisheyeCamera.from_projection("equidistant", 180, image_size=(60, 80))
view = fr.PinholeCamera.edge_matched(camera, image_size=(50, 50))
out, valid = fr.numpy.rectify(np.full((60, 80, 3), 9, np.uint8), camera, view)
assert out.shape == (50, 50, 3) and valid.all() and (out == 9).all()
fr.numpy.distort(out, view, camera)
rays, _ = camera.resize((30, 40)).crop(1, 2, (20, 20)).scale(0.5).unproject([[1.0, 2.0]])
camera.project(np.zeros((4, 3)) + [0, 0, 1])
camera.save("camera.json")
fr.FisheyeCamera.from_opencv(*fr.FisheyeCamera.load("camera.json").to_opencv(), image_size=(60, 80))
fr.FisheyeCamera.from_paper(camera.to_paper(), (60, 80), equation=2)
repr(camera), camera.theta_max, camera.numpy(), view.to_matrix()
loaded = [name for name in sys.modules if name == "torch" or name.startswith("torch.")]
assert not loaded, loaded
print("no torch")
"""


def test_the_door_and_cameras_never_import_torch(run_python):
    done = run_python(WITHOUT_TORCH)
    assert done.stderr == ""
    assert done.stdout == "no torch\n"


def test_both_doors_in_one_process(run_python):
    """Two compiled modules over the same kernels, imported in either order."""
    code = """
import numpy as np, {first}, {second}
import torch, fisheyerec as fr
camera = fr.FisheyeCamera([25.0, 26, 25.3, 18.1, 0.05, -0.01, 0, 0], (37, 52))
view = fr.PinholeCamera.from_fov(90, (31, 43))
image = np.arange(37 * 52 * 3, dtype=np.float32).reshape(37, 52, 3)
ours = fr.numpy.rectify(image, camera, view).image
theirs = fr.rectify(torch.from_numpy(image).permute(2, 0, 1)[None], camera, view).image[0].permute(1, 2, 0)
assert np.array_equal(ours, theirs.numpy())
print("same")
"""
    for first, second in (("torch", "fisheyerec.numpy"), ("fisheyerec.numpy", "torch")):
        done = run_python(code.format(first=first, second=second))
        assert (done.stdout, done.stderr) == ("same\n", "")


# Weights are multiples of 2^-15, of which one may be off by one and a half.
WEIGHT_ROUNDING = 255 * 1.5 / 2**15


@pytest.mark.parametrize("padding", ["zeros", "border"])
@pytest.mark.parametrize("channels", [None, 1, 2, 3, 4, 5, 16])
def test_grey_levels_are_exact_to_half_a_level(channels, padding):
    size = (300, 701)  # more than one run wide, and no multiple of a vector
    camera, view = CAMERA.resize(size), VIEW.resize(size)
    shape = size if channels is None else (*size, channels)
    ramp = np.linspace(0, 250, size[1])[None, :] + 5 * (np.arange(size[0]) % 2)[:, None]
    image = np.broadcast_to((ramp if channels is None else ramp[..., None]), shape).astype(np.uint8)
    out, valid = door.rectify(image, camera, view, padding=padding)
    exact, _ = door.rectify(image.astype(np.float64), camera, view, padding=padding)
    error = np.abs(out - exact)[valid]
    coordinates = 1e-3 * 5  # pixels in float32, times the steepest slope
    assert error.max() <= 0.5 + WEIGHT_ROUNDING + coordinates
    assert error.mean() < 0.26


def test_flat_pictures_stay_flat():
    size = (300, 701)
    out, valid = door.rectify(
        np.full((*size, 3), 255, np.uint8), CAMERA.resize(size), VIEW.resize(size), padding="border"
    )
    assert (out[valid] == 255).all()
