"""One call for photos that do not fill their frame, with and without looking for the circle that they end at.

    python benchmarks/image_circles.py ../shared/data/panoramas --count 80

Draws pictures through equidistant, equisolid and stereographic lenses of 165 to 205 degrees, from panoramas, in frames
of several shapes, with noise and JPEG. The error is the RMS of angles, in degrees, between the rays of the same pixels
up to 60 degrees off the axis, apart from a common factor of tan(theta), which bends nothing and no photo tells.
"""

from __future__ import annotations

import argparse
import io
import math
from pathlib import Path
from unittest import mock

import numpy as np
from PIL import Image

import fisheyerec as fr
import fisheyerec.numpy
from fisheyerec import rectifier as one_call
from fisheyerec.image_circle import find_image_circle

CONTENDERS = ("circle not looked for", "circle alone", "one call")
HEIGHT, WIDTHS = 800, (800, 1067, 1200, 1422)
# theta_d of the lens at an angle, in units of the focal length.
PROJECTIONS = {
    "equidistant": lambda theta: theta,
    "equisolid": lambda theta: 2 * np.sin(theta / 2),
    "stereographic": lambda theta: 2 * np.tan(theta / 2),
}


def draw(panorama: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, fr.FisheyeCamera]:
    """Draw a picture with an image circle, and give it with its camera."""
    height, width = panorama.shape[:2]
    sphere = fr.EquirectangularView.from_fov(fov_deg=360, image_size=(height, width))
    theta_d = PROJECTIONS[rng.choice(list(PROJECTIONS))]
    rim = math.radians(rng.uniform(165, 205)) / 2
    size = (HEIGHT, int(rng.choice(WIDTHS)))
    radius = rng.uniform(0.40, 0.58) * HEIGHT
    theta = np.linspace(0.01, 1.05 * rim, 200)
    k, *_ = np.linalg.lstsq(np.stack([theta**n for n in (3, 5, 7, 9)], -1), theta_d(theta) - theta, rcond=None)
    focal = radius / theta_d(rim)
    centre = [(side - 1) / 2 + rng.normal(0, 0.01 * HEIGHT) for side in size[::-1]]
    camera = fr.FisheyeCamera([focal, focal, *centre, *k], size)
    turn = fr.view_rotation(rng.uniform(0, 360), rng.uniform(-25, 25), rng.normal(0, 4))
    picture, _ = fr.numpy.resample(panorama, sphere, camera, source_from_target=turn)
    y, x = np.mgrid[: size[0], : size[1]]
    covered = (radius - np.hypot(x - centre[0], y - centre[1]) + 1 / 2).clip(0, 1)
    picture = picture * covered[..., None] + rng.normal(3, 2, picture.shape)
    stream = io.BytesIO()
    Image.fromarray(picture.clip(0, 255).astype(np.uint8)).save(stream, "jpeg", quality=88)
    return np.asarray(Image.open(stream)), camera


def angle_error_deg(found: fr.FisheyeCamera, truth: fr.FisheyeCamera) -> float:
    """Compare the angles of the same pixels under two cameras."""
    theta, turn = np.radians(np.meshgrid(np.arange(5, 61, 5.0), np.arange(0, 360, 30.0)))
    rays = np.stack([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)], -1)
    again, _ = found.unproject(truth.project(rays)[0])
    angles = np.arctan2(np.hypot(again[..., 0], again[..., 1]), again[..., 2]).clip(1e-3, math.radians(89))
    scaled = np.arctan(np.geomspace(0.2, 5, 400)[:, None, None] * np.tan(angles))
    return float(np.degrees(np.sqrt(np.nanmean((scaled - theta) ** 2, (1, 2))).min()))


def errors_deg(rectifier: fr.Rectifier, picture: np.ndarray, truth: fr.FisheyeCamera) -> list[float]:
    """Estimate the camera of a picture in the three ways, and compare each with the truth."""
    with mock.patch.object(one_call, "find_image_circle", return_value=None):
        without = rectifier.estimate(picture)
    estimates = [without, rectifier.estimate(picture, refine=False), rectifier.estimate(picture)]
    return [angle_error_deg(estimate.camera, truth) for estimate in estimates]


def main() -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("panoramas", type=Path, help="folder of equirectangular pictures")
    parser.add_argument("--count", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--photo", type=Path, nargs=2, action="append", default=[], metavar=("PICTURE", "LENSFILE"), help="a real one"
    )
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    paths = sorted(arguments.panoramas.glob("*.jpg"))
    rectifier = fr.Rectifier.from_pretrained()
    drawn, found = [], 0
    for _ in range(arguments.count):
        panorama = np.asarray(Image.open(paths[rng.integers(len(paths))]).convert("RGB"))
        picture, camera = draw(panorama, rng)
        drawn.append(errors_deg(rectifier, picture, camera))
        found += find_image_circle(picture) is not None
    print(f"Circle found in {found} of {arguments.count}.\n")
    print("| | median, degrees | mean | 90 % below |\n|---|---|---|---|")
    for name, values in zip(CONTENDERS, np.transpose(drawn), strict=True):
        print(f"| {name} | {np.median(values):.2f} | {np.mean(values):.2f} | {np.quantile(values, 0.9):.2f} |")
    for photo, lens in arguments.photo:
        picture = np.asarray(Image.open(photo).convert("RGB"))
        errors = errors_deg(rectifier, picture, fr.FisheyeCamera.load(lens))
        print(f"\n{photo.name}:", ", ".join(f"{n} {e:.2f}" for n, e in zip(CONTENDERS, errors, strict=True)))


if __name__ == "__main__":
    main()
