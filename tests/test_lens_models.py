"""Lenses of other models: each against its publication or OpenCV, and the Kannala-Brandt cameras fitted to them."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import fisheyerec as fr
from fisheyerec import lens_models
from fisheyerec.camera_files import read_camera_file
from fisheyerec.camera_files.record import HOUSE_MODELS, PARAMETERS

SIZE = (480, 640)
K = (301.5, 302.25, 319.75, 240.5)
LONGER = (452.25, 453.5, 319.75, 240.5)


def grid(image_size=SIZE, count=41):
    """Positions (count^2, 2) over the picture, edge to edge."""
    height, width = image_size
    x, y = (np.linspace(-0.5, size - 0.5, count) for size in (width, height))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


# --- Forward equations, as published --------------------------------------------------------------


def pixels(x, y, fx, fy, cx, cy):
    return np.stack([fx * x + cx, fy * y + cy], -1)


def project_unified(X, Y, Z, fx, fy, cx, cy, xi, k1, k2, p1, p2):
    """Mei and Rives 2007: the unit sphere, seen from xi above its centre, then Brown's distortion."""
    d = np.sqrt(X**2 + Y**2 + Z**2)
    x, y = X / (Z + xi * d), Y / (Z + xi * d)
    s = x**2 + y**2
    radial = 1 + k1 * s + k2 * s**2
    x, y = (
        x * radial + 2 * p1 * x * y + p2 * (s + 2 * x**2),
        y * radial + p1 * (s + 2 * y**2) + 2 * p2 * x * y,
    )
    return pixels(x, y, fx, fy, cx, cy)


def project_extended_unified(X, Y, Z, fx, fy, cx, cy, alpha, beta):
    """Khomutenko, Garcia and Martinet 2016."""
    denominator = alpha * np.sqrt(beta * (X**2 + Y**2) + Z**2) + (1 - alpha) * Z
    return pixels(X / denominator, Y / denominator, fx, fy, cx, cy)


def project_double_sphere(X, Y, Z, fx, fy, cx, cy, xi, alpha):
    """Usenko, Demmel and Cremers 2018."""
    d1 = np.sqrt(X**2 + Y**2 + Z**2)
    d2 = np.sqrt(X**2 + Y**2 + (xi * d1 + Z) ** 2)
    denominator = alpha * d2 + (1 - alpha) * (xi * d1 + Z)
    return pixels(X / denominator, Y / denominator, fx, fy, cx, cy)


def project_division(X, Y, Z, fx, fy, cx, cy, k1):
    """Fitzgibbon's r_u = r / (1 + k1 r^2), solved for r; with Z instead of r_u for rays beyond 90 degrees."""
    R = np.hypot(X, Y)
    r = 2 * R / (Z + np.sqrt(Z**2 - 4 * k1 * R**2))
    return pixels(r * X / R, r * Y / R, fx, fy, cx, cy)


def project_field_of_view(X, Y, Z, fx, fy, cx, cy, omega):
    """Devernay and Faugeras 2001."""
    ru = np.hypot(X, Y) / Z
    rd = np.arctan(2 * ru * np.tan(omega / 2)) / omega
    return pixels(rd / ru * X / Z, rd / ru * Y / Z, fx, fy, cx, cy)


def project_thin_prism_fisheye(X, Y, Z, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, s1, s3):
    """COLMAP's camera models: the equidistant plane, then radial, tangential and thin prism terms."""
    R = np.hypot(X, Y)
    theta = np.arctan2(R, Z)
    u, v = theta * X / R, theta * Y / R
    s = theta**2
    radial = k1 * s + k2 * s**2 + k3 * s**3 + k4 * s**4
    x = u + u * radial + 2 * p1 * u * v + p2 * (s + 2 * u**2) + s1 * s
    y = v + v * radial + 2 * p2 * u * v + p1 * (s + 2 * v**2) + s3 * s
    return pixels(x, y, fx, fy, cx, cy)


def project_brown_conrady(X, Y, Z, fx, fy, cx, cy, *coefficients):
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rays = np.stack([X, Y, Z], -1)
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))[0][:, 0]


PROJECT = {
    "unified": project_unified,
    "extended_unified": project_extended_unified,
    "double_sphere": project_double_sphere,
    "division": project_division,
    "field_of_view": project_field_of_view,
    "thin_prism_fisheye": project_thin_prism_fisheye,
    "brown_conrady": project_brown_conrady,
}

