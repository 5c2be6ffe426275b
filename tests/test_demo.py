"""The page of `fisheyerec demo`: what it computes, what the command line says, and all of it in a real browser."""

from __future__ import annotations

import base64
import getpass
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fisheyerec as fr
from fisheyerec.demo.controls import (
    BALANCE,
    DEGREES,
    EXAMPLE_LENS,
    FRAMINGS,
    WIDE_FRAMINGS,
    decimals,
    ideal_camera,
    moved,
    reaches,
    view_options,
)
from fisheyerec.demo.downloads import write_camera, write_rectified
from fisheyerec.demo.figures import figures, trouble
from fisheyerec.demo.marks import draw_lines, hatch
from fisheyerec.demo.photo import PREVIEW_SIDE, Photo, preview_of
from fisheyerec.demo.preview import make_preview
from fisheyerec.file_rectifiers import ViewOptions
from fisheyerec.pictures import Picture, read_picture, write_picture
from fisheyerec.sightlines import Pieces
from fisheyerec.straightness import bends_of
from fisheyerec.views import PROJECTIONS

ROOT = Path(__file__).resolve().parents[1]
ROOM, ROOM_CAMERA = ROOT / "examples" / "room.jpg", ROOT / "examples" / "room.json"
HOME = Path(fr.__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def room():
    return Photo.open(ROOM)


@pytest.fixture(scope="module")
def camera():
    return fr.FisheyeCamera.load(ROOM_CAMERA)


# --- Photos and previews --------------------------------------------------------------------------


def test_the_preview_is_the_whole_result_made_small(room, camera):
    options = ViewOptions(fov_deg=90, pan_deg=20, tilt_deg=-10, roll_deg=5)
    preview = make_preview(room, camera, options)
    assert preview.after.shape == room.preview.shape == (720, 960, 3)
    whole = fr.numpy.rectify(
        room.picture.pixels, camera, fr.PinholeCamera.from_fov(90, room.size), rotation=fr.view_rotation(20, -10, 5)
    )
    assert preview.valid_share == pytest.approx(whole.valid.mean(), abs=0.002)
    difference = preview.after.astype(float) - preview_of(whole.image)
    assert np.abs(difference).mean() < 2
    assert abs(difference.mean()) < 0.1


@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA", "I;16"])
def test_previews_are_colour_of_eight_bits(tmp_path, mode):
    levels = np.linspace(0, 1, 2000)[None].repeat(40, 0)
    if mode == "I;16":
        image = Image.fromarray(np.rint(levels * 65535).astype(np.uint16))
    else:
        image = Image.fromarray(np.rint(levels * 255).astype(np.uint8)).convert(mode)
    image.save(tmp_path / "grey.png")
    photo = Photo.open(tmp_path / "grey.png")
    assert (photo.preview.dtype, photo.preview.shape) == (np.uint8, (19, PREVIEW_SIDE, 3))
    np.testing.assert_allclose(photo.preview[5, :, 1], np.linspace(0, 255, PREVIEW_SIDE), atol=1.5)
    assert photo.size == (40, 2000)


def test_a_lens_file_of_another_scale_is_scaled_and_one_of_another_shape_refused(room, camera, tmp_path):
    camera.resize((384, 512)).save(tmp_path / "half.json")
    np.testing.assert_allclose(room.load_camera(tmp_path / "half.json").params, camera.params, rtol=1e-12, atol=1e-9)
    camera.crop(0, 0, (768, 900)).save(tmp_path / "narrow.json")
    with pytest.raises(ValueError, match=r"room\.jpg in the shape of its lens file, 900x768, got 1024x768"):
        room.load_camera(tmp_path / "narrow.json")


def test_a_lens_that_folds_is_said_and_shows_nothing_beyond(room):
    folding = fr.FisheyeCamera([420, 420, 511.5, 383.5, -0.3, -0.01, 0, 0], room.size)
    preview = make_preview(room, folding, ViewOptions(fov_deg=140))
    assert preview.fold_deg == pytest.approx(np.degrees(folding.theta_max))
    assert preview.valid_share < 0.9
    assert not preview.after[:, :20].any()
    assert f"fold back {preview.fold_deg:.0f}°" in figures(preview, room.size)


def test_the_figures_are_those_of_the_straightness_of_the_photo(room, camera):
    preview = make_preview(room, camera, ViewOptions())
    assert preview.bend_before > 5 * preview.bend_after
    assert preview.bend_after < 0.15
    assert preview.fold_deg is None
    told = figures(preview, room.size)
    assert f"{preview.bend_before:.2f} → {preview.bend_after:.2f} %" in told
    assert "1024 × 768 px" in told


def test_a_photo_without_lines_is_said_to_have_none(camera, tmp_path):
    write_picture(tmp_path / "plain.png", Picture(np.full((768, 1024, 3), 90, np.uint8)))
    photo = Photo.open(tmp_path / "plain.png")
    preview = make_preview(photo, camera, ViewOptions(), lines=True)
    assert "no lines" in figures(preview, photo.size)
    np.testing.assert_array_equal(preview.before, photo.preview)


def test_a_photo_that_ends_in_a_circle_is_framed_by_it(room, camera, tmp_path):
    y, x = np.mgrid[:768, :1024]
    pixels = np.where(np.hypot(x - 511.5, y - 383.5)[..., None] > 370, 0, room.picture.pixels).astype(np.uint8)
    write_picture(tmp_path / "circular.png", Picture(pixels))
    photo = Photo.open(tmp_path / "circular.png")
    assert photo.circle == pytest.approx((479.5, 359.5, 370 * 960 / 1024), abs=6)
    middle, radius = np.array(photo.working_size[::-1]) / 2, 370 / 1024 * max(photo.working_size)
    assert len(photo.pieces) > 0
    assert np.hypot(*(photo.pieces.points - middle).T).max() < 0.99 * radius
    valid_only = make_preview(photo, camera, ViewOptions("valid_only"))
    assert valid_only.valid_share == 1
    assert valid_only.after.max(-1).min() > 0
    file = write_rectified(photo, camera, ViewOptions("valid_only"), tmp_path, suffix=".png")
    assert read_picture(file).pixels.max(-1).min() > 0


def test_what_goes_wrong_is_told_as_text():
    assert "&lt;b&gt;" in trouble("<b>")


# --- Marks ----------------------------------------------------------------------------------------


def test_the_bend_of_a_parabola_is_that_of_its_equation():
    x = np.linspace(-100, 100, 401)
    sagitta = 4.0
    arc = np.stack([x + 200, 50 + sagitta * (x / 100) ** 2], -1)
    line = np.stack([x + 200, 150 + 0.3 * x], -1)
    pieces = Pieces(np.concatenate([arc, line]), np.array([0, 401, 802]))
    bends, used = bends_of(pieces, None, (400, 400))
    # x^2 less its mean over [-1, 1] has an RMS of sqrt(4 / 45).
    np.testing.assert_allclose(bends, [100 * sagitta * np.sqrt(4 / 45) / 200, 0], rtol=0.01, atol=1e-6)
    assert used.all()


def test_lines_are_red_where_bent_and_green_where_straight(room, camera):
    plain, marked = (make_preview(room, camera, ViewOptions(), lines=lines) for lines in (False, True))

    def colours(marked, plain):
        """How many of the drawn pixels are red and green; outlines are neither."""
        drawn = marked[(marked != plain).any(-1)].astype(int)
        red, green = drawn[:, 0] - drawn[:, 1], drawn[:, 1] - drawn[:, 0]
        return (red > 120).sum(), (green > 120).sum()

    red, green = colours(marked.before, plain.before)
    assert red > 5 * green
    red, green = colours(marked.after, plain.after)
    assert green > 5 * red


def test_a_line_is_drawn_where_it_is_known_and_nowhere_else():
    picture = np.full((100, 200, 3), 128, np.uint8)
    points = np.array([[10.0, 50], [80, 50], [np.nan, np.nan], [120, 50], [190, 50], [100, 10], [100, 90]])
    drawn = draw_lines(picture, points, np.array([0, 5, 7]), np.array([0.0, np.nan]))
    changed = (drawn != picture).any(-1)
    assert changed[50, 10:81].all()
    assert changed[50, 120:191].all()
    assert not changed[:, 90:110].any()
    assert not changed[:40].any()
    assert (picture == 128).all()


def test_only_what_is_not_shown_is_hatched(room, camera):
    plain, hatched = (make_preview(room, camera, ViewOptions("keep_all"), mask=mask) for mask in (False, True))
    changed = (plain.after != hatched.after).any(-1)
    assert changed.mean() == pytest.approx(1 - plain.valid_share, abs=1e-9)
    assert 0 < changed.mean() < 0.5
    where = np.zeros((4, 4), bool)
    np.testing.assert_array_equal(hatch(plain.after[:4, :4], where), plain.after[:4, :4])


# --- Controls -------------------------------------------------------------------------------------


def test_sliders_reach_every_lens_and_stand_for_all_its_decimals(lens):
    sliders = reaches(lens)
    assert list(sliders) == list(lens.parameter_names)
    for reach in sliders.values():
        assert reach.minimum <= reach.value <= reach.maximum
    values = [reach.value for reach in sliders.values()]
    np.testing.assert_array_equal(moved(lens, values).params, lens.params)
    assert all(round(value, decimals(name)) == value for name, value in zip(sliders, values, strict=True))
    values[4] += 0.01
    changed = moved(lens, values).params
    assert changed[4] == values[4]
    np.testing.assert_array_equal(np.delete(changed, 4), np.delete(lens.params, 4))


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_every_framing_of_every_projection_is_a_view(camera, projection):
    for _, framing in FRAMINGS if projection == "pinhole" else WIDE_FRAMINGS:
        options = view_options(projection, framing, 120, 0.3, framing, 240, 10, 0, 0)
        view = options.view_of(camera)
        assert (view.image_size, view.model) == (camera.image_size, projection)
        np.testing.assert_array_equal(options.rotation(), fr.view_rotation(10))
        assert options.fov_deg == ((120 if projection == "pinhole" else 240) if framing == DEGREES else None)
        assert options.balance == (0.3 if framing == BALANCE else None)


def test_the_example_is_drawn_through_the_lens_that_the_page_begins_with():
    photo = Photo.open(HOME / "fisheyerec" / "demo" / "room.jpg")
    preview = make_preview(photo, ideal_camera(*EXAMPLE_LENS, photo.size), ViewOptions())
    assert preview.bend_before > 0.5
    assert preview.bend_after < 0.1


def test_an_orthographic_lens_sees_half_of_everything_at_most():
    found, widest = (ideal_camera("orthographic", fov, (100, 100)) for fov in (220, 180))
    np.testing.assert_array_equal(found.params, widest.params)


# --- Downloads ------------------------------------------------------------------------------------


def test_the_picture_to_download_is_the_whole_one_with_what_its_file_said(camera, tmp_path):
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    with Image.open(ROOM) as image:
        image.save(tmp_path / "made.jpg", exif=exif, quality=95)
    photo, options = Photo.open(tmp_path / "made.jpg"), ViewOptions("keep_all", roll_deg=3)
    (tmp_path / "out").mkdir()
    written = write_rectified(photo, camera, options, tmp_path / "out", suffix=".png")
    assert written == tmp_path / "out" / "made_rectified.png"
    expected = fr.numpy.rectify(
        photo.picture.pixels, camera, options.view_of(camera), rotation=fr.view_rotation(roll_deg=3)
    )
    np.testing.assert_array_equal(read_picture(written).pixels, expected.image)
    as_photo = write_rectified(photo, camera, options, tmp_path / "out")
    assert as_photo.name == "made_rectified.jpg"
    with Image.open(as_photo) as image:
        assert image.getexif()[0x010F] == "Maker"


def test_the_lens_file_to_download_is_exact(room, camera, tmp_path):
    written = write_camera(room, camera, tmp_path)
    assert written.name == "room_camera.json"
    np.testing.assert_array_equal(fr.FisheyeCamera.load(written).params, camera.params)


# --- The command line -----------------------------------------------------------------------------


def demo(*arguments, **options):
    path = os.pathsep.join(filter(None, [str(HOME), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "fisheyerec.cli", "demo", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path, **options.pop("environment", {})},
        **options,
    )


def said_on_refusal(*arguments):
    with demo(*arguments) as process:
        out, err = process.communicate(timeout=120)
    assert (process.returncode, out, len(err.splitlines())) == (2, "", 1), err
    return err


def test_a_port_that_is_taken_is_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"127.0.0.1:{port}: Address already in use" in said_on_refusal("--port", port)


def test_without_gradio_the_line_says_what_to_install(run_python):
    code = (
        "import sys\n"
        "sys.modules['gradio'] = None\n"
        "sys.argv = ['fisheyerec', 'demo', '--port', '0']\n"
        "from fisheyerec.cli import main\n"
        "main()\n"
    )
    result = run_python(code)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.endswith("Gradio is missing: pip install 'fisheyerec[demo]'\n")


def test_a_file_that_is_no_picture_is_refused_before_anything_is_served():
    assert "expected a picture" in said_on_refusal(ROOM_CAMERA, "--port", "0")


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")
def test_ctrl_c_ends_it_in_order_and_leaves_nothing(tmp_path, hears_ctrl_c):
    pytest.importorskip("gradio", reason="Gradio is not installed")
    with demo("--port", "0", environment={"TMPDIR": str(tmp_path)}, preexec_fn=hears_ctrl_c) as process:
        try:
            address = process.stdout.readline().strip()
            with urllib.request.urlopen(address, timeout=120) as page:
                assert b"gradio" in page.read()
            assert list(tmp_path.iterdir()) != []
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, out, err) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


# --- In a browser ---------------------------------------------------------------------------------

PATIENCE = 120  # s, for a machine that has much else to do


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Where the page is served, beginning with its example."""
    pytest.importorskip("gradio", reason="Gradio is not installed")
    folder = tmp_path_factory.mktemp("server")
    with demo("--port", "0", environment={"TMPDIR": str(folder)}) as process:
        try:
            yield process.stdout.readline().strip()
        finally:
            process.terminate()
            out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", ""), "what was shown on the page was told here too"
    left = {path.name for path in folder.iterdir()} - {f"torchinductor_{getpass.getuser()}"}  # torch's own cache
    assert left == set()


@pytest.fixture(scope="module")
def downloads(tmp_path_factory):
    return tmp_path_factory.mktemp("downloads")


@pytest.fixture(scope="module")
def browser(tmp_path_factory, downloads):
    """A Chromium without a window, in a profile of its own."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="Selenium is not installed")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no Chromium with its chromedriver is installed")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    profile = tmp_path_factory.mktemp("profile")
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--hide-scrollbars",
        "--window-size=1400,1000",
        f"--user-data-dir={profile}",
    ):
        options.add_argument(argument)
    options.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        yield browser
    finally:
        browser.quit()


