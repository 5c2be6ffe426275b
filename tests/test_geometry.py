"""Cameras: points to rays and back, against mathematics, against OpenCV, and NumPy against torch."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

import fisheyerec as fr

BACKENDS = ["numpy", "torch"]


def backed(camera, backend):
    """The camera with float64 arrays or tensors."""
    return camera.to(torch.float64) if backend == "torch" else camera


def call(camera, function, vectors):
    """camera.project or camera.unproject of an array, whatever the camera holds; arrays come back."""
    vectors = np.asarray(vectors, dtype=np.float64)
    if isinstance(camera.params, torch.Tensor):
        out, valid = getattr(camera, function)(torch.from_numpy(vectors))
        return out.numpy(), valid.numpy()
    return getattr(camera, function)(vectors)


def theta_d(camera, theta):
    k = camera.params[4:]
    return theta * (1 + sum(k[i] * theta ** (2 * i + 2) for i in range(4)))


def slope(camera, theta):
    k = camera.params[4:]
    return 1 + sum((2 * i + 3) * k[i] * theta ** (2 * i + 2) for i in range(4))


def theta_max_by_roots(camera):
    """The smallest positive root of theta_d' below pi, from the companion matrix."""
    k1, k2, k3, k4 = camera.params[4:]
    u = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1])
    theta = np.sqrt(u[(abs(u.imag) < 1e-9 * abs(u)) & (u.real > 0)].real)
    return min([*theta, math.pi])


def frame_grid(camera, columns=33, rows=25):
    """Points over the whole frame, its edges included, (rows, columns, 2)."""
    height, width = camera.image_size
    x, y = np.linspace(-0.5, width - 0.5, columns), np.linspace(-0.5, height - 0.5, rows)
    return np.stack(np.meshgrid(x, y), -1)


def within_lens(camera, points):
    """Which points lie clearly inside the circle that theta_max maps to."""
    fx, fy, cx, cy = camera.params[:4]
    radius = np.hypot((points[..., 0] - cx) / fx, (points[..., 1] - cy) / fy)
    return radius < theta_d(camera, camera.theta_max) * (1 - 1e-9)


def rays_at(theta, phi):
    """Unit rays at the angles theta from the axis, (theta, phi, 3)."""
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def pixels_at(camera, theta, phi):
    """Eq. 3 of the paper, straight from the angles."""
    fx, fy, cx, cy = camera.params[:4]
    radius = theta_d(camera, np.asarray(theta, dtype=np.float64))[:, None]
    return np.stack([cx + fx * radius * np.cos(phi), cy + fy * radius * np.sin(phi)], -1)


def diagonal(camera):
    return math.hypot(*camera.image_size)


# --- The lens' range ------------------------------------------------------------------------------


def test_theta_max_is_the_first_extremum(lens):
    assert lens.theta_max == pytest.approx(theta_max_by_roots(lens), rel=1e-7)


def test_theta_max_of_the_reference(lens):
    from fisheyerec import reference

    assert float(reference.theta_max(torch.from_numpy(lens.params))) == pytest.approx(lens.theta_max, rel=1e-9)


def test_theta_max_of_a_batch():
    cameras = np.array([[100, 100, 50, 50, 0, 0, 0, 0], [100, 100, 50, 50, -0.3, 0, 0, 0]])
    expected = [math.pi, math.sqrt(1 / 0.9)]
    np.testing.assert_allclose(fr.FisheyeCamera(cameras, (100, 100)).theta_max, expected, rtol=1e-12)


def test_theta_max_is_zero_for_unusable_numbers():
    assert fr.FisheyeCamera([100, 100, 50, 50, math.nan, 0, 0, 0], (100, 100)).theta_max == 0


def test_folding_lenses_fold_inside_their_frame():
    """The table's own claim: without it the tests of the fold would test nothing."""
    from_table = [100, 100, 320, 240, -0.3, -0.01, 0, 0]
    assert fr.FisheyeCamera(from_table, (480, 640)).theta_max < math.radians(61)