# Lenses that see every pixel of the picture, and how well Kannala-Brandt fits them, in pixels.
LENSES = {
    "unified": ("unified", (*K, 0.9, 0, 0, 0, 0), 0.02),
    "unified, bent": ("unified", (K[0] * 2, K[1] * 2, *K[2:], 1.2, -0.2, 0.06, 1e-3, -5e-4), 1.0),
    "unified, a pinhole": ("unified", (*K, 0.0, 0, 0, 0, 0), 0.1),
    "extended_unified": ("extended_unified", (*K, 0.58, 1.14), 0.01),
    "extended_unified, beyond 1": ("extended_unified", (*K, 0.6, 0.4), 0.2),
    "double_sphere": ("double_sphere", (K[0] * 0.7, K[1] * 0.7, *K[2:], -0.24, 0.565), 0.1),
    "double_sphere, over 180": ("double_sphere", (150, 151, *K[2:], -0.27, 0.51), 0.3),
    "division": ("division", (*K, -0.25), 0.1),
    "division, over 180": ("division", (200, 200, *K[2:], -0.3), 0.3),
    "field_of_view": ("field_of_view", (*K, 0.92), 0.1),
    "thin_prism_fisheye": ("thin_prism_fisheye", (*K, -0.03, 0.01, 2e-4, -3e-4, -0.004, 5e-4, 4e-4, -2e-4), 0.6),
    "brown_conrady, 5": ("brown_conrady", (*LONGER, -0.2, 0.05, 4e-4, -2e-4, 0.01, *[0] * 7), 0.5),
    "brown_conrady, 8": ("brown_conrady", (*LONGER, 0.8, 0.1, 2e-4, -3e-4, 0.01, 1.1, 0.3, 0.02, *[0] * 4), 0.7),
    "brown_conrady, 12": (
        "brown_conrady",
        (*LONGER, -0.2, 0.05, 1e-4, -2e-4, 0.01, 0.02, 0.01, 0.001, 2e-4, -1e-4, 1e-4, 2e-4),
        0.5,
    ),
}


@pytest.fixture(params=LENSES)
def other(request):
    return LENSES[request.param]


def test_every_model_a_file_may_hold_is_converted_or_the_houses_own():
    assert set(PARAMETERS) == {*lens_models.MODELS, *HOUSE_MODELS}
    assert {model for model, _, _ in LENSES.values()} | {"ocam"} == set(lens_models.MODELS)


def test_pixels_come_back_through_the_published_equations(other):
    model, params, _ = other
    points = grid()
    rays = lens_models.unproject(model, params, points)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=1e-12)
    away = np.hypot(*(points - params[2:4]).T) > 1e-3  # the published equations divide by the radius
    again = PROJECT[model](*rays[away].T, *params)
    np.testing.assert_allclose(again, points[away], atol=1e-8)


def test_rays_come_back_from_where_the_published_equations_see_them(other):
    """No other ray lands on the same pixel: the inverse is on the branch that begins at the optical axis."""
    model, params, _ = other
    theta, phi = np.meshgrid(np.radians(np.linspace(1, 50, 15)), np.linspace(0, 6, 13))
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    again = lens_models.unproject(model, params, PROJECT[model](*rays.T, *params))
    np.testing.assert_allclose(again, rays, atol=1e-10)


def test_the_shape_of_points_is_kept():
    model, params, _ = LENSES["double_sphere"]
    points = grid().reshape(41, 41, 2)
    rays = lens_models.unproject(model, params, points)
    assert rays.shape == (41, 41, 3)
    np.testing.assert_array_equal(rays[3, 5], lens_models.unproject(model, params, points[3, 5]))


def test_ocam_is_cam2world_of_its_toolbox(tmp_path):
    """cam2world of OCamCalib, in its own axes (rows first, z backwards), from the numbers of a calib_results.txt."""
    a = np.array([-209.3, 0.0, 2.216e-3, -5.12e-6, 2.15e-8])
    row0, column0, c, d, e = 243.6, 359.8, 0.9989, -1.7e-2, 1.1e-2
    text = (
        "#polynomial coefficients for the DIRECT mapping function\n\n"
        f"5 {' '.join(map(str, a))}\n\n#inverse\n\n1 0\n\n#center\n\n{row0} {column0}\n\n"
        f"#affine\n\n{c} {d} {e}\n\n#size\n\n480 752\n"
    )
    path = tmp_path / "calib_results.txt"
    path.write_text(text)
    file = read_camera_file(path)
    points = grid((480, 752))
    column, row = points.T
    x, y = np.linalg.solve([[c, d], [e, 1]], np.stack([row - row0, column - column0]))
    z = np.polyval(a[::-1], np.hypot(x, y))
    expected = np.stack([y, x, -z], -1)  # to the right, down, to the front
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    rays = lens_models.unproject("ocam", file.params, points)
    # But for a turn about the optical axis, of the affine map's nearest rotation.
    u, _, vt = np.linalg.svd([[1, e], [d, c]])
    turn = np.eye(3)
    turn[:2, :2] = u @ vt
    np.testing.assert_allclose(rays, expected @ turn.T, atol=1e-12)
    assert np.degrees(np.arctan2(turn[1, 0], turn[0, 0])) == pytest.approx(np.degrees((d - e) / (1 + c)), rel=1e-3)


