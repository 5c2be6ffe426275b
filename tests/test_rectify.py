"""What the op computes: against plain torch, against OpenCV, and against identities of resampling."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

import fisheyerec as fr
from fisheyerec import _ops, reference

FUNCTIONS = ["rectify", "distort"]
PADDINGS = ["zeros", "border"]
FEW_LENSES = [
    "wide_120",
    "over_180_equidistant_220",
    "folds_in_frame",
    "runs_wild_beyond_frame",
    "surround_view_front",
    "profile_walksnail_folds",
]
SMALL = (37, 52)
VIEW = (31, 43)
few_lenses = pytest.mark.parametrize("lens", FEW_LENSES, indirect=True)


def small(lens):
    return lens.resize(SMALL)


def wide_view(camera, size=VIEW):
    """A view that reaches a little beyond the fisheye picture, so that padding matters."""
    fx, fy, cx, cy = fr.PinholeCamera.edge_matched(camera, size).params
    return fr.PinholeCamera([0.75 * fx, 0.8 * fy, cx + 0.3, cy - 0.6], size)


def rotation(x, y, z):
    return torch.from_numpy(cv2.Rodrigues(np.array([x, y, z], dtype=np.float64))[0])


TILT = rotation(0.1, -0.25, 0.4)


def apply(function, image, camera, view, **options):
    """rectify or distort, the camera first in both."""
    if function == "rectify":
        return fr.rectify(image, camera, view, **options)
    return fr.distort(image, view, camera, **options)


def source_size(function):
    return SMALL if function == "rectify" else VIEW


def expected(function, image, camera, view, rotation=None, interpolation="bilinear", padding="zeros"):
    """The reference in float64."""
    source, target = (camera, view) if function == "rectify" else (view, camera)
    if rotation is not None and function == "distort":
        rotation = rotation.transpose(-1, -2)
    if rotation is not None and rotation.ndim == 2:
        rotation = rotation[None]
    params = [torch.as_tensor(c.params).reshape(-1, len(c.parameter_names)).double() for c in (source, target)]
    exact = image if not image.is_floating_point() and interpolation == "nearest" else image.double()
    return reference.resample(
        exact, *params, rotation, source.model, target.model, *target.image_size, interpolation, padding
    )


# --- Against plain torch --------------------------------------------------------------------------


# What an image of each dtype may differ by from the reference in float64.
INTERPOLATED = {
    torch.float64: lambda t: t.reference,
    torch.float32: lambda t: 100 * t.float32_px,
    torch.bfloat16: lambda t: t.bfloat16,
    torch.float16: lambda t: t.float16,
    torch.uint8: lambda t: 0.5 + 255 * 100 * t.float32_px,  # rounded to whole grey levels, after float32
}


def as_dtype(image, dtype):
    """A picture in [0, 1] as this dtype; integers get its grey levels."""
    if dtype == torch.bool:
        return image > 0.5
    return (image if dtype.is_floating_point else image * 255).to(dtype)


def check_against_reference(function, image, camera, view, tolerance, **options):
    result = apply(function, image, camera, view, **options)
    exact, valid = expected(function, image, camera, view, **options)
    assert result.image.dtype == image.dtype
    # In float32 a coordinate at the very edge of the picture or of the lens may fall on its other side.
    agree = result.valid == valid
    assert agree.double().mean() > (1 - 1e-9 if image.dtype == torch.float64 else 0.995)
    error = (result.image.double() - exact).abs() * agree
    assert error.max() <= INTERPOLATED[image.dtype](tolerance)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_agrees_with_the_reference_for_every_lens(lens, function, padding, dtype, picture, tolerance):
    camera = small(lens)
    view = wide_view(camera)
    image = picture(2, 3, *source_size(function)).to(dtype)
    check_against_reference(function, image, camera, view, tolerance, padding=padding)


LAYOUTS = {
    "contiguous": lambda x: x,
    "channels_last": lambda x: x.contiguous(memory_format=torch.channels_last),
    "crop": lambda x: torch.nn.functional.pad(x, (3, 2, 1, 4))[..., 1:-4, 3:-2],
    "every_second_pixel": lambda x: x.repeat_interleave(2, -1).repeat_interleave(2, -2)[..., ::2, ::2],
    "columns_first": lambda x: x.transpose(-1, -2).contiguous().transpose(-1, -2),
    "some_channels": lambda x: torch.cat([x, x], 1).contiguous(memory_format=torch.channels_last)[:, : x.shape[1]],
    "expanded_batch": lambda x: x[:1].expand(x.shape[0], -1, -1, -1),
    "expanded_channels": lambda x: x[:, :1].expand(-1, x.shape[1], -1, -1),
}


@pytest.mark.parametrize("lens", ["wide_120", "folds_in_frame"], indirect=True)
@pytest.mark.parametrize("turned", [False, True], ids=["straight", "turned"])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("dtype", INTERPOLATED, ids=str)
def test_agrees_with_the_reference(dtype, function, padding, layout, turned, lens, picture, tolerance):
    camera = small(lens)
    view = wide_view(camera)
    image = LAYOUTS[layout](as_dtype(picture(2, 3, *source_size(function)), dtype))
    check_against_reference(
        function, image, camera, view, tolerance, padding=padding, rotation=TILT if turned else None
    )


COPIED = [torch.float64, torch.float32, torch.bfloat16, torch.float16, torch.int64, torch.int32, torch.int16]
COPIED += [torch.uint8, torch.bool]


@pytest.mark.parametrize("layout", ["contiguous", "channels_last", "crop", "expanded_batch"])
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("dtype", COPIED, ids=str)
def test_nearest_agrees_with_the_reference(dtype, function, padding, layout, picture):
    camera = fr.FisheyeCamera([20.0, 21, 25.5, 18.2, -0.3, 0, 0, 0], SMALL)
    view = wide_view(camera)
    image = LAYOUTS[layout]((picture(2, 3, *source_size(function)) * 100).to(dtype))
    result = apply(function, image, camera, view, padding=padding, interpolation="nearest", rotation=TILT)
    labels, valid = expected(function, image, camera, view, TILT, "nearest", padding)
    assert result.image.dtype == dtype
    # Halfway between two pixels rounding decides, which differs between float32 and float64.
    same = (result.image.double() == labels.double()).double().mean()
    assert same > (1 - 1e-9 if dtype == torch.float64 else 0.99)
    assert (result.valid == valid).double().mean() > 0.995


@pytest.mark.parametrize("dtype", [torch.int8, torch.uint16, torch.uint32, torch.uint64], ids=str)
def test_nearest_takes_every_type_of_integer(dtype, picture):
    camera = fr.FisheyeCamera(CAMERAS[0], SMALL)
    labels = (picture(1, 2, *SMALL) * 100).to(torch.int64)
    out = fr.rectify(labels.to(dtype), camera, fr.PinholeCamera(VIEWS[0], VIEW), interpolation="nearest").image
    expected_out = fr.rectify(labels, camera, fr.PinholeCamera(VIEWS[0], VIEW), interpolation="nearest").image
    assert out.dtype == dtype
    assert torch.equal(out.to(torch.int64), expected_out)


def test_nearest_keeps_labels_beyond_2_to_the_53():
    camera = fr.FisheyeCamera([30.0, 30, 15.5, 15.5, 0.05, 0, 0, 0], (32, 32))
    labels = torch.arange(1024).reshape(1, 1, 32, 32) + 2**53 + 1
    result = fr.rectify(labels, camera, fr.PinholeCamera.from_fov(60, (24, 24)), interpolation="nearest")
    seen = result.image[result.valid] - 2**53 - 1
    plain = fr.rectify(labels - 2**53 - 1, camera, result.view, interpolation="nearest")
    assert torch.equal(seen, plain.image[plain.valid])
    assert len(seen.unique()) > 100


EPSILON = 2.0**-40  # far above float64's rounding of a few pixels, far below any other shift


@pytest.mark.parametrize(
    ("shift", "column"), [(0, 3), (0.5 - EPSILON, 3), (0.5 + EPSILON, 4), (-0.5 + EPSILON, 3), (-0.5 - EPSILON, 2)]
)
def test_nearest_is_the_pixel_that_contains_the_point(shift, column):
    image = torch.arange(8, dtype=torch.float64).expand(1, 1, 8, 8).contiguous()
    source = fr.PinholeCamera([8.0, 8, 3.5 + shift, 3.5], (8, 8))
    out, _ = fr.resample(image, source, fr.PinholeCamera([8.0, 8, 3.5, 3.5], (8, 8)), interpolation="nearest")
    assert out[0, 0, 4, 3] == column


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_picture_ends_half_a_pixel_beyond_its_outermost_centres(sign, axis, padding, interpolation):
    """The mask counts the edge itself as inside; zeros lie beyond it for nearest, and fade in for bilinear."""
    image = torch.ones(1, 1, 8, 8, dtype=torch.float64)
    for distance, inside in ((0.5 - EPSILON, True), (0.5, True), (0.5 + EPSILON, False)):
        centre = [3.5 + sign * distance * (axis == name) for name in "xy"]
        source = fr.PinholeCamera([8.0, 8, *centre], (8, 8))
        target = fr.PinholeCamera([8.0, 8, 3.5, 3.5], (8, 8))
        out, valid = fr.resample(image, source, target, padding=padding, interpolation=interpolation)
        edge = (..., slice(None), -1 if sign > 0 else 0) if axis == "x" else (..., -1 if sign > 0 else 0, slice(None))
        assert valid[edge].all() == inside
        assert valid[..., 1:-1, 1:-1].all()
        expected_value = (
            1 if padding == "border" else {"nearest": float(inside), "bilinear": 1 - distance}[interpolation]
        )
        assert (out[edge] - expected_value).abs().max() < 1e-12


# --- Against OpenCV -------------------------------------------------------------------------------


@few_lenses
@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize("padding", PADDINGS)
def test_pictures_are_cv2_remap(padding, dtype, lens, picture):
    height, width = 120, 160
    camera = lens.resize((height, width))
    view = wide_view(camera, (100, 130))
    image = np.ascontiguousarray(picture(1, 3, height, width)[0].permute(1, 2, 0).numpy().astype(np.float32))
    levels = 255 if dtype == np.uint8 else 1
    image = (image * levels).round().astype(dtype) if levels > 1 else image
    K, D = camera.to_opencv()
    maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), view.to_matrix(), (130, 100), cv2.CV_32FC1)
    border = cv2.BORDER_REPLICATE if padding == "border" else cv2.BORDER_CONSTANT
    theirs = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=border).astype(np.float64)

    tensor = torch.from_numpy(image).permute(2, 0, 1)[None]
    result = fr.rectify(tensor, camera, view, padding=padding)
    ours = result.image[0].permute(1, 2, 0).numpy().astype(np.float64)
    valid = result.valid[0, 0].numpy()

    # OpenCV rounds coordinates to 1/32 pixel: off by 1/64 each way at most, times the steepest step beside the pixel.
    padded = np.pad(image.astype(np.float64), ((1, 1), (1, 1), (0, 0)), "edge" if padding == "border" else "constant")
    step_x, step_y = (abs(np.diff(padded, axis=axis)).max() for axis in (1, 0))
    rounding = 1 if dtype == np.uint8 else 1e-5
    inner = valid & (maps[0] > 1) & (maps[0] < width - 2) & (maps[1] > 1) & (maps[1] < height - 2)
    assert inner.mean() > 0.1
    inside_step = sum(abs(np.diff(image.astype(np.float64), axis=axis)).max() for axis in (0, 1))
    assert abs(ours - theirs)[inner].max() <= inside_step / 64 + rounding
    # Beyond the fold OpenCV shows a folded copy, and beyond 90 degrees nothing of use.
    assert abs(ours - theirs)[valid].max() <= (step_x + step_y) / 64 + rounding


# --- Identities -----------------------------------------------------------------------------------


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.uint8], ids=str)
def test_a_view_of_itself_is_the_picture(dtype, padding, interpolation, picture, tolerance):
    view = fr.PinholeCamera([40.3, 41.7, 26.1, 17.9], SMALL)
    image = as_dtype(picture(2, 3, *SMALL), dtype)
    out, valid = fr.resample(image, view, view, padding=padding, interpolation=interpolation)
    # Rounding may take a border pixel outside by an epsilon, where the mask still holds.
    atol = {torch.float64: tolerance.reference, torch.float32: 1e-4, torch.uint8: 0}[dtype]
    torch.testing.assert_close(out, image, rtol=0, atol=atol)
    assert valid.all()


@few_lenses
def test_a_fisheye_picture_through_its_own_lens_is_the_picture(lens, picture, tolerance):
    camera = small(lens)
    image = picture(1, 2, *SMALL)
    out, valid = fr.resample(image, camera, camera)
    assert valid.double().mean() > 0.3
    torch.testing.assert_close(out * valid, image * valid, rtol=0, atol=tolerance.reference)
    assert (out[~valid.expand_as(out)] == 0).all()


@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_linear_in_the_image(function, padding, lens, picture, tolerance):
    camera = small(lens)
    view = wide_view(camera)
    x, y = (picture(1, 2, *source_size(function), seed=seed) for seed in (1, 2))
    A = lambda image: apply(function, image, camera, view, padding=padding, rotation=TILT).image  # noqa: E731
    torch.testing.assert_close(A(2.5 * x - 0.5 * y), 2.5 * A(x) - 0.5 * A(y), rtol=0, atol=10 * tolerance.rounding)


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_backward_is_the_adjoint(function, padding, interpolation, lens, picture, tolerance):
    """<A x, y> = <x, A' y> for random y."""
    camera = small(lens)
    view = wide_view(camera)
    x = picture(2, 2, *source_size(function)).requires_grad_()
    options = {"padding": padding, "interpolation": interpolation, "rotation": TILT}
    Ax = apply(function, x, camera, view, **options).image
    y = torch.from_numpy(np.random.default_rng(3).standard_normal(Ax.shape))
    (adjoint,) = torch.autograd.grad(Ax, x, y)
    scale = (Ax.abs() * y.abs()).sum().item()
    assert (Ax * y).sum().item() == pytest.approx((x * adjoint).sum().item(), abs=tolerance.rounding * scale)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("gradient_layout", ["contiguous", "channels_last", "columns_first", "expanded_channels"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16, torch.float16], ids=str)
