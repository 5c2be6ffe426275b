"""What torch expects of an op: opcheck, compile, export, vmap, autocast, forked processes, other devices."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

import fisheyerec as fr
from fisheyerec import _ops  # noqa: F401  registers the ops

SIZE = (18, 20)
VIEW = fr.PinholeCamera([12.0, 12.5, 7.3, 6.1], (13, 15))
LENSES = torch.tensor(
    [[9.0, 9.5, 9.6, 8.3, 0.05, -0.01, 0.002, 0], [8, 8, 9.1, 8.8, -0.3, 0, 0, 0], [11, 10, 9, 9, 0, 0, 0, 0]]
)
ROTATIONS = torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], [[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]])


def noise(*shape, dtype=torch.float32, seed=0):
    values = torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (values if dtype.is_floating_point else values * 255).to(dtype)


# --- opcheck --------------------------------------------------------------------------------------

# Name: dtype, (B, C), channels_last, lenses, views, rotations, source and target models, interpolation, padding.
KB, PINHOLE, CYLINDER, PANINI = "kannala_brandt", "pinhole", "cylindrical", "panini"
SAMPLES = {
    "rectify": (torch.float32, (2, 3), False, 2, 1, None, (KB, PINHOLE), "bilinear", "zeros"),
    "distort": (torch.float32, (2, 3), False, 2, 1, None, (PINHOLE, KB), "bilinear", "zeros"),
    "border": (torch.float32, (2, 3), False, 1, 1, None, (KB, PINHOLE), "bilinear", "border"),
    "float64": (torch.float64, (1, 1), False, 1, 1, 1, (KB, PINHOLE), "bilinear", "zeros"),
    "bfloat16": (torch.bfloat16, (2, 3), False, 2, 2, None, (KB, PINHOLE), "bilinear", "zeros"),
    "float16_channels_last": (torch.float16, (2, 3), True, 2, 2, None, (KB, PINHOLE), "bilinear", "border"),
    "channels_last": (torch.float32, (2, 3), True, 2, 1, 2, (KB, PINHOLE), "bilinear", "zeros"),
    "distort_turned": (torch.float64, (2, 2), True, 1, 2, 2, (PINHOLE, KB), "bilinear", "border"),
    "grey_levels": (torch.uint8, (2, 3), False, 2, 1, 1, (KB, PINHOLE), "bilinear", "zeros"),
    "labels": (torch.int64, (2, 1), False, 1, 1, None, (KB, PINHOLE), "nearest", "zeros"),
    "masks": (torch.bool, (1, 2), False, 1, 1, None, (PINHOLE, KB), "nearest", "border"),
    "nearest": (torch.float32, (2, 3), True, 2, 1, 2, (KB, PINHOLE), "nearest", "zeros"),
    "between_views": (torch.float32, (2, 3), False, 2, 1, 2, (PINHOLE, PINHOLE), "bilinear", "zeros"),
    "between_lenses": (torch.float32, (2, 3), False, 2, 1, 2, (KB, KB), "bilinear", "zeros"),
    "cylindrical": (torch.float32, (2, 3), False, 2, 1, 2, (KB, CYLINDER), "bilinear", "zeros"),
    "panini": (torch.float64, (1, 2), True, 1, 1, None, (KB, PANINI), "bilinear", "zeros"),
    "distort_panini": (torch.float32, (2, 3), False, 1, 2, 1, (PANINI, KB), "bilinear", "border"),
    "empty_batch": (torch.float32, (0, 3), False, 1, 1, 1, (KB, PINHOLE), "bilinear", "zeros"),
    "no_channels": (torch.float32, (2, 0), False, 1, 1, None, (KB, PINHOLE), "bilinear", "zeros"),
}


def sample_arguments(name, grad):
    dtype, shape, channels_last, lenses, views, rotations, models, interpolation, padding = SAMPLES[name]
    grad = grad and dtype.is_floating_point
    params_dtype = torch.float64 if dtype == torch.float64 else torch.float32
    of_view = lambda count, *more: torch.tensor([[*VIEW.params, *more]], dtype=params_dtype).repeat(count, 1)  # noqa: E731
    of_model = {
        KB: lambda count: LENSES[:count].to(params_dtype),
        PINHOLE: of_view,
        CYLINDER: of_view,
        PANINI: lambda count: of_view(count, 0.8),
    }
    image = noise(*shape, *SIZE, dtype=dtype)
    image = image.contiguous(memory_format=torch.channels_last) if channels_last else image
    tensors = [image, *(of_model[m](n) for m, n in zip(models, (lenses, views), strict=True))]
    tensors.append(None if rotations is None else ROTATIONS[:rotations].to(params_dtype))
    tensors = [t if t is None else t.clone().requires_grad_(grad) for t in tensors]
    return tensors, models, (13, 15), interpolation, padding


@pytest.mark.parametrize("grad", [True, False], ids=["grad", "no_grad"])
@pytest.mark.parametrize("name", SAMPLES)
def test_opcheck_forward(name, grad):
    tensors, models, size, interpolation, padding = sample_arguments(name, grad)
    torch.library.opcheck(torch.ops.fisheyerec.resample.default, (*tensors, *models, *size, interpolation, padding))


@pytest.mark.parametrize("needs", [(True, True, True, True), (True, False, False, False), (False, True, False, False)])
@pytest.mark.parametrize("name", [name for name, sample in SAMPLES.items() if sample[0].is_floating_point])
def test_opcheck_backward(name, needs):
    tensors, models, size, interpolation, padding = sample_arguments(name, False)
    grad = noise(*tensors[0].shape[:2], *size, dtype=tensors[0].dtype, seed=1)
    needs = (*needs[:3], needs[3] and tensors[3] is not None)
    arguments = (grad, *tensors, *models, interpolation, padding, *needs)
    torch.library.opcheck(torch.ops.fisheyerec.resample_backward.default, arguments)


WRONG_GRADIENTS = {
    "dtype": lambda g: g.double(),
    "batch": lambda g: g[:1],
    "more_images": lambda g: torch.cat([g, g]),
    "channels": lambda g: g[:, :1],
    "dimensions": lambda g: g[0],
    "scalar": lambda g: g.sum(),
    "no_pixels": lambda g: g[..., :0],
}


@pytest.mark.parametrize("wrong", WRONG_GRADIENTS.values(), ids=WRONG_GRADIENTS)
def test_a_wrong_gradient_is_an_error_not_a_crash(wrong):
    tensors, models, size, *options = sample_arguments("rectify", False)
    grad = wrong(noise(*tensors[0].shape[:2], *size))
    with pytest.raises(RuntimeError, match=r"fisheyerec::resample_backward\(\): expected"):
        torch.ops.fisheyerec.resample_backward(grad, *tensors, *models, *options, True, True, True, False)


WRONG_ARGUMENTS = {
    "image_dimensions": {0: lambda t: t[0]},
    "image_dtype": {0: lambda t: t.to(torch.complex64)},
    "image_without_pixels": {0: lambda t: t[..., :0]},
    "source_count": {1: lambda t: t[:, :7]},
    "source_batch": {1: lambda t: t.repeat(3, 1)},
    "source_dtype": {1: lambda t: t.half()},
    "target_count": {2: lambda t: t[:, :3]},
    "target_without_batch": {2: lambda t: t[0]},
    "rotation_shape": {3: lambda t: torch.eye(2)[None]},
    "source_model": {4: lambda t: "fisheye"},
    "target_model": {5: lambda t: ""},
    "height": {6: lambda t: 0},
    "width": {7: lambda t: -3},
    "interpolation": {8: lambda t: "bicubic"},
    "padding": {9: lambda t: "reflection"},
}


@pytest.mark.parametrize("wrong", WRONG_ARGUMENTS.values(), ids=WRONG_ARGUMENTS)
def test_a_wrong_argument_of_the_bare_op_is_an_error_not_a_crash(wrong):
    """The op itself is public to torch: it may be called past all checks in Python."""
    tensors, models, size, *options = sample_arguments("rectify", False)
    arguments = [*tensors, *models, *size, *options]
    for index, change in wrong.items():
        arguments[index] = change(arguments[index])
    with pytest.raises(RuntimeError, match=r"fisheyerec::resample\(\): "):
        torch.ops.fisheyerec.resample(*arguments)


# --- compile and export ---------------------------------------------------------------------------


class Model(nn.Module):
    """A small network around the layer: it guesses the lens from the picture, rectifies, and goes on."""

    def __init__(self, view=VIEW, **options):
        super().__init__()
        torch.manual_seed(0)
        self.before = nn.Conv2d(3, 4, 3, padding=1)
        self.guess = nn.Linear(4, 8)
        self.layer = fr.DistortionRectification(view, **options)
        self.after = nn.Conv2d(4, 2, 3)
        self.register_buffer("lens", LENSES[0])

    def forward(self, image):
        features = self.before(image)
        params = self.lens * (1 + 0.01 * self.guess(features.mean((-2, -1))))
        return self.after(self.layer(features, params))


def gradients(model, call, image):
    model.zero_grad()
    image = image.clone().requires_grad_()
    out = call(image)
    out.square().sum().backward()
    return [out.detach(), image.grad, *(p.grad for p in model.parameters())]


@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last], ids=["contiguous", "last"])
@pytest.mark.parametrize("backend", ["eager", "aot_eager", "inductor"])
def test_compile_whole_graphs_forward_and_backward(backend, memory_format):
    torch.compiler.reset()
    model = Model().to(memory_format=memory_format)
    image = noise(2, 3, *SIZE).contiguous(memory_format=memory_format)
    compiled = torch.compile(model, fullgraph=True, backend=backend)
    expected = gradients(model, model, image)
    for ours, theirs in zip(gradients(model, compiled, image), expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_compile_with_any_batch_and_size():
    torch.compiler.reset()

    def straighten(image, params):
        camera = fr.FisheyeCamera(params, (image.shape[-2], image.shape[-1]))
        result = fr.rectify(image, camera, VIEW)
        return result.image * result.valid

    compiled = torch.compile(straighten, fullgraph=True, dynamic=True, backend="aot_eager")
    for batch, height, width in ((2, 18, 20), (3, 22, 17), (1, 9, 9)):
        image, params = noise(batch, 3, height, width), LENSES[:batch].clone().requires_grad_()
        assert torch.equal(compiled(image, params), straighten(image, params))


def test_compile_a_batch_of_lenses_after_batches_of_other_sizes():
    torch.compiler.reset()
    own = fr.DistortionRectification(VIEW, camera=fr.FisheyeCamera(LENSES[0], SIZE))
    compiled = torch.compile(own, fullgraph=True, backend="aot_eager")
    for batch in (1, 3):  # from now on the batch of images is a symbol, that of lenses still a number
        compiled(noise(batch, 3, *SIZE))
    layer = fr.DistortionRectification(VIEW)
    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(noise(2, 3, *SIZE), LENSES[:2]), layer(noise(2, 3, *SIZE), LENSES[:2]))


def test_compile_with_a_rotation_and_distort():
    torch.compiler.reset()

    def there_and_back(image, params, rotation):
        camera = fr.FisheyeCamera(params, SIZE)
        straight = fr.rectify(image, camera, VIEW, rotation=rotation)
        return fr.distort(straight.image, VIEW, camera, rotation=rotation, padding="border").image

    arguments = noise(2, 3, *SIZE), LENSES[:2], ROTATIONS
    compiled = torch.compile(there_and_back, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(*arguments), there_and_back(*arguments))


@pytest.mark.parametrize("strict", [True, False], ids=["strict", "non_strict"])
@pytest.mark.parametrize("dynamic", [False, True], ids=["static", "dynamic"])
def test_export(dynamic, strict):
    model = Model().eval()
    image = noise(2, 3, *SIZE)
    batch = torch.export.Dim("batch", min=1, max=64)
    shapes = {"image": {0: batch}} if dynamic else None
    program = torch.export.export(model, (image,), dynamic_shapes=shapes, strict=strict)
    torch.testing.assert_close(program.module()(image), model(image))
    assert any("fisheyerec.resample" in str(node.target) for node in program.graph.nodes)
    if dynamic:
        more = noise(5, 3, *SIZE, seed=3)
        torch.testing.assert_close(program.module()(more), model(more))


def test_an_exported_program_survives_a_file(tmp_path):
    model = Model().eval()
    image = noise(2, 3, *SIZE)
    torch.export.save(torch.export.export(model, (image,)), tmp_path / "model.pt2")
    torch.testing.assert_close(torch.export.load(tmp_path / "model.pt2").module()(image), model(image))


# --- The layer ------------------------------------------------------------------------------------


def test_the_layer_has_no_state_of_its_own():
    layer = fr.DistortionRectification(VIEW)
    assert layer.state_dict() == {}
    assert list(layer.parameters()) == []
    assert layer.half().view.params.dtype == torch.float64
    assert "pinhole" in repr(layer).lower()


def test_the_layer_learns_its_view():
    params = nn.Parameter(torch.from_numpy(VIEW.params).float())
    layer = fr.DistortionRectification(fr.PinholeCamera(params, VIEW.image_size))
    assert [p is params for p in layer.parameters()] == [True]
    layer(noise(2, 3, *SIZE), LENSES[:2]).sum().backward()
    assert (params.grad != 0).all()


@pytest.mark.parametrize("params", [LENSES[0], LENSES[:2]], ids=["one", "batch"])
def test_the_layer_with_a_camera_of_its_own_stands_in_a_sequence(params):
    image = noise(2, 3, *SIZE)
    layer = fr.DistortionRectification(VIEW, camera=fr.FisheyeCamera(params, SIZE))
    model = nn.Sequential(layer, nn.Conv2d(3, 4, 3)).half().float()
    assert torch.equal(model(image), model[1](fr.DistortionRectification(VIEW)(image, params)))
    assert torch.equal(layer(image, LENSES[1]), fr.DistortionRectification(VIEW)(image, LENSES[1]))
    assert [name for name, _ in model.named_parameters()] == ["1.weight", "1.bias"]
    assert repr(layer.camera) in repr(model)


def test_the_layer_learns_its_camera():
    params = nn.Parameter(LENSES[0].clone())
    layer = fr.DistortionRectification(VIEW, camera=fr.FisheyeCamera(params, SIZE))
    assert [p is params for p in layer.parameters()] == [True]
    layer(noise(2, 3, *SIZE)).sum().backward()
    assert (params.grad != 0).all()


@pytest.mark.parametrize("params", [LENSES[0], LENSES[:1], LENSES[:2]], ids=["one", "batch_of_one", "batch"])
def test_the_layer_is_rectify(params):
    image = noise(2, 3, *SIZE)
    expected = fr.rectify(image, fr.FisheyeCamera(params, SIZE), VIEW, rotation=ROTATIONS, padding="border").image
    layer = fr.DistortionRectification(VIEW, padding="border")
    assert torch.equal(layer(image, params, ROTATIONS), expected)


# --- vmap -----------------------------------------------------------------------------------------


def rectified(image, params, view=None, rotation=None):
    """One image or a batch of them, as the params have it."""
    camera = fr.FisheyeCamera(params, SIZE)
    view = VIEW if view is None else fr.PinholeCamera(view, VIEW.image_size)
    batch = image[None] if image.ndim == 3 else image
    return fr.rectify(batch, camera, view, rotation=rotation).image


VIEWS = torch.from_numpy(VIEW.params).float() * torch.tensor([[1.0], [1.1], [0.9]])
VMAPPED = {
    "image": (0, None, None, None),
    "params": (None, 0, None, None),
    "image_and_params": (0, 0, None, None),
    "view": (None, None, 0, None),
    "rotation": (None, None, None, 0),
    "all": (0, 0, 0, 0),
    "channels_last_dimension": (3, 1, 1, 2),
}


@pytest.mark.parametrize("in_dims", VMAPPED.values(), ids=VMAPPED)
@pytest.mark.parametrize("batched", [False, True], ids=["one_image", "batch_inside"])
def test_vmap_is_a_loop(in_dims, batched):
    """Over three cases; `batch_inside` maps a function that itself takes a batch of two."""
    inner = (2,) if batched else ()
    everything = [
        noise(3, *inner, 3, *SIZE),
        LENSES[:, None].repeat(1, 2, 1) * (1 + 0.01 * noise(3, 2, 8)) if batched else LENSES,
        VIEWS,
        torch.cat([ROTATIONS, torch.eye(3)[None]]),
    ]
    arguments = [t[0] if dim is None else t.movedim(0, dim) for t, dim in zip(everything, in_dims, strict=True)]
    mapped = torch.vmap(rectified, in_dims=in_dims)(*arguments)
    for i in range(3):
        alone = rectified(*(t[0] if dim is None else t[i] for t, dim in zip(everything, in_dims, strict=True)))
        assert torch.equal(mapped[i], alone)


@pytest.mark.parametrize("shared", [(), (1, 2, 3), (0,)], ids=["own", "shared_cameras", "shared_image"])
def test_per_sample_gradients_through_vmap(shared):
    """The gradient of a vmapped call holds one gradient for each sample."""
    everything = [noise(3, 3, *SIZE), LENSES, VIEWS, torch.cat([ROTATIONS, torch.eye(3)[None]])]
    weights = noise(1, 3, *VIEW.image_size, seed=4)
    in_dims = tuple(None if i in shared else 0 for i in range(4))
    leaves = [t[0] if dim is None else t for t, dim in zip(everything, in_dims, strict=True)]
    leaves = [t.clone().requires_grad_() for t in leaves]
    losses = (torch.vmap(rectified, in_dims=in_dims)(*leaves) * weights).square().flatten(1).sum(1)
    mapped = torch.autograd.grad(losses.sum(), leaves)
    total = [torch.zeros_like(t) for t in leaves]
    for i in range(3):
        alone = [(t if dim is None else t[i]).detach().requires_grad_() for t, dim in zip(leaves, in_dims, strict=True)]
        loss = (rectified(*alone) * weights).square().sum()
        torch.testing.assert_close(losses[i], loss)
        for whole, gradient, dim in zip(total, torch.autograd.grad(loss, alone), in_dims, strict=True):
            (whole if dim is None else whole[i]).add_(gradient)
    for ours, theirs in zip(mapped, total, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("way", ["is_grads_batched", "vmap"])
@pytest.mark.parametrize("cameras", [1, 2], ids=["repeated_camera", "a_camera_each"])
@pytest.mark.parametrize("wanted", [(0,), (1, 2), (0, 1, 2, 3)], ids=["image", "cameras", "all"])
def test_vmap_over_incoming_gradients(wanted, cameras, way):
    """Several gradients go backward at once, as fast Jacobians do it."""
    tensors = [noise(2, 3, *SIZE), LENSES[:cameras], VIEWS[:cameras], ROTATIONS[:cameras]]
    leaves = [t.clone().requires_grad_() for t in tensors]
    out = rectified(*leaves)
    grads = noise(4, *out.shape, seed=8)
    chosen = [leaves[i] for i in wanted]

    def backward(grad, **options):
        return torch.autograd.grad(out, chosen, grad, retain_graph=True, **options)

    together = torch.vmap(backward)(grads) if way == "vmap" else backward(grads, is_grads_batched=True)
    for i in range(4):
        for ours, theirs in zip(together, backward(grads[i]), strict=True):
            torch.testing.assert_close(ours[i], theirs, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("rows", [1, 2], ids=["repeated_camera", "a_camera_each"])
@pytest.mark.parametrize("mapped", [(0,), (0, 1), (0, 2), (0, 1, 2, 3, 4), (2,), (1,)], ids=str)
def test_vmap_of_the_backward_op(mapped, rows):
    """Over any of grad, image, source, target and rotation."""
    one = [noise(3, 2, 3, *VIEW.image_size), noise(3, 2, 3, *SIZE, seed=1), LENSES[:, None].repeat(1, rows, 1)]
    tensors = [*one, VIEWS[:, None].repeat(1, rows, 1), torch.cat([ROTATIONS, torch.eye(3)[None]])[:, None]]
    tensors[4] = tensors[4].repeat(1, rows, 1, 1)
    rest = (KB, PINHOLE, "bilinear", "zeros", True, True, True, True)
    op = torch.ops.fisheyerec.resample_backward
    in_dims = [0 if i in mapped else None for i in range(5)]
    arguments = [t if dim == 0 else t[0] for t, dim in zip(tensors, in_dims, strict=True)]
    together = torch.vmap(lambda *t: op(*t, *rest), in_dims=tuple(in_dims))(*arguments)
    for i in range(3):
        alone = op(*(t[i] if dim == 0 else t[0] for t, dim in zip(tensors, in_dims, strict=True)), *rest)
        for ours, theirs in zip(together, alone, strict=True):
            torch.testing.assert_close(ours[i], theirs, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("vectorize", [False, True])
def test_jacobian_of_the_picture_by_the_lens(vectorize):
    def means(params):
        return rectified(noise(1, 3, *SIZE), params).mean((0, 2, 3))

    jacobian = torch.autograd.functional.jacobian(means, LENSES[0], vectorize=vectorize)
    for channel in range(3):
        leaf = LENSES[0].clone().requires_grad_()
        (expected,) = torch.autograd.grad(means(leaf)[channel], leaf)
        torch.testing.assert_close(jacobian[channel], expected)


def test_func_grad_says_no():
    """torch.func.grad takes no operator whose gradient was registered by torch.library: torch says so itself."""
    with pytest.raises(RuntimeError, match="functorch transforms"):
        torch.func.grad(lambda params: rectified(noise(1, 1, *SIZE), params).sum())(LENSES[:1])


# --- autocast and dtypes --------------------------------------------------------------------------


@pytest.mark.parametrize("cast", [torch.bfloat16, torch.float16], ids=str)
def test_autocast_leaves_the_layer_alone(cast):
    image, params = noise(2, 3, *SIZE).requires_grad_(), LENSES[:2].clone().requires_grad_()
    layer = fr.DistortionRectification(VIEW)
    expected = layer(image, params)
    expected_gradients = torch.autograd.grad(expected.square().sum(), (image, params))
    with torch.autocast("cpu", dtype=cast):
        out = layer(image, params)
    assert out.dtype == torch.float32
    assert torch.equal(out, expected)
    for ours, theirs in zip(torch.autograd.grad(out.square().sum(), (image, params)), expected_gradients, strict=True):
        assert torch.equal(ours, theirs)


def test_a_whole_model_under_autocast():
    model = Model()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = model(noise(2, 3, *SIZE))
    assert out.dtype == torch.bfloat16
    out.float().sum().backward()
    assert all(p.grad.isfinite().all() for p in model.parameters())
    torch.testing.assert_close(out.float(), model(noise(2, 3, *SIZE)), rtol=0.1, atol=0.1)


@pytest.mark.parametrize("params_dtype", [torch.bfloat16, torch.float16, torch.float64], ids=str)
@pytest.mark.parametrize("image_dtype", [torch.float32, torch.bfloat16, torch.uint8], ids=str)
def test_params_of_another_dtype_are_their_values(image_dtype, params_dtype):
    image, params = noise(2, 3, *SIZE, dtype=image_dtype), LENSES[:2].to(params_dtype)
    out = fr.DistortionRectification(VIEW)(image, params)
    assert out.dtype == image_dtype
    assert torch.equal(out, fr.DistortionRectification(VIEW)(image, params.float()))


# --- Forked processes -----------------------------------------------------------------------------

# Three channels of it are more than the 16384 values below which one thread does it all, and fewer than the 32768 from
# which torch's own functions take several threads, which do hang in forked children.
BIG = (80, 110)


def big_result(seed):
    camera = fr.FisheyeCamera([45.0, 45, 54, 40, 0.05, -0.01, 0, 0], BIG)
    image = noise(1, 3, *BIG, seed=seed).requires_grad_()
    out = fr.rectify(image, camera, fr.PinholeCamera.from_fov(100, BIG)).image
    out.square().sum().backward()
    return out.detach(), image.grad


def same_bits(ours, theirs):
    return all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


class Pictures(Dataset):
    def __len__(self):
        return 6

    def __getitem__(self, index):
        return big_result(index)


def wait_for(pid, seconds):
    """The exit status of a child, or None (and a dead child) when it hangs."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return status
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return None


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_child_finishes_with_the_same_bits(threads, tmp_path):
    threads(4)
    expected = big_result(0)
    pid = os.fork()
    if pid == 0:
        try:
            os._exit(0 if same_bits(big_result(0), expected) else 7)
        finally:
            os._exit(9)
    assert wait_for(pid, 60) == 0
    assert same_bits(big_result(0), expected)  # and the parent goes on


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_data_loader_workers_finish_with_the_same_bits(threads):
    threads(4)
    expected = [big_result(i) for i in range(6)]
    # A worker has one thread unless it asks for more.
    options = {"num_workers": 2, "multiprocessing_context": "fork", "timeout": 60}
    loader = DataLoader(Pictures(), worker_init_fn=lambda worker: threads(1 + 2 * worker), **options)
    for ours, theirs in zip(loader, expected, strict=True):
        assert same_bits([t[0] for t in ours], theirs)