class PageUser:
    """Does what people do on the page, and waits until it shows."""

    def __init__(self, browser, address, downloads):
        from selenium.common import exceptions
        from selenium.webdriver.support.ui import WebDriverWait

        self.browser, self.address, self.downloads = browser, address, downloads
        # What is not there yet, or is being drawn anew, is tried again.
        unready = (IndexError, exceptions.StaleElementReferenceException, exceptions.ElementNotInteractableException)
        unready += (exceptions.ElementClickInterceptedException, OSError)  # Gradio writes equal pictures once more
        self.wait = WebDriverWait(browser, PATIENCE, poll_frequency=0.1, ignored_exceptions=unready)

    def open(self, query=""):
        self.browser.get(f"{self.address}/{query}")
        self.until(lambda: len(self.pictures()) == 2)

    def until(self, condition):
        return self.wait.until(lambda _: condition())

    def all(self, selector):
        return self.browser.find_elements("css selector", selector)

    def click(self, selector, number=0):
        self.until(lambda: self.all(selector)[number].click() or True)

    def pictures(self):
        """Addresses of the pictures before and after."""
        return self.script("return [...document.querySelectorAll('#comparison img')].map(image => image.src)")

    def script(self, code, *arguments):
        return self.browser.execute_script(code, *arguments)

    def changed(self, act):
        """The pictures before and after, once an act has changed the latter."""
        shown = self.pictures()
        act()
        self.until(lambda: len(self.pictures()) == 2 and self.pictures()[1] != shown[1])
        return self.pixels()

    def pixels(self):
        """The pictures before and after."""
        return self.until(lambda: [self.fetch(source) for source in self.pictures()])

    def fetch(self, source):
        with urllib.request.urlopen(source, timeout=PATIENCE) as stream:
            return np.asarray(Image.open(stream).convert("RGB"))

    def upload(self, selector, path):
        self.until(lambda: self.all(f"{selector} input[type=file]")[0].send_keys(str(path)) or True)

    def choose(self, number):
        """Choose where the lens comes from."""
        self.click("#source input", number)

    def slide(self, name, value):
        """Move a slider, as a pointer does."""
        slider = self.all(f"#{name} input[type=range]")[0]
        self.script(
            "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input', {bubbles: true}))",
            slider,
            value,
        )

    def pick(self, name, option):
        """Pick from a list."""
        self.click(f"#{name} input")
        self.click(f"ul[role=listbox] li[aria-label='{option}']")

    def numbers(self, *names):
        return [float(self.all(f"#{name} input[type=number]")[0].get_attribute("value")) for name in names]

    def download(self, button, name):
        self.click(f"#{button}")
        self.until((self.downloads / name).exists)
        return self.downloads / name