def test_backward_is_the_adjoint_in_every_layout_and_dtype(dtype, gradient_layout, layout, picture, tolerance):
    camera = fr.FisheyeCamera([25.0, 26, 25.5, 18.2, 0.05, -0.01, 0, 0], SMALL)
    view = wide_view(camera)
    x = LAYOUTS[layout](picture(2, 3, *SMALL).to(dtype)).detach().requires_grad_()
    Ax = fr.rectify(x, camera, view).image
    y = LAYOUTS[gradient_layout](torch.from_numpy(np.random.default_rng(3).standard_normal(Ax.shape)).to(dtype))
    (adjoint,) = torch.autograd.grad(Ax, x, y)
    assert adjoint.dtype == dtype
    scale = (Ax.double().abs() * y.double().abs()).sum().item()
    relative = {
        torch.float64: tolerance.rounding,
        torch.float32: tolerance.float32_px,
        torch.bfloat16: tolerance.bfloat16,
        torch.float16: tolerance.float16,
    }[dtype]
    both = [(a.double() * b.double()).sum().item() for a, b in ((Ax, y), (x, adjoint))]
    assert both[0] == pytest.approx(both[1], abs=relative * scale)


def waves(height, width):
    """A picture so smooth that interpolating it twice costs little: wavelengths of 70 pixels and more.

    Its last channel is 1: what has faded into the surroundings, or never was on the picture, is less there.
    """
    x, y = torch.meshgrid(torch.arange(width).double(), torch.arange(height).double(), indexing="xy")
    shapes = [torch.sin(x / 11 + 0.3), torch.cos(y / 13), torch.sin((x + y) / 17), torch.ones_like(x)]
    return torch.stack(shapes)[None] / 2 + 0.5


