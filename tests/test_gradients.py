"""Gradients: finite differences decide, reference.py agrees, and nothing but what was asked for is computed or kept."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import fisheyerec as fr
from fisheyerec import reference

FUNCTIONS = ["rectify", "distort"]
PADDINGS = ["zeros", "border"]
FORMATS = {"contiguous": torch.contiguous_format, "channels_last": torch.channels_last}
TILT = torch.from_numpy(cv2.Rodrigues(np.array([0.1, -0.25, 0.4]))[0])
NAMES = ["image", "camera", "view", "rotation"]


def inputs(lens, picture, function, *, batch=2, channels=2, camera_size=(6, 7), view_size=(5, 6), reach=0.8):
    """Image, camera params (B, 8), view params (B, 4), rotations (B, 3, 3): float64 leaves, all different.

    The view reaches 1 / reach as far as the edge-matched one.
    """
    camera = lens.resize(camera_size)
    view = fr.PinholeCamera.edge_matched(camera, view_size).params * [reach, reach, 1, 1]
    # Not on round numbers: bilinear interpolation has a kink at every pixel.
    off = 1 + 0.01 * np.random.default_rng(1).uniform(0.5, 1, (batch, 1))
    image = picture(batch, channels, *(camera_size if function == "rectify" else view_size))
    tensors = [image, torch.from_numpy(camera.params * off), torch.from_numpy(view * off)]
    turn = torch.from_numpy(cv2.Rodrigues(np.array([0.02, -0.03, 0.05]))[0])
    tensors.append(torch.stack([turn, turn.T.contiguous(), turn @ turn][:batch]))
    return [t.requires_grad_() for t in tensors], camera_size, view_size


def run(function, tensors, camera_size, view_size, **options):
    image, params, view_params, rotation = tensors
    camera, view = fr.FisheyeCamera(params, camera_size), fr.PinholeCamera(view_params, view_size)
    if function == "rectify":
        return fr.rectify(image, camera, view, rotation=rotation, **options)
    return fr.distort(image, view, camera, rotation=rotation, **options)


def run_reference(function, tensors, camera_size, view_size, padding="zeros"):
    image, params, view_params, rotation = tensors
    models = ["kannala_brandt", "pinhole"]
    if function == "rectify":
        return reference.resample(image, params, view_params, rotation, *models, *view_size, "bilinear", padding)[0]
    R = rotation.transpose(-1, -2)
    return reference.resample(image, view_params, params, R, *models[::-1], *camera_size, "bilinear", padding)[0]


def weights_like(tensor, seed=5):
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(tensor.shape)).to(tensor)


# --- Finite differences ---------------------------------------------------------------------------

GRADCHECK_LENSES = [
    "wide_120",
    "over_180_equidistant_220",
    "folds_in_frame",
    "squeezed_off_centre",
    "runs_wild_beyond_frame",
    "gopro_chessboard",
]


@pytest.mark.parametrize("lens", GRADCHECK_LENSES, indirect=True)
@pytest.mark.parametrize("memory_format", FORMATS)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_gradcheck(function, padding, memory_format, lens, picture):
    """Image, eight lens parameters, four view parameters and the rotation at once."""
    tensors, *sizes = inputs(lens, picture, function)
    tensors[0] = tensors[0].detach().contiguous(memory_format=FORMATS[memory_format]).requires_grad_()
    assert run(function, tensors, *sizes).valid.double().mean() > 0.1
    assert torch.autograd.gradcheck(lambda *t: run(function, t, *sizes, padding=padding).image, tensors)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("offset", [0.0, 1e-13, 1e-9, 1e-7, 1e-5])
def test_gradcheck_near_the_axis(offset, function, picture):
    """A pixel on the axis exactly, or a hair beside it; its coordinate in the picture is not an integer."""
    camera_centre, view_centre = ((2.7, 3.3), (2.0, 2.0)) if function == "rectify" else ((3.0, 3.0), (2.4, 1.6))
    camera = torch.tensor([[4.0, 4.1, *camera_centre, 0.05, -0.01, 0.02, 0.003]], dtype=torch.float64)
    view = torch.tensor([[3.0, 3.2, *view_centre]], dtype=torch.float64)
    (camera if function == "distort" else view)[0, 2:4] += torch.tensor([offset, -offset / 2])
    image = picture(1, 2, *((6, 7) if function == "rectify" else (5, 5)))
    tensors = [image, camera, view]
    for tensor in tensors:
        tensor.requires_grad_()
    function_of = lambda *t: run(function, [*t, None], (6, 7), (5, 5)).image  # noqa: E731
    assert torch.autograd.gradcheck(function_of, tensors)


@pytest.mark.parametrize("lens", ["folds_in_frame", "folds_and_rises_again", "profile_philips_folds"], indirect=True)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_gradcheck_at_the_rim(function, lens, picture):
    """Rays from 90 % to 99.9 % of theta_max, where the lens' slope vanishes."""
    tensors, *sizes = inputs(lens, picture, function, batch=1, camera_size=(25, 26), view_size=(1, 9))
    camera = fr.FisheyeCamera(tensors[1][0].detach().numpy(), sizes[0])
    if function == "rectify":
        # The view's row of nine pixels walks outwards along x.
        far, near = (math.tan(f * camera.theta_max) for f in (0.999, 0.9))
        focal = 8 / (far - near)
        view, rotation = [focal, focal, -near * focal, 0.3], torch.eye(3, dtype=torch.float64)
        tensors[2] = torch.tensor([view], dtype=torch.float64, requires_grad=True)
        tensors[3] = rotation[None].requires_grad_()
    else:
        # The fisheye picture's row of nine pixels does; the view is wide enough to be read everywhere.
        k = camera.params[4:]
        at = [t * (1 + sum(k[i] * t ** (2 * i + 2) for i in range(4))) for t in camera.theta_max * np.array([0.9, 1])]
        radius, limit = at
        focal = 8 / (limit * 0.9995 - radius)
        tensors[1] = torch.tensor([[focal, focal, -radius * focal, 0.3, *k]], dtype=torch.float64, requires_grad=True)
        tensors[0] = picture(1, 2, 25, 26).requires_grad_()
        f = 12 / math.tan(camera.theta_max)
        tensors[2] = torch.tensor([[f, f, 11.3, 12.2]], dtype=torch.float64, requires_grad=True)
        tensors[3] = torch.eye(3, dtype=torch.float64)[None].requires_grad_()
        sizes = [(1, 9), (25, 26)]
    assert run(function, tensors, *sizes).valid.double().mean() > 0.5
    # Small steps: close to the rim the second derivative is large.
    assert torch.autograd.gradcheck(lambda *t: run(function, t, *sizes).image, tensors, eps=1e-8, atol=1e-4, rtol=1e-3)