def test_a_turn_of_the_frame_is_no_distortion():
    """OCamCalib's d = -e: a frame that is turned by 3.3 degrees, the camera is the same."""
    polynomial = (475.4, 0.0, -7.05e-4, -6.1e-8, -1.4e-10, *[0] * 5)
    straight = fr.FisheyeCamera.from_model("ocam", (983.4, 577.7, 1, 0, 0, 1, *polynomial), (1096, 1948))
    turned = np.radians(3.3)
    c, s = np.cos(turned), np.sin(turned)
    camera = fr.FisheyeCamera.from_model("ocam", (983.4, 577.7, c, -s, s, c, *polynomial), (1096, 1948))
    np.testing.assert_allclose(camera.params, straight.params, rtol=1e-6)


# --- Where a lens ends ----------------------------------------------------------------------------

# A lens that folds or ends within its picture, and the largest radius on its own plane, (u - cx) / fx, that it fills.
ENDS = {
    "brown_conrady": ("brown_conrady", (*K, -0.5, *[0] * 11), 2 / 3 * np.sqrt(2 / 3)),
    "brown_conrady, rises again": ("brown_conrady", (*K, -0.5, 0.1, *[0] * 10), None),
    "brown_conrady, a pole": ("brown_conrady", (*K, *[0] * 5, -0.5, *[0] * 6), np.inf),
    "thin_prism_fisheye": ("thin_prism_fisheye", (*K, -0.5, *[0] * 7), 2 / 3 * np.sqrt(2 / 3)),
    "unified": ("unified", (*K, 2.0, *[0] * 4), 1 / np.sqrt(3)),
    "extended_unified": ("extended_unified", (*K, 0.9, 1.5), 1 / np.sqrt(0.8 * 1.5)),
    "double_sphere": ("double_sphere", (*K, -0.1, 0.9), 1 / np.sqrt(0.8)),
    "division": ("division", (*K, 1.5), 1 / np.sqrt(1.5)),
    "field_of_view": ("field_of_view", (*K, 1.9), np.pi / 2 / 1.9),
    # z = 1 - r^2 turns nowhere, z = 1 + r^2 at r = 1: r / z falls again.
    "ocam": ("ocam", (*K[2:], 1.0, 0.0, 0.0, 302.25 / 301.5, 301.5, 0.0, 1 / 301.5, *[0] * 7), 1.0),
}


@pytest.mark.parametrize("name", ENDS)
def test_pixels_beyond_the_end_of_a_lens_see_nothing(name):
    model, params, end = ENDS[name]
    points = grid()
    rays = lens_models.unproject(model, params, points)
    radius = np.hypot(*((points - K[2:]) / K[:2]).T)
    seen = np.isfinite(rays[:, 0])
    assert (np.isnan(rays).all(-1) == ~seen).all()
    if end is None:  # its fold is the root of a quadratic: 1 - 1.5 s + 0.5 s^2 = 0 at s = 1
        end = 1 - 0.5 + 0.1
    np.testing.assert_array_equal(seen, radius < end)
    # Farther out on the picture is farther off the axis: no folded copy.
    theta = np.arccos(rays[seen, 2])[np.argsort(radius[seen])]
    assert (np.diff(theta) > -1e-7).all()


# --- The fitted camera ----------------------------------------------------------------------------


def test_a_lens_that_is_kannala_brandt_is_found_again():
    k1, k2, k3, k4 = 0.065, -0.006, -0.004, 0.006
    camera = fr.FisheyeCamera.from_model("thin_prism_fisheye", (*K, k1, k2, 0, 0, k3, k4, 0, 0), SIZE)
    np.testing.assert_allclose(camera.params, (*K, k1, k2, k3, k4), rtol=1e-9, atol=1e-9)
    assert camera.fit_error_px < 1e-9


def test_a_squeezed_lens_off_its_centre_is_found_again():
    params = (310.0, 150.0, -30.0, 350.0, -0.04, 0.02, 0, 0, -0.026, 0.008, 0, 0)
    camera = fr.FisheyeCamera.from_model("thin_prism_fisheye", params, (300, 500))
    np.testing.assert_allclose(camera.params[:4], params[:4], rtol=1e-7)