def difference(a, b):
    """The largest difference where both pictures are whole, and how much of them that is."""
    whole = ((a[:, 3:] > 1 - 1e-9) & (b[:, 3:] > 1 - 1e-9)).expand_as(a)
    return (a - b)[whole].abs().max().item(), whole.double().mean().item()


SMOOTH_LENS = fr.FisheyeCamera([40.0, 41, 63, 62.5, 0.02, -0.01, 0, 0], (128, 128))
SMOOTH = 0.01  # what interpolating `waves` twice may cost: (2 pi / 70)^2 / 8 for each axis and pass, with some stretch


def test_turning_there_and_back_is_no_turn():
    view = fr.PinholeCamera.from_fov(70, (128, 128))
    straight = fr.rectify(waves(128, 128), SMOOTH_LENS, view).image
    turned = fr.rectify(waves(128, 128), SMOOTH_LENS, view, rotation=TILT).image
    back, _ = fr.resample(turned, view, view, source_from_target=TILT.T)
    error, share = difference(back, straight)
    assert share > 0.4
    assert error < SMOOTH
    # The test can tell: the other way round is far off.
    wrong, _ = fr.resample(turned, view, view, source_from_target=TILT)
    assert difference(wrong, straight)[0] > 10 * SMOOTH


@pytest.mark.parametrize("angles", [(0.3, 0, 0), (0, 0.4, 0), (0.2, -0.5, 0.7)])
def test_virtual_views_agree_where_they_overlap(angles):
    """A view made from another view is the view made from the fisheye picture."""
    R_a, R_b = rotation(-0.1, 0.2, 0.1), rotation(*angles)
    wide, narrow = fr.PinholeCamera.from_fov(100, (256, 256)), fr.PinholeCamera.from_fov(50, (64, 64))
    a = fr.rectify(waves(128, 128), SMOOTH_LENS, wide, rotation=R_a).image
    b = fr.rectify(waves(128, 128), SMOOTH_LENS, narrow, rotation=R_b).image
    b_from_a, _ = fr.resample(a, wide, narrow, source_from_target=R_a.T @ R_b)
    error, share = difference(b_from_a, b)
    assert share > 0.3
    assert error < SMOOTH


