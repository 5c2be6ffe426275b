"""Picture files: pixels of every kind there and back, and what a file says about itself."""

import struct

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms, ImageOps

from fisheyerec.pictures import Picture, decode, read_picture, write_picture

SIZE = (20, 32)


@pytest.fixture
def deep():
    """(20, 32, 4) uint16 with all 16 bits in use."""
    return np.random.default_rng(0).integers(0, 65536, (*SIZE, 4), dtype=np.uint16)


KINDS = {"grey": np.s_[..., 0], "colour": np.s_[..., :3], "with alpha": np.s_[...]}


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("kind", KINDS)
def test_sixteen_bits_come_back_as_they_were(tmp_path, deep, kind, suffix):
    pixels = deep[KINDS[kind]]
    write_picture(tmp_path / f"a{suffix}", Picture(pixels))
    found = read_picture(tmp_path / f"a{suffix}").pixels
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, pixels)


@pytest.mark.parametrize("kind", ["grey", "colour"])
def test_a_format_of_eight_bits_takes_the_upper_ones(tmp_path, deep, kind):
    pixels = deep[KINDS[kind]]
    write_picture(tmp_path / "a.bmp", Picture(pixels))
    found = read_picture(tmp_path / "a.bmp").pixels
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, np.rint(pixels / 257))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_is_undone_as_pillow_does(tmp_path, deep, kind, orientation):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    eight = (deep >> 8).astype(np.uint8)[KINDS[kind]]
    image = Image.fromarray(eight)
    image.save(tmp_path / "a.png", exif=exif)
    with Image.open(tmp_path / "a.png") as opened:
        expected = np.asarray(ImageOps.exif_transpose(opened))
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png").pixels, expected)
    write_picture(tmp_path / "deep.png", Picture(eight * np.uint16(257), {"exif": exif.tobytes()}))
    found = read_picture(tmp_path / "deep.png").pixels
    np.testing.assert_array_equal(found, expected * np.uint16(257))


