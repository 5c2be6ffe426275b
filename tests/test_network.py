"""The network: its layers against the paper's numbers, its lens chart, its weights files."""

from __future__ import annotations

import itertools
import json
import math
import re

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

import fisheyerec as fr
from fisheyerec import lens_chart
from fisheyerec.network import PICTURE_MEAN, BaseNetwork, FishEyeRecNet
from fisheyerec.weights import load_network, save_network

CLASSES = 150


def without_memory(build, *arguments, **options):
    """Build a network whose parameters have shapes and no values."""
    lens_chart.population()  # kept for the process: not to be made on the meta device
    with torch.device("meta"):
        return build(*arguments, **options)


# --- The paper's numbers (sections 3.2 and 3.3) -----------------------------------------------------

VGG_16 = [[64, 64], [128, 128], [256, 256, 256], [512, 512, 512], [512, 512, 512]]
# Where torchvision's vgg16 has its convolutions.
VGG_16_NAMES = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
DECODER = [512, 256, 128, 64, 32]
REFINEMENT = [32, 32, 16]
ESTIMATION = [64, 64, 128, 128, 256, 256, 512, 512]
FULLY_CONNECTED = [1024, 1024, 8]


def layers_of_the_paper():
    """(component, kind, output channels, output side, parameters) of each layer that has any, in order."""
    side, width = 256, 3
    for block in VGG_16:
        for channels in block:
            yield "base", "Conv2d", channels, side, 9 * width * channels + channels
            width = channels
        side //= 2
    for channels in DECODER:
        yield "parsing", "Conv2d", channels, side, 9 * width * channels + channels
        side *= 2
        yield "parsing", "ConvTranspose2d", channels, side, 4 * channels * channels + channels
        width = channels
    yield "parsing", "Conv2d", CLASSES, 256, width * CLASSES + CLASSES
    width = 3 + CLASSES
    for channels in REFINEMENT:
        yield "parsing", "Conv2d", channels, 256, 9 * width * channels + channels
        width = channels
    yield "parsing", "Conv2d", CLASSES, 256, width * CLASSES + CLASSES
    yield "estimation", "ConvTranspose2d", 64, 256, 16 * 256 * 64 + 64  # conv3-3, four times as large
    yield "estimation", "Conv2d", 16, 256, 9 * 3 * 16 + 16  # filters on the raw picture
    side, width = 256, 64 + 16 + CLASSES
    for index, channels in enumerate(ESTIMATION):
        yield "estimation", "Conv2d", channels, side, 9 * width * channels + channels
        yield "estimation", "BatchNorm2d", channels, side, 2 * channels
        side, width = side // 2 if index % 2 else side, channels
    width *= side * side
    for channels in FULLY_CONNECTED:
        yield "estimation", "Linear", channels, None, width * channels + channels
        width = channels


def test_the_layers_of_paper_are_those_of_the_paper():
    net = without_memory(FishEyeRecNet.paper, CLASSES)
    seen = []

    def note(component):
        def hook(layer, inputs, output):
            parameters = sum(p.numel() for p in layer.parameters())
            side = output.shape[-1] if output.ndim == 4 else None
            assert output.ndim != 4 or output.shape[-2] == side
            seen.append((component, type(layer).__name__, output.shape[1], side, parameters))

        return hook

    for component in ("base", "parsing", "estimation"):
        for layer in getattr(net, component).modules():
            if not list(layer.children()) and list(layer.parameters()):
                layer.register_forward_hook(note(component))
    picture = torch.empty(2, 3, 256, 256, device="meta")
    features = net.base(picture)
    _, parsing = net.parsing(picture, features[-1])
    assert net.estimation(picture, features[0], parsing).shape == (2, 8)
    expected = list(layers_of_the_paper())
    assert seen == expected
    assert sum(p.numel() for p in net.parameters()) == sum(parameters for *_, parameters in expected)
    assert sum(p.numel() for p in net.base.parameters()) == 14_714_688


def test_what_follows_each_convolution_of_the_estimation():
    """ReLU, then batch normalisation; pooling after every two; drop-out of a half after the last."""
    estimation = without_memory(FishEyeRecNet.paper, 2).estimation
    kinds = [type(layer).__name__ for layer in estimation.convolutions]
    one = ["Conv2d", "ReLU", "BatchNorm2d"]
    assert kinds == [*one, *one, "MaxPool2d"] * 4 + ["Dropout"]
    assert estimation.convolutions[-1].p == 1 / 2