# --- Round trips ----------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_point_within_the_lens_has_a_ray_that_comes_back(lens, backend, tolerance):
    points = frame_grid(lens)
    rays, valid = call(backed(lens, backend), "unproject", points)
    inside = within_lens(lens, points)
    assert inside.any()
    assert valid[inside].all()
    back, seen = call(backed(lens, backend), "project", rays[inside])
    assert seen.all()
    np.testing.assert_allclose(back, points[inside], rtol=0, atol=tolerance.round_trip * diagonal(lens))
    np.testing.assert_allclose(np.linalg.norm(rays[inside], axis=-1), 1, rtol=0, atol=tolerance.rounding)


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_ray_within_the_lens_has_a_point_that_comes_back(lens, backend, tolerance):
    theta, phi = np.linspace(0, 0.999, 60) * lens.theta_max, np.linspace(0, 2 * np.pi, 12)
    rays = rays_at(theta, phi)
    points, valid = call(backed(lens, backend), "project", rays)
    assert valid.all()
    expected = pixels_at(lens, theta, phi)
    scale = diagonal(lens) + abs(expected)
    assert (abs(points - expected) <= tolerance.rounding * 10 * scale).all()

    # Polynomials that run wild send rays outside the frame billions of pixels away: no use, and no digits left.
    near = (abs(points) < 10 * diagonal(lens)).all(-1)
    back, seen = call(backed(lens, backend), "unproject", points[near])
    assert seen.all()
    # What an error in pixels does to the angle is 1 / slope.
    pixel_error = tolerance.round_trip * scale.max(-1) / min(lens.params[:2])
    allowed = pixel_error * np.maximum(1, 1 / slope(lens, theta))[:, None] * 4
    assert (np.linalg.norm(back - rays[near], axis=-1) <= allowed[near]).all()


def test_every_real_profile_comes_back_within_its_frame(every_profile, tolerance):
    lost, off = [], []
    for index, camera in enumerate(every_profile):
        points = frame_grid(camera, 9, 7)
        inside = within_lens(camera, points)
        rays, valid = camera.unproject(points)
        if not valid[inside].all():
            lost.append(index)
            continue
        back, seen = camera.project(rays[inside])
        if not seen.all() or abs(back - points[inside]).max() > tolerance.round_trip * diagonal(camera):
            off.append(index)
    assert lost == []
    assert off == []


@pytest.mark.parametrize("lens", ["wide_120", "over_180_equidistant_220", "gopro_chessboard"], indirect=True)
def test_float32_round_trip(lens, tolerance):
    points = frame_grid(lens)[within_lens(lens, frame_grid(lens))]
    camera = lens.to(torch.float32)
    rays, valid = camera.unproject(torch.from_numpy(points).float())
    back, _ = camera.project(rays)
    assert bool(valid.all())
    np.testing.assert_allclose(back.numpy(), points, rtol=0, atol=4 * tolerance.float32_px * diagonal(lens))


@pytest.mark.parametrize("lens", ["over_180_equidistant_220", "profile_gh4_meike_235_deg"], indirect=True)
@pytest.mark.parametrize("backend", BACKENDS)
def test_rays_behind_the_image_plane(lens, backend, tolerance):
    theta, phi = np.radians([89.999, 90, 90.001, 120, 150, 179, 179.999]), np.linspace(0, 6, 9)
    rays = rays_at(theta, phi)
    points, valid = call(backed(lens, backend), "project", rays)
    assert valid.all()
    np.testing.assert_allclose(points, pixels_at(lens, theta, phi), rtol=tolerance.rounding * 100)
    back, seen = call(backed(lens, backend), "unproject", points)
    assert seen.all()
    np.testing.assert_allclose(back, rays, rtol=0, atol=tolerance.round_trip * 10)


@pytest.mark.parametrize("backend", BACKENDS)
def test_pinhole_round_trip(backend, tolerance):
    view = backed(fr.PinholeCamera([300.0, 310.0, 160.5, 118.0], (240, 320)), backend)
    points = frame_grid(view)
    rays, valid = call(view, "unproject", points)
    assert valid.all()
    assert (rays[..., 2] == 1).all()
    back, seen = call(view, "project", rays * 3)
    assert seen.all()
    np.testing.assert_allclose(back, points, rtol=0, atol=tolerance.rounding * 400)


