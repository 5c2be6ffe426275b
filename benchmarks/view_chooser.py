"""How often does a view chooser give a useless view? Over real calibrations, beside OpenCV.

    python benchmarks/view_chooser.py LENS_PROFILES.csv [--every N] [--json FILE]

The file has columns width, height, fx, fy, cx, cy, k1..k4 of `cv2.fisheye` calibrations. Each lens is asked for views
of its own picture's size. Counted as useless is, in this order, a view that

    is refused      the chooser raises an error;
    is not finite   some parameter is NaN or infinite, or a focal length is not above 0;
    is absurd       its focal length is not within 1/20 to 20 of the lens', the slope of both projections on the axis;
    is empty        less than 5 % of its pixels show any of the picture.

Also counted are broken promises: where balance 0 is to be free of invalid pixels, views with one (on a grid of 33 x 33,
corners included) that lies more than a pixel off the picture, or beyond the lens; where balance 1 is to keep the
picture, views that lose some of what lies up to 75 degrees off the axis, by more than 1 % of the view's width.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

import fisheyerec as fr

FOCAL_RATIO = 20
FILLED = 0.05
KEPT_THETA = math.radians(75)
LOST = 0.01
GRID = np.stack(np.meshgrid(np.linspace(0, 1, 33), np.linspace(0, 1, 33)), -1).reshape(-1, 2)

Chooser = Callable[[fr.FisheyeCamera], fr.PinholeCamera]


def opencv(balance: float) -> Chooser:
    """Give OpenCV's chooser, at a balance."""

    def choose(camera: fr.FisheyeCamera) -> fr.PinholeCamera:
        K, D = camera.to_opencv()
        height, width = camera.image_size
        estimate = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify
        new = estimate(K, D, (width, height), np.eye(3), balance=balance)
        return fr.PinholeCamera(np.array([new[0, 0], new[1, 1], new[0, 2], new[1, 2]]), camera.image_size)

    return choose


CHOOSERS: dict[str, Chooser] = {
    "OpenCV, balance 0": opencv(0),
    "OpenCV, balance 0.5": opencv(0.5),
    "OpenCV, balance 1": opencv(1),
    "edge_matched": lambda camera: fr.view_for(camera, camera.image_size),
    "valid_only = balance 0": lambda camera: fr.view_for(camera, camera.image_size, "valid_only"),
    "balance 0.5": lambda camera: fr.view_for(camera, camera.image_size, balance=0.5),
    "keep_all = balance 1": lambda camera: fr.view_for(camera, camera.image_size, "keep_all"),
    "valid_rectangle": lambda camera: fr.view_for(camera, camera.image_size, "valid_rectangle"),
}


def fault(camera: fr.FisheyeCamera, choose: Chooser) -> tuple[str, fr.PinholeCamera | None]:
    """Give what is wrong with the view of a lens, "" for nothing, and the view where it is of any use."""
    try:
        view = choose(camera)
    except (ValueError, cv2.error):
        return "refused", None
    params = np.asarray(view.params)
    if not np.isfinite(params).all() or (params[:2] <= 0).any():
        return "not finite", None
    ratio = math.sqrt(params[0] * params[1] / abs(camera.params[0] * camera.params[1]))
    if not 1 / FOCAL_RATIO <= ratio <= FOCAL_RATIO:
        return "absurd", None
    if filled(camera, view).mean() < FILLED:
        return "empty", None
    return "", view


def filled(camera: fr.FisheyeCamera, view: fr.PinholeCamera) -> np.ndarray:
    """Tell which points of a grid on the view show the picture, or are a pixel off it at most."""
    height, width = view.image_size
    points, valid = camera.project(view.unproject(GRID * [width - 1, height - 1])[0])
    height, width = camera.image_size
    return np.asarray(valid & ((points >= -1) & (points <= [width, height])).all(-1))


def loses(camera: fr.FisheyeCamera, view: fr.PinholeCamera) -> bool:
    """Tell whether some of the picture up to KEPT_THETA lies outside the view."""
    height, width = camera.image_size
    rays, valid = camera.unproject(GRID * [width - 1, height - 1])
    near = valid & (rays[:, 2] >= math.cos(KEPT_THETA))
    points, _ = view.project(rays[near])
    height, width = view.image_size
    margin = LOST * width
    return not ((points >= -margin) & (points <= [width + margin, height + margin])).all()


def count(cameras: list[fr.FisheyeCamera], name: str, choose: Chooser) -> dict[str, int]:
    """Count the faults and broken promises of one chooser."""
    faults: Counter[str] = Counter()
    for camera in cameras:
        kind, view = fault(camera, choose)
        faults[kind] += 1
        if view is not None:
            faults["invalid pixels"] += name.endswith("balance 0") and not filled(camera, view).all()
            faults["loses picture"] += name.endswith("balance 1") and loses(camera, view)
    return dict(faults)


def main() -> None:
    """Count and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("profiles", type=Path)
    parser.add_argument("--every", type=int, default=1, help="only every Nth lens")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with arguments.profiles.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))[:: arguments.every]
    names = fr.FisheyeCamera.parameter_names
    cameras = [fr.FisheyeCamera([float(r[name]) for name in names], (int(r["height"]), int(r["width"]))) for r in rows]
    kinds = ["refused", "not finite", "absurd", "empty", "invalid pixels", "loses picture"]
    print(f"{len(cameras)} lenses\n\n| view | {' | '.join(kinds)} |\n|---|{'---|' * len(kinds)}")
    results = {}
    for name, choose in CHOOSERS.items():
        results[name] = faults = count(cameras, name, choose)
        promised = {"invalid pixels": name.endswith("balance 0"), "loses picture": name.endswith("balance 1")}
        cells = [str(faults.get(kind, 0)) if promised.get(kind, True) else "" for kind in kinds]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({"lenses": len(cameras), "views": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