@pytest.mark.parametrize("build", [FishEyeRecNet.paper, FishEyeRecNet.compact])
def test_without_scene_parsing_only_its_inputs_and_itself_are_gone(build):
    full, bare = (without_memory(build, 5, scene_parsing=each) for each in (True, False))
    assert bare.parsing is None
    shapes = [{name: value.shape for name, value in net.estimation.named_parameters()} for net in (full, bare)]
    assert shapes[0].keys() == shapes[1].keys()
    differing = [name for name in shapes[0] if shapes[0][name] != shapes[1][name]]
    assert len(differing) == 1
    assert shapes[0][differing[0]][1] - shapes[1][differing[0]][1] == 5
    assert without_memory(FishEyeRecNet.from_design, bare.design).parsing is None


def test_compact_ships():
    net = without_memory(FishEyeRecNet.compact)
    assert 2 * sum(p.numel() for p in net.parameters()) < 24e6


# --- VGG-16 weights ---------------------------------------------------------------------------------


def vgg_only():
    """The paper's base in a network that is quick to build."""
    return FishEyeRecNet(BaseNetwork(), None, nn.Identity(), 256, True, {})


@pytest.fixture(scope="module")
def vgg16_state():
    """A state dict with the names and shapes of torchvision's vgg16, its classifier cut short."""
    generator = torch.Generator().manual_seed(0)
    state, width = {}, 3
    for name, channels in zip(VGG_16_NAMES, itertools.chain(*VGG_16), strict=True):
        state[f"features.{name}.weight"] = torch.rand(channels, width, 3, 3, generator=generator)
        state[f"features.{name}.bias"] = torch.rand(channels, generator=generator)
        width = channels
    return state | {"classifier.0.weight": torch.zeros(3, 3), "classifier.0.bias": torch.zeros(3)}


def test_torchvision_weights_fit(vgg16_state, tmp_path):
    torch.save(vgg16_state, tmp_path / "vgg16.pth")
    net = vgg_only()
    net.load_vgg16(tmp_path / "vgg16.pth")
    loaded = net.base.state_dict()
    assert loaded.keys() == {name for name in vgg16_state if name.startswith("features.")}
    for name, value in loaded.items():
        assert torch.equal(value, vgg16_state[name]), name


@pytest.mark.parametrize(
    ("spoil", "names"),
    [
        (lambda state: state.pop("features.28.bias"), "features.28.bias"),
        (lambda state: state.update({"features.30.weight": torch.zeros(1)}), "features.30.weight"),
        (lambda state: state.update({"features.0.weight": torch.zeros(64, 1, 3, 3)}), "features.0.weight"),
        (lambda state: state.update({"epoch": 3}), "state dict of tensors"),
    ],
)
def test_other_weights_do_not_fit(vgg16_state, tmp_path, spoil, names):
    state = dict(vgg16_state)
    spoil(state)
    torch.save(state, tmp_path / "other.pth")
    net = vgg_only()
    before = net.base.features[0].weight.clone()
    with pytest.raises(ValueError, match=rf"load_vgg16\(\): expected .*{re.escape(names)}"):
        net.load_vgg16(tmp_path / "other.pth")
    assert torch.equal(net.base.features[0].weight, before)


@pytest.mark.parametrize("content", [b"", b"not weights", b"PK\x03\x04 half a zip"])
def test_a_broken_file_of_weights_is_called_so(tmp_path, content):
    (tmp_path / "broken.pth").write_bytes(content)
    with pytest.raises(ValueError, match=r"load_vgg16\(\): expected a state dict, got .*broken\.pth"):
        vgg_only().load_vgg16(tmp_path / "broken.pth")


def test_vgg16_is_for_the_paper_and_must_be_there(tmp_path):
    with pytest.raises(FileNotFoundError):
        vgg_only().load_vgg16(tmp_path / "missing.pth")
    with pytest.raises(ValueError, match="VGG-16 base"):
        FishEyeRecNet.compact().load_vgg16(tmp_path / "missing.pth")


# --- Forward and backward -----------------------------------------------------------------------------


def forward_all(net, side, batch):
    torch.manual_seed(0)
    output = net(torch.rand(batch, 3, side, side))
    parts = [output.image, output.parsing, output.first_parsing, output.rectified_parsing]
    loss = sum(part.square().mean() for part in [*parts, output.estimate.log_sigma] if part is not None)
    return output, loss