# --- The axis, the rim, and nothing ---------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_axis_is_the_principal_point(lens, backend):
    camera = backed(lens, backend)
    points, valid = call(camera, "project", [[0, 0, z] for z in (1e-6, 1, 7.5, 1e6)])
    assert valid.all()
    assert (points == lens.params[2:4]).all()
    rays, seen = call(camera, "unproject", lens.params[2:4])
    assert seen
    assert rays.tolist() == [0, 0, 1]


@pytest.mark.parametrize("backend", BACKENDS)
def test_rays_a_hair_off_the_axis(lens, backend, tolerance):
    # The principal point at 0, so that the pixel keeps all digits of the small angle.
    camera = fr.FisheyeCamera(np.concatenate([lens.params[:2], [0, 0], lens.params[4:]]), lens.image_size)
    theta, phi = np.logspace(-12, -3, 19), np.linspace(0.1, 6.2, 7)
    rays = rays_at(theta, phi)
    points, valid = call(backed(camera, backend), "project", rays)
    assert valid.all()
    np.testing.assert_allclose(points, pixels_at(camera, theta, phi), rtol=tolerance.rounding)
    back, _ = call(backed(camera, backend), "unproject", points)
    np.testing.assert_allclose(back, rays, rtol=tolerance.rounding)


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixels_a_hair_off_the_principal_point(lens, backend, tolerance):
    fx, fy, cx, cy = lens.params[:4]
    offsets = np.stack(np.meshgrid([-1e-6, 0, 1e-6], [-1e-6, 0, 1e-6]), -1)
    points = np.array([cx, cy]) + offsets
    offsets = points - [cx, cy]  # what is left of them: exact
    rays, valid = call(backed(lens, backend), "unproject", points)
    assert valid.all()
    np.testing.assert_allclose(rays[..., :2], offsets / [fx, fy], rtol=tolerance.rounding, atol=0)
    np.testing.assert_allclose(rays[..., 2], 1, rtol=0, atol=tolerance.rounding)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_rim(lens, backend):
    limit, phi = theta_max_by_roots(lens), np.linspace(0, 6, 9)
    for theta, expected in ((limit * (1 - 1e-6), True), (min(limit * (1 + 1e-6), math.pi), limit == math.pi)):
        points, valid = call(backed(lens, backend), "project", rays_at([theta], phi))
        assert (valid == expected).all()
        assert (np.isnan(points) == (not expected)).all()

    fx, fy, cx, cy = lens.params[:4]
    circle = np.stack([fx * np.cos(phi), fy * np.sin(phi)], -1) * theta_d(lens, limit)
    for factor, expected in ((1 - 1e-9, True), (1 + 1e-6, False)):
        rays, valid = call(backed(lens, backend), "unproject", [cx, cy] + circle * factor)
        assert (valid == expected).all()
        assert (np.isnan(rays) == (not expected)).all()


NOWHERE = {
    "zero": [0.0, 0.0, 0.0],
    "backwards": [0.0, 0.0, -1.0],
    "nan_x": [math.nan, 0.1, 1.0],
    "nan_z": [0.1, 0.1, math.nan],
    "infinite_x": [math.inf, 0.0, 1.0],
    "all_infinite": [math.inf, math.inf, math.inf],
    "too_small_to_divide_by": [0.0, 0.0, 5e-324],
}


@pytest.mark.parametrize("ray", NOWHERE.values(), ids=NOWHERE)
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_rays_that_meet_no_pixel_are_nan_and_invalid(ray, backend, model):
    camera = {
        "fisheye": fr.FisheyeCamera([100.0, 100, 50, 50, 0.1, 0, 0, 0], (100, 100)),
        "pinhole": fr.PinholeCamera([100.0, 100, 50, 50], (100, 100)),
    }[model]
    points, valid = call(backed(camera, backend), "project", ray)
    assert not valid
    assert np.isnan(points).all()


