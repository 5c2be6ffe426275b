"""Averaging where pictures shrink, against pictures of sixteen times as many samples each way."""

import numpy as np
import pytest
import torch

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


# --- Tensors --------------------------------------------------------------------------------------


def as_tensor(picture):
    """(H, W, C) to (1, C, H, W)."""
    return torch.from_numpy(np.moveaxis(picture, -1, 0).copy())[None]


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32, np.float64])
@pytest.mark.parametrize(("function", "source", "target", "least"), CASES.values(), ids=CASES)
def test_tensors_are_averaged_as_arrays_are(function, source, target, least, dtype):
    plate = zone_plate(source.image_size)
    picture = np.stack([plate, plate[::-1], plate.mean() + 0 * plate], -1)
    picture = np.rint(255 * picture).astype(dtype) if dtype == np.uint8 else picture.astype(dtype)
    expected = getattr(door, function)(picture, source, target, antialias=True)
    found = getattr(fr, function)(as_tensor(picture), source, target, antialias=True)
    assert found.image.dtype == as_tensor(picture).dtype
    np.testing.assert_array_equal(found.valid[0, 0].numpy(), expected.valid)
    # To the rounding of their sums; of bytes and halves, whose samples are rounded alike, to the bit.
    exact = {np.float32: 1e-6, np.float64: 1e-14}.get(dtype, 0)
    np.testing.assert_allclose(found.image.numpy(), as_tensor(expected.image).numpy(), rtol=0, atol=exact)


def test_a_view_four_times_as_coarse_comes_near_to_256_samples_a_pixel():
    """Error without averaging, in grey levels, several times that with it."""
    plate, view = zone_plate(CAMERA.image_size), VIEW.resize((90, 120))
    expected = truth("rectify", plate, CAMERA, view)
    image = torch.from_numpy(plate)[None, None]
    plain, averaged = (fr.rectify(image, CAMERA, view, antialias=a) for a in (False, True))
    where = inner(plain.valid[0, 0].numpy())
    without, rest = (255 * np.abs(r.image[0, 0].numpy() - expected)[where].mean() for r in (plain, averaged))
    assert rest < 2
    assert without > 8 * rest


def test_each_picture_of_a_batch_is_averaged_as_if_it_came_alone():
    """By its own camera, one of which shrinks less than the others, and turned on its own."""
    image = torch.rand(3, 2, *CAMERA.image_size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    scales = torch.tensor([1, 0.2, 1.3], dtype=torch.float64)
    params = torch.as_tensor(CAMERA.params).repeat(3, 1)
    params[:, :2] *= scales[:, None]
    rotation = torch.stack([torch.from_numpy(fr.view_rotation(pan_deg=pan)) for pan in (0, 10, -20)])
    view = VIEW.resize((36, 48))
    cameras = [fr.FisheyeCamera(row, CAMERA.image_size) for row in params]
    assert len({antialiasing.levels(camera, view, None) for camera in cameras}) > 1
    together = fr.rectify(image, fr.FisheyeCamera(params, CAMERA.image_size), view, rotation=rotation, antialias=True)
    for i, camera in enumerate(cameras):
        alone = fr.rectify(image[i : i + 1], camera, view, rotation=rotation[i], antialias=True)
        torch.testing.assert_close(together.image[i : i + 1], alone.image, rtol=0, atol=0)
        assert torch.equal(together.valid[i : i + 1], alone.valid)


def test_one_camera_averages_a_batch_and_one_picture_meets_many_cameras(monkeypatch):
    image = torch.rand(2, 3, *CAMERA.image_size, generator=torch.Generator().manual_seed(0))
    view = VIEW.resize((36, 48))
    batch = fr.rectify(image, CAMERA, view, antialias=True).image
    monkeypatch.setattr(antialiasing, "_BAND", 64 * 48 * 5)
    alone = [fr.rectify(picture[None], CAMERA, view, antialias=True).image for picture in image]
    torch.testing.assert_close(torch.cat(alone), batch)
    cameras = fr.FisheyeCamera(np.tile(CAMERA.params, (2, 1)), CAMERA.image_size)
    many = fr.rectify(image[:1], cameras, view, antialias=True).image
    torch.testing.assert_close(many, batch[:1].expand(2, -1, -1, -1))
    for empty in (image[:0], image[:, :0]):
        assert fr.rectify(empty, CAMERA, view, antialias=True).image.shape == (*empty.shape[:2], 36, 48)


@pytest.mark.parametrize("size", [(5, 6), (1, 2)], ids=["target_enlarged", "source_averaged_too"])
def test_gradients_flow_through_averages(size):
    lens = torch.tensor([[8.0, 8.1, 15.2, 11.7, 0.05, -0.01, 0, 0], [11, 10, 15, 12, 0, 0, 0, 0]], dtype=torch.float64)
    view = torch.as_tensor(fr.PinholeCamera.from_fov(90, (5, 6)).resize(size).params)[None]
    turn = torch.from_numpy(fr.view_rotation(5, 3, 2))
    image = torch.rand(2, 1, 24, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    tensors = [tensor.clone().requires_grad_() for tensor in (image, lens, view, turn)]

    def rectified(image, lens, view, turn):
        layer = fr.DistortionRectification(fr.PinholeCamera(view, size), antialias=True)
        return layer(image, lens, turn)

    assert torch.autograd.gradcheck(rectified, tensors, fast_mode=True)


def test_layers_average_and_say_so():
    layer = fr.DistortionRectification(VIEW.resize((36, 48)), camera=CAMERA, antialias=True)
    image = as_tensor(zone_plate(CAMERA.image_size)[..., None])
    expected = fr.rectify(image, CAMERA, VIEW.resize((36, 48)), antialias=True).image
    torch.testing.assert_close(layer(image), expected, rtol=0, atol=0)
    assert "antialias=True" in repr(layer)


def test_averaging_breaks_the_graph_and_leaves_other_layers_whole():
    torch.compiler.reset()
    image = torch.rand(1, 1, 48, 64, generator=torch.Generator().manual_seed(0))
    camera, view = CAMERA.resize((48, 64)), VIEW.resize((12, 16))
    averaging = fr.DistortionRectification(view, camera=camera, antialias=True)
    torch.testing.assert_close(torch.compile(averaging, backend="eager")(image), averaging(image), rtol=0, atol=0)
    # Compiled after it, for another size, a batch is a symbol that must be found equal to the batch of lenses.
    plain, pictures = fr.DistortionRectification(view), torch.rand(2, 3, 24, 32)
    params = torch.as_tensor(CAMERA.resize((24, 32)).params).repeat(2, 1)
    compiled = torch.compile(plain, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(pictures, params), plain(pictures, params), rtol=0, atol=0)


def test_tensors_of_labels_are_never_averaged():
    labels, options = torch.zeros(1, 1, *CAMERA.image_size, dtype=torch.uint8), {"interpolation": "nearest"}
    with pytest.raises(ValueError, match=r"^rectify\(\): expected interpolation 'bilinear' for antialias"):
        fr.rectify(labels, CAMERA, VIEW, antialias=True, **options)
    with pytest.raises(ValueError, match=r"^DistortionRectification\(\): expected interpolation 'bilinear'"):
        fr.DistortionRectification(VIEW, antialias=True, **options)