# --- Exact values ---------------------------------------------------------------------------------


@pytest.mark.parametrize("padding", PADDINGS)
def test_integer_coordinates_of_a_pinhole(padding, tolerance):
    """A view of itself reads every pixel at integer coordinates, where floor = ceil would make the gradient vanish.

    The picture a x + b y has a derivative there: d out / d(source cx) = a, and minus that for the target.
    """
    a, b = 0.3, -0.7
    y, x = torch.meshgrid(torch.arange(8.0), torch.arange(9.0), indexing="ij")
    x, y = x.double(), y.double()
    image = (a * x + b * y)[None, None]
    fx, fy, cx, cy = 6.0, 7.0, 4.0, 3.0
    source = torch.tensor([[fx, fy, cx, cy]], dtype=torch.float64, requires_grad=True)
    target = source.detach().clone().requires_grad_()
    out, _ = fr.resample(image, fr.PinholeCamera(source, (8, 9)), fr.PinholeCamera(target, (8, 9)), padding=padding)
    torch.testing.assert_close(out, image, rtol=0, atol=tolerance.rounding * 10)
    weights = torch.zeros_like(image)
    weights[..., 1:-1, 1:-1] = weights_like(image)[..., 1:-1, 1:-1]
    (out * weights).sum().backward()
    w = weights[0, 0]
    expected = [(w * a * (x - cx)).sum() / fx, (w * b * (y - cy)).sum() / fy, a * w.sum(), b * w.sum()]
    expected = torch.stack([torch.as_tensor(e, dtype=torch.float64) for e in expected])[None]
    torch.testing.assert_close(source.grad, expected, rtol=tolerance.rounding * 100, atol=1e-12)
    torch.testing.assert_close(target.grad, -expected, rtol=tolerance.rounding * 100, atol=1e-12)


