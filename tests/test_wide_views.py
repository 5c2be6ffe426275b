"""The views beside the pinhole: identities of each projection, the kernels against reference.py, gradients."""

import math

import numpy as np
import pytest
import torch

import fisheyerec as fr
from fisheyerec import reference
from fisheyerec.camera_files import WRITERS

SIZE = (60, 100)
VIEWS = {
    "cylindrical": fr.CylindricalView.from_fov(200, SIZE),
    "cylindrical_full_turn": fr.CylindricalView.from_fov(360, SIZE),
    "equirectangular": fr.EquirectangularView.from_fov(220, SIZE),
    "equirectangular_full_turn": fr.EquirectangularView.from_fov(360, (50, 100)),
    "stereographic": fr.StereographicView.from_fov(230, SIZE),
    "little_planet": fr.StereographicView.from_fov(340, SIZE),
    "panini": fr.PaniniView.from_fov(150, SIZE),
    "panini_half": fr.PaniniView.from_fov(130, SIZE, distance=0.5),
}
WIDE_LENS = [24.0, 24, 49.5, 29.5, 0.03, -0.01, 0.002, 0]  # equal angles, nearly: 4 x 60 degrees across
ROTATION = fr.view_rotation(20, 10, -5)


@pytest.fixture(params=VIEWS)
def view(request):
    return VIEWS[request.param]


@pytest.fixture
def camera():
    return fr.FisheyeCamera(WIDE_LENS, SIZE)


def grid(size, columns=21, rows=13):
    height, width = size
    return np.stack(np.meshgrid(np.linspace(-0.5, width - 0.5, columns), np.linspace(-0.5, height - 0.5, rows)), -1)


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))


def leaves(camera, view, picture, size=SIZE):
    """Image, lens, view and rotation as float64 leaves."""
    tensors = [picture(1, 2, *size), torch.tensor([camera.params.tolist()]), torch.from_numpy(view.params)[None]]
    return [t.to(torch.float64).requires_grad_() for t in [*tensors, torch.from_numpy(ROTATION)[None]]]


# --- Points and rays ------------------------------------------------------------------------------


def test_points_come_back_from_their_rays(view, tolerance):
    rays, seen = view.unproject(grid(view.image_size))
    points, valid = view.project(2 * rays)
    inner = seen & (abs(rays[..., 0]) + abs(rays[..., 2]) > 1e-6) & ((rays[..., 2] > -0.999) | (rays[..., 0] != 0))
    assert inner.mean() > 0.4
    assert valid[inner].all()
    off = abs(points - grid(view.image_size))
    off[..., 0] = np.minimum(off[..., 0], abs(2 * math.pi * view.params[0] - off[..., 0]))  # the seam is both edges
    assert off[inner].max() < 100 * tolerance.round_trip


def test_arrays_and_tensors_agree(view, tolerance):
    points = grid(view.image_size)
    tensors = view.to(torch.float64)
    for function, vectors in (("unproject", points), ("project", view.unproject(points)[0])):
        expected, valid = getattr(view, function)(vectors)
        out, mask = getattr(tensors, function)(torch.from_numpy(vectors))
        np.testing.assert_array_equal(mask.numpy(), valid)
        np.testing.assert_allclose(out.numpy(), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("view", "half_width_deg"),
    [
        (fr.CylindricalView.from_fov(310, SIZE), 155),
        (fr.EquirectangularView.from_fov(310, SIZE), 155),
        (fr.StereographicView.from_fov(310, SIZE), 155),
        (fr.PaniniView.from_fov(170, SIZE), 85),
        (fr.PaniniView.from_fov(170, SIZE, distance=0.2), 85),
    ],
    ids=lambda value: getattr(value, "model", None),
)
def test_a_view_is_as_wide_as_asked_for(view, half_width_deg):
    rays, _ = view.unproject([[-0.5, 29.5], [99.5, 29.5]])
    axis = np.array([0.0, 0, 1])
    np.testing.assert_allclose(np.degrees([angle(r, axis) for r in rays]), half_width_deg, rtol=1e-12)
    assert rays[0][0] < 0 < rays[1][0]


def test_a_panorama_shows_every_direction():
    view = VIEWS["equirectangular_full_turn"]
    rays = np.random.default_rng(0).standard_normal((1000, 3))
    points, valid = view.project(rays)
    assert valid.all()
    assert ((points >= -0.5) & (points <= [99.5, 49.5])).all()


def test_panini_without_distance_is_a_perspective(tolerance):
    panini, pinhole = fr.PaniniView.from_fov(120, SIZE, distance=0), fr.PinholeCamera.from_fov(120, SIZE)
    rays, valid = panini.unproject(grid(SIZE))
    assert valid.all()
    expected, _ = pinhole.unproject(grid(SIZE))
    np.testing.assert_allclose(rays / rays[..., 2:], expected, rtol=0, atol=1e-12)


