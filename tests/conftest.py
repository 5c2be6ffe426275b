"""What every test shares: the package under test, the table of cameras, the table of tolerances."""

from __future__ import annotations

import csv
import functools
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"


def _leave_source_tree() -> None:
    """Take the checkout off sys.path where its package has no compiled part, so that the installed one is tested.

    `python -m pytest` puts the current folder first; the source tree there would shadow the installation.
    """
    if not any((ROOT / "fisheyerec").glob("_C*")):
        sys.path[:] = [entry for entry in sys.path if Path(entry or os.curdir).resolve() != ROOT]


_leave_source_tree()

import torch  # noqa: E402  after sys.path is right, as is what follows

import fisheyerec as fr  # noqa: E402


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let tests that look at the demo's page leave pictures of it."""
    parser.addoption("--screenshots", type=Path, metavar="FOLDER", help="folder for pictures of the demo's page")


# --- Tolerances -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tolerances:
    """Every tolerance of the tests, by cause. Relative ones are of the size of what is compared."""

    rounding: float = 1e-12
    """A handful of float64 operations: identities that hold exactly on paper (relative)."""
    round_trip: float = 1e-11
    """There and back through the lens: as above, through a polynomial, an arctangent and a square root (relative to
    the picture's diagonal)."""
    opencv: float = 1e-9
    """Against cv2.fisheye in float64, which orders its sums differently and iterates to 1e-10 (relative)."""
    opencv_float32: float = 2e-7
    """Against OpenCV's float32 maps: their own rounding (relative)."""
    reference: float = 1e-9
    """The op against reference.py in float64, both a picture's values in [0, 1] and gradients (relative)."""
    float32_px: float = 1e-6
    """Where float32 arithmetic looks for a pixel (relative to the picture's diagonal)."""
    float32_gradient: float = 1e-4
    """float32 gradients against float64, on pictures with natural statistics (relative to the largest)."""
    uint8: float = 1.0
    """One grey level: rounding half up after sums that were rounded differently."""
    bfloat16: float = 2.0**-8
    """One unit in the last place of bfloat16 below 1: eight bits of mantissa."""
    float16: float = 2.0**-11
    """One unit in the last place of float16 below 1: eleven bits of mantissa."""
    layout: float = 2.0**-22
    """The same float32 sums in another memory layout, where compilers fuse other multiplications and additions."""
    fit_px: float = 0.1
    """Kannala-Brandt fitted to an ideal projection, at 1000 px and up to 180 degrees."""


TOLERANCES = Tolerances()


@pytest.fixture(scope="session")
def tolerance() -> Tolerances:
    return TOLERANCES


# --- Cameras --------------------------------------------------------------------------------------

# Written here, so that the tests mean something without ../shared: height, width, fx, fy, cx, cy, k1..k4.
WRITTEN = {
    "mild_60": (480, 640, 560.0, 561.5, 321.25, 236.5, -0.02, 0.004, -0.001, 0.0),
    "wide_120": (960, 1280, 560.0, 558.0, 645.3, 470.1, 0.065, -0.006, -0.004, 0.006),
    "half_angle_near_90": (600, 800, 254.8, 254.5, 399.0, 300.2, 0.0, 0.0, 0.0, 0.0),
    "over_180_equidistant_220": (500, 500, 130.2, 130.2, 249.5, 249.5, 0.0, 0.0, 0.0, 0.0),
    "squeezed_off_centre": (300, 500, 210.0, 150.0, -30.0, 350.0, -0.04, 0.02, -0.026, 0.008),
    # theta_d turns at 58 degrees, well inside the frame.
    "folds_in_frame": (480, 640, 300.0, 300.0, 320.0, 240.0, -0.3, -0.01, 0.0, 0.0),
    # theta_d rises to 51 degrees, falls to 70 and rises again: what lies beyond the first turn is no picture either.
    "folds_and_rises_again": (480, 640, 300.0, 300.0, 320.0, 240.0, -23 / 36, 1 / 6, 0.0, 0.0),
    # Tame inside the frame, 800 times as steep at pi: a table laid evenly over theta_d would miss the frame.
    "runs_wild_beyond_frame": (720, 1280, 590.0, 590.0, 640.0, 360.0, 0.316, 0.116, -0.005, 0.131),
}

PROJECTED = {
    "equidistant_170": ("equidistant", 170),
    "stereographic_170": ("stereographic", 170),
    "equisolid_170": ("equisolid", 170),
    "orthographic_170": ("orthographic", 170),
}

CALIBRATED = {
    "gopro_chessboard": "fisheye/gopro_chessboard/camera.json",
    "wide_chessboard": "fisheye/wide_chessboard/camera.json",
    "surround_view_front": "fisheye/surround_view/front.json",
    "surround_view_left": "fisheye/surround_view/left.json",
    "kalibr": "fisheye/camera_files/kalibr/KB.yml",
}