@pytest.mark.parametrize("turned", [False, True], ids=["straight", "turned"])
def test_distort_is_undone_by_rectify(turned):
    view = fr.PinholeCamera.from_fov(80, (128, 128))
    R = TILT if turned else None
    fisheye = fr.distort(waves(128, 128), view, SMOOTH_LENS, rotation=R).image
    error, share = difference(fr.rectify(fisheye, SMOOTH_LENS, view, rotation=R).image, waves(128, 128))
    assert share > 0.5
    assert error < 2 * SMOOTH  # the fisheye picture shows the view's edges smaller than they are


@few_lenses
def test_a_quarter_turn_of_the_view_turns_the_picture(lens, picture, tolerance):
    """About z from x to y: what the view shows at (x, y) it showed at (-y, x)."""
    camera = small(lens)
    view = fr.PinholeCamera.from_fov(90, (40, 40))
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    image = picture(1, 2, *SMALL)
    straight, turned = fr.rectify(image, camera, view), fr.rectify(image, camera, view, rotation=quarter)
    torch.testing.assert_close(
        turned.image, straight.image.transpose(-1, -2).flip(-2), rtol=0, atol=tolerance.reference
    )
    assert torch.equal(turned.valid, straight.valid.transpose(-1, -2).flip(-2))


def test_pan_looks_right_and_tilt_looks_down():
    """camera_from_view turns the view's axis: a positive angle about y (down) points it right, to larger x."""
    camera = fr.FisheyeCamera([40.0, 40, 49.5, 49.5, 0, 0, 0, 0], (100, 100))
    image = torch.stack(torch.meshgrid(torch.arange(100.0), torch.arange(100.0), indexing="xy"))[None].double()
    view = fr.PinholeCamera.from_fov(20, (11, 11))
    centre = lambda R: fr.rectify(image, camera, view, rotation=R).image[0, :, 5, 5].tolist()  # noqa: E731
    assert centre(rotation(0, 0.5, 0)) == pytest.approx([49.5 + 40 * 0.5, 49.5])
    assert centre(rotation(-0.5, 0, 0)) == pytest.approx([49.5, 49.5 + 40 * 0.5])


