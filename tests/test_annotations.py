"""What is known about a picture moves with it: against OpenCV, pictures of the same shapes, and dense samples."""

# ruff: noqa: E501  a table is read by its columns: one bad sample a line

import cv2
import numpy as np
import pytest
import torch
from skimage.draw import polygon2mask
from skimage.measure import points_in_poly

import fisheyerec as fr
import fisheyerec.numpy as door
from fisheyerec.outlines import Transfer, moved_points

SIZE, VIEW_SIZE = (60, 80), (45, 64)
CAMERA = fr.FisheyeCamera([26.0, 27, 39.3, 29.1, 0.05, -0.01, 0, 0], SIZE)
VIEW = fr.PinholeCamera.from_fov(100, VIEW_SIZE)
TURN = fr.view_rotation(pan_deg=25, tilt_deg=-10, roll_deg=15)
OVER_180 = fr.FisheyeCamera([130.2, 130.2, 249.5, 249.5, 0, 0, 0, 0], (500, 500))
TURNS = {"straight": None, "turned": TURN, "aside": fr.view_rotation(pan_deg=100)}
by_turn = pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)


def corners_of(box):
    x0, y0, x1, y1 = box
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=float)


def random_boxes(rng, size, count):
    """Around whole pixels, a twentieth to a half of the picture wide and high."""
    height, width = size
    sides = np.stack([rng.integers(s // 20 + 1, s // 2, count) for s in (width, height)], -1)
    low = (rng.random((count, 2)) * ([width, height] - sides)).astype(int)
    return np.concatenate([low, low + sides], -1) - 0.5


def star(rng, box, count=11):
    """A polygon in a box, pointed and dented."""
    x0, y0, x1, y1 = box
    angle = np.sort(rng.random(count)) * 2 * np.pi
    radius = rng.uniform(0.3, 1, count)
    return (
        np.stack([x0 + x1 + (x1 - x0) * radius * np.cos(angle), y0 + y1 + (y1 - y0) * radius * np.sin(angle)], -1) / 2
    )


def raster(polygon, size):
    return polygon2mask(size, polygon[:, ::-1]) if len(polygon) else np.zeros(size, bool)


def area(polygon):
    x, y = polygon.T
    return abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def grid(box, count=100):
    """Points in a box and on its edges."""
    x0, y0, x1, y1 = box
    return np.stack(np.meshgrid(np.linspace(x0, x1, count), np.linspace(y0, y1, count)), -1)


def view_of(lens):
    return fr.view_for(lens, (300, 400), fov_deg=90)


# --- Points ---------------------------------------------------------------------------------------


def test_rectified_points_are_cv2_undistort_points(lens):
    view, rng = view_of(lens), np.random.default_rng(0)
    points = rng.random((400, 2)) * lens.image_size[::-1] - 0.5
    moved = fr.rectify_sample(fr.Sample(points=points), lens, view, rotation=TURN)
    K, D = lens.to_opencv()
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-14)
    expected = cv2.fisheye.undistortPoints(points[:, None], K, D, R=TURN.T, P=view.to_matrix(), criteria=criteria)[:, 0]
    # OpenCV gives points behind the view and beyond the lens' turn too: its answer counts where we give one, and where
    # its iteration has converged to the same place of the picture.
    rays, _ = view.unproject(expected)
    again, _ = lens.project(rays @ TURN.T)
    found = moved.points_valid & (np.abs(again - points).max(-1) < 1e-6)
    if moved.points_valid.any():
        assert found.sum() >= 0.85 * moved.points_valid.sum()
    np.testing.assert_allclose(moved.points[found], expected[found], rtol=1e-7, atol=1e-6)


def test_distorted_points_are_cv2_distort_points(lens, tolerance):
    view, rng = view_of(lens), np.random.default_rng(0)
    points = rng.random((400, 2)) * [400, 300]
    moved = fr.distort_sample(fr.Sample(points=points), view, lens)
    K, D = lens.to_opencv()
    upright = (points - view.params[2:]) / view.params[:2]
    expected = cv2.fisheye.distortPoints(upright[:, None], K, D)[:, 0]
    valid = moved.points_valid
    np.testing.assert_allclose(moved.points[valid], expected[valid], rtol=tolerance.opencv, atol=tolerance.opencv)
    height, width = lens.image_size
    inside = ((expected >= -0.5) & (expected <= [width - 0.5, height - 0.5])).all(-1)
    assert not (valid & ~inside).any()
    within_lens = np.arctan(np.hypot(*upright.T)) < lens.theta_max
    np.testing.assert_array_equal(valid, inside & within_lens)


@by_turn
def test_points_come_back(lens, turn, tolerance):
    view = view_of(lens)
    points = np.random.default_rng(0).random((20, 20, 2)) * lens.image_size[::-1] - 0.5
    moved = fr.rectify_sample(fr.Sample(points=points), lens, view, rotation=turn)
    back = fr.distort_sample(moved, view, lens, rotation=turn)
    assert moved.points_valid.shape == (20, 20)
    np.testing.assert_array_equal(np.isnan(moved.points).all(-1), ~moved.points_valid)
    np.testing.assert_array_equal(back.points_valid, moved.points_valid)
    valid = back.points_valid
    # At a turn of theta_d an angle is known to the square root of rounding only.
    diagonal = np.hypot(*lens.image_size)
    np.testing.assert_allclose(back.points[valid], points[valid], atol=tolerance.round_trip * diagonal)


def test_points_that_are_not_seen_are_nan():
    points = [[249.5, 249.5], [249.5, 20], [249.5, 480], [5, 5], [np.nan, 3], [249.5, 30.9]]
    view = fr.PinholeCamera.from_fov(90, (100, 100))
    moved = fr.rectify_sample(fr.Sample(points=points), OVER_180, view)
    np.testing.assert_array_equal(moved.points_valid, [True, False, False, False, False, False])
    assert np.isnan(moved.points[1:]).all()
    turned = fr.rectify_sample(fr.Sample(points=points), OVER_180, view, rotation=fr.view_rotation(tilt_deg=90))
    np.testing.assert_array_equal(turned.points_valid, [False, True, False, False, False, True])


# --- Boxes and polygons ---------------------------------------------------------------------------


@by_turn
def test_boxes_enclose_what_is_seen_of_them_and_no_more(lens, turn):
    """Against dense points in each box: none lies outside, the outermost lie at the edges."""
    view = view_of(lens)
    boxes = random_boxes(np.random.default_rng(1), lens.image_size, 12)
    moved = fr.rectify_sample(fr.Sample(boxes=boxes), lens, view, rotation=turn)
    for box, found, visible in zip(boxes, moved.boxes, moved.boxes_visible, strict=True):
        points, valid = moved_points(grid(box), lens, view, turn)
        # A grid misses what its steps hide, at borders and in tips.
        assert visible == pytest.approx(valid.mean(), abs=0.015)
        if valid.any():
            low, high = points[valid].min(0), points[valid].max(0)
            assert (found[:2] <= low + 0.1).all()
            assert (found[2:] >= high - 0.1).all()
        if valid.all():
            steps = np.linalg.norm(np.diff(points, axis=0), axis=-1).max()
            np.testing.assert_allclose(found, [*low, *high], atol=0.1 + steps / 50)
            assert visible == 1
        assert np.isnan(found).all() == (visible == 0)


def test_a_rectified_box_is_the_box_of_the_rectified_mask():
    """Where all is seen, to a pixel."""
    lens = fr.FisheyeCamera.from_projection("equidistant", 170, image_size=(750, 1000))
    view = fr.PinholeCamera.from_fov(120, (480, 640))
    boxes = random_boxes(np.random.default_rng(2), lens.image_size, 20)
    masks = np.stack([raster(corners_of(box), lens.image_size) for box in boxes], -1)
    moved = fr.rectify_sample(fr.Sample(boxes=boxes, mask=masks), lens, view)
    whole = np.flatnonzero(moved.boxes_visible == 1)
    assert len(whole) > 5
    for i in whole:
        rows, columns = np.nonzero(moved.mask[..., i])
        expected = [columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5]
        np.testing.assert_allclose(moved.boxes[i], expected, atol=1)


@pytest.mark.parametrize("direction", ["rectify", "distort"])
@by_turn
def test_polygons_are_drawn_as_pictures_of_them_are(lens, direction, turn):
    rng = np.random.default_rng(3)
    size = (300, 400)
    cameras = [lens.resize(size), view_of(lens)]
    move, source_from_target = fr.rectify_sample, turn
    if direction == "distort":
        cameras.reverse()
        move, source_from_target = fr.distort_sample, None if turn is None else turn.T
    polygons = [star(rng, box) for box in random_boxes(rng, size, 6)]
    moved = move(fr.Sample(polygons=polygons), *cameras, rotation=turn)
    height, width = size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    rays, _ = cameras[1].unproject(pixels)
    points, valid = cameras[0].project(rays if source_from_target is None else rays @ source_from_target.T)
    points = np.nan_to_num(points.reshape(-1, 2), nan=-1e9)
    for polygon, found, visible in zip(polygons, moved.polygons, moved.polygons_visible, strict=True):
        expected = points_in_poly(points, polygon).reshape(size) & valid
        drawn = raster(found, size)
        union = (expected | drawn).sum()
        assert (expected & drawn).sum() >= min(0.98 * union, union - 12)
        assert (visible > 0) >= (expected.sum() > 2)


@by_turn
def test_polygons_come_back(lens, turn):
    """Every vertex, and edges to the tolerance, where all is seen."""
    rng = np.random.default_rng(4)
    view = view_of(lens)
    polygons = [star(rng, box) for box in random_boxes(rng, lens.image_size, 12)]
    moved = fr.rectify_sample(fr.Sample(polygons=polygons), lens, view, rotation=turn)
    back = fr.distort_sample(moved, view, lens, rotation=turn)
    for i in np.flatnonzero(moved.polygons_visible == 1):
        assert back.polygons_visible[i] == 1
        distance = np.linalg.norm(polygons[i][:, None] - back.polygons[i], axis=-1).min(1)
        assert distance.max() < 1e-6
        assert area(back.polygons[i]) == pytest.approx(area(polygons[i]), rel=0.01)


def test_a_finer_tolerance_comes_nearer_to_the_curve():
    polygon = corners_of((5.5, 3.5, 70.5, 50.5))
    exact = Transfer(CAMERA, VIEW.resize((4500, 6400)), None, 1e-3)
    (reference,), _ = exact.polygons([polygon])
    for tolerance_px in (1.0, 0.1, 0.01):
        moved = fr.rectify_sample(
            fr.Sample(polygons=[polygon]), CAMERA, VIEW.resize((4500, 6400)), tolerance_px=tolerance_px
        )
        starts, ends = moved.polygons[0], np.roll(moved.polygons[0], -1, 0)
        edges = ends - starts
        place = ((reference[:, None] - starts) * edges).sum(-1) / (edges * edges).sum(-1)
        nearest = starts + place.clip(0, 1)[..., None] * edges
        assert np.linalg.norm(reference[:, None] - nearest, axis=-1).min(1).max() < 1.1 * tolerance_px


def test_a_box_around_all_that_is_seen_is_the_whole_view():
    moved = fr.rectify_sample(fr.Sample(boxes=[[-0.5, -0.5, 79.5, 59.5]], polygons=[corners_of((-9, -9, 90, 90))]),
                              CAMERA, fr.PinholeCamera.from_fov(60, VIEW_SIZE))  # fmt: skip
    np.testing.assert_array_equal(moved.boxes, [[-0.5, -0.5, 63.5, 44.5]])
    assert area(moved.polygons[0]) == pytest.approx(64 * 45)
    assert len(moved.polygons[0]) == 4
    assert 0.01 < moved.boxes_visible[0] < 1


ASIDE = fr.view_rotation(pan_deg=90)  # the point behind the view lies 90 degrees to the left, on the picture


@pytest.mark.parametrize("y0", [200.0, 249.5, 240.25], ids=["around", "edge_through_it", "beside_its_row"])
def test_what_lies_behind_a_view_is_not_seen(y0):
    """A box around the point behind the view is all around the view's rim, and shows nothing in it."""
    view = fr.PinholeCamera.from_fov(90, (100, 100))
    box = [20.0, y0, 80, 300]
    moved = fr.rectify_sample(fr.Sample(boxes=[box]), OVER_180, view, rotation=ASIDE)
    assert moved.boxes_visible[0] == 0
    assert np.isnan(moved.boxes).all()
    there = fr.rectify_sample(fr.Sample(boxes=[box]), OVER_180, view, rotation=ASIDE.T)
    assert there.boxes_visible[0] > 0.6


def test_a_lens_that_looks_backwards_shows_what_lies_around_the_point_behind():
    """A fisheye view of 300 degrees, turned round: a polygon around its back is seen as all but a hole."""
    target = fr.FisheyeCamera.from_projection("equidistant", 350, image_size=(400, 400))
    turned = fr.view_rotation(pan_deg=180)
    box = [200.0, 210, 290, 300]
    moved = fr.rectify_sample(fr.Sample(boxes=[box], polygons=[corners_of(box)]), OVER_180, target, rotation=turned)
    _, valid = moved_points(grid(box, 400), OVER_180, target, turned)
    assert moved.boxes_visible[0] == pytest.approx(valid.mean(), abs=0.005)
    rays, _ = target.unproject(np.stack(np.meshgrid(np.arange(400), np.arange(400)), -1).astype(float))
    points, _ = OVER_180.project(rays @ turned.T)
    expected = ((points >= box[:2]) & (points <= box[2:])).all(-1)
    drawn = raster(moved.polygons[0], (400, 400))
    assert (expected & drawn).sum() / (expected | drawn).sum() > 0.98


def test_an_excursion_round_a_corner_leaves_no_trace():
    """A polygon that leaves over the left edge, passes above the view and returns over the left edge."""
    square = fr.PinholeCamera([50.0, 50, 4.5, 4.5], (10, 10))
    hook = np.array([(3, 3), (-20, 3), (-20, -20), (20, -20), (20, -10), (-10, -10), (-10, 6), (3, 6)], dtype=float)
    moved = fr.rectify_sample(fr.Sample(polygons=[hook]), square, square)  # any camera will do
    np.testing.assert_allclose(moved.polygons[0].min(0), [-0.5, 3])
    np.testing.assert_allclose(moved.polygons[0].max(0), [3, 6])
    assert area(moved.polygons[0]) == pytest.approx(3.5 * 3)


def test_nothing_in_nothing_out():
    sample = fr.Sample(points=np.empty((0, 2)), boxes=[], polygons=[np.empty((0, 2))], mask=np.zeros((*SIZE, 2), bool))
    moved = fr.rectify_sample(sample, CAMERA, VIEW)
    assert moved.points.shape == (0, 2)
    assert (moved.boxes.shape, moved.boxes_visible.shape) == ((0, 4), (0,))
    assert moved.polygons[0].shape == (0, 2)
    assert moved.polygons_visible.tolist() == [0]
    empty = fr.rectify_sample(fr.Sample(), CAMERA, VIEW)
    assert all(value is None for name, value in vars(empty).items() if name != "depth_kind")


@pytest.mark.parametrize("box", [[10, 10, 10, 20], [10, 10, 10, 10], [np.nan] * 4, [1e9, 0, 2e9, 1]])
def test_boxes_without_area_on_the_picture_are_not_seen(box):
    for function, cameras in ((fr.rectify_sample, (CAMERA, VIEW)), (fr.distort_sample, (VIEW, CAMERA))):
        moved = function(fr.Sample(boxes=[box]), *cameras)
        assert np.isnan(moved.boxes).all()
        assert moved.boxes_visible[0] == 0


def test_unusable_cameras_see_nothing():
    camera = fr.FisheyeCamera([np.nan, 26, 25.3, 18.1, 0, 0, 0, 0], SIZE)
    sample = fr.Sample(points=[[3.0, 3]], boxes=[[1, 2, 3, 4]], polygons=[corners_of((1, 2, 3, 4))])
    for moved in (fr.rectify_sample(sample, camera, VIEW), fr.distort_sample(sample, VIEW, camera)):
        assert not moved.points_valid.any()
        assert not moved.boxes_visible.any()
        assert not moved.polygons_visible.any()


# --- Pictures -------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [None, TURN], ids=["straight", "turned"])
@pytest.mark.parametrize("antialias", [False, True])
def test_pictures_are_those_of_the_op(antialias, turn):
    rng = np.random.default_rng(0)
    for function, size, cameras in (("rectify", SIZE, (CAMERA, VIEW)), ("distort", VIEW_SIZE, (VIEW, CAMERA))):
        op = getattr(door, function)
        image, labels = rng.integers(0, 256, (*size, 3), dtype=np.uint8), rng.integers(0, 900, size)
        mask = rng.random((*size, 4)) < 0.5
        sample = fr.Sample(image=image, labels=labels, mask=mask)
        options = {"rotation": turn, "padding": "border"}
        moved = getattr(fr, f"{function}_sample")(sample, *cameras, antialias=antialias, **options)
        expected, valid = op(image, *cameras, antialias=antialias, **options)
        np.testing.assert_array_equal(moved.image, expected)
        np.testing.assert_array_equal(moved.valid, valid)
        for name, raster in (("labels", labels), ("mask", mask)):
            nearest = op(raster, *cameras, rotation=turn, interpolation="nearest").image
            np.testing.assert_array_equal(getattr(moved, name), nearest)
            assert getattr(moved, name).dtype == raster.dtype


def test_what_was_not_valid_stays_so():
    sample = fr.Sample(image=np.full(SIZE, 0.5), points=[[39.0, 29], [np.nan, 1]])
    wide = fr.PinholeCamera.from_fov(150, VIEW_SIZE)
    moved = fr.rectify_sample(sample, CAMERA, wide, rotation=TURN)
    back = fr.distort_sample(moved, wide, CAMERA, rotation=TURN)
    _, seen = door.distort(moved.image, wide, CAMERA, rotation=TURN)
    again = door.distort(moved.valid, wide, CAMERA, rotation=TURN, interpolation="nearest").image
    np.testing.assert_array_equal(back.valid, again)
    assert not (back.valid & ~seen).any()
    assert 0 < back.valid.sum() < seen.sum()
    np.testing.assert_array_equal(back.points_valid, [True, False])


# --- Depth ----------------------------------------------------------------------------------------

PLANE, OFFSET = np.array([0.2, -0.3, 1.0]), 4.0  # PLANE . X = OFFSET in the fisheye camera's frame


def plane_depth(camera, kind, rotation=None):
    """Depth of the plane along each pixel's ray or along the camera's axis; rotation is plane_from_camera."""
    height, width = camera.image_size
    rays, valid = camera.unproject(np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float))
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    along = (rays if rotation is None else rays @ rotation.T) @ PLANE
    distance = np.where(valid & (along > 0), OFFSET / np.where(along > 0, along, 1), 0)
    return distance if kind == "distance" else distance * rays[..., 2]


@pytest.mark.parametrize("turn", [None, TURN], ids=["straight", "turned"])
@pytest.mark.parametrize("kind", ["z", "distance"])
@pytest.mark.parametrize("direction", ["rectify", "distort"])
def test_depth_of_a_plane_is_that_of_its_rays(direction, kind, turn):
    """To what half a pixel of the source makes of a slanted plane."""
    camera, view = CAMERA.resize((600, 800)), fr.PinholeCamera.from_fov(80, (300, 400))
    if direction == "rectify":
        depth, expected = plane_depth(camera, kind), plane_depth(view, kind, turn)
        moved = fr.rectify_sample(fr.Sample(depth=depth, depth_kind=kind), camera, view, rotation=turn)
    else:
        depth, expected = plane_depth(view, kind, turn), plane_depth(camera, kind)
        moved = fr.distort_sample(fr.Sample(depth=depth, depth_kind=kind), view, camera, rotation=turn)
    seen = moved.valid & (moved.depth > 0)
    assert seen.mean() > 0.2
    np.testing.assert_allclose(moved.depth[seen], expected[seen], rtol=0.01)
    assert moved.depth_kind == kind


def test_depth_is_that_of_the_nearest_pixels_own_point():
    """Exactly: its point in space, turned into the view's frame."""
    depth = np.random.default_rng(0).uniform(1, 9, SIZE)
    moved = fr.rectify_sample(fr.Sample(depth=depth), CAMERA, VIEW, rotation=TURN)
    rays, _ = VIEW.unproject(np.stack(np.meshgrid(np.arange(64), np.arange(45)), -1).astype(float))
    points, _ = CAMERA.project(rays @ TURN.T)
    column, row = np.floor(np.nan_to_num(points) + 0.5).astype(int).clip(0, [79, 59]).transpose(2, 0, 1)
    directions, _ = CAMERA.unproject(np.stack([column, row], -1).astype(float))
    in_space = directions / directions[..., 2:] * depth[row, column][..., None]
    expected = (in_space @ TURN)[..., 2]
    seen = moved.valid & (directions[..., 2] > 0)
    np.testing.assert_allclose(moved.depth[seen], expected[seen], rtol=1e-9)


def test_depth_in_whole_millimetres_stays_so():
    depth = np.full(SIZE, 1500, np.uint16)
    depth[:30] = 0
    moved = fr.rectify_sample(fr.Sample(depth=depth), CAMERA, VIEW, rotation=TURN)
    assert moved.depth.dtype == np.uint16
    exact = fr.rectify_sample(fr.Sample(depth=depth.astype(float)), CAMERA, VIEW, rotation=TURN)
    np.testing.assert_array_equal(moved.depth, np.rint(exact.depth))
    straight = fr.rectify_sample(fr.Sample(depth=depth), CAMERA, VIEW)
    assert set(np.unique(straight.depth)) == {0, 1500}


# --- Bad input ------------------------------------------------------------------------------------

# What is bad in a sample, or in an option -> exception and what it says.
BAD = {
    "no_sample": ({"sample": np.zeros(SIZE)}, TypeError, "sample as a Sample, got ndarray"),
    "list_for_image": ({"image": [[1]]}, TypeError, "sample.image as a NumPy array or a tensor, got list"),
    "image_of_another_size": ({"image": np.zeros((60, 79))}, ValueError, r"sample.image of the size of camera, \(60, 80\)"),
    "integer_image": ({"image": np.zeros(SIZE, np.int32)}, ValueError, "sample.image of a floating dtype, uint8 or uint16 .* got int32"),
    "labels_of_another_size": ({"labels": np.zeros((6, 80), int)}, ValueError, r"sample.labels of the size of camera"),
    "floating_labels": ({"labels": np.zeros(SIZE)}, ValueError, "sample.labels of an integer dtype, got float64"),
    "integer_mask": ({"mask": np.zeros(SIZE, int)}, ValueError, "sample.mask of dtype bool, got int64"),
    "depth_of_channels": ({"depth": np.zeros((*SIZE, 1))}, ValueError, r"sample.depth of shape \(H, W\), got \(60, 80, 1\)"),
    "depth_of_another_size": ({"depth": np.zeros((60, 60))}, ValueError, "sample.depth of the size of camera"),
    "unknown_depth": ({"depth_kind": "disparity"}, ValueError, r"sample.depth_kind in \('z', 'distance'\), got 'disparity'"),
    "points_of_3": ({"points": np.zeros((5, 3))}, ValueError, r"sample.points of shape \(..., 2\), got \(5, 3\)"),
    "points_of_words": ({"points": [["a", "b"]]}, TypeError, r"sample.points as numbers \(..., 2\)"),
    "one_box_flat": ({"boxes": [1, 2, 3, 4]}, ValueError, r"sample.boxes of shape \(N, 4\), got \(4,\)"),
    "boxes_of_5": ({"boxes": np.zeros((2, 5))}, ValueError, r"sample.boxes of shape \(N, 4\), got \(2, 5\)"),
    "box_as_width_and_height": ({"boxes": [[1, 2, 3, 4], [30, 40, 10, 10]]}, ValueError, r"x0 <= x1 .* got \[30.0, 40.0, 10.0, 10.0\] at 1"),
    "polygon_of_2": ({"polygons": [np.zeros((3, 2)), np.zeros((2, 2))]}, ValueError, r"sample.polygons\[1\] of shape \(M, 2\) with M >= 3"),
    "polygon_flat": ({"polygons": [[1, 2, 3, 4, 5, 6]]}, ValueError, r"sample.polygons\[0\] of shape \(M, 2\), got \(6,\)"),
    "polygons_by_name": ({"polygons": {"a": 1}}, TypeError, "sample.polygons as a list of arrays, got dict"),
    "integer_valid": ({"valid": np.zeros(SIZE, int)}, ValueError, "sample.valid of dtype bool"),
    "no_tolerance": ({"tolerance_px": 0}, ValueError, "tolerance_px of at least 0.001, got 0"),
    "tolerance_nan": ({"tolerance_px": float("nan")}, ValueError, "tolerance_px of at least 0.001, got nan"),
    "rotation_2x2": ({"rotation": np.eye(2)}, ValueError, r"rotation of shape \(3, 3\), got \(2, 2\)"),
    "camera_is_no_camera": ({"camera": 3}, TypeError, "camera as a camera, got int"),
    "batch_of_cameras": ({"camera": fr.FisheyeCamera(np.tile(CAMERA.params, (3, 1)), SIZE)}, ValueError, "one camera, got a batch of 3"),
    "unknown_padding": ({"padding": "wrap", "image": np.zeros(SIZE)}, ValueError, "padding in"),
}  # fmt: skip


@pytest.mark.parametrize(("bad", "exception", "message"), BAD.values(), ids=BAD)
def test_bad_input_is_told_in_one_line(bad, exception, message):
    options = {name: bad[name] for name in ("padding", "tolerance_px", "rotation") if name in bad}
    sample = bad.get("sample") if "sample" in bad else fr.Sample(**{
        name: value for name, value in bad.items() if name not in (*options, "camera")
    })  # fmt: skip
    camera = bad.get("camera", CAMERA)
    with pytest.raises(exception, match=message) as raised:
        fr.rectify_sample(sample, camera, VIEW, **options)
    assert str(raised.value).startswith("rectify_sample(): expected ")
    assert "\n" not in str(raised.value)


def test_the_mirror_speaks_of_itself():
    with pytest.raises(
        ValueError, match=r"^distort_sample\(\): expected sample.labels of the size of view, \(45, 64\)"
    ):
        fr.distort_sample(fr.Sample(labels=np.zeros(SIZE, int)), VIEW, CAMERA)
    with pytest.raises(ValueError, match=r"^distort_sample\(\): expected rotation of shape"):
        fr.distort_sample(fr.Sample(), VIEW, CAMERA, rotation=np.eye(4))


def test_samples_move_without_torch(run_python):
    code = """
import sys
import numpy as np, fisheyerec as fr
camera = fr.FisheyeCamera.from_projection("equidistant", 170, image_size=(60, 80))
view = fr.PinholeCamera.from_fov(80, (50, 50))
sample = fr.Sample(image=np.zeros((60, 80)), boxes=[[10, 10, 40, 30]], points=[[40, 30]])
fr.distort_sample(fr.rectify_sample(sample, camera, view), view, camera)
print("torch" in sys.modules)
"""
    done = run_python(code)
    assert (done.stdout, done.stderr) == ("False\n", "")


# --- Tensors --------------------------------------------------------------------------------------


def as_tensors(sample):
    """The same sample in tensors, its pictures' channels first."""

    def tensor(name, value):
        if name == "polygons":
            return [torch.from_numpy(polygon) for polygon in value]
        channels_last = name in ("image", "labels", "mask") and value.ndim == 3
        return torch.from_numpy(np.moveaxis(value, -1, 0).copy() if channels_last else value)

    given = {name: value for name, value in vars(sample).items() if value is not None and name != "depth_kind"}
    return fr.Sample(depth_kind=sample.depth_kind, **{name: tensor(name, value) for name, value in given.items()})


@pytest.mark.parametrize("turn", [None, TURN], ids=["straight", "turned"])
@pytest.mark.parametrize("kind", ["z", "distance"])
@pytest.mark.parametrize("direction", ["rectify", "distort"])
def test_tensors_move_as_arrays_do(direction, kind, turn):
    rng = np.random.default_rng(0)
    cameras, size = ((CAMERA, VIEW), SIZE) if direction == "rectify" else ((VIEW, CAMERA), VIEW_SIZE)
    sample = fr.Sample(
        image=rng.random((*size, 3)),
        labels=rng.integers(0, 900, size),
        mask=rng.random((*size, 4)) < 0.5,
        depth=rng.integers(0, 5000, size).astype(np.int32) if turn is None else rng.uniform(1, 9, size),
        depth_kind=kind,
        points=rng.random((5, 7, 2)) * size[::-1],
        boxes=random_boxes(rng, size, 8),
        polygons=[star(rng, box) for box in random_boxes(rng, size, 5)],
        valid=rng.random(size) < 0.9,
    )
    move = getattr(fr, f"{direction}_sample")
    expected = as_tensors(move(sample, *cameras, rotation=turn, antialias=True))
    for rotation in [turn] if turn is None else [turn, torch.from_numpy(turn)]:
        moved = move(as_tensors(sample), *cameras, rotation=rotation, antialias=True)
        for name, value in vars(expected).items():
            found = getattr(moved, name)
            if name == "depth_kind":
                assert found == value
            elif name == "polygons":
                assert all(torch.equal(a, b) for a, b in zip(found, value, strict=True))
            else:
                assert (found.dtype, found.shape) == (value.dtype, value.shape), name
                torch.testing.assert_close(found, value, equal_nan=True, rtol=1e-9, atol=1e-9)


def test_tensors_and_arrays_may_stand_together():
    sample = fr.Sample(image=torch.rand(3, *SIZE), labels=np.zeros(SIZE, int), boxes=torch.tensor([[5, 5, 20, 20]]),
                       points=[[30.0, 20]])  # fmt: skip
    moved = fr.rectify_sample(sample, CAMERA, VIEW)
    assert (moved.image.dtype, moved.image.shape) == (torch.float32, (3, *VIEW_SIZE))
    assert isinstance(moved.labels, np.ndarray)
    assert isinstance(moved.points, np.ndarray)
    assert (moved.boxes.dtype, moved.boxes_visible.dtype) == (torch.float32, torch.float32)


@pytest.mark.parametrize("direction", ["rectify", "distort"])
def test_gradients_of_a_sample_reach_all_there_is(direction):
    """Points in view, out of view and beyond the lens' turn; depth through the turn of its axis."""
    names, size = (("lens", "view"), (6, 8)) if direction == "rectify" else (("view", "lens"), (5, 7))
    folding = torch.tensor([3.0, 3.1, 3.6, 2.4, -0.2, 0, 0, 0], dtype=torch.float64, requires_grad=True)
    view = torch.tensor([3.5, 3.5, 3.2, 2.1], dtype=torch.float64, requires_grad=True)
    turn = torch.tensor(TURN, requires_grad=True)
    generator = torch.Generator().manual_seed(0)
    image, depth = (torch.rand(*shape, *size, generator=generator, dtype=torch.float64, requires_grad=True)
                    for shape in ((1,), ()))  # fmt: skip
    points = torch.rand(12, 2, generator=generator, dtype=torch.float64) * torch.tensor([12.0, 9]) - 2
    points.requires_grad_()

    def move(lens, view, turn, image, depth, points):
        cameras = {"lens": fr.FisheyeCamera(lens, (6, 8)), "view": fr.PinholeCamera(view, (5, 7))}
        sample = fr.Sample(image=image, depth=depth, points=points)
        moved = getattr(fr, f"{direction}_sample")(sample, *(cameras[name] for name in names), rotation=turn)
        assert 0 < moved.points_valid.sum() < 12
        return moved.image, moved.depth, moved.points[moved.points_valid]

    assert torch.autograd.gradcheck(move, (folding, view, turn, image, depth, points), fast_mode=True)


BAD_TENSORS = {
    "batch": ({"image": torch.zeros(2, 3, *SIZE)}, ValueError, r"sample.image of shape \(H, W\) or \(C, H, W\), got \(2, 3, 60, 80\)"),
    "image_of_another_size": ({"image": torch.zeros(3, 60, 79)}, ValueError, r"sample.image of the size of camera, \(60, 80\)"),
    "channels_last": ({"image": torch.zeros(60, 80, 3)}, ValueError, r"sample.image of the size of camera"),
    "floating_labels": ({"labels": torch.zeros(SIZE)}, ValueError, "sample.labels of an integer dtype, got torch.float32"),
    "integer_mask": ({"mask": torch.zeros(SIZE, dtype=torch.int64)}, ValueError, "sample.mask of dtype bool, got torch.int64"),
    "complex_depth": ({"depth": torch.zeros(SIZE, dtype=torch.complex64)}, ValueError, "sample.depth of a floating or integer dtype"),
    "points_of_3": ({"points": torch.zeros(5, 3)}, ValueError, r"sample.points of shape \(..., 2\), got \(5, 3\)"),
    "boxes_flat": ({"boxes": torch.zeros(4)}, ValueError, r"sample.boxes of shape \(N, 4\), got \(4,\)"),
}  # fmt: skip


@pytest.mark.parametrize(("bad", "exception", "message"), BAD_TENSORS.values(), ids=BAD_TENSORS)
def test_bad_tensors_are_told_in_one_line(bad, exception, message):
    with pytest.raises(exception, match=message) as raised:
        fr.rectify_sample(fr.Sample(**bad), CAMERA, VIEW)
    assert str(raised.value).startswith("rectify_sample(): expected ")
    assert "\n" not in str(raised.value)