@pytest.fixture(scope="module")
def user(address, browser, downloads):  # the browser leaves before the server does
    return PageUser(browser, address, downloads)


@pytest.fixture(scope="module")
def calibrated(user):
    """The user, who has opened the room with its lens file; the lens was estimated before."""
    user.open()
    user.changed(lambda: user.upload("#photo", ROOM))
    estimated = user.numbers("fx", "fy", "cx", "cy")
    user.choose(1)
    user.changed(lambda: user.upload("#lens-file", ROOM_CAMERA))
    return user, estimated


def test_the_page_begins_with_the_example_and_asks_no_other_machine(user, address):
    user.open()
    before, after = user.pixels()
    assert before.shape == after.shape == (720, 960, 3)
    assert np.abs(before.astype(int) - after).mean() > 10
    user.until(lambda: "Bend of lines" in user.all("#told")[0].text)
    user.until(lambda: user.script("return document.fonts.status") == "loaded")
    asked = [json.loads(entry["message"])["message"] for entry in user.browser.get_log("performance")]
    asked = [entry["params"]["request"]["url"] for entry in asked if entry["method"] == "Network.requestWillBeSent"]
    assert f"{address}/" in asked
    elsewhere = [url for url in asked if not url.startswith((address, "data:", "blob:", "chrome"))]
    assert elsewhere == []