@pytest.mark.parametrize("scene_parsing", [True, False])
def test_gradients_reach_every_parameter_of_compact(scene_parsing):
    torch.manual_seed(1)
    net = FishEyeRecNet.compact(5, scene_parsing=scene_parsing)
    output, loss = forward_all(net, 64, 3)
    loss.backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name
    assert output.image.shape == (3, 3, 64, 64)
    assert output.camera.params.shape == (3, 8)
    if scene_parsing:
        assert output.parsing.shape == output.first_parsing.shape == (3, 5, 8, 8)
        assert output.rectified_parsing.shape == (3, 5, 64, 64)
    else:
        assert output.parsing is output.first_parsing is output.rectified_parsing is None


def test_gradients_reach_every_parameter_of_paper():
    """One picture: the fully connected layers alone are 135 million parameters."""
    torch.manual_seed(0)
    net = FishEyeRecNet.paper(2)
    output, loss = forward_all(net, 256, 1)
    loss.backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name
    assert output.parsing.shape == output.rectified_parsing.shape == (1, 2, 256, 256)


def test_nothing_is_rectified_where_nobody_asks():
    output = FishEyeRecNet.compact().eval()(torch.rand(1, 3, 64, 96), straighten=False)
    assert output.image is output.rectified_parsing is None
    assert output.camera.image_size == output.view.image_size == (64, 96)


@pytest.mark.parametrize(
    ("build", "image", "got"),
    [
        (FishEyeRecNet.compact, torch.zeros(1, 3, 64, 65), "(1, 3, 64, 65) torch.float32"),
        (FishEyeRecNet.compact, torch.zeros(1, 1, 64, 64), "(1, 1, 64, 64)"),
        (FishEyeRecNet.compact, torch.zeros(3, 64, 64), "(3, 64, 64)"),
        (FishEyeRecNet.compact, torch.zeros(1, 3, 64, 64, dtype=torch.uint8), "torch.uint8"),
        (FishEyeRecNet.paper, torch.zeros(1, 3, 64, 64), "(1, 3, 64, 64)"),
    ],
)
def test_a_picture_of_another_shape_is_refused(build, image, got):
    net = without_memory(build, 2)
    with pytest.raises(ValueError, match=rf"FishEyeRecNet\(\): expected image of shape .*{re.escape(got)}"):
        net(image)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_picture_that_is_not_finite_is_refused(value):
    image = torch.zeros(1, 3, 64, 64)
    image[0, 1, 2, 3] = value
    with pytest.raises(ValueError, match=r"FishEyeRecNet\(\): expected .*finite"):
        FishEyeRecNet.compact().eval()(image)