# --- The mask, the fold, the back -----------------------------------------------------------------


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("padding", PADDINGS)
def test_the_mask_is_where_the_ray_meets_the_picture(lens, padding, function):
    camera = small(lens)
    view = wide_view(camera)
    source, target = (camera, view) if function == "rectify" else (view, camera)
    result = apply(
        function, torch.ones(1, 1, *source_size(function), dtype=torch.float64), camera, view, padding=padding
    )

    height, width = target.image_size
    rays, seen = target.unproject(np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float))
    points, hit = source.project(rays)
    x, y = np.moveaxis(points, -1, 0)
    live = seen & hit
    on_picture = (x >= -0.5) & (x <= source.image_size[1] - 0.5) & (y >= -0.5) & (y <= source.image_size[0] - 0.5)
    # Coordinates within an epsilon of the edge may fall either way.
    edge = np.minimum(abs(x % 1 - 0.5), abs(y % 1 - 0.5)) < 1e-9
    valid = result.valid[0, 0].numpy()
    assert (valid == (live & on_picture))[~edge].all()
    ones = result.image[0, 0].numpy()
    if padding == "border":
        assert abs(ones - live).max() < 1e-12
    else:
        inner = live & (x >= 0) & (x <= source.image_size[1] - 1) & (y >= 0) & (y <= source.image_size[0] - 1)
        outer = ~live | (x <= -1) | (x >= source.image_size[1]) | (y <= -1) | (y >= source.image_size[0])
        assert abs(ones[inner] - 1).max(initial=0) < 1e-12
        assert (ones[outer] == 0).all()


@pytest.mark.parametrize(
    "lens",
    ["folds_in_frame", "folds_and_rises_again", "profile_philips_folds", "profile_iphone12_folds"],
    indirect=True,
)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.uint8], ids=str)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_a_lens_that_folds_shows_no_folded_copy(lens, dtype, padding, interpolation):
    camera = lens.resize((96, 128))
    view = fr.PinholeCamera.from_fov(160, (81, 81))
    image = torch.full((1, 2, 96, 128), 7, dtype=dtype)
    result = fr.rectify(image, camera, view, padding=padding, interpolation=interpolation)
    pixels = np.stack(np.meshgrid(np.arange(81), np.arange(81)), -1) - 40.0
    theta = np.arctan(np.hypot(*np.moveaxis(pixels / view.params[0], -1, 0)))
    beyond = torch.from_numpy(theta > camera.theta_max + 1e-4)
    assert 0.1 < beyond.double().mean() < 0.99
    assert (result.image[..., beyond] == 0).all()
    assert not result.valid[..., beyond].any()
    assert result.valid[0, 0, 40, 40]

    # The mirror: fisheye pixels outside the circle of theta_max show nothing.
    fisheye = fr.distort(torch.full((1, 1, 81, 81), 7, dtype=dtype), view, camera, padding=padding)
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    fx, fy, cx, cy, *k = camera.params
    limit = camera.theta_max * (1 + sum(k[i] * camera.theta_max ** (2 * i + 2) for i in range(4)))
    outside = torch.from_numpy(np.hypot((x - cx) / fx, (y - cy) / fy) > limit * (1 + 1e-5))
    assert outside.any()
    assert (fisheye.image[..., outside] == 0).all()
    assert not fisheye.valid[..., outside].any()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("yaw_deg", [60, 90, 108, 130, 180])
def test_a_lens_over_180_degrees_sees_behind_itself(yaw_deg, dtype):
    camera = fr.FisheyeCamera.from_projection("equidistant", 220, (200, 200))
    radius = torch.hypot(*torch.meshgrid(torch.arange(200.0) - 99.5, torch.arange(200.0) - 99.5, indexing="xy"))
    theta_deg = (radius * 1.1).to(dtype)[None, None]  # the picture tells its own angle: 100 px for 110 degrees
    view = fr.PinholeCamera.from_fov(20, (21, 21))
    result = fr.rectify(theta_deg, camera, view, rotation=rotation(0, math.radians(yaw_deg), 0))
    centre = result.image[0, 0, 10, 10].item()
    if yaw_deg <= 108:
        assert result.valid[0, 0, 10, 10]
        assert centre == pytest.approx(yaw_deg, abs=0.1)
    else:
        assert not result.valid.any()
        assert (result.image == 0).all()


