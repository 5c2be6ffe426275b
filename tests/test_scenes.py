"""The example scenes: exact geometry, exact coverage, the same picture for the same seed."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
sys.path.insert(0, str(EXAMPLES))

import scenes  # noqa: E402
from scenes.lighting import AmbientLayer, AmbientLight, Sun, tone_curve  # noqa: E402
from scenes.materials import Material, chessboard, painted  # noqa: E402
from scenes.rendering import World  # noqa: E402
from scenes.solids import Placement, Shape, Solid  # noqa: E402

MAKERS = ("room", "street", "corridor", "chessboard")


@cache
def scene(name: str, seed: int = 0) -> scenes.Scene:
    return getattr(scenes, name)(seed)


def pinhole(image_size: tuple[int, int], focal: float, centre: tuple[float, float] | None = None):
    height, width = image_size
    middle = ((width - 1) / 2, (height - 1) / 2) if centre is None else centre

    def unproject(points):
        plane = (points - middle) / focal
        rays = np.concatenate([plane, np.ones_like(plane[..., :1])], -1)
        return rays, np.ones(points.shape[:-1], dtype=bool)

    return unproject


def sphere_of_rays(count: int) -> np.ndarray:
    rays = np.random.default_rng(3).standard_normal((count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def bare(solids: list[Solid]) -> scenes.Scene:
    """These solids under even light, seen from the origin."""
    even = AmbientLayer(np.ones((6, 2, 2, 2), dtype=np.float32), np.ones((6, 3)))
    ambient = AmbientLight(np.zeros(3), 1.0, [even])
    sun = Sun(np.array([0.0, -1.0, 0.0]), np.zeros(3))
    return scenes.Scene(World(solids, sun, ambient, np.zeros_like), np.zeros(3), np.eye(3))


def solid(along, height, out, **options) -> Solid:
    place = Placement([])
    material = options.pop("material", painted())
    colour = options.pop("colour", np.full(3, 0.5))
    place.box(along, height, out, material, colour, scenes.Label.FURNITURE, **options)
    return place.solids[0]


@pytest.mark.parametrize("name", MAKERS)
def test_the_seed_decides_the_picture(name):
    unproject = pinhole((24, 32), 15.0)
    first = scenes.render_camera(scene(name), unproject, (24, 32), 1)
    again = scenes.render_camera(getattr(scenes, name)(0), unproject, (24, 32), 1)
    other = scenes.render_camera(scene(name, 1), unproject, (24, 32), 1)
    for field in ("image", "labels", "depth"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    assert (first.image != other.image).mean() > 0.2


@pytest.mark.parametrize("name", MAKERS)
def test_every_direction_sees_something_of_a_known_class(name):
    seen = scenes.render(scene(name), sphere_of_rays(4000))
    assert seen.labels.min() > 0
    assert seen.labels.max() < len(scenes.CLASSES)
    sky = seen.labels == scenes.Label.SKY
    np.testing.assert_array_equal(np.isinf(seen.depth), sky)
    assert len(np.unique(seen.labels)) >= 5
    assert (sky.mean() > 0.1) == (name == "street")


def test_a_box_covers_exactly_the_pixels_it_projects_to():
    front = bare([solid((-0.7, 1.1), (-0.4, 0.9), (4.0, 5.0))])
    size, focal, centre = (61, 81), 50.0, (33.3, 31.7)
    picture = scenes.render_camera(front, pinhole(size, focal, centre), size, 3)
    y, x = np.mgrid[: size[0], : size[1]]
    # Heights count up and y counts down; the camera sees the front face, 4 m away, only.
    inside = (x > -0.7 / 4 * focal + centre[0]) & (x < 1.1 / 4 * focal + centre[0])
    inside &= (y > -0.9 / 4 * focal + centre[1]) & (y < 0.4 / 4 * focal + centre[1])
    np.testing.assert_array_equal(picture.labels == scenes.Label.FURNITURE, inside)
    rays, _ = pinhole(size, focal, centre)(np.stack([x, y], -1).astype(float))
    distance = 4 * np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(picture.depth[inside], distance[inside], rtol=1e-12)


def test_what_lies_behind_the_image_plane_is_seen():
    behind = bare([solid((-1, 1), (-1, 1), (-6, -5))])
    seen = scenes.render(behind, np.array([[0, 0, -2.0], [0, 0, 2.0], [1.0, 0, -5.5]]))
    np.testing.assert_allclose(seen.depth, [5, np.inf, np.hypot(1, 5.5) / 5.5 * 5], rtol=1e-12)
    assert seen.labels.tolist() == [scenes.Label.FURNITURE, scenes.Label.SKY, 6]


def test_round_and_slanted_solids_are_met_where_geometry_says():
    ball = solid((-1, 1), (-1, 1), (4, 6), shape=Shape.ELLIPSOID)
    seen = scenes.render(bare([ball]), np.array([[0, 0, 1.0], [0.1, 0, 1.0], [0.3, 0, 1.0]]))
    along = 1 / np.hypot(1, 0.1)
    grazing = 5 * along - np.sqrt((5 * along) ** 2 - 24)
    np.testing.assert_allclose(seen.depth, [4, grazing, np.inf], rtol=1e-12)

    pole = solid((1, 3), (-5, 5), (4, 6), shape=Shape.CYLINDER)
    seen = scenes.render(bare([pole]), np.array([[2, 0, 5.0], [2, 1, 5.0]]))
    expected = (np.hypot(2, 5) - 1) * np.array([1, np.sqrt(30) / np.sqrt(29)])
    np.testing.assert_allclose(seen.depth, expected, rtol=1e-12)

    place = Placement([])
    place.prism([(-2, -1), (2, -1), (-2, 3)], (4, 6), painted(), np.ones(3), scenes.Label.CAR)
    # The slope runs from (2, -1) to (-2, 3): along + height = 1, and y points down.
    downwards = scenes.render(bare(place.solids).posed((0.5, -9, 5)), np.array([[0, 1.0, 0]]))
    np.testing.assert_allclose(downwards.depth, [8.5], rtol=1e-12)
    normal = place.solids[0].normals(np.array([[0.5], [-0.5], [5.0]]))[:, 0]
    np.testing.assert_allclose(normal, [np.sqrt(0.5), -np.sqrt(0.5), 0], atol=1e-12)


def test_the_tree_finds_what_trying_every_solid_finds():
    crowd = scene("room").world
    ray = sphere_of_rays(300).T
    origin = np.repeat(scene("room").position[:, None], 300, axis=1)
    best = np.full(300, np.inf)
    for one in crowd.solids:
        with np.errstate(divide="ignore"):
            slabs = (np.stack([one.lo, one.hi])[..., None] - origin) / ray
        near, far = one.cut(origin, ray, slabs.min(0).max(0), slabs.max(0).min(0))
        best = np.where((near < far) & (near > 0), np.minimum(best, near), best)
    np.testing.assert_allclose(crowd.tree.nearest(origin, ray)[0], best, rtol=1e-12)


@pytest.mark.parametrize("name", ["room", "street"])
def test_only_the_direction_of_a_ray_counts(name):
    # Off centre, so that no ray falls exactly on a joint of the symmetrical scene.
    unproject = pinhole((30, 40), 20.0, (19.37, 14.71))
    rays, _ = unproject(np.stack(np.meshgrid(np.arange(40.0), np.arange(30.0)), -1))
    scale = np.random.default_rng(0).uniform(0.01, 100, (30, 40, 1))
    plain, scaled = (scenes.render(scene(name), r) for r in (rays, rays * scale))
    np.testing.assert_array_equal(plain.image, scaled.image)
    np.testing.assert_array_equal(plain.labels, scaled.labels)
    np.testing.assert_allclose(plain.depth, scaled.depth, rtol=1e-9)


def test_supersampling_averages_to_the_analytic_coverage():
    square, distance, white = 0.37, 10.0, 0.2
    squares = chessboard(square, (0.0, 0.0), np.zeros(3))
    glowing = Material(squares.texture, emits=True)
    wall = solid((-9, 9), (-9, 9), (10, 11), material=glowing, colour=np.full(3, white))
    size, focal, centre = (25, 31), 47.0, (14.2, 11.6)
    unproject = pinhole(size, focal, centre)
    picture = scenes.render_camera(bare([wall]), unproject, size, 5)

    def share(count, middle):
        """Share of each pixel, seen as a span on the wall, in the squares [0, square) + 2 k."""
        edges = (np.arange(count + 1) - 0.5 - middle) / focal * distance
        whole = np.floor(edges / (2 * square))
        filled = whole * square + np.minimum(edges - whole * 2 * square, square)
        return np.diff(filled) / np.diff(edges)

    # v counts upwards from the board's origin, rows of the picture downwards.
    a, b = share(size[1], centre[0]), share(size[0], size[0] - 1 - centre[1])[::-1, None]
    light = (1 - a * b - (1 - a) * (1 - b)) * tone_curve(np.array(white))
    encoded = picture.image[..., 0] / 255
    decoded = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(decoded, light, atol=0.006)
    assert np.ptp(light) > 0.1


def test_invalid_pixels_and_unusable_rays_are_black_and_unlabelled():
    def half(points):
        rays, valid = pinhole((20, 20), 15.0)(points)
        return rays, valid & (points[..., 0] < 9.5)

    picture = scenes.render_camera(scene("corridor"), half, (20, 20), 3)
    assert (picture.labels[:, :10] > 0).all()
    assert (picture.image[:, :10].sum(-1) > 0).all()
    assert (picture.image[:, 10:] == 0).all()
    assert (picture.labels[:, 10:] == 0).all()
    assert np.isinf(picture.depth[:, 10:]).all()
    rays = np.array([[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1], [0, 0, 1.0]])
    seen = scenes.render(scene("corridor"), rays)
    assert (seen.image[:3] == 0).all()
    assert seen.labels[:3].tolist() == [0, 0, 0]
    assert np.isinf(seen.depth[:3]).all()
    assert seen.labels[3] > 0


def test_chessboard_corners_part_four_squares():
    board = scenes.chessboard(1, squares=(5, 8), square=0.2, distance=1.5)
    board = board.posed(np.add(board.position, [0.2, 0.1, 0.3]), yaw_deg=12, pitch_deg=-7, roll_deg=4)
    corners = board.corners
    assert corners.shape == (4, 7, 3)
    right, down = corners[0, 1] - corners[0, 0], corners[1, 0] - corners[0, 0]
    np.testing.assert_allclose(np.linalg.norm([right, down], axis=1), 0.2)
    offsets = np.array([right + down, right - down, -right - down, down - right]) * 1e-5
    seen = scenes.render(board, corners[..., None, :] + offsets)
    assert (seen.labels == scenes.Label.CHESSBOARD).all()
    np.testing.assert_allclose(seen.depth.mean(-1), np.linalg.norm(corners, axis=-1), rtol=1e-4)
    bright = seen.image[..., 0] > 90
    falling, rising = bright[..., [0, 2]], bright[..., [1, 3]]
    assert (falling[..., 0] == falling[..., 1]).all()
    assert (rising[..., 0] == rising[..., 1]).all()
    assert (falling[..., 0] != rising[..., 0]).all()
    assert (bright[0, :-1, 0] != bright[0, 1:, 0]).all()


@pytest.mark.parametrize("name", MAKERS)
def test_lines_lie_on_surfaces_the_camera_sees(name):
    view = scene(name).posed(yaw_deg=20, pitch_deg=-10)
    lines = view.lines(min_angle_deg=6)
    assert lines.shape[0] > 40
    assert lines.shape[1:] == (2, 3)
    ends = lines / np.linalg.norm(lines, axis=-1, keepdims=True)
    assert np.degrees(np.arccos((ends[:, 0] * ends[:, 1]).sum(-1))).min() >= 6 - 1e-6
    share = np.linspace(0.1, 0.9, 5)[:, None]
    points = (lines[:, :1] * (1 - share) + lines[:, 1:] * share).reshape(-1, 3)
    distance = np.linalg.norm(points, axis=1)
    # Rays to either side of an edge: one of them meets the solid the edge belongs to.
    aside = np.random.default_rng(1).standard_normal((12, 1, 3)) * 2e-4 * distance[:, None]
    depth = scenes.render(view, points + aside).depth
    on_surface = (np.abs(depth - distance) < 0.02 * distance).any(0)
    assert on_surface.mean() > 0.9


@pytest.mark.parametrize(("colour", "count"), [(0.5, 6), (0.4, 7)])
def test_lines_leave_out_the_joint_of_flush_boxes_of_one_colour(colour, count):
    paint = painted()
    pair = [
        solid((-1, 0), (-1, 1), (4, 5), material=paint),
        solid((0, 1), (-1, 1), (4, 5), material=paint, colour=np.full(3, colour)),
    ]
    lines = bare(pair).lines()
    assert len(lines) == count
    joints = (lines[..., 0] == 0).all(1)
    assert joints.sum() == count - 6
    for joint in lines[joints]:
        np.testing.assert_allclose(joint, [[0, -1, 4], [0, 1, 4]])


def test_posing_turns_the_camera_right_up_and_clockwise():
    home = scene("street")
    ahead = np.array([[0, 0, 1.0]])
    for turn, same in (
        ({"yaw_deg": 90}, [1.0, 0, 0]),
        ({"pitch_deg": 30}, [0, -0.5, np.sqrt(0.75)]),
        ({"yaw_deg": 180}, [0, 0, -1.0]),
    ):
        turned = scenes.render(home.posed(**turn), ahead)
        np.testing.assert_allclose(turned.depth, scenes.render(home, np.array([same])).depth)
    right = home.posed(roll_deg=90).rotation @ [1.0, 0, 0]
    np.testing.assert_allclose(right, [0, 1, 0], atol=1e-12)


def test_misuse_is_named_in_one_line():
    corridor = scene("corridor")
    unproject = pinhole((4, 4), 3.0)

    def flat(points):
        return points, np.ones(points.shape[:-1], dtype=bool)

    for call, message in (
        (lambda: scenes.render(corridor, np.ones((5, 2))), r"render\(\).*rays.*\(5, 2\)"),
        (
            lambda: scenes.render(corridor, np.ones((5, 3)), footprint=np.ones(4)),
            r"render\(\).*footprint.*\(5,\).*\(4,\)",
        ),
        (lambda: scenes.render_camera(corridor, unproject, (0, 4)), r"image_size.*\(0, 4\)"),
        (lambda: scenes.render_camera(corridor, unproject, (4, 4), 2), r"supersample.*odd.*2"),
        (lambda: scenes.render_camera(corridor, flat, (4, 4)), r"unproject.*rays.*\(12, 12, 3\)"),
        (lambda: corridor.posed((1.0, 2.0)), r"posed\(\).*\(3,\).*\(2,\)"),
        (lambda: corridor.corners, r"corners.*chessboard"),
        (lambda: scenes.chessboard(squares=(1, 4)), r"chessboard\(\).*squares.*\(1, 4\)"),
    ):
        with pytest.raises(ValueError, match=message) as error:
            call()
        assert "\n" not in str(error.value)


def test_scenes_need_numpy_only():
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import scenes; "
        "bad = {'torch', 'fisheyerec', 'PIL', 'cv2', 'scipy'} & set(sys.modules); "
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code, str(EXAMPLES)], check=True)