@pytest.mark.parametrize("point", [[math.nan, 1.0], [1.0, math.inf], [-math.inf, math.inf], [1e308, 1e308]])
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_points_that_have_no_ray_are_nan_and_invalid(point, backend, model):
    camera = {
        "fisheye": fr.FisheyeCamera([100.0, 100, 50, 50, 0.1, 0, 0, 0], (100, 100)),
        "pinhole": fr.PinholeCamera([1e-3, 1e-3, 50, 50], (100, 100)),
    }[model]
    rays, valid = call(backed(camera, backend), "unproject", point)
    assert not valid
    assert np.isnan(rays).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("index", range(8))
@pytest.mark.parametrize("backend", BACKENDS)
def test_unusable_parameters_make_everything_invalid(value, index, backend):
    params = np.array([100.0, 100, 50, 50, 0.1, 0, 0, 0])
    params[index] = value
    camera = backed(fr.FisheyeCamera(params, (100, 100)), backend)
    points, hit = call(camera, "project", [[0.1, 0.2, 1], [0, 0, 1]])
    rays, seen = call(camera, "unproject", [[20, 30], [50, 50]])
    assert not hit.any()
    assert not seen.any()
    assert np.isnan(points).all()
    assert np.isnan(rays).all()


# --- Shapes, homogeneity, backends ----------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_the_direction_of_a_ray_counts(lens, backend, tolerance):
    theta = np.linspace(0.01, 0.99, 9) * min(lens.theta_max, 3)
    rays = rays_at(theta, np.linspace(0, 6, 7))
    expected, _ = call(backed(lens, backend), "project", rays)
    for length in (1e-100, 1e-3, 7.0, 1e100):
        points, valid = call(backed(lens, backend), "project", rays * length)
        assert valid.all()
        np.testing.assert_allclose(points, expected, rtol=100 * tolerance.rounding, atol=tolerance.rounding)


@pytest.mark.parametrize("function", ["project", "unproject"])
def test_numpy_agrees_with_torch(lens, function, tolerance):
    points = frame_grid(lens, 40, 30)
    radius = np.hypot(*np.moveaxis((points - lens.params[2:4]) / lens.params[:2], -1, 0))
    # Near the fold an angle is only known to the square root of epsilon: the rim has its own test.
    vectors = points[radius < 0.98 * theta_d(lens, lens.theta_max)]
    if function == "project":
        vectors, _ = call(backed(lens, "torch"), "unproject", vectors)
    ours, valid = call(lens, function, vectors)
    theirs, seen = call(backed(lens, "torch"), function, vectors)
    assert valid.all()
    assert seen.all()
    scale = diagonal(lens) if function == "project" else 1
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=10 * tolerance.rounding * scale)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (0,), (2, 0, 3)])
def test_any_shape_of_points_and_rays(backend, shape):
    camera = backed(fr.FisheyeCamera([100.0, 100, 50, 50, 0.1, 0, 0, 0], (100, 100)), backend)
    rays, valid = call(camera, "unproject", np.full((*shape, 2), 20.0))
    assert (rays.shape, valid.shape) == ((*shape, 3), shape)
    points, valid = call(camera, "project", rays)
    assert (points.shape, valid.shape) == ((*shape, 2), shape)
    assert valid.dtype == bool


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", [(3,), (3, 4), (3, 2, 4)])
def test_a_batch_of_cameras_is_a_loop_over_cameras(backend, shape, tolerance):
    params = np.array([WIDE, [200, 210, 40, 60, 0, 0.1, 0, 0], [90, 90, 50, 50, -0.2, 0, 0, 0.0]])
    points = np.random.default_rng(0).uniform(0, 100, (*shape, 2))
    batch = backed(fr.FisheyeCamera(params, (100, 100)), backend)
    rays, valid = call(batch, "unproject", points)
    back, _ = call(batch, "project", rays)
    for i, row in enumerate(params):
        camera = backed(fr.FisheyeCamera(row, (100, 100)), backend)
        expected, seen = call(camera, "unproject", points[i])
        np.testing.assert_array_equal(valid[i], seen)
        np.testing.assert_allclose(rays[i], expected, rtol=tolerance.rounding)
        np.testing.assert_allclose(back[i], call(camera, "project", rays[i])[0], rtol=tolerance.rounding)