def test_a_photo_is_estimated_and_a_lens_file_replaces_the_estimate(calibrated, camera):
    user, estimated = calibrated
    found = fr.Rectifier.from_pretrained().estimate(ROOM).camera
    np.testing.assert_allclose(estimated, found.params[:4], atol=0.06)
    np.testing.assert_allclose(user.numbers(*camera.parameter_names), camera.params, atol=0.06)
    expected = make_preview(Photo.open(ROOM), camera, ViewOptions())
    for shown, made in zip(user.pixels(), (expected.before, expected.after), strict=True):
        assert np.abs(shown.astype(int) - made).mean() < 3  # of a JPEG


def test_a_slider_changes_the_picture(calibrated, camera):
    user, _ = calibrated
    _, still = user.pixels()
    _, turned = user.changed(lambda: user.slide("pan", 25))
    assert np.abs(turned.astype(int) - still).mean() > 10
    expected = make_preview(Photo.open(ROOM), camera, ViewOptions(pan_deg=25), mask=True)
    assert np.abs(turned.astype(int) - expected.after).mean() < 3
    _, bent = user.changed(lambda: user.slide("k1", 0.3))
    assert np.abs(bent.astype(int) - turned).mean() > 3
    user.changed(lambda: user.slide("k1", round(camera.params[4], 4)))
    _, back = user.changed(lambda: user.slide("pan", 0))
    np.testing.assert_array_equal(back, still)