def test_stereographic_is_twice_the_tangent_of_the_half_angle():
    view = VIEWS["little_planet"]
    theta = np.linspace(0.1, 3, 20)
    points, _ = view.project(np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1))
    np.testing.assert_allclose(points[:, 0] - view.params[2], 2 * view.params[0] * np.tan(theta / 2), rtol=1e-12)


def test_scaling_and_cropping_keep_the_rays(view):
    points = grid(view.image_size)
    rays, _ = view.unproject(points)
    np.testing.assert_allclose(view.crop(3, 4, (20, 20)).unproject(points - [3, 4])[0], rays, atol=1e-12)
    scaled, _ = view.resize((2 * view.image_size[0], 2 * view.image_size[1])).unproject((points + 0.5) * 2 - 0.5)
    np.testing.assert_allclose(scaled, rays, atol=1e-12)


# --- Files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".json", ".yaml"])
def test_a_view_comes_back_from_its_file(view, tmp_path, suffix):
    path = tmp_path / f"view{suffix}"
    view.save(path)
    for again in (fr.load_view(path), type(view).load(path)):
        assert (type(again), again.image_size) == (type(view), view.image_size)
        np.testing.assert_array_equal(again.params, view.params)
    with pytest.raises(ValueError, match=rf"FisheyeCamera\.load\(\): expected a kannala_brandt .*got {view.model}"):
        fr.FisheyeCamera.load(path)


def test_a_pinhole_is_a_view_and_a_lens_is_none(camera, tmp_path):
    pinhole = fr.PinholeCamera.from_fov(90, SIZE)
    pinhole.save(tmp_path / "pinhole.yml", format="opencv")
    assert isinstance(fr.load_view(tmp_path / "pinhole.yml"), fr.PinholeCamera)
    camera.save(tmp_path / "lens.json")
    with pytest.raises(ValueError, match=r"load_view\(\): expected a view, pinhole, .*lens\.json', got kannala_brandt"):
        fr.load_view(tmp_path / "lens.json")
    with pytest.raises(OSError, match="No such file"):
        fr.load_view(tmp_path / "none.json")


@pytest.mark.parametrize("format", ["opencv", "kalibr", "colmap", "gyroflow", "ros"])
def test_other_formats_hold_no_such_view(view, tmp_path, format):
    path = tmp_path / f"view{WRITERS[format].suffixes[0]}"
    with pytest.raises(ValueError, match=rf"model: expected one of kannala_brandt, pinhole, got {view.model}"):
        view.save(path, format=format)
    assert not path.exists()


def test_a_distance_that_no_view_has_is_told(tmp_path):
    with pytest.raises(ValueError, match=r"d: expected at least 0, got -0\.5"):
        fr.PaniniView([30.0, 30, 4, 4, -0.5], SIZE).save(tmp_path / "view.json")


# --- The op ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True], ids=["straight", "turned"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("function", ["rectify", "distort"])
def test_the_op_is_the_reference(function, camera, view, dtype, turned, picture, tolerance):
    source, target = (camera, view) if function == "rectify" else (view, camera)
    image = picture(1, 2, *source.image_size).to(dtype)
    rotation = torch.from_numpy(ROTATION)[None] if turned else None
    out, valid = fr.resample(image, source, target, source_from_target=rotation)
    expected, mask = reference.resample(
        image.double(),
        torch.from_numpy(source.params)[None],
        torch.from_numpy(target.params)[None],
        rotation,
        source.model,
        target.model,
        *target.image_size,
        "bilinear",
        "zeros",
    )
    exact = dtype == torch.float64
    assert (valid != mask).double().mean() <= (0 if exact else 0.002)
    both = valid & mask
    assert both.double().mean() > 0.01
    off = abs(out.double() - expected) * both
    assert off.max() < (tolerance.reference if exact else 5e-4)
    array = fr.numpy.resample(
        image[0].permute(1, 2, 0).numpy(), source, target, source_from_target=ROTATION if turned else None
    )
    np.testing.assert_allclose(array.image, out[0].permute(1, 2, 0).numpy(), atol=tolerance.layout)
    np.testing.assert_array_equal(array.valid, valid[0, 0].numpy())