WIDE = [100.0, 100, 50, 50, 0.05, -0.01, 0, 0]


# --- OpenCV ---------------------------------------------------------------------------------------


def test_project_is_cv2_project_points(lens, tolerance):
    theta = np.linspace(0, 0.999, 40) * min(lens.theta_max, math.radians(85))
    rays = rays_at(theta, np.linspace(0, 2 * np.pi, 24)).reshape(-1, 3)
    K, D = lens.to_opencv()
    expected, _ = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), K, D)
    points, valid = lens.project(rays)
    assert valid.all()
    np.testing.assert_allclose(points, expected[:, 0], rtol=tolerance.opencv, atol=tolerance.opencv)


def test_unproject_is_cv2_undistort_points(lens, tolerance):
    # OpenCV looks for angles up to 90 degrees with theta_d up to pi/2.
    theta = np.linspace(0.01, 0.9, 20) * min(lens.theta_max, math.radians(80))
    theta = theta[theta_d(lens, theta) < 1.5]
    points = pixels_at(lens, theta, np.linspace(0, 6, 13)).reshape(-1, 2)
    K, D = lens.to_opencv()
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-14)
    expected = cv2.fisheye.undistortPoints(points[:, None], K, D, criteria=criteria)[:, 0]
    rays, valid = lens.unproject(points)
    assert valid.all()
    # OpenCV's iteration may fail, or end beyond the fold: its answer counts where OpenCV itself maps it back.
    upright = np.concatenate([expected, np.ones_like(expected[:, :1])], -1)
    again = cv2.fisheye.projectPoints(upright[:, None], np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    found = (abs(again - points).max(-1) < 1e-6) & (np.hypot(*expected.T) < math.tan(min(lens.theta_max, 1.5)))
    assert found.mean() >= 0.85
    np.testing.assert_allclose(
        (rays[:, :2] / rays[:, 2:])[found], expected[found], rtol=10 * tolerance.opencv, atol=tolerance.opencv
    )


@pytest.mark.parametrize("rotated", [False, True])
def test_the_map_is_cv2_init_undistort_rectify_map(lens, rotated, tolerance):
    height, width = 90, 120
    view = fr.PinholeCamera([70.0, 72.0, 58.0, 47.0], (height, width))
    R = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0] if rotated else np.eye(3)
    K, D = lens.to_opencv()
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    rays = view.unproject(pixels)[0] @ R  # OpenCV's R is view_from_camera
    points, valid = lens.project(rays)
    exact, _ = cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, D)
    map_x, map_y = cv2.fisheye.initUndistortRectifyMap(K, D, R, view.to_matrix(), (width, height), cv2.CV_32FC1)
    in_front = valid & (rays[..., 2] > 0.05)
    assert in_front.any()
    ours, theirs = points[in_front], exact.reshape(height, width, 2)[in_front]
    np.testing.assert_allclose(ours, theirs, rtol=tolerance.opencv, atol=tolerance.opencv * diagonal(lens))
    maps = np.stack([map_x, map_y], -1)[in_front]
    rounding = tolerance.opencv_float32
    np.testing.assert_allclose(ours, maps, rtol=rounding, atol=rounding * diagonal(lens))


# --- The pixel convention -------------------------------------------------------------------------


def both_rays(camera, points, other, other_points):
    rays, valid = camera.unproject(points)
    others, seen = other.unproject(other_points)
    np.testing.assert_array_equal(valid, seen)
    assert valid.any()
    return rays[valid], others[valid]


def interior(camera):
    """Points of the frame clear of the rim, where rounding decides about validity and conditions are bad."""
    points = frame_grid(camera, 21, 17).reshape(-1, 2)
    radius = np.hypot(*((points - camera.params[2:4]) / camera.params[:2]).T)
    return points[radius < 0.97 * theta_d(camera, camera.theta_max)]


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 3.0, 1.7])
def test_a_scaled_camera_sees_the_same_rays(lens, factor, tolerance):
    points = interior(lens)
    rays, others = both_rays(lens, points, lens.scale(factor), (points + 0.5) * factor - 0.5)
    np.testing.assert_allclose(rays, others, rtol=0, atol=10 * tolerance.rounding)
    assert lens.scale(factor).image_size == tuple(round(size * factor) for size in lens.image_size)