class Tensors(nn.Module):
    """A network's output as tensors, which is what an exported program may return."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, image):
        output = self.network(image)
        return output.image, output.camera.params, output.view.params


def test_the_whole_of_compact_is_one_graph(tmp_path):
    torch.compiler.reset()
    torch.manual_seed(0)
    model, image = Tensors(FishEyeRecNet.compact(4)).eval(), torch.rand(2, 3, 96, 192)
    with torch.no_grad():
        expected = model(image)
        torch.export.save(torch.export.export(model, (image,)), tmp_path / "model.pt2")
        exported = torch.export.load(tmp_path / "model.pt2").module()
        compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
        for program in (exported, compiled):
            torch.testing.assert_close(program(image), expected)


# --- What the head emits ------------------------------------------------------------------------------


class Emits(nn.Module):
    """An estimation network that always says the same."""

    def __init__(self, emitted):
        super().__init__()
        self.emitted = emitted

    def forward(self, image, features, parsing):
        return self.emitted


def decode(emitted, side=32):
    net = FishEyeRecNet.compact(scene_parsing=False).eval()
    net.estimation = Emits(emitted)
    with torch.no_grad():
        return net(torch.zeros(len(emitted), 3, side, side), straighten=False)


@pytest.fixture(scope="module")
def wild():
    """(600, 16) numbers of every size up to a million, and corners of what can be emitted."""
    generator = torch.Generator().manual_seed(0)
    emitted = torch.randn(600, 16, generator=generator) * torch.logspace(-3, 6, 600)[:, None]
    emitted[::3] = 1e6 * emitted[::3].sign()
    return emitted


def test_whatever_is_emitted_decodes_to_a_finite_camera_that_rises(wild):
    output = decode(wild)
    for value in (output.camera.params, output.view.params, output.estimate.chart, output.estimate.covariance):
        assert value.isfinite().all()
    assert (torch.linalg.eigvalsh(output.estimate.covariance) > 0).all()
    assert (output.camera.params[:, :2] > 0).all()
    theta = torch.linspace(0, math.pi, 4001, dtype=torch.float64)
    for fx, _, _, _, *k in output.camera.params.tolist():
        rho = fx * (theta + sum(k_i * theta ** (2 * i + 3) for i, k_i in enumerate(k)))
        corner = int((rho >= 16 * math.sqrt(2)).double().argmax())
        assert corner > 0, "the lens never reaches the corner"
        assert (rho[: corner + 1].diff() > 0).all()


def test_a_centred_camera_sees_the_whole_picture_whatever_is_emitted(wild):
    emitted = wild.clone()
    emitted[:, lens_chart.PRINCIPAL_POINT] = emitted[:, lens_chart.ASPECT, None] = 0
    corners = torch.tensor([[-0.5, -0.5], [31.5, -0.5], [-0.5, 31.5], [31.5, 31.5]], dtype=torch.float64)
    _, valid = decode(emitted).camera.unproject(corners.expand(len(emitted), -1, -1))
    assert valid.all()


def test_nothing_emitted_is_the_mean_lens():
    output = decode(torch.zeros(1, 16))
    mean, basis = lens_chart.population()
    assert torch.equal(output.estimate.chart[0], mean)
    torch.testing.assert_close(output.estimate.covariance[0], basis @ basis.mT)


# --- The lens chart -------------------------------------------------------------------------------------


def as_batch(lens):
    return torch.as_tensor(lens.params)[None].double(), lens.image_size


def test_a_camera_survives_its_chart(lens, tolerance):
    params, size = as_batch(lens)
    chart = lens_chart.chart_from_camera(params, size)
    if not chart.isfinite().all():
        pytest.skip("the lens ends within the radii of the chart")
    if chart[:, lens_chart.PROFILE].max() + chart[:, lens_chart.FIELD_OF_VIEW] > lens_chart.angle_to_g(
        torch.tensor(math.radians(150))
    ):
        pytest.skip("wider than the chart reaches, 150 degrees off the axis")
    fitted = lens_chart.camera_from_chart(chart, size)
    # The fit is pulled towards the equidistant lens with a weight of 1e-9.
    torch.testing.assert_close(lens_chart.chart_from_camera(fitted, size), chart, rtol=0, atol=1e-5)
    # Within the outermost radius; what lies beyond is extrapolated by a polynomial of ninth degree.
    radius = lens_chart.RADII[-1] * max(size) / 2
    height, width = size
    grid = torch.meshgrid(torch.linspace(0, width - 1, 9), torch.linspace(0, height - 1, 9), indexing="xy")
    points = torch.stack(grid, -1).reshape(1, -1, 2).double()
    rays, valid = fr.FisheyeCamera(params, size).unproject(points)
    again, seen = fr.FisheyeCamera(fitted, size).project(rays)
    away = (points - params[:, None, 2:4]) / torch.tensor([1, params[0, 1] / params[0, 0]])
    within = valid & (away.norm(dim=-1) <= radius)
    assert within.any()
    assert seen[within].all()
    assert (again - points).norm(dim=-1)[within].max() < 2e-5 * math.hypot(*size)


@pytest.mark.parametrize("scale", [1 / 4, 3])
def test_a_chart_is_the_same_for_a_resized_picture(lens, scale, tolerance):
    params, size = as_batch(lens)
    size = tuple(4 * (side // 4) for side in size)  # so that both sides scale alike
    lens = fr.FisheyeCamera(params, size)
    resized = lens.resize(tuple(int(side * scale) for side in size))
    charts = [lens_chart.chart_from_camera(each.params, each.image_size) for each in (lens, resized)]
    torch.testing.assert_close(*charts, rtol=0, atol=1e-9, equal_nan=True)


def test_the_chart_is_differentiable_both_ways():
    mean, basis = lens_chart.population()
    generator = torch.Generator().manual_seed(0)
    deviations = torch.randn(4, 8, generator=generator, dtype=torch.float64)
    charts = (mean + deviations @ basis.mT).requires_grad_()
    assert torch.autograd.gradcheck(lambda chart: lens_chart.camera_from_chart(chart, (48, 64)), charts)
    params = lens_chart.camera_from_chart(charts.detach(), (48, 64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda each: lens_chart.chart_from_camera(each, (48, 64)), params)


def test_g_is_smooth_and_undone():
    tangent = math.radians(75)
    theta = torch.tensor([1e-3, 0.5, tangent - 1e-7, tangent, tangent + 1e-7, 2.5], dtype=torch.float64)
    g = lens_chart.angle_to_g(theta)
    torch.testing.assert_close(lens_chart.angle_from_g(g), theta, rtol=1e-12, atol=0)
    assert torch.equal(g.sort().values, g)
    assert g[4] - g[2] < 1e-6


# --- Pictures that are not square -----------------------------------------------------------------------


@pytest.mark.parametrize("size", [(64, 40), (36, 64)])
def test_a_picture_is_seen_in_the_middle_of_a_square_of_the_mean_colour(size):
    torch.manual_seed(0)
    net = FishEyeRecNet.compact(3).eval()
    image = torch.rand(2, 3, *size)
    square = torch.tensor(PICTURE_MEAN)[:, None, None].repeat(2, 1, 64, 64)
    top, left = (64 - size[0]) // 2, (64 - size[1]) // 2
    square[..., top : top + size[0], left : left + size[1]] = image
    with torch.no_grad():
        one, other = net(image), net(square)
    for name in ("chart", "covariance"):
        torch.testing.assert_close(getattr(one.estimate, name), getattr(other.estimate, name))
    torch.testing.assert_close(one.parsing, other.parsing)
    assert one.rectified_parsing.shape == (2, 3, *size)
    # The lens is that of the picture itself, about its own centre.
    offset = other.camera.params[:, 2:4] - one.camera.params[:, 2:4]
    torch.testing.assert_close(offset, torch.tensor([[left, top]], dtype=torch.float64).expand(2, -1))


# --- Weights files ----------------------------------------------------------------------------------------


@pytest.fixture
def weights(tmp_path):
    torch.manual_seed(0)
    net = FishEyeRecNet.compact(3).eval()
    save_network(net, tmp_path / "net.safetensors", {"seed": 0})
    return net, tmp_path / "net.safetensors"


def test_weights_survive_in_halves(weights):
    net, path = weights
    loaded = load_network(path)
    assert loaded.design == net.design
    assert not loaded.training
    for name, value in net.state_dict().items():
        expected = value.half().float() if value.dtype == torch.float32 else value
        assert torch.equal(loaded.state_dict()[name], expected), name
    image = torch.rand(1, 3, 64, 64)
    with torch.no_grad():
        cameras = [each(image, straighten=False).camera for each in (net, loaded)]
    # eleven bits of every weight
    torch.testing.assert_close(cameras[0].params, cameras[1].params, rtol=1e-2, atol=1e-2)
    assert path.stat().st_size < 2.2 * sum(p.numel() for p in net.parameters())
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_weights_of_another_number_of_classes_are_refused(weights, tmp_path):
    net, path = weights
    tensors = load_file(path)
    save_file(tensors, tmp_path / "other.safetensors", {"design": json.dumps(net.design | {"num_classes": 4})})
    with pytest.raises(ValueError, match=r"expected .* of shape .*other\.safetensors.* another number of classes\?"):
        load_network(tmp_path / "other.safetensors")


@pytest.mark.parametrize(
    "spoil",
    [
        lambda whole: b"",
        lambda whole: b"not weights at all",
        lambda whole: whole[: len(whole) // 2],
        lambda whole: whole[: len(whole) - 1],
        lambda whole: b"\xff" * 8 + whole[8:],
    ],
)
def test_a_broken_weights_file_is_called_so(weights, spoil):
    _, path = weights
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(ValueError, match=r"expected a safetensors file, got .*net\.safetensors"):
        load_network(path)


@pytest.mark.parametrize("metadata", [{}, {"design": "nonsense"}, {"design": "{}"}, {"design": '{"network": "deep"}'}])
def test_a_file_that_names_no_network_is_refused(tmp_path, metadata):
    save_file({"a": torch.zeros(1)}, tmp_path / "a.safetensors", metadata)
    with pytest.raises(ValueError, match=r"load_network\(\): expected a file of save_network"):
        load_network(tmp_path / "a.safetensors")


def test_a_missing_weights_file_is_missing(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_network(tmp_path / "missing.safetensors")


def test_weights_that_cannot_be_written_leave_the_old_file(weights, monkeypatch):
    net, path = weights
    before = path.read_bytes()

    def fail(*arguments):
        raise OSError("no space left")

    monkeypatch.setattr("fisheyerec.weights.save_file", fail)
    with pytest.raises(OSError, match="no space"):
        save_network(net, path, {})
    assert path.read_bytes() == before
    assert [each.name for each in path.parent.iterdir()] == [path.name]
