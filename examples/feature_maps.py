"""Feature maps rectified in the middle of a network that reads fisheye frames and answers in a perspective view.

    python examples/feature_maps.py [PICTURE.png]

Noisy fisheye frames go in; which pixels of a perspective view show the polygon on the wall comes out. The first
convolutions read the frame as it was taken, `DistortionRectification` rectifies their 16 feature maps (channels_last),
the others read those. One sees the overlap (intersection over union) of prediction and truth on new frames with three
things in the middle: feature maps merely resized; rectified with the true lens; rectified with a lens that starts wrong
and is learnt together with the weights, by the gradient through the layer. PICTURE shows some frames, the truth, and
the three predictions, one row each.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from wall import photograph, polygons, save

import fisheyerec as fr

FEATURES_SIZE = (32, 32)
VIEW = fr.PinholeCamera.from_fov(fov_deg=110, image_size=(48, 48))
_IDEAL = fr.FisheyeCamera.from_projection("equisolid", fov_deg=150, image_size=(64, 64))
CAMERA = fr.FisheyeCamera(_IDEAL.params + np.array([0, 0, 3, -2, 0, 0, 0, 0]), _IDEAL.image_size)


class Overlaps(NamedTuple):
    """Intersection over union with each thing in the middle, and how far off the learnt lens was and is."""

    resized: float
    true_lens: float
    learnt_lens: float
    before_px: float
    after_px: float


class LearntRectification(nn.Module):
    """The rectification layer with a lens that is a first guess and eight numbers to learn."""

    def __init__(self, view: fr.PinholeCamera, guess: fr.FisheyeCamera) -> None:
        super().__init__()
        self.layer = fr.DistortionRectification(view)
        self.guess = torch.tensor(guess.params)
        # Pixels, and less and less for k1 to k4: moved all alike they would fold the lens on the way.
        self.unit = torch.tensor([1.0] * 4 + [0.3**i / guess.params[0] for i in (1, 2, 3, 4)])
        self.steps = nn.Parameter(torch.zeros(8))

    @property
    def params(self) -> Tensor:
        """The lens as it is now, (8,)."""
        return self.guess + self.unit * self.steps

    def forward(self, features: Tensor) -> Tensor:
        """Rectify feature maps."""
        return self.layer(features, self.params)


def network(middle: nn.Module) -> nn.Sequential:
    """Build the network around what stands in the middle."""
    torch.manual_seed(0)
    # Kernel 4, stride 2 and padding 1 keep the pixel convention: each feature is centred on the 2x2 pixels it halves,
    # as camera.resize() has it. Kernel 3 would shift the maps by half a pixel.
    return nn.Sequential(
        *(nn.Conv2d(1, 16, 4, stride=2, padding=1), nn.ReLU()),
        *(nn.Conv2d(16, 16, 3, padding=1), nn.ReLU()),
        middle,
        *(nn.Conv2d(16, 16, 3, padding=1), nn.ReLU()),
        nn.Conv2d(16, 1, 3, padding=1),
    ).to(memory_format=torch.channels_last)


def frames_and_truth(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Take noisy fisheye frames (B, 1, 64, 64) of polygons; and what a perspective camera would see of them."""
    x, y, size, turn = torch.rand(4, count, generator=generator)
    corners = torch.randint(3, 7, (count,), generator=generator)
    drawing = polygons(corners, torch.stack([2 * x - 1, 2 * y - 1], -1), 0.3 + 0.4 * size, 2 * torch.pi * turn)
    frames = photograph(drawing, CAMERA)
    noise = torch.randn(frames.shape, generator=generator)
    truth = (photograph(drawing, VIEW) > 0.5).float()
    return (0.3 + 0.4 * frames + 0.2 * noise).to(memory_format=torch.channels_last), truth


def train(model: nn.Module, frames: Tensor, truth: Tensor, steps: int) -> None:
    """Train the whole network, a lens in its middle included."""
    generator = torch.Generator().manual_seed(0)
    lens = [parameter for name, parameter in model.named_parameters() if name.endswith("steps")]
    weights = [parameter for name, parameter in model.named_parameters() if not name.endswith("steps")]
    optimizer = torch.optim.Adam([{"params": weights, "lr": 1e-2}, {"params": lens}])
    for step in range(steps):
        # The gradient to the lens means nothing until the weights know what a polygon looks like.
        optimizer.param_groups[1]["lr"] = 5e-2 if step >= steps // 4 else 0.0
        chosen = torch.randint(len(frames), (16,), generator=generator)
        optimizer.zero_grad()
        F.binary_cross_entropy_with_logits(model(frames[chosen]), truth[chosen]).backward()
        optimizer.step()


def overlap(model: nn.Module, frames: Tensor, truth: Tensor) -> float:
    """Intersection over union of prediction and truth, over all frames."""
    with torch.inference_mode():
        predicted = model(frames) > 0
    wanted = truth > 0
    return float((predicted & wanted).sum() / (predicted | wanted).sum())


def distance_px(camera: fr.FisheyeCamera, true: fr.FisheyeCamera) -> float:
    """RMS distance between where two lenses look for the pixels of the view, in pixels of the feature maps."""
    height, width = VIEW.image_size
    rays, _ = VIEW.unproject(np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), -1))
    return float(((camera.project(rays)[0] - true.project(rays)[0]) ** 2).sum(-1).mean() ** 0.5)


def main(steps: int = 200, count: int = 512, picture: str | None = None) -> Overlaps:
    """Train three networks on count frames and compare them on others; write what they see to a file."""
    generator = torch.Generator().manual_seed(0)
    (frames, truth), (new_frames, new_truth) = (frames_and_truth(n, generator) for n in (count, 128))

    # The camera of the feature maps is that of the frames, resized.
    lens = CAMERA.resize(FEATURES_SIZE)
    guess = fr.FisheyeCamera.from_projection("equidistant", fov_deg=120, image_size=FEATURES_SIZE)
    learnt = LearntRectification(VIEW, guess)
    models = [
        network(nn.Upsample(VIEW.image_size, mode="bilinear")),
        network(fr.DistortionRectification(VIEW, camera=lens)),
        network(learnt),
    ]
    overlaps = []
    for name, model in zip(("resized", "rectified, true lens", "rectified, learnt lens"), models, strict=True):
        train(model, frames, truth, steps)
        overlaps.append(overlap(model, new_frames, new_truth))
        print(f"feature maps {name + ':':<24}{overlaps[-1]:.2f} overlap")
    after = fr.FisheyeCamera(learnt.params.detach().numpy(), FEATURES_SIZE)
    result = Overlaps(*overlaps, distance_px(guess, lens), distance_px(after, lens))
    print(f"the learnt lens was {result.before_px:.2f} px of the feature maps off, and is {result.after_px:.2f}")
    if picture is not None:
        with torch.inference_mode():
            seen = [new_frames, new_truth, *(model(new_frames).sigmoid() for model in models)]
        rows = (torch.cat(list(pictures[:10]), -1) for pictures in seen)
        save(picture, torch.cat([F.pad(row, (0, 640 - row.shape[-1], 2, 2), value=0.5) for row in rows], 1))
    return result


if __name__ == "__main__":
    main(picture=sys.argv[1] if len(sys.argv) > 1 else None)