# --- Unusable numbers -----------------------------------------------------------------------------


def with_value(tensor, index, value):
    tensor = tensor.clone()
    tensor.view(-1)[index] = value
    return tensor


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", ["camera", "view", "rotation"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_unusable_numbers_give_zeros_and_no_gradient(function, padding, dtype, which, value, picture):
    """One bad image in a batch of three; every entry of the bad parameters in turn."""
    good = {
        "camera": torch.tensor([25.0, 25, 26, 18, 0.05, 0, 0, 0], dtype=dtype),
        "view": torch.tensor([20.0, 20, 21, 15], dtype=dtype),
        "rotation": TILT.to(dtype).contiguous(),
    }
    for index in range(good[which].numel()):
        tensors = {name: tensor.expand(3, *tensor.shape).clone() for name, tensor in good.items()}
        tensors[which][1] = with_value(good[which], index, value)
        for tensor in tensors.values():
            tensor.requires_grad_()
        image = picture(3, 2, *source_size(function)).to(dtype).requires_grad_()
        camera = fr.FisheyeCamera(tensors["camera"], SMALL)
        view = fr.PinholeCamera(tensors["view"], VIEW)
        result = apply(function, image, camera, view, padding=padding, rotation=tensors["rotation"])
        assert (result.image[1] == 0).all()
        assert not result.valid[1].any()
        assert result.valid[0].any()
        assert torch.equal(result.valid[0], result.valid[2])
        result.image.sum().backward()
        for tensor in (image, *tensors.values()):
            assert (tensor.grad[1] == 0).all()
            assert tensor.grad[0].isfinite().all()
            assert (tensor.grad[0] != 0).any()


@pytest.mark.parametrize("params", [
    [0.0, 25, 26, 18, 0, 0, 0, 0],
    [0.0, 0, 0, 0, 0, 0, 0, 0],
    [-25.0, 25, 26, 18, 0, 0, 0, 0],
    [25.0, 25, 1e30, -1e30, 0, 0, 0, 0],
    [1e30, 1e30, 26, 18, 0, 0, 0, 0],
    [1e-30, 1e-30, 26, 18, 0, 0, 0, 0],
    [25.0, 25, 26, 18, -1e30, 1e30, -1e30, 1e30],
    [25.0, 25, 26, 18, 1e36, 0, 0, 1e36],  # theta_d(pi) overflows float32
    [25.0, 25, 26, 18, 1e300, 1e300, 1e300, 1e300],  # overflows in float32 themselves
    [25.0, 25, 26, 18, 1e308, 1e308, 1e308, 1e308],  # theta_d(pi) overflows float64
    [1e300, 1e300, 1e300, 1e300, 0, 0, 0, 0],
    [25.0, 25, 26, 18, -1e300, 0, 0, 0],
], ids=str)  # fmt: skip
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.uint8], ids=str)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_absurd_parameters_stay_within_the_picture(function, padding, dtype, params, picture):
    """No crash, no memory beyond the picture: every value is a mean of the picture's or zero."""
    image = as_dtype(picture(1, 2, *source_size(function)) / 2 + 0.5, dtype)
    camera = fr.FisheyeCamera(params, SMALL)
    result = apply(function, image, camera, fr.PinholeCamera([20.0, 20, 21, 15], VIEW), padding=padding)
    assert result.image.double().isfinite().all()
    assert (result.image >= 0).all()
    assert (result.image <= image.max() * (1 + 1e-5)).all()


@few_lenses
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("padding", PADDINGS)
def test_nan_pixels_stay_with_those_that_read_them(lens, layout, padding, picture):
    camera = small(lens)
    view = wide_view(camera)
    clean = LAYOUTS[layout](picture(1, 3, *SMALL))
    dirty = clean.clone(memory_format=torch.preserve_format)
    dirty[0, 1, 10:14, 20:25] = math.nan
    x = fr.rectify(dirty, camera, view, padding=padding).image
    expected_x = fr.rectify(clean, camera, view, padding=padding).image
    # A channel of its own that is 1 at those pixels tells who reads them.
    marks = torch.zeros(1, 1, *SMALL, dtype=torch.float64)
    marks[..., 9:15, 19:26] = 1  # a pixel wider: at integer coordinates the neighbour of weight 0 may be read
    reads = fr.rectify(marks, camera, view, padding=padding).image[0, 0] > 0
    assert torch.equal(x[0, [0, 2]], expected_x[0, [0, 2]])
    assert torch.equal(x[0, 1][~reads], expected_x[0, 1][~reads])
    assert x[0, 1].isnan().any()


# --- Batches, shapes, memory ----------------------------------------------------------------------