def test_a_resized_camera_sees_the_same_rays(lens, tolerance):
    height, width = lens.image_size
    other = lens.resize((97, 213))
    points = interior(lens)
    rays, others = both_rays(lens, points, other, (points + 0.5) * [213 / width, 97 / height] - 0.5)
    np.testing.assert_allclose(rays, others, rtol=0, atol=10 * tolerance.rounding)
    assert other.image_size == (97, 213)


@pytest.mark.parametrize("corner", [(0, 0), (13, 7), (-5, -40)])
def test_a_cropped_camera_sees_the_same_rays(lens, corner, tolerance):
    points = interior(lens)
    rays, others = both_rays(lens, points, lens.crop(*corner, (60, 80)), points - corner)
    np.testing.assert_allclose(rays, others, rtol=0, atol=10 * tolerance.rounding)
    assert lens.crop(*corner, (60, 80)).image_size == (60, 80)


def test_the_middle_of_the_frame_stays_the_middle():
    view = fr.PinholeCamera.from_fov(90, (101, 201))
    assert view.params.tolist() == pytest.approx([100.5, 100.5, 100, 50])  # W/2 pixels at 45 degrees, (W-1)/2
    assert view.scale(2).params.tolist() == pytest.approx([201, 201, 200.5, 100.5])
    assert view.crop(1, 2, (10, 10)).params.tolist() == pytest.approx([100.5, 100.5, 99, 48])


def test_from_fov_reaches_from_edge_to_edge():
    view = fr.PinholeCamera.from_fov(100, (480, 640))
    rays, _ = view.unproject([[-0.5, 239.5], [639.5, 239.5]])
    np.testing.assert_allclose(np.degrees(np.arctan(rays[:, 0])), [-50, 50], rtol=1e-12)
    np.testing.assert_allclose(rays[:, 1], 0, atol=1e-15)


# --- Other people's conventions -------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(4,), (4, 1), (1, 4)])
def test_opencv_there_and_back(lens, shape):
    K, D = lens.to_opencv()
    assert K.tolist() == [[lens.params[0], 0, lens.params[2]], [0, lens.params[1], lens.params[3]], [0, 0, 1]]
    again = fr.FisheyeCamera.from_opencv(K, D.reshape(shape), lens.image_size)
    assert again.params.tolist() == lens.params.tolist()


def test_opencv_batch():
    K = np.stack([np.diag([100.0, 110, 1]), np.diag([200.0, 210, 1])])
    D = np.arange(8.0).reshape(2, 4)
    camera = fr.FisheyeCamera.from_opencv(K, D, (10, 20))
    assert camera.params.tolist() == [[100, 110, 0, 0, 0, 1, 2, 3], [200, 210, 0, 0, 4, 5, 6, 7]]


@pytest.mark.parametrize("D_as", [np.asarray, torch.as_tensor, list])
@pytest.mark.parametrize("K_as", [np.asarray, torch.as_tensor, list])
def test_opencv_takes_arrays_tensors_and_lists_in_any_mixture(K_as, D_as):
    K, D = [[100.0, 0, 50], [0, 110, 40], [0, 0, 1]], [0.1, 0.2, 0.3, 0.4]
    camera = fr.FisheyeCamera.from_opencv(K_as(K), D_as(D), (10, 20))
    np.testing.assert_allclose(np.asarray(camera.params), [100, 110, 50, 40, 0.1, 0.2, 0.3, 0.4], rtol=1e-6)


@pytest.mark.parametrize("K_as", [np.asarray, torch.as_tensor, list])
def test_pinhole_matrix_there_and_back(K_as):
    K = [[100.0, 0, 50], [0, 110, 40], [0, 0, 1]]
    view = fr.PinholeCamera.from_matrix(K_as(K), (10, 20))
    assert view.to_matrix().tolist() == K