def test_the_fit_is_as_good_as_it_says_by_opencv(other):
    model, params, worst = other
    camera = fr.FisheyeCamera.from_model(model, params, SIZE)
    assert 0 <= camera.fit_rms_px <= camera.fit_error_px < worst
    points = grid(count=97)
    rays = lens_models.unproject(model, params, points)
    before_90 = rays[:, 2] > 0.01  # cv2.fisheye takes points in front of the camera alone
    matrix, D = camera.to_opencv()
    zero = np.zeros(3)
    again = cv2.fisheye.projectPoints(rays[before_90][:, None], zero, zero, matrix, D)[0][:, 0]
    error = np.hypot(*(again - points[before_90]).T)
    assert error.max() <= camera.fit_error_px * 1.02 + 1e-8
    if before_90.all():
        assert error.max() == pytest.approx(camera.fit_error_px, rel=0.02, abs=1e-8)
        assert np.sqrt(np.mean(error**2)) == pytest.approx(camera.fit_rms_px, rel=0.05, abs=1e-8)


def test_only_the_part_of_the_picture_that_a_lens_fills_is_fitted():
    model, params, _ = ENDS["double_sphere"]
    camera = fr.FisheyeCamera.from_model(model, (150, 150, *params[2:]), SIZE)
    assert camera.fit_error_px < 1


def test_a_lens_is_fitted_where_it_sees():
    """Of the kind of KITTI-360's: xi beyond 1, strongly bent, its picture a circle within a square picture."""
    params = (1336.0, 1335.5, 717.0, 706.0, 2.2, 0.017, 1.65, 4e-4, 4e-4)
    seen = np.isfinite(lens_models.unproject("unified", params, grid((1400, 1400)))[:, 0])
    assert 0.8 < seen.mean() < 0.9
    assert fr.FisheyeCamera.from_model("unified", params, (1400, 1400)).fit_error_px < 0.9


def test_cameras_that_were_not_fitted_tell_no_error(tmp_path):
    camera = fr.FisheyeCamera.from_model(*LENSES["double_sphere"][:2], SIZE)
    camera.save(tmp_path / "camera.json")
    again = fr.FisheyeCamera.load(tmp_path / "camera.json")
    assert (again.fit_error_px, again.fit_rms_px, again.fitted_to) == (None, None, None)
    np.testing.assert_array_equal(again.params, camera.params)


# --- Files ----------------------------------------------------------------------------------------

CAMERA_FILES = Path(__file__).resolve().parents[2] / "shared" / "data" / "fisheye" / "camera_files"
needs_camera_files = pytest.mark.skipif(
    not CAMERA_FILES.is_dir(), reason=f"real calibrations not there: {CAMERA_FILES}"
)


@needs_camera_files
@pytest.mark.parametrize(
    ("name", "fit_px", "whole_px", "middle_px", "turned_px"),
    [("DS", 0.001, 1.4, 1.0, 0.41), ("EUCM", 0.001, 1.0, 0.8, 0.3), ("RadTan", 0.8, 27, 1.3, 0.75)],
)
def test_one_camera_in_four_models_agrees(name, fit_px, whole_px, middle_px, turned_px):
    """Four calibrations of one camera by kalibr, from the same pictures, of which the camera's KB is one.

    Half a pixel of the principal point is a turn of the camera by a milliradian, which no calibration can tell from a
    turn of the board: without it they agree better. RadTan's polynomial runs off in the corners.
    """
    reference = fr.FisheyeCamera.load(CAMERA_FILES / "kalibr" / "KB.yml")
    camera = fr.FisheyeCamera.load(CAMERA_FILES / "kalibr" / f"{name}.yml")
    assert camera.fit_error_px < fit_px
    points = grid(camera.image_size, count=65)
    rays, valid = camera.unproject(points)
    assert valid.all()

    def distance(rays, points):
        seen, valid = reference.project(rays)
        assert valid.all()
        return np.hypot(*(seen - points).T)

    assert distance(rays, points).max() < whole_px
    middle = np.hypot(*(points - reference.params[2:4]).T) < 350
    assert distance(rays[middle], points[middle]).max() < middle_px
    u, _, vt = np.linalg.svd(reference.unproject(points[middle])[0].T @ rays[middle])
    assert distance(rays[middle] @ (u @ vt).T, points[middle]).max() < turned_px


