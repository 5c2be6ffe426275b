"""FishEyeRecNet (Yin, Wang, Yu, Zhang, Fua, Tao, ECCV 2018), top to bottom in the paper's words.

Four cooperating components (Fig. 2): a base network extracts features; a scene parsing network decodes semantics from
them; a distortion parameter estimation network reads features, picture and parsing and gives the lens; the distortion
rectification layer makes picture and parsing straight. All of it is differentiable, end to end.

What the paper leaves open, and what is done here:

| the paper | here |
|---|---|
| conv3-3 raised by a deconvolution | to the picture's size: kernel 4, stride 4, 64 filters |
| 3x3 learnable filters on the picture | 16 of them |
| the parsing fed to the estimation | the refined one, as probabilities |
| classifiers of the first and the refined parsing | 1x1 convolutions to the number of classes |
| filters of the decoder's deconvolutions | as many as the convolution before each |
| activations of decoder and refinement | ReLU after each convolution and deconvolution |
| scale of the eight outputs | a lens chart (`lens_chart`), normalised around the lens population, bounded |
| focal length of the rectified picture | the edge-matched view of the estimated camera |
| normalisation of the picture | ImageNet mean and deviation, as VGG-16 was trained |
"""

from __future__ import annotations

import itertools
import os
import pickle
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from . import lens_chart
from .cameras import FisheyeCamera, PinholeCamera
from .rectification import rectify

PICTURE_MEAN = (0.485, 0.456, 0.406)
"""RGB of ImageNet's mean colour, which fills the margins of pictures that are not square."""

# How far, in deviations of the lens population, the network may leave its mean.
_LARGEST_DEVIATION = 5.0
# The fully connected layers of `compact` read a grid of so many cells each way.
_CELLS = 6


class NetworkOutput(NamedTuple):
    """What FishEyeRecNet makes of a batch of pictures (B, 3, H, W)."""

    camera: FisheyeCamera
    """The estimated lenses, params (B, 8) float64, for pictures of the size of the input."""
    view: PinholeCamera
    """The edge-matched views of these cameras, params (B, 4)."""
    image: Tensor | None
    """(B, 3, H, W): the rectified pictures I_r; None where not asked for."""
    parsing: Tensor | None
    """(B, N, s, s) logits of the scene parsing of the picture in its square, perhaps smaller; None without."""
    first_parsing: Tensor | None
    """(B, N, s, s) logits before the refinement network; None without scene parsing."""
    rectified_parsing: Tensor | None
    """(B, N, H, W) probabilities of the classes in the rectified picture, 0 where it is empty; None like the others."""
    estimate: LensEstimate | LensClasses
    """The lens as a distribution: the former from FishEyeRecNet, the latter from a network that classifies."""


class LensEstimate(NamedTuple):
    """A Gaussian over lens charts: what the estimation network emits."""

    chart: Tensor
    """(B, 8) float64, the mean."""
    covariance: Tensor
    """(B, 8, 8) float64."""
    deviation: Tensor
    """(B, 8): the mean in deviations of the lens population, bounded."""
    log_sigma: Tensor
    """(B, 8): logarithm of the expected error of `deviation`; 0 for a network that does not emit it."""


class LensClasses(NamedTuple):
    """A distribution over a fixed set of N lenses."""

    chart: Tensor
    """(B, 8) float64, of the likeliest."""
    logits: Tensor
    """(B, N)."""
    classes: Tensor
    """(N, 8) float64, the charts of all."""