def test_the_papers_equation_3(lens):
    fx, fy, cx, cy, *k = lens.params
    assert lens.to_paper().tolist() == [*k, fx, fy, cx, cy]
    assert fr.FisheyeCamera.from_paper(lens.to_paper(), lens.image_size).params.tolist() == lens.params.tolist()


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_papers_equation_2(backend, tolerance):
    """r = k1 t + k2 t^3 + k3 t^5 + k4 t^7 with pixels m_u r, m_v r: evaluated as printed."""
    P_d = np.array([1.2, 0.06, -0.04, 0.01, 300.0, 310.0, 320.0, 240.0])
    k1, k2, k3, k4, m_u, m_v, u_0, v_0 = P_d
    P_d = torch.from_numpy(P_d) if backend == "torch" else P_d
    camera = fr.FisheyeCamera.from_paper(P_d, (480, 640), equation=2)
    t, phi = np.linspace(0, 1.2, 30), 0.7
    r = k1 * t + k2 * t**3 + k3 * t**5 + k4 * t**7
    points, _ = call(camera, "project", rays_at(t, [phi])[:, 0])
    expected = np.stack([m_u * r * np.cos(phi) + u_0, m_v * r * np.sin(phi) + v_0], -1)
    np.testing.assert_allclose(points, expected, rtol=tolerance.rounding * 10)


IDEAL = {
    "equidistant": lambda t: t,
    "stereographic": lambda t: 2 * np.tan(t / 2),
    "equisolid": lambda t: 2 * np.sin(t / 2),
    "orthographic": np.sin,
}


@pytest.mark.parametrize("fov_deg", [30, 100, 150, 180])
@pytest.mark.parametrize("projection", IDEAL)
def test_ideal_projections(projection, fov_deg, tolerance):
    camera = fr.FisheyeCamera.from_projection(projection, fov_deg, (600, 1000))
    theta = np.linspace(0, math.radians(fov_deg) / 2, 5003)
    points, valid = camera.project(rays_at(theta[:-1], [0])[:, 0])
    assert valid.all()
    ideal = 499.5 + 500 * IDEAL[projection](theta) / IDEAL[projection](theta[-1])
    error = abs(points[:, 0] - ideal[:-1]).max()
    assert error < tolerance.fit_px
    assert error == pytest.approx(camera.fit_error_px, rel=0.02, abs=1e-9)


@pytest.mark.parametrize(("projection", "fov_deg"), [("equidistant", 300), ("stereographic", 220), ("equisolid", 300)])
def test_ideal_projections_beyond_180_tell_their_error(projection, fov_deg):
    camera = fr.FisheyeCamera.from_projection(projection, fov_deg, (1000, 1000))
    theta = np.linspace(0, math.radians(fov_deg) / 2, 5003)
    ideal = 499.5 + 500 * IDEAL[projection](theta) / IDEAL[projection](theta[-1])
    error = abs(499.5 + camera.params[0] * theta_d(camera, theta) - ideal).max()
    assert error == pytest.approx(camera.fit_error_px, rel=0.02, abs=1e-9)


# --- The edge-matched view ------------------------------------------------------------------------

# fx, fy, cx, cy of an equidistant lens with a 201 x 201 picture, the view's size (height, width) -> its focal length.
EDGE_MATCHED = {
    "centred": ([100, 100, 100, 100], (64, 64), 32 / math.tan(1.005)),
    "nearest_edge_right": ([100, 100, 110, 100], (64, 64), 32 / math.tan(0.905)),
    "nearest_edge_left": ([100, 100, 80, 100], (64, 64), 32 / math.tan(0.805)),
    "nearest_edge_upper": ([100, 100, 100, 70], (64, 64), 32 / math.tan(0.705)),
    "nearest_edge_lower": ([100, 100, 100, 140], (64, 64), 32 / math.tan(0.605)),
    "squeezed": ([100, 200, 100, 100], (64, 64), 32 / math.tan(0.5025)),
    "capped_at_60_degrees": ([50, 50, 100, 100], (64, 64), 32 / math.tan(math.pi / 3)),
    "wide_view_bound_by_width": ([100, 100, 100, 100], (64, 128), 64 / math.tan(1.005)),
    "wide_view_bound_by_height": ([100, 300, 100, 100], (64, 100), 32 / math.tan(0.335)),
}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("pinhole", "size", "focal"), EDGE_MATCHED.values(), ids=EDGE_MATCHED)
def test_edge_matched_by_hand(pinhole, size, focal, backend):
    camera = backed(fr.FisheyeCamera([*map(float, pinhole), 0, 0, 0, 0], (201, 201)), backend)
    view = fr.PinholeCamera.edge_matched(camera, size)
    assert view.params.tolist() == pytest.approx([focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2], rel=1e-9)
    assert view.image_size == size