def test_integer_coordinates_of_a_fisheye(tolerance):
    """The same through a lens: d x / d k_i = fx theta^(2i+1) cos phi, exactly undone by the target's own k_i."""
    a, b, size = 0.3, -0.7, (9, 10)
    camera = fr.FisheyeCamera([5.0, 5.5, 4.0, 4.0, 0.05, -0.02, 0.01, 0.002], size)
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(10.0), indexing="ij")
    image = (a * x.double() + b * y.double())[None, None]
    source = torch.from_numpy(camera.params)[None].requires_grad_()
    target = source.detach().clone().requires_grad_()
    out, valid = fr.resample(image, fr.FisheyeCamera(source, size), fr.FisheyeCamera(target, size))
    assert valid.all()
    weights = torch.zeros_like(image)
    weights[..., 1:-1, 1:-1] = weights_like(image)[..., 1:-1, 1:-1]
    (out * weights).sum().backward()

    rays, _ = camera.unproject(np.stack([x.numpy(), y.numpy()], -1).astype(float))
    theta, phi = np.arccos(np.clip(rays[..., 2], -1, 1)), np.arctan2(rays[..., 1], rays[..., 0])
    w, (fx, fy, cx, cy) = weights[0, 0].numpy(), camera.params[:4]
    x, y = x.double().numpy(), y.double().numpy()
    expected = [(w * a * (x - cx)).sum() / fx, (w * b * (y - cy)).sum() / fy, a * w.sum(), b * w.sum()]
    for i in range(1, 5):
        along = theta ** (2 * i + 1)
        expected.append((w * along * (a * fx * np.cos(phi) + b * fy * np.sin(phi))).sum())
    np.testing.assert_allclose(source.grad[0].numpy(), expected, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(target.grad, -source.grad, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_repeated_camera_gathers_the_gradients_of_all_images(function, lens, picture, tolerance):
    tensors, *sizes = inputs(lens, picture, function, batch=3)
    once = [tensors[0]] + [t[:1].detach().clone().requires_grad_() for t in tensors[1:]]
    each = [tensors[0]] + [t.detach().expand(3, *t.shape[1:]).clone().requires_grad_() for t in once[1:]]
    outs = [run(function, t, *sizes).image for t in (once, each)]
    assert torch.equal(*outs)
    weights = weights_like(outs[0])
    grads = [torch.autograd.grad(out, t, weights) for out, t in zip(outs, (once, each), strict=True)]
    for a, b in zip(*(g[1:] for g in grads), strict=True):
        torch.testing.assert_close(a, b.sum(0, keepdim=True), rtol=tolerance.rounding * 10, atol=1e-9)


# --- Against plain torch --------------------------------------------------------------------------


@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_gradients_are_those_of_the_reference(lens, function, padding, picture, tolerance):
    tensors, *sizes = inputs(lens, picture, function, camera_size=(22, 27), view_size=(20, 25))
    outs = run(function, tensors, *sizes, padding=padding).image, run_reference(function, tensors, *sizes, padding)
    weights = weights_like(outs[0])
    ours, theirs = (torch.autograd.grad(out, tensors, weights) for out in outs)
    for name, a, b in zip(NAMES, ours, theirs, strict=True):
        assert a.isfinite().all(), name
        # Parameters differ in nature: each is compared on its own scale.
        scale = b.abs().amax() if name in ("image", "rotation") else b.abs().amax(0)
        assert ((a - b).abs() <= tolerance.reference * scale + 1e-10).all(), name


@pytest.mark.parametrize("lens", ["wide_120", "over_180_equidistant_220", "runs_wild_beyond_frame"], indirect=True)
@pytest.mark.parametrize("memory_format", FORMATS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_float32_gradients_are_close_to_float64(function, memory_format, lens, picture, tolerance):
    sizes = {"camera_size": (96, 128), "view_size": (90, 120)}
    tensors, *sizes = inputs(lens, picture, function, channels=3, reach=0.9, **sizes)
    shape = sizes[1] if function == "rectify" else sizes[0]
    weights = picture(2, 3, *shape, seed=9) - 0.3
    # A picture of its own coordinates tells where the kinks of bilinear interpolation lie: a coordinate that float32
    # rounds across one takes the neighbouring slope.
    ramp = torch.stack(torch.meshgrid(*(torch.arange(n).double() for n in tensors[0].shape[:1:-1]), indexing="xy"))
    at = run(function, [ramp.expand(2, -1, -1, -1), *tensors[1:]], *sizes, padding="border").image
    weights = weights * ((at - at.round()).abs() > 1e-3).all(1, keepdim=True)
    assert (weights != 0).double().mean() > 0.2

    def gradients(dtype):
        leaves = [t.detach().to(dtype).requires_grad_() for t in tensors]
        image = leaves[0].contiguous(memory_format=FORMATS[memory_format])
        out = run(function, [image, *leaves[1:]], *sizes).image
        return torch.autograd.grad(out, leaves, weights.to(dtype))

    for name, single, double in zip(NAMES, gradients(torch.float32), gradients(torch.float64), strict=True):
        assert single.dtype == torch.float32
        scale = double.abs().amax() if name in ("image", "rotation") else double.abs().amax(0)
        error = ((single.double() - double).abs() / scale).max()
        assert error < tolerance.float32_gradient, name


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_half_precision_gradients_are_summed_in_float32(function, dtype, picture, tolerance):
    """All 2000 pixels of the view read the same two by two: a sum in half precision would stall at 256 or 2048."""
    camera = fr.FisheyeCamera(torch.tensor([1e-3, 1e-3, 1.5, 1.5, 0, 0, 0, 0], dtype=torch.float64), (4, 4))
    view = fr.PinholeCamera.from_fov(100, (40, 50))
    if function == "distort":  # the mirror: a fisheye of 2000 pixels, a tiny pinhole picture
        camera = fr.FisheyeCamera.from_projection("equidistant", 100, (40, 50))
        view = fr.PinholeCamera([1e-3, 1e-3, 1.5, 1.5], (4, 4))
    image = torch.ones(1, 2, 4, 4, dtype=dtype, requires_grad=True)
    out = (fr.rectify(image, camera, view) if function == "rectify" else fr.distort(image, view, camera)).image
    out.sum().backward()
    assert image.grad.dtype == dtype
    torch.testing.assert_close(
        image.grad[0, 0, 1:3, 1:3].double(), torch.full((2, 2), 500.0).double(), rtol=0.01, atol=0
    )


@pytest.mark.parametrize("params_dtype", [torch.float64, torch.float32, torch.bfloat16, torch.float16], ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16, torch.float16], ids=str)
def test_gradients_have_the_dtype_and_layout_of_what_they_belong_to(dtype, params_dtype, lens_of_any_dtype, picture):
    params, view_params, rotation = (t.to(params_dtype).requires_grad_() for t in lens_of_any_dtype)
    image = picture(1, 3, 16, 16).to(dtype).contiguous(memory_format=torch.channels_last).requires_grad_()
    out = fr.rectify(
        image, fr.FisheyeCamera(params, (16, 16)), fr.PinholeCamera(view_params, (12, 12)), rotation=rotation
    ).image
    out.sum().backward()
    assert image.grad.dtype == dtype
    assert image.grad.is_contiguous(memory_format=torch.channels_last)
    for tensor in (params, view_params, rotation):
        assert tensor.grad.dtype == params_dtype
        assert tensor.grad.shape == tensor.shape
        assert tensor.grad.isfinite().all()
        assert (tensor.grad != 0).any()


@pytest.fixture
def lens_of_any_dtype():
    """Numbers that bfloat16 holds exactly."""
    values = [[8.0, 8, 7.5, 7.25, 0.0625, 0, 0, 0], [7.0, 7, 5.5, 5.25], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]]
    return [torch.tensor(v, dtype=torch.float64) for v in values]


# --- Only what was asked for ----------------------------------------------------------------------


class Recorder(TorchDispatchMode):
    """Keeps the arguments and results of every call of the backward op."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if func.name() == "fisheyerec::resample_backward":
            self.calls.append((args, out))
        return out


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("wanted", [w for w in itertools.product([True, False], repeat=4) if any(w)], ids=str)
def test_only_requested_gradients_are_computed(wanted, function, picture, lens_of_any_dtype, tolerance):
    image = picture(2, 2, 16, 16)
    params, view_params, rotation = (t.expand(2, *t.shape).clone() for t in lens_of_any_dtype)
    everything = [image, params, view_params, rotation]

    def gradients(flags):
        leaves = [t.clone().requires_grad_(flag) for t, flag in zip(everything, flags, strict=True)]
        out = run(function, leaves, (16, 16), (16, 16)).image
        with Recorder() as recorder:
            out.backward(torch.ones_like(out))
        ((_, results),) = recorder.calls
        return [leaf.grad for leaf in leaves], results

    all_leaves, _ = gradients([True] * 4)
    leaves, results = gradients(wanted)
    order = [0, 1, 2, 3] if function == "rectify" else [0, 2, 1, 3]  # image, source, target, rotation
    for flag, result in zip([wanted[i] for i in order], results, strict=True):
        assert (result.numel() > 0) == flag
        assert flag or result.shape == (0,)
    for flag, leaf, full in zip(wanted, leaves, all_leaves, strict=True):
        assert (leaf is not None) == flag
        if leaf is not None:  # other sums are compiled when fewer gradients are asked for
            torch.testing.assert_close(leaf, full, rtol=tolerance.rounding, atol=tolerance.rounding * full.abs().max())


def test_forward_keeps_its_inputs_and_nothing_else(picture, lens_of_any_dtype):
    image = picture(2, 3, 64, 64).requires_grad_()
    params, view_params, rotation = (t.expand(2, *t.shape).clone().requires_grad_() for t in lens_of_any_dtype)
    saved = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: saved.append(t) or t, lambda t: t):
        out = run("rectify", [image, params, view_params, rotation], (64, 64), (100, 100)).image
    inputs_bytes = sum(t.nbytes for t in (image, params, view_params, rotation))
    assert sum(t.nbytes for t in saved) == inputs_bytes
    own = {t.untyped_storage().data_ptr() for t in (image, params, view_params, rotation)}
    assert {t.untyped_storage().data_ptr() for t in saved} <= own
    assert out.requires_grad


def test_nothing_is_kept_without_gradients(picture, lens_of_any_dtype):
    params, view_params, _ = lens_of_any_dtype
    saved = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: saved.append(t) or t, lambda t: t):
        out = run("rectify", [picture(1, 3, 64, 64), params, view_params, None], (64, 64), (100, 100)).image
    assert saved == []
    assert not out.requires_grad


@pytest.mark.parametrize("which", [0, 1, 2, 3], ids=["image", "lens", "view", "rotation"])
def test_forward_mode_says_no(picture, lens_of_any_dtype, which):
    tensors = [picture(1, 1, 16, 16), *lens_of_any_dtype]

    def straighten(tensor):
        return run("rectify", [*tensors[:which], tensor, *tensors[which + 1 :]], (16, 16), (12, 12)).image

    with pytest.raises(RuntimeError, match=r"expected derivatives in reverse mode; forward mode .* is not supported"):
        torch.func.jvp(straighten, (tensors[which],), (torch.ones_like(tensors[which]),))


def test_double_backward_says_no(picture, lens_of_any_dtype):
    params, view_params, rotation = (t.requires_grad_() for t in lens_of_any_dtype)
    image = picture(1, 1, 16, 16).requires_grad_()
    out = run("rectify", [image, params, view_params, rotation], (16, 16), (12, 12)).image
    (gradient,) = torch.autograd.grad(out.square().sum(), params, create_graph=True)
    with pytest.raises(RuntimeError, match=r"expected a first derivative; double backward .* is not supported"):
        gradient.sum().backward()


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_an_integer_image_gives_no_gradient_silently_wrong(interpolation, function, lens_of_any_dtype):
    params, view_params, rotation = (t.requires_grad_() for t in lens_of_any_dtype)
    image = torch.zeros(1, 3, 16, 16, dtype=torch.uint8)

    def backward():
        out = run(function, [image, params, view_params, rotation], (16, 16), (16, 16), interpolation=interpolation)
        out.image.sum().backward()

    with pytest.raises((ValueError, RuntimeError), match=r"floating|require gradients|does not require grad"):
        backward()


def test_nearest_gives_the_image_a_gradient_and_the_cameras_zero(picture, lens_of_any_dtype):
    params, view_params, rotation = (t.requires_grad_() for t in lens_of_any_dtype)
    image = picture(1, 2, 16, 16).requires_grad_()
    out = run("rectify", [image, params, view_params, rotation], (16, 16), (12, 12), interpolation="nearest").image
    out.sum().backward()
    assert image.grad.sum() == (out != 0).sum()
    assert all((t.grad == 0).all() for t in (params, view_params, rotation))


# --- Any number of threads ------------------------------------------------------------------------

# (B, C, H, W) of the image and (h, w) of the result: all of them more than the 16384 values below which one thread
# does it all.
PARALLEL = {
    "one_picture": ((1, 3, 160, 200), (150, 190)),
    "batch": ((5, 2, 64, 70), (60, 66)),
    "many_channels": ((2, 33, 30, 40), (28, 36)),
    "one_channel": ((1, 1, 200, 150), (170, 140)),
    "tall": ((1, 2, 700, 20), (600, 18)),
    "few_rows": ((1, 3, 2, 4000), (2, 3900)),
}


@pytest.mark.parametrize("memory_format", FORMATS)
@pytest.mark.parametrize("shapes", PARALLEL.values(), ids=PARALLEL)
@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16], ids=str)
def test_bits_do_not_depend_on_threads(dtype, function, shapes, memory_format, picture, threads):
    (batch, channels, *source), target = shapes
    camera_size, view_size = (tuple(source), target) if function == "rectify" else (target, tuple(source))
    focal = max(camera_size) / 2.2
    centre = [(camera_size[1] - 1) / 2, (camera_size[0] - 1) / 2]
    params = torch.tensor([[focal, focal, *centre, 0.03, -0.01, 0.02, 0.001]], dtype=torch.float64).repeat(batch, 1)
    view = fr.PinholeCamera.from_fov(80, view_size).params
    tensors = [
        picture(batch, channels, *source).to(dtype).contiguous(memory_format=FORMATS[memory_format]),
        params,
        torch.from_numpy(view)[None].repeat(batch, 1),
        TILT[None].repeat(batch, 1, 1) if function == "rectify" else torch.eye(3).double()[None],
    ]
    weights = None

    def everything():
        nonlocal weights
        leaves = [t.detach().clone(memory_format=torch.preserve_format).requires_grad_() for t in tensors]
        result = run(function, leaves, camera_size, view_size)
        weights = weights_like(result.image) if weights is None else weights
        return [result.image, result.valid, *torch.autograd.grad(result.image, leaves, weights)]

    threads(1)
    expected = everything()
    assert expected[0].numel() > 16384
    assert expected[1].any()
    for count in (2, 3, 5):
        threads(count)
        for name, a, b in zip(["out", "valid", *NAMES], expected, everything(), strict=True):
            assert torch.equal(a, b), f"{name} with {count} threads"


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_bits_of_grey_levels_do_not_depend_on_threads(interpolation, picture, threads):
    camera = fr.FisheyeCamera([90.0, 90, 99.5, 79.5, 0.03, 0, 0, 0], (160, 200))
    image = (picture(1, 3, 160, 200) * 255).to(torch.uint8)
    view = fr.PinholeCamera.from_fov(90, (150, 190))
    results = []
    for count in (1, 2, 3, 5):
        threads(count)
        results.append(fr.rectify(image, camera, view, interpolation=interpolation).image)
    assert all(torch.equal(results[0], other) for other in results[1:])