@needs_camera_files
def test_ocam_agrees_with_its_tools_own_conversion():
    """The Kannala-Brandt camera that fisheye-calib-adapter (Lee 2024) publishes for this file."""
    camera = fr.FisheyeCamera.load(CAMERA_FILES / "OcamCalib" / "OcamCalib.yml")
    assert camera.fit_error_px < 1.0
    assert camera.fit_rms_px < 0.35
    k = (-0.024177982258138626, -0.02468060856551476, 0.0067980292813516101, -0.00028741698165920014)
    published = fr.FisheyeCamera(
        [207.80160746623932, 208.03589206893787, 359.82991415117499, 243.61144870873036, *k], (480, 752)
    )
    theta, phi = np.meshgrid(np.radians(np.linspace(0, 85, 18)), np.linspace(0, 6, 13))
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    difference = np.linalg.norm(camera.project(rays)[0] - published.project(rays)[0], axis=-1)
    assert difference.max() < 3


@needs_camera_files
def test_load_refuses_above_the_threshold_in_one_line():
    path = CAMERA_FILES / "kalibr" / "RadTan.yml"
    message = (
        f"FisheyeCamera.load(): {str(path)!r}: expected a brown_conrady lens that kannala_brandt fits within 0.5 px "
        "(max_fit_error_px), got 0.753 px at most and 0.183 px RMS: allow more, or calibrate with cv2.fisheye"
    )
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        fr.FisheyeCamera.load(path, max_fit_error_px=0.5)
    assert len(str(caught.value).splitlines()) == 1
    taken = fr.FisheyeCamera.load(path, max_fit_error_px=0.8)
    assert (taken.fitted_to, taken.fit_error_px > 0.5) == ("brown_conrady", True)


@needs_camera_files
def test_load_gives_each_class_its_own_model():
    from fisheyerec.cameras import load_camera

    assert isinstance(load_camera(CAMERA_FILES / "pinhole.yml"), fr.PinholeCamera)
    assert isinstance(load_camera(CAMERA_FILES / "UCM.yml"), fr.FisheyeCamera)
    with pytest.raises(ValueError, match=r"PinholeCamera\.load\(\): expected a pinhole camera in .*, got extended_uni"):
        fr.PinholeCamera.load(CAMERA_FILES / "UCM.yml")


# --- Refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "params", "words"),
    [
        ("fov", K, "from_model(): expected model in ['brown_conrady', 'division', "),
        ("kannala_brandt", (*K, 0, 0, 0, 0), "got 'kannala_brandt'"),
        ("double_sphere", K, "from_model(): params: expected fx, fy, cx, cy, xi, alpha, got 4 numbers"),
        ("double_sphere", (*K, np.nan, 0.5), "from_model(): xi: expected a finite number, got nan"),
        ("double_sphere", (-1, *K[1:], 0, 0.5), "from_model(): fx: expected a positive number, got -1"),
        ("double_sphere", (1, 1, *K[2:], 0, 0.9), "whose picture sees rays off its axis, got rays at"),
        ("brown_conrady", (*K, -0.01, 0, 0.05, 0.05, *[0] * 8), "a brown_conrady lens that kannala_brandt fits within"),
        ("ocam", (*K[2:], 0, 0, 0, 0, 200, *[0] * 9), "from_model(): "),
        ("ocam", (*K[2:], 1, 0, 0, -1, 200, *[0] * 9), "off its axis, got rays at 0 of 4225 positions"),
        ("ocam", (*K[2:], 1, 0, 0, 1, -200, *[0] * 9), "from_model(): expected"),
        ("ocam", (*K[2:], 1, 0, 0, 1, 1e300, *[0] * 9), "off its axis, got rays at 4225 of 4225 positions"),
        ("division", (1e300, 1e300, *K[2:], -0.1), "off its axis, got rays at 4225 of 4225 positions"),
        ("brown_conrady", (*K, 1e300, *[0] * 11), "from_model(): "),
    ],
)
def test_from_model_refuses(model, params, words):
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        fr.FisheyeCamera.from_model(model, params, SIZE)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("model", sorted(lens_models.MODELS))
def test_whatever_a_file_holds_gives_a_good_camera_or_one_error(model):
    rng = np.random.default_rng(0)
    outcomes = []
    for _ in range(15):
        count = len(PARAMETERS[model])
        params = rng.standard_normal(count) * 10.0 ** rng.integers(-6, 7, count)
        if model != "ocam":
            params[:4] = np.abs(params[:4]) + 1e-3
        try:
            camera = fr.FisheyeCamera.from_model(model, params, SIZE)
        except ValueError as error:
            outcomes.append(str(error))
        else:
            assert camera.fit_error_px <= 1
            assert np.isfinite(camera.params).all()
            outcomes.append("fitted")
    assert all(outcome == "fitted" or outcome.startswith("FisheyeCamera.from_model(): ") for outcome in outcomes)
