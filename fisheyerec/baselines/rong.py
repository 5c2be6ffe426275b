"""Rong, Huang, Shang, Ying, "Radial lens distortion correction using convolutional neural networks trained with
synthesized images", ACCV 2016: a network classifies the picture by the coefficient of a one-parameter division model.

    r_u = r / (1 + lambda r^2),   tan(theta) = r_u / f

where r is a pixel's distance from the middle of the picture, in units of half the diagonal of the square around it.
f, the field of view, is none of the model's business: the edge-matched view looks the same whatever it is.

The label of a synthetic picture is the class whose profile, log(tan theta(r) / tan theta(R)) at the radii of the lens
chart, is nearest to that of its true lens. The true lens has a principal point, an aspect and a shape of its own, of
which the model knows nothing: at best it explains 0.97 to 0.99 of the variance of each of the profile's four numbers.

The article was not at hand, only accounts of it: what is theirs is the method. Where it was chosen, or left:

| the article, as told | here |
|---|---|
| AlexNet | its five convolutions, three poolings and three fully connected layers, narrower, so that they ship; batch |
| | instead of response normalisation, no drop-out, pictures of 192x192, no weights of ImageNet to begin with |
| 401 classes of the coefficient | 51, evenly from -0.65 to 0.1, where the population of lenses lies: as many as the |
| | number of pictures can fill; the rounding costs 0.0005 of the variance |
| pictures with long lines, distorted by the | the pictures, lenses, optimiser and number of steps of our `compact` |
| model itself | |
| the most probable class | the same |
| | a last layer that begins with the classes in order (`_ordered_classes`) |

The weights, rong.safetensors, are trained on the data of MODEL_CARD.md, which says how and under what terms: for
research and non-commercial use only. On 256 unseen pairs they explain 0.73 of the variance of the profile.
"""

from __future__ import annotations

import math
import os
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from .. import lens_chart, pixel
from ..cameras import FisheyeCamera, PinholeCamera
from ..network import LensClasses, LensNetwork, NetworkOutput
from ..rectification import rectify
from ..rectifier import network_frame
from ..weights import fill, read_tensors
from .division import camera_of_division

COEFFICIENTS = np.linspace(-0.65, 0.1, 51)
"""lambda of each class."""


def load(path: str | os.PathLike[str] | None = None) -> RongNetwork:
    """Read the trained network, ready for inference.

    Args:
        path: a weights file as `fisheyerec train --network rong` writes it; None for the one in this package.

    Raises:
        ValueError: a file that is none or broken, or weights of another network.
        OSError: the file cannot be read.
    """
    with as_file(files(__package__) / "rong.safetensors") as shipped:
        weights = shipped if path is None else Path(path)
        network = RongNetwork()
        fill(network, read_tensors(weights), str(weights))
    return network.eval()


def estimate(image: np.ndarray, network: RongNetwork) -> FisheyeCamera:
    """Estimate the camera of a picture (H, W, 3) RGB uint8, with `fit_error_px`."""
    frame = torch.from_numpy(network_frame(image, network.longer_side)).permute(2, 0, 1)[None] / 255
    with torch.inference_mode():
        logits = network(frame, straighten=False).estimate.logits
    return camera_from_division(COEFFICIENTS[int(logits.argmax())], (image.shape[0], image.shape[1]))


def chart_from_division(coefficient: Tensor) -> Tensor:
    """Give the lens charts of division models r_u = r / (1 + lambda r^2) with the centre in the middle.

    Args:
        coefficient: (...) lambda, above -1; r is in units of half the diagonal of the square around the picture.

    Returns:
        (..., 8) float64.
    """
    coefficient = coefficient.to(torch.float64)[..., None]
    r = coefficient.new_tensor([*lens_chart.RADII, 1.0]) / math.sqrt(2)
    g = lens_chart.angle_to_g(_angle(r, coefficient))
    centred = g.new_zeros(3).expand(*g.shape[:-1], 3)
    return torch.cat([g[..., :-1] - g[..., -1:], g[..., -1:], centred], -1)