class LensNetwork(nn.Module):
    """What networks share that tell the lens of a picture: its square, normalised frame.

    Calling one with pictures (B, 3, H, W), RGB in [0, 1], gives a NetworkOutput; `straighten=False` does not rectify.

    Args:
        longer_side: of the pictures that it is made for, in pixels.
        fixed_size: whether it is bound to that side.
        design: what is needed to build the same network again.
    """

    picture_mean: Tensor
    picture_deviation: Tensor
    parsing: SceneParsingNetwork | None

    def __init__(self, longer_side: int, fixed_size: bool, design: dict[str, Any]) -> None:
        super().__init__()
        self.longer_side, self.fixed_size, self.design = longer_side, fixed_size, design
        self.register_buffer("picture_mean", torch.tensor(PICTURE_MEAN)[:, None, None])
        self.register_buffer("picture_deviation", torch.tensor([0.229, 0.224, 0.225])[:, None, None])

    def frame(self, image: Tensor) -> Tensor:
        """Put normalised pictures (B, 3, H, W) into the middle of squares (B, 3, S, S) with margins of 0.

        Raises:
            ValueError: another shape, or NaN or infinite values.
        """
        self._check_image(image)
        top, left, side = _margins(image)
        height, width = image.shape[-2:]
        return functional.pad(
            (image - self.picture_mean) / self.picture_deviation,
            (left, side - width - left, top, side - height - top),
        ).contiguous(memory_format=torch.channels_last)

    def _check_image(self, image: Tensor) -> None:
        name = type(self).__name__
        side = str(self.longer_side) if self.fixed_size else "a multiple of 32"
        expected = f"(B, 3, H, W), the longer side {side},"
        fits = image.ndim == 4 and image.shape[1] == 3 and image.is_floating_point() and min(image.shape) > 0
        if fits:
            longer = max(image.shape[-2:])
            fits = longer == self.longer_side if self.fixed_size else longer % 32 == 0
        if not fits:
            raise ValueError(
                f"{name}(): expected image of shape {expected} and a floating dtype, "
                f"got {tuple(image.shape)} {image.dtype}"
            )
        if not torch.compiler.is_compiling() and not image.isfinite().all():
            raise ValueError(f"{name}(): expected a finite image, got NaN or infinite values")


def _margins(image: Tensor) -> tuple[int, int, int]:
    """Where pictures lie within their squares, top and left, and the side of these."""
    height, width = image.shape[-2:]
    side = max(height, width)
    return (side - height) // 2, (side - width) // 2, side