# --- Other devices --------------------------------------------------------------------------------


def test_other_devices_take_the_reference():
    """`meta` stands for every device that is not the CPU: shapes and dtypes come back, and from plain torch."""
    image = torch.empty(2, 3, *SIZE, device="meta", dtype=torch.bfloat16)
    result = fr.rectify(image, fr.FisheyeCamera(LENSES[:2], SIZE), VIEW, rotation=ROTATIONS)
    assert result.image.device.type == result.valid.device.type == "meta"
    assert (result.image.shape, result.image.dtype) == ((2, 3, *VIEW.image_size), torch.bfloat16)
    assert (result.valid.shape, result.valid.dtype) == ((2, 1, *VIEW.image_size), torch.bool)
    assert [fr.backend_for(d) for d in ("cpu", "meta", "cuda:1")] == ["native", "reference", "reference"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_cuda_agrees_with_the_cpu(dtype):
    leaves = [noise(2, 3, *SIZE).to(dtype), LENSES[:2].to(dtype), VIEWS[:2].to(dtype), ROTATIONS.to(dtype)]
    results = []
    for device in ("cpu", "cuda"):
        tensors = [t.to(device).requires_grad_() for t in leaves]
        out = rectified(*tensors)
        results.append([out, *torch.autograd.grad(out.square().sum(), tensors)])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(theirs.cpu(), ours, rtol=1e-3, atol=1e-3)