@pytest.mark.parametrize("turned", [False, True], ids=["straight", "turned"])
@pytest.mark.parametrize("width", [64, 700, 1900])
def test_float_is_as_exact_as_pixel_by_pixel(view, width, turned):
    """Where it interpolates the map, against every coordinate in float64: a picture of x and of y says where."""
    size = (width // 4, width)
    view = view.resize(size)
    camera = fr.FisheyeCamera(WIDE_LENS, SIZE).resize(size)
    ramp = np.stack(np.meshgrid(np.arange(size[1]), np.arange(size[0])), -1).astype(np.float32)
    options = {"rotation": ROTATION if turned else None, "padding": "border"}
    rough = fr.numpy.rectify(ramp, camera, view, **options)
    exact = fr.numpy.rectify(ramp.astype(np.float64), camera, view, **options)
    assert (rough.valid != exact.valid).mean() < 0.002
    assert abs(rough.image - exact.image)[rough.valid & exact.valid].max() < 1e-4 + 1e-6 * width


def test_a_straight_horizon_stays_a_row(camera):
    """Rays of the middle row of every unturned view lie in the plane Y = 0."""
    for view in VIEWS.values():
        height, width = view.image_size
        rays, seen = view.unproject(np.stack([np.arange(width), np.full(width, (height - 1) / 2)], -1))
        assert abs(rays[seen][:, 1]).max() < 1e-12


def test_a_full_turn_of_pan_is_a_shift_of_the_panorama(picture, tolerance):
    """Pan by ten columns' worth, and the same pixels stand ten columns further."""
    source = VIEWS["equirectangular_full_turn"]
    image = picture(1, 1, *source.image_size)
    rotation = torch.from_numpy(fr.view_rotation(36))
    out, valid = fr.resample(image, source, source, source_from_target=rotation, padding="border")
    inner = torch.arange(100)[:89]  # beyond lies the seam, between the last column and the first
    torch.testing.assert_close(out[..., inner], image[..., inner + 10], rtol=0, atol=1e-10)
    assert valid[..., inner].all()


def test_nan_and_nonsense_are_values(camera, view):
    image = torch.ones(1, 1, *SIZE)
    for broken in ([math.nan] * 4, [math.inf, 1, 1, 1], [0.0, 0, 0, 0]):
        params = [*broken, 1.0][: len(view.params)]
        out, valid = fr.resample(image, camera, type(view)(params, (9, 9)))
        assert not valid.any()
        assert (out == 0).all()
    if view.model == "panini":
        out, valid = fr.resample(image, camera, type(view)([30.0, 30, 4, 4, -0.5], (9, 9)))
        assert not valid.any()


# --- Gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cylindrical", "equirectangular", "stereographic", "panini", "panini_half"])
@pytest.mark.parametrize("function", ["rectify", "distort"])
def test_gradients_match_finite_differences(function, name, picture):
    """To the image, the lens, the view (Panini's distance too) and the rotation."""
    size = (7, 9)
    camera, view = fr.FisheyeCamera(WIDE_LENS, SIZE).resize(size), VIEWS[name].resize(size)
    tensors = leaves(camera, view, picture, size)
    off = torch.tensor(1.0037, dtype=torch.float64)  # bilinear interpolation has a kink at every pixel

    def run(image, params, view_params, rotation):
        lens, window = fr.FisheyeCamera(params * off, size), type(view)(view_params * off, size)
        if function == "rectify":
            return fr.rectify(image, lens, window, rotation=rotation).image
        return fr.distort(image, window, lens, rotation=rotation).image

    assert torch.autograd.gradcheck(run, tensors, eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("function", ["rectify", "distort"])
def test_gradients_are_the_references(function, camera, view, picture):
    tensors = leaves(camera, view, picture, view.image_size if function == "distort" else SIZE)
    image, params, view_params, rotation = tensors
    models, cameras, size = [camera.model, view.model], [params, view_params], view.image_size
    R = rotation
    if function == "distort":
        models, cameras, size, R = models[::-1], cameras[::-1], SIZE, rotation.transpose(-1, -2)
    weights = torch.randn(1, 2, *size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    both = []
    for op in (torch.ops.fisheyerec.resample, reference.resample):
        out, _ = op(image, *cameras, R, *models, *size, "bilinear", "zeros")
        both.append(torch.autograd.grad((out * weights).sum(), tensors))
    for ours, theirs in zip(*both, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-7 * float(theirs.abs().max()))


# --- Bad input ------------------------------------------------------------------------------------

BAD = {
    "cylinder": (lambda: fr.CylindricalView.from_fov(361, SIZE), r"CylindricalView.*fov_deg in \(0, 360\], got 361"),
    "panorama": (lambda: fr.EquirectangularView.from_fov(0, SIZE), r"fov_deg in \(0, 360\], got 0"),
    "planet": (lambda: fr.StereographicView.from_fov(360, SIZE), r"fov_deg in \(0, 360\), got 360"),
    "panini": (lambda: fr.PaniniView.from_fov(180, SIZE, distance=0), r"fov_deg in \(0, 180\), got 180"),
    "nan": (lambda: fr.PaniniView.from_fov(math.nan, SIZE), r"got nan"),
    "distance": (lambda: fr.PaniniView.from_fov(100, SIZE, distance=1.5), r"distance in \[0, 1\], got 1.5"),
    "four_of_five": (lambda: fr.PaniniView([1.0, 1, 1, 1], SIZE), r"shape \(5,\) or \(B, 5\) \(fx, fy, cx, cy, d\)"),
    "size": (lambda: fr.CylindricalView.from_fov(90, (0, 3)), r"at least \(1, 1\)"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_views_are_told(case):
    call, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        call()