class FishEyeRecNet(LensNetwork):
    """The whole network: a picture in, the lens and the rectified picture out.

    Args:
        base: gives a list of feature maps, high to low resolution.
        parsing: the scene parsing network, or None ("-SPN -SL" of Table 1).
        estimation: gives (B, 8) or, with its expected errors, (B, 16).
        longer_side: of the pictures that it is made for, in pixels.
        fixed_size: whether the estimation network is bound to that side.
        design: what `from_design` needs to build the same network again.
    """

    lens_mean: Tensor
    lens_basis: Tensor

    def __init__(
        self,
        base: nn.Module,
        parsing: SceneParsingNetwork | None,
        estimation: nn.Module,
        longer_side: int,
        fixed_size: bool,
        design: dict[str, Any],
    ) -> None:
        super().__init__(longer_side, fixed_size, design)
        self.base, self.parsing, self.estimation = base, parsing, estimation
        mean, basis = lens_chart.population()
        self.register_buffer("lens_mean", mean)
        self.register_buffer("lens_basis", basis)

    @classmethod
    def paper(cls, num_classes: int = 150, *, scene_parsing: bool = True) -> FishEyeRecNet:
        """Build the network to the letter of the paper, for pictures of 256x256.

        Args:
            num_classes: of the scene parsing; 150 for ADE20K.
            scene_parsing: False for the ablation "-SPN -SL".
        """
        parsing = (
            SceneParsingNetwork(512, (512, 256, 128, 64, 32), (32, 32, 16), num_classes) if scene_parsing else None
        )
        estimation = EstimationNetwork(num_classes if scene_parsing else 0)
        return cls(BaseNetwork(), parsing, estimation, 256, True, _design("paper", num_classes, scene_parsing))

    @classmethod
    def compact(cls, num_classes: int = 8, *, scene_parsing: bool = True) -> FishEyeRecNet:
        """Build the four components at a size that ships: made for pictures of longer side 192.

        Args:
            num_classes: of the scene parsing.
            scene_parsing: False for the ablation "-SPN -SL".
        """
        widths = (16, 32, 64, 64, 64)
        parsing = (
            SceneParsingNetwork(widths[-1], (48, 32), (16, 16, 16), num_classes, shrink=8) if scene_parsing else None
        )
        base = CompactBaseNetwork(widths if scene_parsing else widths[: CompactBaseNetwork.eighth + 1])
        estimation = CompactEstimationNetwork(widths[CompactBaseNetwork.eighth], num_classes if scene_parsing else 0)
        return cls(base, parsing, estimation, 192, False, _design("compact", num_classes, scene_parsing))

    @classmethod
    def from_design(cls, design: dict[str, Any]) -> FishEyeRecNet:
        """Build the network that a `design` describes.

        Args:
            design: "network" ("paper" or "compact"), "num_classes" and "scene_parsing".

        Raises:
            ValueError: another network.
            KeyError: an incomplete design.
        """
        builders = {"paper": cls.paper, "compact": cls.compact}
        if design["network"] not in builders:
            raise ValueError(f"FishEyeRecNet(): expected network in {sorted(builders)}, got {design['network']!r}")
        return builders[design["network"]](design["num_classes"], scene_parsing=design["scene_parsing"])

    def forward(self, image: Tensor, *, straighten: bool = True) -> NetworkOutput:
        """Estimate the lens and rectify picture and parsing.

        Args:
            image: (B, 3, H, W) RGB in [0, 1]; its longer side is 256 for `paper`, a multiple of 32 for `compact`. The
                network sees it in the middle of a square whose margins have the mean colour.
            straighten: whether to rectify at all.

        Raises:
            ValueError: another shape, or NaN or infinite values.
        """
        normalised = self.frame(image)
        height, width = image.shape[-2:]
        features = self.base(normalised)
        parsing = first_parsing = probabilities = None
        if self.parsing is not None:
            first_parsing, parsing = self.parsing(normalised, features[-1])
            probabilities = parsing.softmax(1)
        estimate = self._decode(self.estimation(normalised, features[0], probabilities))
        camera = FisheyeCamera(lens_chart.camera_from_chart(estimate.chart, (height, width)), (height, width))
        view = PinholeCamera.edge_matched(camera, (height, width))
        rectified = rectify(image, camera, view).image if straighten else None
        rectified_parsing = None
        if probabilities is not None and straighten:
            top, left, side = _margins(image)
            enlarged = functional.interpolate(probabilities, size=(side, side), mode="bilinear", align_corners=False)
            cropped = enlarged[..., top : top + height, left : left + width]
            rectified_parsing = rectify(cropped, camera, view).image
        return NetworkOutput(camera, view, rectified, parsing, first_parsing, rectified_parsing, estimate)

    def _decode(self, emitted: Tensor) -> LensEstimate:
        emitted = emitted.to(torch.float64)
        deviation = _LARGEST_DEVIATION * torch.tanh(emitted[:, :8] / _LARGEST_DEVIATION)
        log_sigma = emitted[:, 8:].clamp(-6, 2) if emitted.shape[1] == 16 else torch.zeros_like(deviation)
        chart = self.lens_mean + deviation @ self.lens_basis.mT
        spread = self.lens_basis * log_sigma.exp()[:, None]  # (B, 8, 8)
        return LensEstimate(chart, spread @ spread.mT, deviation, log_sigma)

    def load_vgg16(self, path_or_url: str | os.PathLike[str]) -> None:
        """Load ImageNet weights into the base network of `paper`.

        Args:
            path_or_url: a state dict with the names of torchvision's vgg16 (`features.0.weight`...), whose classifier,
                if any, is not used; a local file or an https URL.

        Raises:
            ValueError: not such a state dict; the message names what is missing, unknown or of another shape.
            OSError: the file cannot be read.
        """
        where = "FishEyeRecNet.load_vgg16()"
        if not isinstance(self.base, BaseNetwork):
            raise ValueError(
                f"{where}: expected a network with the paper's VGG-16 base, got {type(self.base).__name__}"
            )
        source = os.fspath(path_or_url)
        if source.startswith("https://"):
            state = torch.hub.load_state_dict_from_url(source, map_location="cpu", weights_only=True)
        else:
            try:
                state = torch.load(source, map_location="cpu", weights_only=True)
            except (RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as error:
                raise ValueError(f"{where}: expected a state dict, got {source!r} that is none ({error})") from error
        if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
            raise ValueError(f"{where}: expected a state dict of tensors in {source!r}")
        features = {name: value for name, value in state.items() if not name.startswith("classifier.")}
        expected = self.base.state_dict()
        wrong = sorted(
            name
            for name in expected.keys() | features.keys()
            if name not in expected or name not in features or expected[name].shape != features[name].shape
        )
        if wrong:
            raise ValueError(
                f"{where}: expected the state dict of torchvision's vgg16 in {source!r}, got one that differs in "
                f"{len(wrong)} tensors, the first being {wrong[0]!r}"
            )
        self.base.load_state_dict(features)


def _design(network: str, num_classes: int, scene_parsing: bool) -> dict[str, Any]:
    return {"network": network, "num_classes": num_classes, "scene_parsing": scene_parsing}


class BaseNetwork(nn.Module):
    """The paper's base network: the convolutions of VGG-16 (Simonyan and Zisserman, 2014), named as torchvision's."""

    channels = (64, 64, "pool", 128, 128, "pool", 256, 256, 256, "pool", 512, 512, 512, "pool", 512, 512, 512, "pool")
    conv3_3 = 15
    """Where in `features` the ReLU after conv3-3 stands."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = 3
        for channels in self.channels:
            if isinstance(channels, str):
                layers.append(nn.MaxPool2d(2))
            else:
                layers += [nn.Conv2d(width, channels, 3, padding=1), nn.ReLU(inplace=True)]
                width = channels
        self.features = nn.Sequential(*layers)

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, 3, H, W) -> conv3-3 (B, 256, H/4, W/4) and the last pooling (B, 512, H/32, W/32)."""
        conv3_3 = self.features[: self.conv3_3 + 1](image)
        return [conv3_3, self.features[self.conv3_3 + 1 :](conv3_3)]


class SceneParsingNetwork(nn.Module):
    """The paper's decoder of convolution-deconvolution pairs, and the refinement network that looks at the picture.

    Args:
        features: channels of what the base network gives.
        widths: filters of each pair (3x3 convolution, 2x2 deconvolution of stride 2).
        refinement_widths: filters of the 3x3 convolutions of the refinement network.
        num_classes: N.
        shrink: the parsing is this many times smaller than the picture.
    """

    def __init__(
        self,
        features: int,
        widths: Sequence[int],
        refinement_widths: Sequence[int],
        num_classes: int,
        shrink: int = 1,
    ) -> None:
        super().__init__()
        pairs: list[nn.Module] = []
        for before, width in zip([features, *widths], widths, strict=False):
            pairs += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU(inplace=True)]
            pairs += [nn.ConvTranspose2d(width, width, 2, stride=2), nn.ReLU(inplace=True)]
        self.decoder = nn.Sequential(*pairs)
        self.first_classifier = nn.Conv2d(widths[-1], num_classes, 1)
        self.unshuffle = nn.PixelUnshuffle(shrink)
        layers: list[nn.Module] = []
        for before, width in zip([3 * shrink**2 + num_classes, *refinement_widths], refinement_widths, strict=False):
            layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU(inplace=True)]
        self.refinement = nn.Sequential(*layers)
        self.classifier = nn.Conv2d(refinement_widths[-1], num_classes, 1)

    def forward(self, image: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Picture (B, 3, H, W) and features -> first and refined parsing, logits (B, N, H/shrink, W/shrink)."""
        first = self.first_classifier(self.decoder(features))
        refined = self.classifier(self.refinement(torch.cat([self.unshuffle(image), first], 1)))
        return first, refined


class EstimationNetwork(nn.Module):
    """The paper's distortion parameter estimation network, for pictures of 256x256.

    Args:
        num_classes: of the parsing that it reads; 0 without.
    """

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.raise_conv3_3 = nn.ConvTranspose2d(256, 64, 4, stride=4)
        self.filters = nn.Conv2d(3, 16, 3, padding=1)
        layers: list[nn.Module] = []
        before = 64 + 16 + num_classes
        for index, width in enumerate((64, 64, 128, 128, 256, 256, 512, 512)):
            layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU(inplace=True), nn.BatchNorm2d(width)]
            if index % 2:
                layers.append(nn.MaxPool2d(2))
            before = width
        self.convolutions = nn.Sequential(*layers, nn.Dropout(0.5))
        self.fully_connected = nn.Sequential(
            nn.Flatten(),
            nn.Linear(512 * 16 * 16, 1024),
            nn.ReLU(inplace=True),
            nn.Linear(1024, 1024),
            nn.ReLU(inplace=True),
            nn.Linear(1024, 8),
        )

    def forward(self, image: Tensor, conv3_3: Tensor, parsing: Tensor | None) -> Tensor:
        """Picture (B, 3, 256, 256), conv3-3 (B, 256, 64, 64), parsing (B, N, 256, 256) -> (B, 8)."""
        maps = [self.raise_conv3_3(conv3_3), self.filters(image)]
        if parsing is not None:
            maps.append(parsing)
        emitted: Tensor = self.fully_connected(self.convolutions(torch.cat(maps, 1)))
        return emitted


class CompactBaseNetwork(nn.Module):
    """The base network of `compact`: residual convolutions that halve the picture at each stage.

    Args:
        widths: channels at 1/2, 1/4, 1/8...
    """

    eighth = 2
    """Which of the stages gives an eighth of the picture's size."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        stages: list[nn.Module] = [nn.Sequential(*_convolution(3, widths[0], 2))]
        stages += [Residual(before, width, 2) for before, width in itertools.pairwise(widths)]
        self.stages = nn.ModuleList(stages)

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, 3, S, S) -> feature maps of an eighth of its size and smaller."""
        features = [image]
        for stage in self.stages:
            features.append(stage(features[-1]))
        return features[1 + self.eighth :]


class CompactEstimationNetwork(nn.Module):
    """The estimation network of `compact`: from an eighth of the picture's size down to a grid of _CELLS x _CELLS.

    What a lens does to a line depends on where the line lies: the fully connected layers know each cell of the grid by
    its place.

    Args:
        features: channels of the base network's features.
        num_classes: of the parsing that it reads; 0 without.
    """

    def __init__(self, features: int, num_classes: int) -> None:
        super().__init__()
        self.filters = nn.Sequential(*_convolution(3, 8, 2), nn.AvgPool2d(4))
        self.join = nn.Sequential(
            nn.Conv2d(features + 8 + num_classes, 64, 1, bias=False), nn.BatchNorm2d(64), nn.ReLU(inplace=True)
        )
        self.convolutions = nn.Sequential(Residual(64, 64, 2), Residual(64, 128, 2))
        self.fully_connected = nn.Sequential(
            nn.AdaptiveAvgPool2d(_CELLS),
            nn.Flatten(),
            nn.Linear(128 * _CELLS**2, 256),
            nn.ReLU(inplace=True),
            nn.Linear(256, 2 * lens_chart.SIZE),
        )

    def forward(self, image: Tensor, features: Tensor, parsing: Tensor | None) -> Tensor:
        """Picture (B, 3, S, S), features and parsing (B, ., S/8, S/8) -> (B, 16): the lens, log of expected errors."""
        maps = [features, self.filters(image)]
        if parsing is not None:
            maps.append(parsing)
        emitted: Tensor = self.fully_connected(self.convolutions(self.join(torch.cat(maps, 1))))
        return emitted


class Residual(nn.Module):
    """Two 3x3 convolutions with a short cut (He et al., 2016), which averages where the stride is 2."""

    def __init__(self, before: int, width: int, stride: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(*_convolution(before, width, stride), *_convolution(width, width, 1)[:2])
        self.short_cut = nn.Sequential(
            nn.AvgPool2d(stride), nn.Conv2d(before, width, 1, bias=False), nn.BatchNorm2d(width)
        )

    def forward(self, maps: Tensor) -> Tensor:
        """(B, before, h, w) -> (B, width, h/stride, w/stride)."""
        return functional.relu(self.short_cut(maps) + self.convolutions(maps))


def _convolution(before: int, width: int, stride: int) -> list[nn.Module]:
    return [
        nn.Conv2d(before, width, 3, stride, padding=1, bias=False),
        nn.BatchNorm2d(width),
        nn.ReLU(inplace=True),
    ]