def tiff(pixels, orientation):
    """A TIFF of uint16 colour, as no writer at hand makes one that is turned."""
    height, width, channels = pixels.shape
    tags = [
        (256, 3, width),
        (257, 3, height),
        (258, 3, 8),
        (259, 3, 1),
        (262, 3, 2),
        (273, 4, 16),
        (274, 3, orientation),
    ]
    tags += [(277, 3, channels), (278, 3, height), (279, 4, pixels.nbytes)]
    entries = [struct.pack("<HHII", tag, kind, channels if tag == 258 else 1, value) for tag, kind, value in tags]
    header = struct.pack("<2sHI", b"II", 42, 16 + pixels.nbytes) + struct.pack("<3HH", 16, 16, 16, 0)
    return header + pixels.tobytes() + struct.pack("<H", len(tags)) + b"".join(entries) + struct.pack("<I", 0)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_deep_colour_of_a_turned_tiff_is_upright(tmp_path, deep, orientation):
    (tmp_path / "a.tif").write_bytes(tiff(deep[..., :3], orientation))
    with Image.open(tmp_path / "a.tif") as image:
        expected = np.asarray(image)  # Pillow turns it upright, in 8 bits
    found = read_picture(tmp_path / "a.tif").pixels
    np.testing.assert_array_equal(found // 256, expected)


@pytest.fixture
def described():
    """EXIF with a maker, a place and a size, and a colour profile."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Make] = 6, "Maker"
    exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base.ExifImageWidth: 32, ExifTags.Base.ExifImageHeight: 20})
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] = "N"
    return {"exif": exif.tobytes(), "icc_profile": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()}


@pytest.mark.parametrize("target", [".jpg", ".png", ".tif", ".webp", ".avif", "16.png"])
@pytest.mark.parametrize("source", [".jpg", ".png", ".tif", ".webp"])
def test_what_a_file_says_about_itself_is_kept_and_its_orientation_used_up(tmp_path, described, source, target):
    Image.new("RGB", (32, 20)).save(tmp_path / f"a{source}", **described)
    picture = read_picture(tmp_path / f"a{source}")
    assert picture.pixels.shape == (32, 20, 3)
    pixels = picture.pixels[:10] * (np.uint16(257) if target == "16.png" else np.uint8(1))
    write_picture(tmp_path / f"b{target}", Picture(pixels, picture.metadata))
    with Image.open(tmp_path / f"b{target}") as image:
        assert image.size == (20, 10)
        exif = image.getexif()
        assert exif.get(ExifTags.Base.Orientation, 1) == 1
        assert exif[ExifTags.Base.Make] == "Maker"
        assert exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] == "N"
        details = exif.get_ifd(ExifTags.IFD.Exif)
        size = details[ExifTags.Base.ExifImageWidth], details[ExifTags.Base.ExifImageHeight]
        assert size == (20, 10)
        assert image.info["icc_profile"] == described["icc_profile"]
        image.load()


def test_how_a_tiff_stores_its_pixels_is_not_told_of_another_file(tmp_path):
    Image.new("RGB", (32, 20)).save(tmp_path / "a.tif", compression="tiff_lzw")
    write_picture(tmp_path / "b.jpg", read_picture(tmp_path / "a.tif"))
    with Image.open(tmp_path / "b.jpg") as image:
        assert dict(image.getexif()) == {}


def test_a_profile_of_inks_is_not_kept_for_rgb(tmp_path, described):
    Image.new("CMYK", (32, 20)).save(tmp_path / "a.jpg", icc_profile=described["icc_profile"])
    assert read_picture(tmp_path / "a.jpg").metadata == {}


def test_alpha_is_left_out_where_there_is_no_room(tmp_path, deep):
    write_picture(tmp_path / "a.jpg", Picture((deep >> 8).astype(np.uint8)))
    assert read_picture(tmp_path / "a.jpg").pixels.shape == (*SIZE, 3)


@pytest.mark.parametrize("quality", [0, 101])
def test_quality_outside_its_range_is_refused(tmp_path, quality):
    with pytest.raises(ValueError, match=rf"quality in \[1, 100\], got {quality}"):
        write_picture(tmp_path / "a.jpg", Picture(np.zeros(SIZE, np.uint8)), quality=quality)


def test_deep_colour_that_is_cut_off_is_broken(tmp_path, deep):
    write_picture(tmp_path / "a.png", Picture(deep))
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:-500])
    with pytest.raises(ValueError, match="expected a complete picture"):
        read_picture(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".tif", ".png"])
def test_a_file_of_several_pictures_is_refused(tmp_path, suffix):
    frames = [Image.fromarray(np.full((20, 32, 3), level, np.uint8)) for level in (0, 200)]
    frames[0].save(tmp_path / f"two{suffix}", save_all=True, append_images=frames[1:])
    with pytest.raises(ValueError, match=r"expected one picture, got .*two.* of 2 frames"):
        read_picture(tmp_path / f"two{suffix}")


def test_the_preview_in_a_photo_does_not_count(tmp_path):
    frames = [Image.fromarray(np.full((20, 32, 3), level, np.uint8)) for level in (0, 200)]
    frames[0].save(tmp_path / "photo.jpg", "MPO", save_all=True, append_images=frames[1:])
    assert not read_picture(tmp_path / "photo.jpg").pixels.any()


def test_floating_numbers_are_refused(tmp_path):
    image = Image.fromarray(np.linspace(0, 1, 640, dtype=np.float32).reshape(20, 32))
    image.save(tmp_path / "depth.tif")
    with pytest.raises(ValueError, match=r"expected whole numbers, got .*depth\.tif"):
        read_picture(tmp_path / "depth.tif")
    with pytest.raises(ValueError, match="expected an image of whole numbers"):
        decode(image)
