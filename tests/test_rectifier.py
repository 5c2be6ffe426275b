"""One call for an uncalibrated photo: what the network sees, the camera's way back, and the command line."""

import contextlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

import fisheyerec as fr
from fisheyerec import rectifier as module
from fisheyerec.cli import app
from fisheyerec.cli.estimate import _json_line
from fisheyerec.lens_chart import SIZE, camera_from_chart, chart_from_camera, chart_of
from fisheyerec.network import FishEyeRecNet
from fisheyerec.pictures import Picture, read_picture, write_picture
from fisheyerec.rectifier import Rectifier
from fisheyerec.views import PROJECTIONS
from fisheyerec.weights import save_network

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
sys.path.insert(0, str(EXAMPLES))

import scenes  # noqa: E402  beside the package

ROOM = EXAMPLES / "room.jpg"
SIZES = [(256, 256), (768, 1024), (1024, 768), (480, 640), (270, 480), (333, 500), (101, 640), (64, 64), (16, 16)]


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return FishEyeRecNet.compact().eval()


@pytest.fixture(scope="module")
def rectifier(network):
    return Rectifier(network)


@pytest.fixture(scope="module")
def weights(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "net.safetensors"
    save_network(network, path, {})
    return path


@pytest.fixture(scope="module")
def room():
    """Half of the example's size, 512x384."""
    return np.asarray(Image.open(ROOM).resize((512, 384), Image.Resampling.BOX))


@pytest.fixture(scope="module")
def ramp():
    """A smooth picture, 512x384: no line takes time to be looked at."""
    y, x = np.mgrid[:384, :512]
    return np.stack([x / 2, y / 2, 255 - (x + y) / 4], -1).astype(np.uint8)


@pytest.fixture(scope="module")
def straight():
    """Nested rectangles, 256x192: no fisheye made them."""
    picture = np.full((192, 256), 128, np.uint8)
    for number, margin in enumerate(range(6, 90, 14)):
        picture[margin:-margin, margin:-margin] = (30, 220)[number % 2]
    return picture


class Told(FishEyeRecNet):
    """A network that says the same of every picture."""

    chart = torch.tensor([-1.55, -0.83, -0.38, 0.66, -0.3, 0.03, -0.02, 0.002], dtype=torch.float64)

    def forward(self, image, *, straighten=True):
        self.seen = image
        output = super().forward(image, straighten=straighten)
        covariance = 1e-4 * torch.eye(SIZE, dtype=torch.float64).expand(len(image), -1, -1)
        chart = self.chart.expand(len(image), -1)
        return output._replace(estimate=output.estimate._replace(chart=chart, covariance=covariance))


@pytest.fixture(scope="module")
def told():
    network = Told.compact().eval()
    return Rectifier(network)


# --- The camera's way back ------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
def test_the_camera_is_the_one_of_the_chart_at_any_size(told, size):
    """The frame may be cropped or continued: the chart is relative to the longer side, which is whole."""
    found = told.estimate(np.zeros(size, np.uint8), refine=False).camera
    assert found.image_size == size
    chart = chart_from_camera(torch.as_tensor(found.params), size)
    # Sides are whole numbers of pixels in the working copy and in the box: half a pixel of the shorter one.
    shorter = min(size) * min(1, 512 / max(size))
    np.testing.assert_allclose(chart, told.network.chart, atol=1 / shorter)


def test_the_same_scene_at_two_resolutions_gives_the_same_camera(rectifier, room):
    one, two = (rectifier.estimate(photo, refine=False).camera for photo in (room, ROOM))
    np.testing.assert_allclose(one.resize((768, 1024)).params, two.params, atol=0.1)


@pytest.mark.parametrize("size", SIZES)
def test_a_point_of_the_frame_is_the_same_point_of_the_working_copy(size):
    """A ramp of coordinates, resized as the network sees it, says where each pixel came from."""
    height, width = size
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    seen = module.network_frame(np.stack([x, y, 0 * x], -1), 192)
    small = seen.shape[:2]
    points = np.stack(np.meshgrid(np.arange(small[1]), np.arange(small[0])), -1).astype(float)
    eight = fr.FisheyeCamera([100, 100, 0, 0, 0, 0, 0, 0], small)
    expected, _ = eight.resize(size).project(eight.unproject(points)[0])
    reach = 1 + max(side / shrunk for side, shrunk in zip(size, small, strict=True))
    inside = ((expected > reach) & (expected < np.array([width, height]) - 1 - reach)).all(-1)
    assert inside.any() or min(size) < 32
    np.testing.assert_allclose(seen[..., :2][inside], expected[inside], atol=1e-3 * max(size))


@pytest.mark.parametrize("size", [*SIZES, (16, 1600), (1600, 16)])
def test_frames_keep_the_shape_within_a_pixel_and_have_a_middle(size):
    frame = module.network_frame(np.zeros((*size, 3), np.uint8), 192)
    assert max(frame.shape[:2]) == 192
    assert all(side % 2 == 0 for side in frame.shape[:2])
    assert abs(min(frame.shape[:2]) - 192 * min(size) / max(size)) <= 1


@pytest.mark.parametrize("mirror", [(1, 1, False), (-1, 1, False), (1, -1, True), (-1, -1, True)])
def test_charts_of_flips_and_turns_are_put_upright(mirror):
    """Against the geometry: where a camera sees a ray, and where it is after the picture was turned."""
    x, y, turned = mirror
    chart = torch.tensor([-1.55, -0.83, -0.38, 0.66, -0.3, 0.03, -0.02, 0.0], dtype=torch.float64)
    size = (192, 256)
    upright = fr.FisheyeCamera(camera_from_chart(module._undo(x, y, turned) @ chart, size).numpy(), size)
    seen_size = size[::-1] if turned else size
    seen = fr.FisheyeCamera(camera_from_chart(chart, seen_size).numpy(), seen_size)
    rays = np.array([[0.3, 0.2, 1.0], [-0.5, 0.1, 1.0]])
    points = upright.project(rays)[0]
    if turned:
        points, rays = points[:, ::-1], rays[:, [1, 0, 2]]
    points = np.where([x < 0, y < 0], np.array(seen_size[::-1]) - 1 - points, points)
    np.testing.assert_allclose(seen.project(rays * [x, y, 1])[0], points, atol=1e-9)
    # A profile is read along x, so that only square pixels turn exactly; but long ones turn into tall ones.
    assert module._undo(x, y, turned)[7, 7] == (-1 if turned else 1)


def test_averaging_over_flips_makes_a_mirrored_photo_the_mirrored_camera(network, ramp):
    averaging = Rectifier(network, average=True)
    one = averaging.estimate(ramp, refine=False).camera.params
    two = averaging.estimate(np.ascontiguousarray(ramp[:, ::-1]), refine=False).camera.params
    mirrored = one * 1
    mirrored[2] = ramp.shape[1] - 1 - mirrored[2]
    np.testing.assert_allclose(two, mirrored, rtol=1e-4, atol=1e-4)


def test_answers_that_disagree_widen_the_covariance(told):
    """The same principal point is told of every flip and turn, so none can be true."""
    mean, covariance = module._ask(told.network, torch.zeros(1, 3, 192, 192), average=True)
    np.testing.assert_allclose(mean[5:7], 0, atol=1e-12)
    np.testing.assert_allclose(covariance[5, 5], 1e-4 + (0.03**2 + 0.02**2) / 2)
    np.testing.assert_allclose(covariance[0, 0], 1e-4)


# --- Photos of every kind -------------------------------------------------------------------------


def kinds(ramp):
    tensor = torch.from_numpy(ramp.copy()).permute(2, 0, 1)
    grey = ramp[..., 1]
    return {
        "path": (ROOM, (768, 1024, 3), np.uint8),
        "pil": (Image.fromarray(ramp), (384, 512, 3), np.uint8),
        "rgb": (ramp, (384, 512, 3), np.uint8),
        "grey": (grey, (384, 512), np.uint8),
        "rgba": (np.dstack([ramp, grey]), (384, 512, 4), np.uint8),
        "uint16": (ramp.astype(np.uint16) * 257, (384, 512, 3), np.uint16),
        "12 bit": (ramp.astype(np.uint16) * 16, (384, 512, 3), np.uint16),
        "float32": (ramp.astype(np.float32) / 255, (384, 512, 3), np.float32),
        "float16": (ramp.astype(np.float16) / 255, (384, 512, 3), np.float16),
        "float64 grey": (grey / 255, (384, 512), np.float64),
        "every other pixel": (ramp[::2, ::-2], (192, 256, 3), np.uint8),
        "tensor": (tensor, (3, 384, 512), torch.uint8),
        "batch": (tensor[None] / 255, (1, 3, 384, 512), torch.float32),
        "bfloat16": ((tensor[None] / 255).bfloat16(), (1, 3, 384, 512), torch.bfloat16),
        "grey tensor": (tensor[:1], (1, 384, 512), torch.uint8),
    }


@pytest.mark.parametrize("kind", kinds(np.zeros((384, 512, 3), np.uint8)))
def test_a_photo_comes_back_as_it_came(told, ramp, kind):
    photo, shape, dtype = kinds(ramp)[kind]
    result = told(photo, refine=False)
    assert (tuple(result.image.shape), result.image.dtype) == (shape, dtype)
    assert tuple(result.valid.shape) in (shape[:2], (*shape[:-3], 1, *shape[-2:]))
    assert result.distorted
    assert bool(result.valid.all())
    assert repr(result).startswith("PhotoRectification(")


def test_depth_and_channels_do_not_change_what_the_network_sees(told, ramp):
    told.estimate(ramp, refine=False)
    expected = told.network.seen
    for kind in ("pil", "rgba", "uint16", "12 bit", "float32", "float16", "tensor", "batch"):
        told.estimate(kinds(ramp)[kind][0], refine=False)
        assert (told.network.seen - expected).abs().max() < 0.01 + 0.03 * (kind == "12 bit"), kind


def test_the_picture_is_the_ops_at_full_resolution(told, ramp):
    result = told(ramp, fov_deg=90, size=(300, 400), refine=False)
    assert result.view.image_size == (300, 400)
    np.testing.assert_array_equal(result.image, fr.numpy.rectify(ramp, result.camera, result.view).image)
    sixteen = told(ramp.astype(np.uint16) * 257, fov_deg=90, size=(300, 400), refine=False)
    assert np.abs(sixteen.image / 257 - result.image).max() < 0.51 + 1


def test_exif_orientation_is_applied(told, ramp, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(ramp).rotate(90, expand=True).save(tmp_path / "turned.png", exif=exif)
    expected = told(ramp, refine=False)
    for photo in (tmp_path / "turned.png", Image.open(tmp_path / "turned.png")):
        np.testing.assert_array_equal(told(photo, refine=False).image, expected.image)


@pytest.mark.parametrize("size", [(16, 16), (17, 23), (64, 64), (16, 1600), (2000, 33)])
def test_small_and_narrow_photos_work(rectifier, size):
    photo = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    result = rectifier(photo)
    assert result.image.shape == (*size, 3)
    assert np.isfinite(result.camera.params).all()
    assert 0 < result.confidence <= 1


def test_a_hundred_megapixels(told):
    photo = np.zeros((8000, 12500), np.uint8)
    photo[::500] = 255
    result = told(photo, refine=False)
    assert result.image.shape == photo.shape
    np.testing.assert_allclose(result.camera.params[2], 6249.5 + 0.03 * 6250, atol=6250 / 512)


BAD = {
    "one pixel": (np.zeros((1, 1, 3), np.uint8), ValueError, r"at least 16x16 pixels, got 1x1"),
    "fifteen rows": (np.zeros((15, 40), np.uint8), ValueError, r"at least 16x16 pixels, got 40x15"),
    "empty": (np.zeros((0, 40), np.uint8), ValueError, r"at least 16x16 pixels, got 40x0"),
    "two channels": (np.zeros((32, 32, 2), np.uint8), ValueError, r"\(H, W, 4\), got \(32, 32, 2\)"),
    "four axes": (np.zeros((1, 32, 32, 3), np.uint8), ValueError, r"got \(1, 32, 32, 3\)"),
    "int64": (np.zeros((32, 32), np.int64), ValueError, r"uint8, uint16 or a floating dtype, got int64"),
    "NaN": (np.full((32, 32), np.nan, np.float32), ValueError, r"finite pixels, got NaN"),
    "infinite": (torch.full((3, 32, 32), torch.inf), ValueError, r"finite pixels, got NaN or infinite"),
    "a batch": (torch.zeros(2, 3, 32, 32), ValueError, r"\(1, C, H, W\).*got \(2, 3, 32, 32\)"),
    "channels last": (torch.zeros(32, 32, 3), ValueError, r"\(C, H, W\).*got \(32, 32, 3\)"),
    "flat": (torch.zeros(32), ValueError, r"got \(32,\)"),
    "a number": (3, TypeError, r"a path, PIL image, array or tensor, got int"),
    "no such file": ("missing.jpg", OSError, r"missing\.jpg"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_photo_is_refused(told, case):
    photo, kind, message = BAD[case]
    with pytest.raises(kind, match=message) as caught:
        told(photo)
    assert "\n" not in str(caught.value)


def test_options_that_contradict_are_refused(told, ramp):
    view = fr.PinholeCamera.from_fov(90, (30, 40))
    with pytest.raises(ValueError, match="view alone"):
        told(ramp, view=view, fov_deg=90)
    with pytest.raises(ValueError, match="one of mode, fov_deg, focal and balance"):
        told(ramp, focal=90, fov_deg=90, refine=False)


@pytest.mark.parametrize("rotation", [None, fr.view_rotation(10, 5, 20)], ids=["straight", "turned"])
def test_a_mode_of_view_for_and_a_rotation_are_taken(told, rotation):
    photo = np.random.default_rng(3).integers(0, 256, (60, 80), np.uint8)
    result = told(photo, view="keep_all", size=(30, 40), rotation=rotation, refine=False)
    view = fr.view_for(result.camera, (30, 40), "keep_all")
    np.testing.assert_array_equal(result.view.params, view.params)
    expected = fr.numpy.rectify(photo, result.camera, view, rotation=rotation).image
    np.testing.assert_array_equal(result.image, expected)


@pytest.fixture(scope="module")
def drawn():
    """A room seen through a lens of 150 degrees, and a network that knows the lens."""
    camera = fr.FisheyeCamera.from_projection("equisolid", 150, (192, 256))
    network = Told.compact().eval()
    network.chart = torch.from_numpy(chart_of(camera))
    scene = scenes.room(seed=1)
    return scene, scenes.render_camera(scene, camera.unproject, camera.image_size, supersample=1).image, network


@pytest.mark.parametrize(
    ("projection", "fov_deg"), [*((projection, None) for projection in PROJECTIONS), ("cylindrical", 120)]
)
def test_every_projection_shows_the_scene_as_such_a_camera_would(drawn, projection, fov_deg):
    """Drawn through the view itself, without a fisheye in between, which the op knows nothing of."""
    scene, photo, network = drawn
    result = Rectifier(network)(photo, projection=projection, fov_deg=fov_deg, size=(90, 120), refine=False)
    assert result.distorted
    assert (result.view.model, result.view.image_size) == (projection, (90, 120))
    expected_view = fr.view_for(result.camera, (90, 120), projection=projection, fov_deg=fov_deg)
    np.testing.assert_array_equal(result.view.params, expected_view.params)

    rays, exists = result.view.unproject(np.stack(np.meshgrid(np.arange(120), np.arange(90)), -1))
    points, seen = result.camera.project(rays)
    inside = (points > -0.5) & (points < np.array([255.5, 191.5]))
    np.testing.assert_array_equal(result.valid, exists & seen & inside.all(-1))
    assert 0.5 < result.valid.mean() <= 1
    near = ((points > -1) & (points < np.array([256, 192]))).all(-1)  # a pixel beyond, zero padding has faded out
    assert (result.image[~near] == 0).all()
    if fov_deg is None:  # as wide as the lens sees between its edges, or less
        assert result.valid[45].all()

    sharp = scenes.render_camera(scene, result.view.unproject, (90, 120), supersample=1).image
    error = np.square(result.image.astype(float) - sharp)[result.valid].mean()
    assert error < 500  # what another projection shows of the scene is off by 2400 and more


# --- What is known of the result ------------------------------------------------------------------


def test_a_photo_without_distortion_is_left_alone(rectifier, straight):
    result = rectifier(straight, fov_deg=60, size=(20, 30))
    assert not result.distorted
    assert not result.refined
    np.testing.assert_array_equal(result.image, straight)
    assert result.valid.all()
    assert result.straightness_after == result.straightness_before < 0.3


def test_the_camera_of_an_undistorted_photo_changes_nothing(rectifier, straight):
    result = rectifier(straight)
    points = np.array([[0.0, 0.0], [255.0, 100.0], [127.5, 95.5], [30.0, 191.0]])
    seen, valid = result.camera.project(result.view.unproject(points)[0])
    assert valid.all()
    np.testing.assert_allclose(seen, points, atol=0.05)


def test_refinement_straightens_what_the_network_did_not(rectifier, room):
    rough, fine = rectifier(room, refine=False), rectifier(room)
    assert (rough.refined, fine.refined) == (False, True)
    assert rough.straightness_before == fine.straightness_before > 0.5
    assert fine.straightness_after < fine.straightness_before / 3
    assert fine.confidence > rough.confidence


def test_confidence_falls_with_the_error_it_expects():
    chart = Told.chart.numpy()
    errors = [module._expected_error_px(chart, sigma**2 * np.eye(SIZE)) for sigma in (0.0, 0.001, 0.01, 0.1)]
    assert errors[0] == 0
    assert (np.diff(errors) > 0).all()


def test_an_uncertain_principal_point_hardly_counts():
    """1.28 px either way shift the picture by 1.8 px RMS and bend it by a tenth of that."""
    only = np.zeros((SIZE, SIZE))
    only[5, 5] = only[6, 6] = 0.01**2
    assert 0 < module._expected_error_px(Told.chart.numpy(), only) < 0.3 * 1.28 * 2**0.5


def test_the_expected_error_is_that_of_random_lenses():
    chart, covariance = Told.chart.numpy(), np.diag([6e-3, 6e-3, 3e-3, 9e-3, 0.03, 6e-3, 6e-3, 1e-3]) ** 2
    size = (256, 256)
    charts = np.random.default_rng(0).multivariate_normal(chart, covariance, 600)
    cameras = fr.FisheyeCamera(camera_from_chart(torch.from_numpy(np.stack([chart, *charts])), size), size)
    view = fr.PinholeCamera.edge_matched(cameras, size)
    grid = torch.cartesian_prod(*[torch.linspace(0, 255, 9, dtype=torch.float64)] * 2).expand(601, -1, -1)
    mean, *others = cameras.project(view.unproject(grid)[0])[0].numpy()
    # x' = s x + a, y' = s y + b
    one, zero = np.ones(len(mean)), np.zeros(len(mean))
    columns = np.stack([np.concatenate(c) for c in (mean.T, (one, zero), (zero, one))], -1)
    squares = [np.linalg.lstsq(columns, np.concatenate(other.T))[1][0] / len(mean) for other in others]
    np.testing.assert_allclose(module._expected_error_px(chart, covariance), np.mean(squares) ** 0.5, rtol=0.15)


def test_a_photo_without_lines_still_has_an_answer(told):
    estimate = told.estimate(np.full((64, 64, 3), 90, np.uint8))
    assert estimate.distorted
    assert not estimate.refined
    assert np.isnan([estimate.straightness_before, estimate.straightness_after]).all()


# --- Weights --------------------------------------------------------------------------------------


def test_weights_are_loaded_from_a_file(weights, rectifier, ramp):
    loaded = Rectifier.from_pretrained(weights)
    one, two = (each.estimate(ramp, refine=False).camera.params for each in (loaded, rectifier))
    np.testing.assert_allclose(one, two, rtol=0.02)


def test_missing_weights_are_one_line(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"expected a weights file, got '.*none\.safetensors' that does not"):
        Rectifier.from_pretrained(tmp_path / "none.safetensors")
    monkeypatch.setattr(module, "files", lambda package: tmp_path)
    with pytest.raises(FileNotFoundError, match="this installation came without"):
        Rectifier.from_pretrained()


def test_a_network_of_the_paper_is_given_its_side(ramp):
    network = Told.compact().eval()
    network.fixed_size, network.longer_side = True, 256
    Rectifier(network).estimate(ramp, refine=False)
    assert network.seen.shape == (1, 3, 192, 256)


# --- The command line -----------------------------------------------------------------------------


def run(*arguments, cwd):
    """In this process, as importing torch takes seconds; tests/test_cli.py has the process of its own."""
    with contextlib.chdir(cwd):
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


@pytest.fixture
def pictures(tmp_path, room, straight):
    write_picture(tmp_path / "room.png", Picture(room))
    write_picture(tmp_path / "straight.png", Picture(straight))
    (tmp_path / "broken.png").write_bytes((tmp_path / "room.png").read_bytes()[:1000])
    return tmp_path


def test_blind_rectify_end_to_end(pictures, weights, rectifier):
    result = run(
        "rectify", "room.png", "-o", "out.png", "--weights", weights, "--save-camera", "lens.json", cwd=pictures
    )
    assert (result.exit_code, result.stderr) == (0, "")
    assert re.match(r"out\.png: 512x384, 100\.0% valid, fx .*confidence 0\.\d\d, lines bend by", result.stdout)
    blind = read_picture(pictures / "out.png").pixels
    assert run("rectify", "room.png", "--camera", "lens.json", "-o", "again.png", cwd=pictures).exit_code == 0
    np.testing.assert_array_equal(read_picture(pictures / "again.png").pixels, blind)


def test_estimate_prints_an_object_a_line_and_goes_on_after_a_broken_picture(pictures, weights):
    names = ["room.png", "broken.png", "straight.png"]
    result = run("estimate", *names, "--json", "--weights", weights, cwd=pictures)
    assert result.exit_code == 1
    broken, summary = result.stderr.splitlines()
    assert "broken.png" in broken
    assert summary == "fisheyerec estimate: 1 of 3 pictures failed"
    first, second = map(json.loads, result.stdout.splitlines())
    keys = ["image", "camera", "confidence", "distorted", "straightness_before", "straightness_after"]
    assert list(first) == list(second) == keys
    assert list(first["camera"]) == ["model", "width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]
    assert (first["image"], first["camera"]["width"], first["camera"]["height"]) == ("room.png", 512, 384)
    assert first["camera"]["model"] == "kannala_brandt"
    assert 0 <= first["confidence"] <= 1
    assert (first["distorted"], second["distorted"]) == (True, False)
    assert first["straightness_after"] < first["straightness_before"]


def test_an_undistorted_picture_goes_through_the_command_line_unchanged(pictures, weights):
    result = run("rectify", "straight.png", "-o", "out.png", "--weights", weights, cwd=pictures)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "as it was, no fisheye distortion found" in result.stdout
    before, after = (read_picture(pictures / name).pixels for name in ("straight.png", "out.png"))
    np.testing.assert_array_equal(before, after)


def test_json_has_null_where_there_are_no_lines(told):
    estimate = told.estimate(np.full((64, 64, 3), 90, np.uint8))
    line = json.loads(_json_line(Path("grey.png"), estimate))
    assert (line["straightness_before"], line["straightness_after"]) == (None, None)


COMMAND_BAD = {
    "broken weights": (["estimate", "room.png", "--weights", "room.png"], r"expected a safetensors file"),
    "no weights": (["rectify", "room.png", "-o", "out.png", "--weights", "none"], r"expected a weights file"),
    "other classes": (["estimate", "room.png", "--weights", "classes.safetensors"], r"another number of classes\?"),
    "no picture": (["estimate", "none.png", "--weights", "{weights}"], r"none\.png: No such file"),
    "broken picture": (["rectify", "broken.png", "-o", "out.png", "--weights", "{weights}"], r"complete picture"),
    "camera twice": (
        ["rectify", "room.png", "-o", "out.png", "--camera", "lens.json", "--weights", "{weights}"],
        r"expected --camera, or",
    ),
    "camera of several": (["estimate", "room.png", "straight.png", "-o", "a.json"], r"with one picture, got 2"),
    "camera suffix": (["estimate", "room.png", "-o", "a.txt", "--weights", "{weights}"], r"suffix \.json or \.yaml"),
    "two views": (
        ["rectify", "room.png", "-o", "out.png", "--focal", "3", "--fov-deg", "3"],
        r"one of --view, --fov-deg",
    ),
}


@pytest.fixture(scope="module")
def other_classes(tmp_path_factory, network):
    """Weights whose file says another number of classes than they are for."""
    path = tmp_path_factory.mktemp("classes") / "classes.safetensors"
    design, network.design = network.design, network.design | {"num_classes": 5}
    save_network(network, path, {})
    network.design = design
    return path


@pytest.mark.parametrize("case", COMMAND_BAD)
def test_bad_input_is_one_line_and_leaves_nothing(case, pictures, weights, other_classes):
    arguments, message = COMMAND_BAD[case]
    (pictures / "classes.safetensors").write_bytes(other_classes.read_bytes())
    before = {p: p.read_bytes() for p in pictures.iterdir()}
    result = run(*(a.format(weights=weights) for a in arguments), cwd=pictures)
    assert result.exit_code == 2, result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert re.search(message, result.stderr), result.stderr
    assert {p: p.read_bytes() for p in pictures.iterdir()} == before