def test_projections_and_framings_bring_their_sliders(calibrated, camera):
    user, _ = calibrated
    user.changed(lambda: user.pick("projection", "Equirectangular"))
    user.pick("wide-framing", "Field of view")
    user.until(lambda: user.all("#wide-fov"))
    user.changed(lambda: user.slide("wide-fov", 300))
    expected = make_preview(Photo.open(ROOM), camera, ViewOptions(projection="equirectangular", fov_deg=300), mask=True)
    user.until(lambda: np.abs(user.pixels()[1].astype(int) - expected.after).mean() < 3)
    assert user.all("#fov") == user.all("#framing") == []
    user.pick("projection", "Perspective")
    user.until(lambda: user.all("#framing"))
    assert user.all("#wide-fov") == []
    expected = make_preview(Photo.open(ROOM), camera, ViewOptions())
    user.until(lambda: np.abs(user.pixels()[1].astype(int) - expected.after).mean() < 3)


def test_lines_are_drawn_on_both_pictures(calibrated):
    user, _ = calibrated
    before, after = user.pixels()
    lined = user.changed(lambda: user.click("#marks input"))
    assert all((np.abs(a.astype(int) - b).max(-1) > 100).any() for a, b in zip(lined, (before, after), strict=True))
    user.changed(lambda: user.click("#marks input"))


