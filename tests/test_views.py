"""Views of a fisheye camera: what each promises, on every lens of the table and on thousands of real ones."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import fisheyerec as fr
from fisheyerec import views

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
MODES = [{"mode": mode} for mode in views.MODES] + [{"balance": b} for b in (0, 0.5, 1)]
GRID = np.stack(np.meshgrid(np.linspace(0, 1, 33), np.linspace(0, 1, 33)), -1).reshape(-1, 2)


def on_picture(camera, rays):
    points, valid = camera.project(rays)
    height, width = camera.image_size
    return valid & ((points >= -0.5) & (points <= [width - 0.5, height - 0.5])).all(-1)


def shows_picture(camera, view, edges=False):
    """At a grid over the view, from corner pixel to corner pixel, or from edge to edge."""
    height, width = view.image_size
    points = GRID * [width, height] - 0.5 if edges else GRID * [width - 1, height - 1]
    return on_picture(camera, view.unproject(points)[0])


def focal_ratio(camera, view):
    """The view's focal length by the lens' own."""
    return float(view.params[0]) / math.sqrt(abs(camera.params[0] * camera.params[1]))


def solid_angle(view):
    """By summing up the view's pixels: dx dy / (1 + x^2 + y^2)^(3/2) in the plane Z = 1."""
    height, width = view.image_size
    fx, fy, cx, cy = view.params
    x, y = np.meshgrid((np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy)
    return ((1 + x * x + y * y) ** -1.5).sum() / (fx * fy)


# --- Every lens -----------------------------------------------------------------------------------


@pytest.mark.parametrize("options", MODES, ids=str)
def test_real_lenses_get_a_view_of_sensible_focal_that_shows_their_picture(every_profile, options):
    """Every few of them; benchmarks/view_chooser.py walks all."""
    for camera in every_profile[:: 97 if options.get("mode") == "valid_rectangle" else 13]:
        view = fr.view_for(camera, camera.image_size, **options)
        assert np.isfinite(view.params).all()
        assert 1 / 5 < focal_ratio(camera, view) < 5, camera
        shown = shows_picture(camera, view)
        assert shown.mean() > 0.15, camera
        if options in ({"mode": "valid_only"}, {"mode": "valid_rectangle"}, {"balance": 0}):
            assert shown.all(), camera


@pytest.mark.parametrize("size", [(300, 700), (90, 64)])
def test_valid_views_are_valid_and_could_not_be_wider(lens, size):
    for choose in (views.valid_only, views.valid_rectangle):
        view = choose(lens, size)
        assert shows_picture(lens, view).all()
        if view.params[0] > views.keep_all(lens, size).params[0] * 1.001:
            focal = view.params[0] * 0.999
            middle = np.array([(size[1] - 1) / 2, (size[0] - 1) / 2])
            wider = fr.PinholeCamera([focal, focal, *(middle + (view.params[2:] - middle) * 0.999)], size)
            assert not shows_picture(lens, wider, edges=True).all()


def test_the_largest_valid_rectangle_sees_no_less_than_the_centred_one(lens):
    size = (60, 80)
    centred, anywhere = views.valid_only(lens, size), views.valid_rectangle(lens, size)
    assert solid_angle(anywhere) >= solid_angle(centred) * (1 - 1e-4)


def test_the_largest_valid_rectangle_beats_those_around_it(lens):
    """Rectangles drawn by chance: none that is valid sees more than a hundredth more."""
    size, rng = (60, 80), np.random.default_rng(0)
    best = views.valid_rectangle(lens, size)
    largest, widest = solid_angle(best), views._enclose(lens.numpy(), size, np.zeros(2)).params[0]
    half = np.array([80, 60]) / 2 / widest
    for spread in np.repeat([0.3, 0.1, 0.03, 0.01], 50):
        focal = best.params[0] * math.exp(-abs(rng.normal(0, spread)))
        centre = ([39.5, 29.5] - best.params[2:]) / best.params[:2] + rng.normal(0, spread, 2) * half
        other = fr.PinholeCamera([focal, focal, *([39.5, 29.5] - focal * centre)], size)
        within = (np.abs(centre) + np.array([80, 60]) / 2 / focal <= half).all()
        if within and shows_picture(lens, other, edges=True).all():
            assert solid_angle(other) <= 1.01 * largest


def test_keep_all_shows_the_picture_as_far_as_75_degrees(lens):
    size = (300, 400)
    view = views.keep_all(lens, size)
    height, width = lens.image_size
    rays, valid = lens.unproject(GRID * [width - 1, height - 1])
    rays = rays[valid & (rays[:, 2] >= math.cos(views.KEEP_ALL_THETA_MAX))]
    points, _ = view.project(rays)
    assert ((points >= [-1, -1]) & (points <= [400, 300])).all()  # half a pixel for what lies between border points


def test_balance_runs_evenly_from_valid_only_to_keep_all(lens):
    size = (300, 400)
    narrow, wide = views.valid_only(lens, size).params[0], views.keep_all(lens, size).params[0]
    focal = [fr.view_for(lens, size, balance=balance).params[0] for balance in (0, 0.25, 0.5, 0.75, 1)]
    np.testing.assert_allclose(focal, narrow * (wide / narrow) ** np.linspace(0, 1, 5), rtol=1e-12)


def test_the_standard_view_is_the_edge_matched_one(lens):
    size = (300, 400)
    if views._is_centred(lens.numpy()):
        expected = fr.PinholeCamera.edge_matched(lens, size)
        np.testing.assert_array_equal(fr.view_for(lens, size).params, expected.params)


# --- In the op ------------------------------------------------------------------------------------


@pytest.mark.parametrize("balance", [0, 0.5, 1])
def test_balance_goes_from_all_valid_to_all_kept(balance):
    camera = fr.FisheyeCamera.load(EXAMPLES / "room.json")
    view = views.balanced(camera, balance, camera.image_size)
    _, valid = fr.numpy.rectify(np.zeros(camera.image_size, np.uint8), camera, view)
    corners, seen = view.project(camera.unproject([[-0.5, 383.5], [1023.5, 383.5], [511.5, -0.5], [511.5, 767.5]])[0])
    inside = seen & (np.abs(corners - [511.5, 383.5]) <= [512 + 1e-6, 384 + 1e-6]).all(-1)
    assert valid.all() == (balance == 0)
    assert inside.all() == (balance == 1)


# --- Lenses whose axis lies off the picture -------------------------------------------------------


@pytest.fixture
def off_axis():
    """A long lens whose axis a calibration put below the picture."""
    return fr.FisheyeCamera([9000.0, 9000, 900, 3000, 0.1, 0, 0, 0], (1080, 1920))


@pytest.mark.parametrize("options", MODES, ids=str)
def test_a_lens_whose_axis_misses_its_picture_is_seen_whole(off_axis, options):
    view = fr.view_for(off_axis, (540, 960), **options)
    assert shows_picture(off_axis, view).mean() > 0.75
    assert 0.4 < focal_ratio(off_axis, view) < 0.6


@pytest.mark.parametrize("options", [{"fov_deg": 12.0}, {"focal": 4500.0}], ids=str)
def test_a_fixed_view_of_it_is_centred_on_the_picture(off_axis, options):
    view = fr.view_for(off_axis, (540, 960), **options)
    (x, y), _ = off_axis.project(view.unproject([479.5, 269.5])[0])
    assert abs(x - 959.5) < 20
    assert abs(y - 539.5) < 20
    if "focal" in options:
        assert view.params[0] == 4500


def test_a_picture_beyond_any_perspective_view_is_refused():
    camera = fr.FisheyeCamera([100.0, 100, -300, 50, 0, 0, 0, 0], (100, 100))  # from 170 degrees off the axis
    with pytest.raises(ValueError, match="shows something within 75 degrees"):
        fr.view_for(camera, (100, 100), "valid_only")


# --- Rotation -------------------------------------------------------------------------------------


def test_angles_turn_as_they_are_said_to():
    right, _, forward = np.eye(3)
    quarter = math.sqrt(0.5)
    np.testing.assert_allclose(fr.view_rotation(pan_deg=45) @ forward, [quarter, 0, quarter], atol=1e-15)
    np.testing.assert_allclose(fr.view_rotation(tilt_deg=45) @ forward, [0, -quarter, quarter], atol=1e-15)
    np.testing.assert_allclose(fr.view_rotation(roll_deg=45) @ right, [quarter, quarter, 0], atol=1e-15)
    np.testing.assert_array_equal(fr.view_rotation(), np.eye(3))
    # Pan is about the camera's vertical, whatever the tilt: the horizon of the view stays level.
    assert (fr.view_rotation(70, 30) @ right)[1] == 0


def test_rotations_are_made_of_three_turns():
    """Against Rodrigues' formula."""
    pan, tilt, roll = (cv2.Rodrigues(np.radians(v))[0] for v in ([0, 33.0, 0], [-12.0, 0, 0], [0, 0, 155.0]))
    np.testing.assert_allclose(fr.view_rotation(33, -12, 155), pan @ tilt @ roll, atol=1e-15)


def test_rotations_of_many_angles_at_once():
    with pytest.raises(ValueError, match=r"view_rotation\(\): expected finite angles, got inf, 0.0 and 0.0"):
        fr.view_rotation(math.inf)
    pan = np.array([[0.0, 10, 20], [30, 40, 50]])
    many = fr.view_rotation(pan, tilt_deg=7)
    assert many.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(many[1, 2], fr.view_rotation(50, 7))
    tensor = fr.view_rotation(torch.from_numpy(pan), tilt_deg=7)
    np.testing.assert_allclose(tensor.numpy(), many, atol=1e-15)


def test_a_picture_is_differentiable_in_the_angles(picture):
    camera = fr.FisheyeCamera(torch.tensor([30.0, 30, 19.5, 14.5, 0.05, 0, 0, 0], dtype=torch.float64), (30, 40))
    image, view = picture(1, 1, 30, 40), fr.PinholeCamera.from_fov(60, (5, 6))
    angles = torch.tensor([12.3, -8.1, 21.7], dtype=torch.float64, requires_grad=True)
    rectified = lambda angles: fr.rectify(image, camera, view, rotation=fr.view_rotation(*angles)).image  # noqa: E731
    assert torch.autograd.gradcheck(rectified, (angles,), eps=1e-4, atol=1e-6)


# --- Options --------------------------------------------------------------------------------------

PINHOLE = fr.PinholeCamera([50.0, 50, 4, 4], (9, 9))
CAMERA = fr.FisheyeCamera.from_projection("equidistant", fov_deg=150, image_size=(300, 400))


def test_fixed_views_are_what_they_say():
    size = (100, 160)
    np.testing.assert_array_equal(
        fr.view_for(CAMERA, size, fov_deg=100).params, fr.PinholeCamera.from_fov(100, size).params
    )
    np.testing.assert_array_equal(
        fr.view_for(CAMERA, size, focal=70).params, fr.PinholeCamera.from_focal(70, size).params
    )


@pytest.mark.parametrize(("projection", "fov_deg"), [("cylindrical", 100), ("panini", 20.0), ("stereographic", 250)])
def test_other_projections_are_as_wide_as_they_are_asked_to_be(projection, fov_deg):
    view = fr.view_for(CAMERA, (100, 160), projection=projection, fov_deg=fov_deg)
    assert view.model == projection
    rays, _ = view.unproject([[-0.5, 49.5], [159.5, 49.5]])
    np.testing.assert_allclose(np.degrees(np.arctan2(rays[:, 0], rays[:, 2])), [-fov_deg / 2, fov_deg / 2])


@pytest.mark.parametrize("projection", views.WIDE_PROJECTIONS)
def test_other_projections_show_the_lens_from_edge_to_edge(lens, projection):
    if not views._is_centred(lens.numpy()):
        with pytest.raises(ValueError, match="expected fov_deg for a lens whose axis"):
            fr.view_for(lens, (100, 160), projection=projection)
        return
    view = fr.view_for(lens, (100, 160), projection=projection)
    _, widest_deg = views.WIDE_PROJECTIONS[projection]
    rays, valid = view.unproject([[-0.4999, 49.5], [79.5, 49.5], [159.4999, 49.5]])
    theta = np.degrees(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
    assert valid.all()
    assert theta[0] == pytest.approx(theta[2])
    assert theta[1] == pytest.approx(0, abs=1e-9)
    # No further than the nearer edge, and to the edge unless the projection ends before.
    height, width = lens.image_size
    points, hit = lens.project(rays[[0, 2]])
    offset = np.abs(points[:, 0] - lens.params[2]).max()
    nearer = min(lens.params[2] + 0.5, width - 0.5 - lens.params[2])
    assert hit.all()
    assert offset <= nearer * 1.001 + 0.01 * height
    ends_before = theta[0] > widest_deg / 2 - 0.1 or theta[0] > np.degrees(lens.theta_max) - 0.1
    assert ends_before or offset >= 0.98 * nearer - 0.02 * height


BAD = {
    "two_options": (lambda: fr.view_for(CAMERA, (9, 9), "keep_all", balance=1), ValueError, "expected one of mode"),
    "projection": (lambda: fr.view_for(CAMERA, (9, 9), projection="flat"), ValueError, "projection in .*got 'flat'"),
    "wide_mode": (lambda: fr.view_for(CAMERA, (9, 9), "keep_all", projection="panini"), ValueError, "a panini view"),
    "wide_fov": (lambda: fr.view_for(CAMERA, (9, 9), fov_deg=361, projection="cylindrical"), ValueError, "got 361"),
    "mode": (lambda: fr.view_for(CAMERA, (9, 9), "best"), ValueError, "mode in .*'edge_matched'.*got 'best'"),
    "fov": (lambda: fr.view_for(CAMERA, (9, 9), fov_deg=180), ValueError, "fov_deg in .0, 180.*got 180"),
    "focal": (lambda: fr.view_for(CAMERA, (9, 9), focal=0), ValueError, "focal length above 0, got 0"),
    "balance": (lambda: fr.view_for(CAMERA, (9, 9), balance=-1), ValueError, r"balance in \[0, 1\], got -1"),
    "balance_nan": (lambda: fr.view_for(CAMERA, (9, 9), balance=math.nan), ValueError, "got nan"),
    "size": (lambda: fr.view_for(CAMERA, (0, 9)), ValueError, r"at least \(1, 1\)"),
    "pinhole": (lambda: fr.view_for(PINHOLE, (9, 9), "keep_all"), TypeError, "FisheyeCamera"),
    "batch": (lambda: fr.view_for(fr.FisheyeCamera(np.ones((3, 8)), (9, 9)), (9, 9)), ValueError, "batch of 3"),
    "not_finite": (lambda: fr.view_for(fr.FisheyeCamera([math.nan] * 8, (9, 9)), (9, 9)), ValueError, "finite"),
    "no_focal": (lambda: fr.view_for(fr.FisheyeCamera([0.0] * 8, (9, 9)), (9, 9)), ValueError, "finite"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_options_are_told(case):
    call, error, message = BAD[case]
    with pytest.raises(error, match=message):
        call()