CAMERAS = torch.tensor(
    [[25.0, 25, 26, 18, 0.05, 0, 0, 0], [20, 22, 25, 20, -0.1, 0.02, 0, 0], [30, 30, 20, 18, 0, 0, 0.1, 0]],
    dtype=torch.float64,
)
VIEWS = torch.tensor([[20.0, 20, 21, 15], [15, 16, 20, 15], [25, 25, 22, 14]], dtype=torch.float64)
ROTATIONS = torch.stack([rotation(0, 0, 0.1), rotation(0.2, 0, 0), rotation(0, -0.3, 0)])


@pytest.mark.parametrize("rotations", [None, 1, 3])
@pytest.mark.parametrize("views", [0, 1, 3])
@pytest.mark.parametrize("cameras", [0, 1, 3])
@pytest.mark.parametrize("images", [1, 3])
@pytest.mark.parametrize("function", FUNCTIONS)
def test_one_of_something_is_repeated_for_a_batch(function, images, cameras, views, rotations, picture):
    """Counts of images, cameras, views, rotations; 0 is a single camera without a batch dimension."""
    pick = lambda all_, count: all_[0] if count == 0 else all_[:count]  # noqa: E731
    camera = fr.FisheyeCamera(pick(CAMERAS, cameras), SMALL)
    view = fr.PinholeCamera(pick(VIEWS, views), VIEW)
    image = picture(images, 2, *source_size(function))
    R = None if rotations is None else ROTATIONS[:rotations]
    result = apply(function, image, camera, view, rotation=R)
    batch = max(images, cameras, views, rotations or 0)
    assert result.image.shape[0] == batch
    assert result.valid.shape == (batch, 1, *result.image.shape[-2:])
    for i in range(batch):
        alone = apply(
            function,
            image[min(i, images - 1)][None],
            fr.FisheyeCamera(CAMERAS[min(i, max(cameras, 1) - 1)], SMALL),
            fr.PinholeCamera(VIEWS[min(i, max(views, 1) - 1)], VIEW),
            rotation=None if R is None else R[min(i, rotations - 1)],
        )
        assert torch.equal(alone.image[0], result.image[i])
        assert torch.equal(alone.valid[0], result.valid[i])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize(("batch", "channels", "rows"), [(0, 3, 1), (0, 3, 0), (2, 0, 1), (2, 0, 2), (0, 0, 1)])
def test_empty_batches_go_forward_and_backward(function, dtype, batch, channels, rows):
    image = torch.zeros(batch, channels, *source_size(function), dtype=dtype, requires_grad=True)
    params = CAMERAS[:rows].clone().requires_grad_()
    view = VIEWS[0].clone().requires_grad_()
    result = apply(function, image, fr.FisheyeCamera(params, SMALL), fr.PinholeCamera(view, VIEW))
    size = VIEW if function == "rectify" else SMALL
    assert result.image.shape == (batch, channels, *size)
    assert result.valid.shape == (batch, 1, *size)
    result.image.sum().backward()
    assert image.grad.shape == image.shape
    assert params.grad.shape == params.shape
    assert (params.grad == 0).all()
    assert (view.grad == 0).all()


@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("source_pixels", [(1, 1), (1, 7), (7, 1)])
@pytest.mark.parametrize("target_pixels", [(1, 1), (1, 9), (9, 9)])
def test_pictures_of_one_pixel_or_one_row(source_pixels, target_pixels, padding, picture, tolerance):
    camera = fr.FisheyeCamera([3.0, 3, (source_pixels[1] - 1) / 2, 0.1, 0.05, 0, 0, 0], source_pixels)
    view = fr.PinholeCamera([4.0, 4, (target_pixels[1] - 1) / 2, 0.2], target_pixels)
    image = (picture(1, 2, *source_pixels) + 1).requires_grad_()
    result = fr.rectify(image, camera, view, padding=padding)
    image_64, valid = expected("rectify", image, camera, view, padding=padding)
    torch.testing.assert_close(result.image, image_64, rtol=0, atol=tolerance.reference)
    assert torch.equal(result.valid, valid)
    assert valid.any()
    torch.testing.assert_close(*(torch.autograd.grad(out.sum(), image)[0] for out in (result.image, image_64)))


@pytest.mark.parametrize("channels", [1, 2, 3, 16, 17, 33])
@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8], ids=str)
def test_memory_format_follows_the_image(channels, dtype, picture, tolerance):
    camera, view = fr.FisheyeCamera(CAMERAS[0], SMALL), fr.PinholeCamera(VIEWS[0], VIEW)
    image = as_dtype(picture(2, channels, *SMALL), dtype)
    plain = fr.rectify(image, camera, view).image
    assert plain.is_contiguous()
    last = fr.rectify(image.contiguous(memory_format=torch.channels_last), camera, view).image
    assert last.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(plain, last, rtol=tolerance.layout, atol=tolerance.layout)