# Rows of lens_profiles.csv, by brand, model, lens and width.
PROFILES = {
    "profile_gh4_meike_235_deg": ("Panasonic", "Lumix GH4", "meike 3,5mm", 1920),
    "profile_zv_e10_meike_157_deg": ("Sony", "ZV-E10", "MEIKE 7.5mm F2.8", 3840),
    "profile_insta360_go": ("Insta360", "Go", "fisheye", 2720),
    "profile_gear_360": ("Samsung", "Gear 360 (2017)", "180 Degree", 1920),
    "profile_hero5_session": ("GoPro", "HERO5 Session", "", 2704),
    "profile_a7iii_laowa_15mm": ("Sony", "a7III", "Laowa 15mm", 3840),
    "profile_keychain_wild": ("AKASO", "KeyChain_1920x1080", "", 1920),
    "profile_zv_e10_35mm_wild": ("Sony", "ZV-E10", "7Artisans 35mm f1.8 (crop)", 3840),
    "profile_hero12_max_folds": ("GoPro", "HERO12 Black", "Max", 1920),
    "profile_walksnail_folds": ("Walksnail", "Avatar Micro V1", "", 1280),
    "profile_iphone12_folds": ("Apple", "iPhone 12", "Ultra Wide", 1920),
    "profile_a7rii_ttartisan_folds": ("Sony", "a7rII", "TTArtisan  7.5mm F2", 3840),
    "profile_philips_folds": ("Philips", "adr810", "", 1920),
}

LENSES = [*WRITTEN, *PROJECTED, *CALIBRATED, *PROFILES]


@functools.cache
def _profile_rows() -> list[dict[str, str]]:
    with open(SHARED / "lens_profiles.csv", newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _profile(row: dict[str, str]) -> Any:
    params = [float(row[name]) for name in fr.FisheyeCamera.parameter_names]
    return fr.FisheyeCamera(params, (int(row["height"]), int(row["width"])))


def _lens(name: str) -> Any:
    if name in WRITTEN:
        height, width, *params = WRITTEN[name]
        return fr.FisheyeCamera(params, (height, width))
    if name in PROJECTED:
        projection, fov_deg = PROJECTED[name]
        return fr.FisheyeCamera.from_projection(projection, fov_deg, (750, 1000))
    file = SHARED / CALIBRATED.get(name, "lens_profiles.csv")
    if not file.exists():
        pytest.skip(f"real calibration not there: {file}")
    if name in CALIBRATED:
        return fr.FisheyeCamera.load(file)
    brand, model, lens, width = PROFILES[name]
    wanted = {"brand": brand, "model": model, "lens": lens, "width": str(width)}
    return _profile(next(row for row in _profile_rows() if wanted.items() <= row.items()))


@pytest.fixture(params=LENSES)
def lens(request: pytest.FixtureRequest) -> Any:
    """One camera after the other of the whole table; `indirect` parametrisation picks some by name."""
    return _lens(request.param)


@pytest.fixture(scope="session")
def every_profile() -> list[Any]:
    """All calibrations of lens_profiles.csv."""
    if not (SHARED / "lens_profiles.csv").exists():
        pytest.skip(f"real calibrations not there: {SHARED / 'lens_profiles.csv'}")
    return [_profile(row) for row in _profile_rows()]


# --- Pictures -------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def picture() -> Callable[..., torch.Tensor]:
    """picture(batch, channels, height, width, seed=0): float64 in [0, 1] with the 1/f spectrum of photographs."""

    def make(batch: int, channels: int, height: int, width: int, seed: int = 0) -> torch.Tensor:
        rng = np.random.default_rng(seed)
        frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
        frequency[0, 0] = np.inf
        noise = np.fft.rfft2(rng.standard_normal((batch, channels, height, width)))
        values = np.fft.irfft2(noise / frequency, s=(height, width))
        low = values.min((-2, -1), keepdims=True)
        spread = np.ptp(values, (-2, -1))[..., None, None]
        return torch.from_numpy((values - low) / np.where(spread > 0, spread, 1))

    return make


# --- Processes and threads ------------------------------------------------------------------------


@pytest.fixture
def threads() -> Any:
    """torch.set_num_threads, put back afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def run_python(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run Python code in a fresh process that imports the package under test, wherever that lies."""

    def run(code: str, timeout: float = 120, **environment: str) -> subprocess.CompletedProcess[str]:
        home = str(Path(fr.__file__).resolve().parents[1])
        path = os.pathsep.join(filter(None, [home, os.environ.get("PYTHONPATH")]))
        return subprocess.run(
            [sys.executable, "-c", code],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path, **environment},
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return run


@pytest.fixture
def hears_ctrl_c() -> Callable[[], object]:
    """For `preexec_fn` of a process that is to be interrupted: shells start their background jobs deaf to it."""
    return lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of a drawn scene that pans, with a tone, as MP4."""
    pytest.importorskip("av", reason="PyAV is not installed")
    import clips

    path = tmp_path_factory.mktemp("clips") / "clip.mp4"
    clips.make_clip(path)
    return path


# --- Training -------------------------------------------------------------------------------------


@pytest.fixture
def one_thread(threads: Callable[[int], None]) -> None:
    """Torch computes with one thread, so that runs are the same to the last bit."""
    threads(1)


@pytest.fixture
def tiny_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever network training asks for is a tiny one."""
    import tiny_training

    monkeypatch.setattr(fr.FishEyeRecNet, "from_design", staticmethod(tiny_training.tiny))


@pytest.fixture
def batch() -> Any:
    """Eight pairs with their straight pictures; two have no labels."""
    import tiny_training

    return tiny_training.draw_batch()