def test_downloads_are_the_whole_picture_and_the_exact_lens(calibrated, camera):
    user, _ = calibrated
    lens = user.download("take-camera", "room_camera.json")
    np.testing.assert_array_equal(fr.FisheyeCamera.load(lens).params, camera.params)
    user.click("#download input", 1)
    picture = read_picture(user.download("take-picture", "room_rectified.png")).pixels
    view = fr.PinholeCamera.edge_matched(camera, camera.image_size)
    np.testing.assert_array_equal(picture, fr.numpy.rectify(read_picture(ROOM).pixels, camera, view).image)


def test_a_broken_lens_file_is_told_in_words_and_changes_nothing(calibrated, camera, tmp_path):
    user, _ = calibrated
    (tmp_path / "broken.json").write_text('{"fx": "<b>wide</b>"}')
    shown = user.pictures()
    user.click("#lens-file button[aria-label='Clear'], #lens-file button[aria-label='Remove this file']")
    user.upload("#lens-file", tmp_path / "broken.json")
    user.until(lambda: "broken.json" in " ".join(toast.text for toast in user.all(".toast-body")))
    assert str(tmp_path) not in user.all("body")[0].text
    assert user.pictures() == shown
    np.testing.assert_allclose(user.numbers(*camera.parameter_names), camera.params, atol=0.06)


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize(("width", "height"), [(1400, 1000), (400, 860)], ids=["desktop", "phone"])
def test_the_page_fits_the_screen(user, request, width, height, theme):
    """`--screenshots FOLDER` leaves pictures; that of the README is desktop_light.jpg."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < height}
    user.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    user.open(f"?__theme={theme}")
    user.changed(lambda: user.click("#marks input"))
    assert user.script("return document.documentElement.scrollWidth") <= width
    cut = """
        return [...document.querySelectorAll('#workplace :is(label, button, b, input)')].filter(element => {
            const box = element.getBoundingClientRect();
            const outside = box.width > 0 && (box.left < 0 || box.right > innerWidth);
            return outside || (element.innerText && element.scrollWidth > element.offsetWidth + 1);
        }).map(element => element.outerHTML);
    """
    assert user.script(cut) == []
    folder = request.config.getoption("screenshots")
    if folder is not None:
        user.until(lambda: user.script("return [...document.images].every(image => image.complete)"))
        name = f"{'desktop' if width > height else 'phone'}_{theme}.jpg"
        jpeg = {"format": "jpeg", "quality": 85, "captureBeyondViewport": width < height}
        taken = user.browser.execute_cdp_cmd("Page.captureScreenshot", jpeg)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(base64.b64decode(taken["data"]))