def camera_from_division(coefficient: float, image_size: tuple[int, int]) -> FisheyeCamera:
    """Fit a Kannala-Brandt camera to a division model r_u = r / (1 + lambda r^2) with the centre in the middle.

    Args:
        coefficient: lambda, above -1; r is in units of half the diagonal of the square around the picture.
        image_size: (height, width).

    Returns:
        A camera whose `fit_error_px` is the largest distance between both models within the picture.

    Raises:
        ValueError: another coefficient.
    """
    if not -1 < coefficient < math.inf:
        raise ValueError(f"camera_from_division(): expected a finite coefficient above -1, got {coefficient:g}")
    half_diagonal = max(image_size) / math.sqrt(2)
    focal = float(_focal(torch.tensor(coefficient, dtype=torch.float64)))
    centre = (pixel.centre(image_size[1]), pixel.centre(image_size[0]))
    return camera_of_division(focal * half_diagonal, centre, coefficient * focal**2, image_size)


def _angle(r: Tensor, coefficient: Tensor) -> Tensor:
    """theta(r) of a division model of the focal length that `_focal` chooses."""
    return torch.atan(r / (1 + coefficient * r**2) / _focal(coefficient))


def _focal(coefficient: Tensor) -> Tensor:
    """The focal length of a division model, chosen so that a Kannala-Brandt polynomial fits.

    For lambda < 0 the model is, as tan(theta) = 2t / (1 - t^2) for t = tan(theta / 2), the stereographic lens
    tan(theta / 2) = sqrt(-lambda) r, which a polynomial of theta fits well. With the mean lens's field of view it would
    miss strong distortion by 20 px; lenses that bend less than the mean one have that.
    """
    mean = lens_chart.angle_from_g(lens_chart.population()[0][lens_chart.FIELD_OF_VIEW]).to(coefficient.device)
    side = 2 * torch.atan((-coefficient / 2).clamp(min=0).sqrt())  # the stereographic lens's theta(R), r^2 = 1 / 2
    r_u_side = math.sqrt(2) / (2 + coefficient)
    return r_u_side / torch.maximum(side, mean).tan()


class RongNetwork(LensNetwork):
    """The classification network: pictures whose longer side is 192 in, the likeliest class of lenses out."""

    classes: Tensor

    def __init__(self) -> None:
        super().__init__(192, True, {"network": "rong"})
        self.parsing = None
        self.register_buffer("classes", chart_from_division(torch.from_numpy(COEFFICIENTS)), persistent=False)
        self.features = nn.Sequential(
            *_convolution(3, 48, 11, stride=4),
            nn.MaxPool2d(3, 2, padding=1),
            *_convolution(48, 96, 5),
            nn.MaxPool2d(3, 2, padding=1),
            *_convolution(96, 128, 3),
            *_convolution(128, 128, 3),
            *_convolution(128, 64, 3),
            nn.MaxPool2d(3, 2, padding=1),
        )
        self.classifier = nn.Sequential(
            nn.Flatten(),
            nn.Linear(64 * 6 * 6, 384),
            nn.ReLU(inplace=True),
            nn.Linear(384, 384),
            nn.ReLU(inplace=True),
            _ordered_classes(384, len(COEFFICIENTS)),
        )

    def forward(self, image: Tensor, *, straighten: bool = True) -> NetworkOutput:
        """Classify the lens and rectify the pictures.

        Args:
            image: (B, 3, H, W) RGB in [0, 1], the longer side 192.
            straighten: whether to rectify at all.

        Raises:
            ValueError: another shape, or NaN or infinite values.
        """
        logits = self.classifier(self.features(self.frame(image)))
        chart = self.classes[logits.argmax(-1)]
        size = (image.shape[-2], image.shape[-1])
        camera = FisheyeCamera(lens_chart.camera_from_chart(chart, size), size)
        view = PinholeCamera.edge_matched(camera, size)
        rectified = rectify(image, camera, view).image if straighten else None
        return NetworkOutput(camera, view, rectified, None, None, None, LensClasses(chart, logits, self.classes))


def _ordered_classes(before: int, count: int) -> nn.Linear:
    """The last layer: of chance only in what it listens to, from which it takes the classes in their order.

    So the gradient begins as that of a regression. Where each class listened to something of its own, the loss after
    22,000 pictures was still the entropy of the labels, 3.4; like this, it had fallen to 3.2 after 16,000.
    """
    layer = nn.Linear(before, count)
    place = math.sqrt(3) * torch.linspace(-1, 1, count)  # of variance 1
    with torch.no_grad():
        layer.weight.copy_(place[:, None] * layer.weight[0])
    return layer


def _convolution(before: int, width: int, kernel: int, stride: int = 1) -> list[nn.Module]:
    return [
        nn.Conv2d(before, width, kernel, stride, padding=kernel // 2, bias=False),
        nn.BatchNorm2d(width),
        nn.ReLU(inplace=True),
    ]
