"""Draws the fisheye pictures of this folder and the demo's, and the README's before and after. From the project's root:

python examples/draw.py
"""

from pathlib import Path

import numpy as np
import scenes

import fisheyerec as fr
from fisheyerec.demo.controls import EXAMPLE_LENS
from fisheyerec.pictures import Picture, read_picture, write_picture

HERE = Path(__file__).resolve().parent
IMAGES = HERE.parent / "docs" / "images"
DEMO = HERE.parent / "fisheyerec" / "demo" / "room.jpg"
SIZE = (768, 1024)

PICTURES = {
    "room": (scenes.room(seed=1), fr.FisheyeCamera.from_projection("equisolid", fov_deg=150, image_size=SIZE)),
    "street": (scenes.street(seed=2), fr.FisheyeCamera.from_projection("equidistant", fov_deg=160, image_size=SIZE)),
}


def draw(name: str) -> None:
    """Draw one scene through its fisheye camera, and save picture and lens file."""
    scene, camera = PICTURES[name]
    picture = scenes.render_camera(scene, camera.unproject, camera.image_size, supersample=3)
    write_picture(HERE / f"{name}.jpg", Picture(picture.image))
    camera.save(HERE / f"{name}.json")


def draw_for_demo() -> None:
    """Draw what the page of `fisheyerec demo` begins with, small enough to be installed with it."""
    camera = fr.FisheyeCamera.from_projection(*EXAMPLE_LENS, image_size=(720, 960))
    picture = scenes.render_camera(scenes.room(seed=5), camera.unproject, camera.image_size, supersample=3)
    write_picture(DEMO, Picture(picture.image), quality=88)


def before_and_after(names: list[str]) -> None:
    """Put each drawn picture beside its rectification, one row each, at half size."""
    rows = []
    for name in names:
        picture, camera = read_picture(HERE / f"{name}.jpg").pixels, fr.FisheyeCamera.load(HERE / f"{name}.json")
        view = fr.PinholeCamera.edge_matched(camera, camera.image_size)
        pair = (picture, fr.numpy.rectify(picture, camera, view).image)
        rows.append(np.concatenate([np.pad(half(p), ((3, 3), (3, 3), (0, 0)), constant_values=255) for p in pair], 1))
    IMAGES.mkdir(parents=True, exist_ok=True)
    write_picture(IMAGES / "before_after.jpg", Picture(np.concatenate(rows)))


def half(picture: np.ndarray) -> np.ndarray:
    """Average 2x2 pixels."""
    height, width, _ = picture.shape
    return picture.reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3)).round().astype(np.uint8)


if __name__ == "__main__":
    for name in PICTURES:
        draw(name)
    draw_for_demo()
    before_and_after(list(PICTURES))
