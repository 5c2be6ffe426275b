"""A lens recovered by gradient descent through the rectification layer, from one fisheye picture of straight lines.

    python examples/recover_lens.py [PICTURE.png]

A chart of straight lines whose layout is known hangs in front of a fisheye camera whose lens is not. All that is
minimised is the difference between the rectified picture and the chart; its gradient reaches the eight numbers of the
lens through `DistortionRectification`. One sees how far the lens is from the true one, as the RMS distance in pixels
over the whole fisheye picture, while both pictures get sharper. PICTURE shows the fisheye picture, and what the first
guess and the recovered lens make of it, over the chart: red where only the chart has a line, cyan where only the
rectified picture has one, white where they agree.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from wall import photograph, save

import fisheyerec as fr

BLURS = (12.0, 6.0, 3.0, 1.5, 0.7)
"""Standard deviations in pixels. Wide ones first: lines that do not touch their counterparts pull in no direction."""


class Recovery(NamedTuple):
    """The lens that was found, and the distance from the true one before and after, in pixels."""

    camera: fr.FisheyeCamera
    before_px: float
    after_px: float


def chart(points: Tensor) -> Tensor:
    """Draw 24 white lines in all directions, at uneven distances from the middle."""
    x, y = points.unbind(-1)
    distances = 3 * torch.rand(24, generator=torch.Generator().manual_seed(1)) - 1.5
    lit = torch.zeros_like(x, dtype=torch.bool)
    for angle, distance in zip(torch.linspace(0, torch.pi, 25), distances, strict=False):
        lit |= (x * angle.cos() + y * angle.sin() - distance).abs() < 0.02
    return lit[None].float()


def blur(pictures: Tensor, sigma: float) -> Tensor:
    """Convolve with a Gaussian."""
    radius = round(3 * sigma)
    kernel = torch.exp(-(torch.arange(-radius, radius + 1) / sigma).square() / 2)
    kernel = (kernel / kernel.sum()).expand(pictures.shape[1], 1, 1, -1)
    padded = F.pad(pictures, (radius,) * 4, mode="replicate")
    across = F.conv2d(padded, kernel, groups=len(kernel))
    return F.conv2d(across, kernel.mT, groups=len(kernel))


def distance_px(camera: fr.FisheyeCamera, true: fr.FisheyeCamera) -> float:
    """RMS distance between where two lenses put what the true one sees, over its whole picture."""
    height, width = true.image_size
    pixels = torch.cartesian_prod(torch.arange(width).double(), torch.arange(height).double()).numpy()
    points, _ = camera.project(true.unproject(pixels)[0])
    return float(((points - pixels) ** 2).sum(-1).mean() ** 0.5)


def main(image_size: tuple[int, int] = (240, 320), picture: str | None = None) -> Recovery:
    """Recover a lens, telling how it goes; write what it looks like to a file."""
    height, width = image_size
    ideal = fr.FisheyeCamera.from_projection("equisolid", fov_deg=100, image_size=image_size)
    off_ideal = np.array([0, width / 200, width / 50, -width / 70, 0, 0, 0, 0])  # pixels not square, lens not centred
    true = fr.FisheyeCamera(ideal.params + off_ideal, image_size)
    view = fr.view_for(true, (height * 6 // 5, width * 6 // 5), "keep_all")
    fisheye, straight = photograph(chart, true), photograph(chart, view)
    # A second channel of ones becomes the share of each pixel of the view that the fisheye picture covers.
    covered = torch.cat([fisheye, torch.ones_like(fisheye)], 1)

    # A first guess from nothing but the size of the picture: equidistant, too long a lens, centred.
    focal = 0.66 * width
    guess = torch.tensor([focal, focal, ideal.params[2], ideal.params[3], 0, 0, 0, 0], dtype=torch.float64)
    # Steps of one move the picture by one pixel, where a ray is one radian off the axis.
    unit = torch.tensor([1.0] * 4 + [1 / focal] * 4, dtype=torch.float64)
    steps = nn.Parameter(torch.zeros(8, dtype=torch.float64))
    layer = fr.DistortionRectification(view)

    def camera() -> fr.FisheyeCamera:
        return fr.FisheyeCamera((guess + unit * steps).detach().numpy(), image_size)

    def over_chart() -> Tensor:
        rectified = layer(fisheye, guess + unit * steps)[0]
        return torch.cat([straight[0], rectified, rectified])

    before_px, first_look = distance_px(camera(), true), over_chart()
    print(f"first guess: {before_px:.2f} px from the true lens")
    for sigma in BLURS:
        source, wanted = blur(covered, sigma), blur(straight, sigma)
        optimizer = torch.optim.LBFGS([steps], line_search_fn="strong_wolfe")

        def loss(source: Tensor = source, wanted: Tensor = wanted) -> Tensor:
            steps.grad = None
            rectified, share = layer(source, guess + unit * steps).split(1, 1)
            difference = 1e3 * (rectified - share * wanted).square().sum() / share.sum()
            difference.backward()
            return difference

        optimizer.step(loss)
        print(f"pictures blurred by {sigma:4.1f} px: {distance_px(camera(), true):.3f} px from the true lens")
    if picture is not None:
        save(picture, fisheye[0], first_look, over_chart())
    return Recovery(camera(), before_px, distance_px(camera(), true))


if __name__ == "__main__":
    main(picture=sys.argv[1] if len(sys.argv) > 1 else None)
