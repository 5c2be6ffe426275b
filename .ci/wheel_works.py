"""Uses the installed package as its first user would, without compiler and checkout.

python .ci/wheel_works.py EXAMPLES     where EXAMPLES is the folder of room.jpg and room.json
"""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import fisheyerec as fr


def check_command_line(examples: Path) -> None:
    """A calibrated picture becomes another, and the shipped weights are found."""
    program = Path(sysconfig.get_path("scripts")) / "fisheyerec"
    room = str(examples / "room.jpg")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "out.jpg")
        subprocess.run([program, "rectify", room, "--camera", examples / "room.json", "-o", out], check=True)
        before, after = np.asarray(Image.open(room)), np.asarray(Image.open(out))
    assert after.shape == before.shape, f"expected a picture {before.shape}, got {after.shape}"
    assert np.abs(after.astype(int) - before).mean() > 10, "the picture did not change"
    estimate = json.loads(subprocess.check_output([program, "estimate", room, "--json"]))
    assert estimate["distorted"], f"expected a fisheye lens, got {estimate}"


def check_numpy(examples: Path) -> np.ndarray:
    """The NumPy door opens without torch."""
    camera = fr.FisheyeCamera.load(examples / "room.json")
    picture = np.asarray(Image.open(examples / "room.jpg"))
    view = fr.PinholeCamera.edge_matched(camera, camera.image_size)
    image, valid = fr.numpy.rectify(picture.astype(np.float32), camera, view)
    assert valid.all()
    assert "torch" not in sys.modules, "fisheyerec.numpy imported torch"
    return image


def check_torch(examples: Path, expected: np.ndarray) -> None:
    """The op gives what the NumPy door gave, and its gradient to the lens is the reference's."""
    import torch

    lens = fr.FisheyeCamera.load(examples / "room.json")
    params = torch.tensor(lens.params, requires_grad=True)
    camera = fr.FisheyeCamera(params, lens.image_size)
    view = fr.PinholeCamera.edge_matched(lens, lens.image_size)
    picture = torch.tensor(np.asarray(Image.open(examples / "room.jpg"))).double().permute(2, 0, 1)[None]
    cameras = (params[None], torch.tensor(view.params)[None], None, camera.model, view.model, *view.image_size)
    ours = fr.rectify(picture, camera, view).image
    reference, _ = fr.reference.resample(picture, *cameras, "bilinear", "zeros")
    torch.testing.assert_close(ours[0].permute(1, 2, 0), torch.tensor(expected).double(), rtol=0, atol=0.05)
    gradients = [torch.autograd.grad(image.square().mean(), params)[0] for image in (ours, reference)]
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=0)


def loaded_libgomps() -> set[str]:
    """Give the files of every libgomp in this process; none on systems without /proc."""
    maps = Path("/proc/self/maps")
    lines = maps.read_text().splitlines() if maps.exists() else []
    return {line.split()[-1] for line in lines if "libgomp" in line}


if __name__ == "__main__":
    examples = Path(sys.argv[1])
    home, site = Path(fr.__file__).parents[1], Path(sysconfig.get_path("platlib"))
    assert home.samefile(site), f"expected the installed package in {site}, got {home}"
    check_command_line(examples)
    image = check_numpy(examples)
    brought = set(map(str, site.glob("torch/lib/libgomp.so.1")))
    assert not brought or loaded_libgomps() == brought, f"expected {brought}, got {loaded_libgomps()}"
    check_torch(examples, image)
    assert len(loaded_libgomps()) <= 1, f"two teams of threads: {loaded_libgomps()}"
    print(f"fisheyerec {fr.__version__} works: command line, NumPy door, torch op and its gradient")