def straightens(camera, theta):
    """Whether the lens squeezes its picture towards the edge, compared with a pinhole, up to theta."""
    t = np.linspace(1e-3, theta, 400)
    return (np.diff(theta_d(camera, t) / np.tan(t)) <= 0).all()


def test_edge_matched_is_valid_everywhere(lens):
    height, width = lens.image_size
    cx, cy = lens.params[2:4]
    if not (0 <= cx < width and 0 <= cy < height):
        pytest.skip("principal point outside the frame: the view's own axis is not in the picture")
    view = fr.PinholeCamera.edge_matched(lens, (100, 100))
    pixels = np.stack(np.meshgrid(np.arange(100.0), np.arange(100.0)), -1)
    rays = view.unproject(pixels)[0]
    points, valid = lens.project(rays)
    corner = math.atan(math.hypot(50, 50) / view.params[0])
    if corner < lens.theta_max and straightens(lens, corner):
        assert valid.all()
        assert (points >= -0.5 - 1e-6).all()
        assert (points <= np.array([width, height]) - 0.5 + 1e-6).all()
    else:
        assert valid[50, 50]
        assert valid.mean() > 0.5


def test_edge_matched_of_a_batch_and_in_torch(tolerance):
    params = np.array([WIDE, [80, 90, 47, 52, 0.1, 0.02, 0, 0]])
    batch = fr.PinholeCamera.edge_matched(fr.FisheyeCamera(params, (100, 100)), (32, 48)).params
    tensors = fr.PinholeCamera.edge_matched(fr.FisheyeCamera(torch.from_numpy(params), (100, 100)), (32, 48)).params
    single = [fr.PinholeCamera.edge_matched(fr.FisheyeCamera(p, (100, 100)), (32, 48)).params for p in params]
    np.testing.assert_allclose(batch, single, rtol=tolerance.rounding)
    np.testing.assert_allclose(tensors.numpy(), single, rtol=tolerance.rounding)


@pytest.mark.parametrize(
    "params",
    [
        [100, 110, 53, 46, 0.05, -0.01, 0.02, 0.003],  # one edge is nearest, so that the minimum has a derivative
        [40, 40, 53, 46, 0.05, -0.01, 0.02, 0.003],  # capped: the derivative is 0
        [60, 60, 53, 46, -0.3, 0.0, 0.0, 0.0],  # its edges lie beyond the fold
    ],
)
def test_edge_matched_gradient(params):
    params = torch.tensor([params], dtype=torch.float64, requires_grad=True)

    def focal(p):
        return fr.PinholeCamera.edge_matched(fr.FisheyeCamera(p, (100, 100)), (32, 32)).params

    assert torch.autograd.gradcheck(focal, (params,))


# --- Files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".json", ".yaml", ".yml"])
def test_save_and_load_keep_every_bit(lens, suffix, tmp_path):
    lens.save(tmp_path / f"camera{suffix}")
    again = fr.FisheyeCamera.load(tmp_path / f"camera{suffix}")
    assert again.params.tolist() == lens.params.tolist()
    assert again.image_size == lens.image_size


def test_a_view_is_saved_and_loaded_too(tmp_path):
    view = fr.PinholeCamera.from_fov(100, (480, 640))
    view.save(tmp_path / "view.json")
    again = fr.PinholeCamera.load(tmp_path / "view.json")
    assert again.params.tolist() == view.params.tolist()
    message = r"FisheyeCamera\.load\(\): expected a kannala_brandt camera in .*, got pinhole"
    with pytest.raises(ValueError, match=message):
        fr.FisheyeCamera.load(tmp_path / "view.json")