@pytest.mark.parametrize("width", [1, 15, 16, 17, 255, 256, 257, 515])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_runs_of_pixels_of_any_length(width, dtype, picture, tolerance):
    """The kernels handle rows in runs of 256 pixels and 16 lanes: their ends are where mistakes live."""
    camera = fr.FisheyeCamera([150.0, 150, 260, 6, 0.02, 0, 0, 0], (12, 520))
    view = fr.PinholeCamera([120.0, 120, width / 2, 2], (5, width))
    image = picture(1, 2, 12, 520).to(dtype)
    result = fr.rectify(image, camera, view)
    exact, valid = expected("rectify", image, camera, view)
    assert torch.equal(result.valid, valid)
    torch.testing.assert_close(result.image.double(), exact, rtol=0, atol=INTERPOLATED[dtype](tolerance) * 10)


EVERYTHING = """
import torch, fisheyerec as fr

cameras = torch.tensor([[25.0, 26, 25.3, 18.1, 0.05, -0.01, 0.002, 0.001], [20, 20, 26, 18, -0.1, 0, 0, 0]])
views = torch.tensor([[20.0, 21, 21.2, 14.9]])
functions = ((fr.rectify, (37, 52)), (fr.distort, (31, 43)))
layouts = ((3, torch.contiguous_format), (3, torch.channels_last), (19, torch.channels_last))
results = []
for dtype in (torch.float64, torch.float32, torch.bfloat16, torch.float16, torch.uint8):
    number = torch.float64 if dtype == torch.float64 else torch.float32
    for channels, layout in layouts:
        for function, (height, width) in functions:
            # Smooth, so that a coordinate rounded across a pixel's edge finds nearly the same slope there.
            waves = torch.arange(2 * channels).reshape(2, channels, 1, 1) + torch.arange(height)[:, None] / 9
            image = torch.sin(waves + torch.arange(width) / 7).double() / 2 + 0.5
            image = (image * 255 if dtype == torch.uint8 else image).to(dtype).contiguous(memory_format=layout)
            leaves = [image, cameras.to(number), views.to(number)]
            leaves = [t.clone().requires_grad_(dtype != torch.uint8) for t in leaves]
            camera, view = fr.FisheyeCamera(leaves[1], (37, 52)), fr.PinholeCamera(leaves[2], (31, 43))
            order = (camera, view) if function is fr.rectify else (view, camera)
            out = function(leaves[0], *order, padding="border").image
            results.append(out.detach())
            if dtype != torch.uint8:
                results += torch.autograd.grad(out.double().sum(), leaves)
torch.save(results, "results.pt")
"""


def test_all_instruction_sets_agree(run_python, tmp_path, tolerance):
    """FISHEYEREC_ISA asks for less than the processor has; where it has no more, the same code runs thrice."""
    results = []
    for instruction_set in ("baseline", "avx2", "avx512"):
        done = run_python(EVERYTHING, FISHEYEREC_ISA=instruction_set)
        assert done.stderr == ""
        results.append(torch.load(tmp_path / "results.pt"))
    relative = {
        torch.float64: tolerance.reference,
        torch.float32: tolerance.float32_gradient,
        torch.bfloat16: tolerance.bfloat16,
        torch.float16: 2 * tolerance.float16,
    }
    for other in results[1:]:
        for ours, theirs in zip(results[0], other, strict=True):
            if ours.dtype == torch.uint8:
                difference = (ours.int() - theirs.int()).abs()
                assert difference.max() <= tolerance.uint8
                assert difference.double().mean() < 0.01
            else:
                scale = ours.double().abs().max()
                assert (ours.double() - theirs.double()).abs().max() <= relative[ours.dtype] * scale


def test_the_input_is_left_alone(picture):
    image = picture(2, 3, *SMALL)
    before = image.clone()
    fr.rectify(image, fr.FisheyeCamera(CAMERAS[0], SMALL), fr.PinholeCamera(VIEWS[0], VIEW))
    assert torch.equal(image, before)


def test_backends_have_names():
    assert fr.backend_for("cpu") == "native"
    assert fr.backend_for(torch.device("cuda", 0)) == "reference"
    assert _ops.backend_for("meta") == "reference"


@pytest.mark.parametrize("lens", ["wide_120", "gopro_chessboard", "profile_a7iii_laowa_15mm"], indirect=True)
def test_float32_looks_within_a_thousandth_of_a_pixel_at_4k(lens):
    """Pictures of their own coordinates, about the centre, show where each pixel was looked for."""
    camera = lens.resize((2160, 3840))
    whole = fr.PinholeCamera.edge_matched(camera, camera.image_size)
    y, x = torch.meshgrid(torch.arange(2160) - 1080, torch.arange(3840) - 1920, indexing="ij")
    coordinates = torch.stack([x, y])[None]
    for top in (0, 1070, 2100):
        view = whole.crop(0, top, (24, 3840))
        exact = fr.rectify(coordinates.double(), camera, view, padding="border")
        ours = fr.rectify(coordinates.float(), camera, view, padding="border")
        both = exact.valid & ours.valid
        assert both.double().mean() > 0.9
        assert ((ours.image - exact.image).abs() * both).max() < 1e-3
