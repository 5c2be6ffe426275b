"""A network trained on ordinary pictures is made to see fisheye frames: one layer in front, nothing retrained.

    python examples/fisheye_frames.py [PICTURE.png]

A small network learns to tell triangles, squares, pentagons and discs in pictures of a perspective camera; then a
fisheye camera looks at the same walls. One sees the share of shapes named right, by the network on the perspective
pictures it was made for, by the same network on fisheye frames, and with `DistortionRectification` in front of it in an
`nn.Sequential`: as in the first case. PICTURE shows some shapes in the three guises, one below the other.
"""

from __future__ import annotations

import math
import sys
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from wall import Drawing, photograph, polygons, save

import fisheyerec as fr

CORNERS = torch.tensor([3, 4, 5, 60])
VIEW = fr.PinholeCamera.from_fov(fov_deg=120, image_size=(64, 64))
CAMERA = fr.FisheyeCamera.from_projection("equidistant", fov_deg=170, image_size=(128, 128))


class Accuracy(NamedTuple):
    """Shares of shapes named right; and how far apart the answers to rectified and perspective pictures are.

    The latter is the RMS difference of the network's outputs, relative to the outputs' own standard deviation.
    """

    perspective: float
    fisheye: float
    rectified: float
    difference: float


def shapes(count: int, generator: torch.Generator) -> tuple[Drawing, Tensor]:
    """Draw count shapes anywhere on their walls, of any size and angle; and which of the four each of them is."""
    kind = torch.randint(len(CORNERS), (count,), generator=generator)
    x, y, size, turn = torch.rand(4, count, generator=generator)
    centre = 1.8 * torch.stack([x, y], -1) - 0.9
    return polygons(CORNERS[kind], centre, (1 + size) / 2, 2 * math.pi * turn), kind


def trained_network(steps: int, generator: torch.Generator) -> nn.Module:
    """Train a network on perspective pictures, as whoever published its weights did."""
    torch.manual_seed(0)
    network = nn.Sequential(
        *(nn.Conv2d(1, 16, 5, stride=2, padding=2), nn.ReLU()),
        *(nn.Conv2d(16, 32, 3, stride=2, padding=1), nn.ReLU()),
        *(nn.Conv2d(32, 32, 3, stride=2, padding=1), nn.ReLU()),
        *(nn.Conv2d(32, 64, 3, padding=1), nn.ReLU()),
        *(nn.AdaptiveMaxPool2d(1), nn.Flatten(), nn.Linear(64, len(CORNERS))),
    )
    drawing, kinds = shapes(1024, generator)
    pictures = photograph(drawing, VIEW, supersample=2)
    optimizer = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, total_steps=steps)
    for step in range(steps):
        chosen = torch.randint(len(kinds), (64,), generator=generator)
        batch = pictures[chosen].rot90(step % 4, (-2, -1))
        optimizer.zero_grad()
        F.cross_entropy(network(batch), kinds[chosen]).backward()
        optimizer.step()
        schedule.step()
    return network.eval()


@torch.inference_mode()
def compared(network: nn.Module, perspective: Tensor, fisheye: Tensor, kinds: Tensor) -> Accuracy:
    """Ask the network about the same shapes three times."""
    seeing_fisheye = nn.Sequential(fr.DistortionRectification(VIEW, camera=CAMERA), network)

    expected = network(perspective)
    # Scaled to the size the network was trained at, to be fair.
    bare = network(F.interpolate(fisheye, VIEW.image_size, mode="bilinear", antialias=True))
    rectified = seeing_fisheye(fisheye)
    right = [float((outputs.argmax(1) == kinds).float().mean()) for outputs in (expected, bare, rectified)]
    return Accuracy(*right, float((rectified - expected).square().mean().sqrt() / expected.std()))


def main(steps: int = 300, count: int = 256, picture: str | None = None) -> Accuracy:
    """Train for some steps, then compare on count shapes; write some of them to a file."""
    generator = torch.Generator().manual_seed(0)
    network = trained_network(steps, generator)
    drawing, kinds = shapes(count, generator)
    perspective, fisheye = photograph(drawing, VIEW), photograph(drawing, CAMERA)
    accuracy = compared(network, perspective, fisheye, kinds)
    print(f"perspective pictures:            {accuracy.perspective:6.1%} named right")
    print(f"fisheye frames:                  {accuracy.fisheye:6.1%}")
    print(f"fisheye frames, layer in front:  {accuracy.rectified:6.1%}")
    print(f"outputs with the layer differ from those on perspective pictures by {accuracy.difference:.1%}")
    if picture is not None:
        rectified = fr.rectify(fisheye, CAMERA, VIEW).image
        rows = (torch.cat(list(pictures[:8]), -1) for pictures in (perspective, fisheye, rectified))
        save(picture, torch.cat([F.pad(row, (0, 8 * 128 - row.shape[-1], 2, 2), value=0.5) for row in rows], 1))
    return accuracy


if __name__ == "__main__":
    main(picture=sys.argv[1] if len(sys.argv) > 1 else None)
