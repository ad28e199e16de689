"""Bare photographs and videos: what their files say, which are worth having, and which frames a film gives."""

from __future__ import annotations

import io
import math
import os
import shutil
import struct
import sys
import zlib
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pillow_heif
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter, uniform_filter1d

from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.export.video import open_video
from lumigraph.readers.pictures import find_file, list_images, read_image, reads_heic, upright_size
from lumigraph.sfm.photos import Intake, gather, is_bare, is_video
from lumigraph.sfm.photos.judge import MIN_SHARPNESS, blurred, judge, sharpness
from lumigraph.sfm.photos.overlap import MIN_SHARED, apart, details, shared
from lumigraph.sfm.photos.video import Odometer, choose, extract

SIZE = (480, 320)
ORIENTATION, EXIF, GPS = 0x0112, 0x8769, 0x8825


def canvas(seed: int = 0, side: int = 1400) -> np.ndarray:
    """A wall with paint at all scales and hard edges, larger than any photograph of it."""
    rng = np.random.default_rng(seed)
    wall = sum(
        np.asarray(Image.fromarray(rng.normal(size=(n, n)).astype(np.float32)).resize((side, side))) / n**0.3
        for n in (10, 40, 160, 640)
    )
    wall = 128 + 40 * wall / wall.std()
    for _ in range(300):
        x, y, width, height = rng.integers(0, side, 4) // [1, 1, 20, 20]
        wall[y : y + height, x : x + width] = rng.integers(20, 235)
    grey = wall.clip(0, 255)
    return np.stack([grey, 0.9 * grey, 0.8 * grey + 20], -1).astype(np.uint8)


WALL = canvas()


def view(x: int, y: int = 0, size: tuple[int, int] = SIZE) -> Image.Image:
    """The wall from somewhere."""
    return Image.fromarray(WALL[y : y + size[1], x : x + size[0]])


def store(path: Path, image: Image.Image, **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, **({"quality": 92} if path.suffix in (".jpg", ".webp") else {}), **options)
    return path


def walk_past(folder: Path, count: int = 8, step: int = 40) -> list[Path]:
    """Photographs as somebody takes them who walks by: neighbours overlap by nine tenths."""
    return [store(folder / f"{i}.jpg", view(40 + step * i, 3 * i)) for i in range(count)]


def tags(exif: dict[int, object] | None = None, gps: dict[int, object] | None = None, **main: object) -> Image.Exif:
    found = Image.Exif()
    found.update({{"make": 0x010F, "model": 0x0110, "orientation": ORIENTATION}[k]: v for k, v in main.items()})
    if exif:
        found.get_ifd(EXIF).update(exif)
    if gps:
        found.get_ifd(GPS).update(gps)
    return found


def only(tmp_path: Path, exif: Image.Exif, size: tuple[int, int] = SIZE):
    path = store(tmp_path / "photos" / "one.jpg", view(0, size=size), exif=exif)
    return gather([path], tmp_path / "work").photos[0]


def names(intake: Intake) -> list[str]:
    return [photo.name for photo in intake.photos]


# What lies in a folder


def test_upright_photographs_are_used_where_they_lie(tmp_path):
    files = walk_past(tmp_path / "photos", 3)
    store(tmp_path / "photos" / "more" / "deep.png", view(0, 500))
    before = {path: path.read_bytes() for path in files}
    intake = gather([tmp_path / "photos"], tmp_path / "work")
    assert names(intake) == ["0.jpg", "1.jpg", "2.jpg", "more/deep.png"]
    assert [p.path for p in intake.photos[:3]] == files and {p.size for p in intake.photos} == {SIZE}
    assert {path: path.read_bytes() for path in files} == before
    assert not list((tmp_path / "work").rglob("*.*")), "nothing had to be copied"
    assert (intake.blurred, intake.duplicates, intake.unreadable, intake.in_order) == ({}, {}, {}, False)


def test_what_programs_made_is_passed_over(tmp_path):
    photos = tmp_path / "photos"
    walk_past(photos / "images", 2)
    store(photos / "images_2" / "0.jpg", view(40).resize((240, 160)))  # reduced
    store(photos / ".thumbnails" / "0.jpg", view(0))
    store(photos / "._0.jpg", view(0))
    store(photos / "scene" / "images" / "0.jpg", view(0))  # a capture's result
    (photos / "scene" / "transforms.json").write_text("{}")
    store(photos / "work" / "upright" / "9.jpg", view(0))
    (photos / "notes.txt").write_text("sunny")
    (photos / "again").symlink_to(photos)
    assert names(gather([photos], photos / "work")) == ["0.jpg", "1.jpg"]


def test_links_to_folders_are_followed_once(tmp_path):
    walk_past(tmp_path / "disk" / "left", 2)
    walk_past(tmp_path / "disk" / "right", 2)
    (tmp_path / "photos").mkdir()
    for name in ("left", "right"):
        (tmp_path / "photos" / name).symlink_to(tmp_path / "disk" / name)
    (tmp_path / "disk" / "left" / "round").symlink_to(tmp_path / "photos")
    assert len(names(gather([tmp_path / "photos"], tmp_path / "work"))) == 4


def test_a_list_of_files_is_taken_each_once(tmp_path):
    a, b, _ = walk_past(tmp_path / "x", 3)
    c = store(tmp_path / "y" / "c.jpg", view(0, 400))
    assert names(gather([b, a, c, tmp_path / "x" / ".." / "x" / "0.jpg"], tmp_path / "work")) == [
        "x/0.jpg",
        "x/1.jpg",
        "y/c.jpg",
    ]


def test_folders_with_poses_are_not_bare(tmp_path):
    walk_past(tmp_path / "photos", 2)
    film = tmp_path / "film.MP4"
    film.write_bytes(b"")
    assert is_bare(tmp_path / "photos") and is_bare(film) and is_video(film)
    (tmp_path / "photos" / "transforms.json").write_text('{"frames": []}')
    (tmp_path / "empty").mkdir()
    for path in ("photos", "empty", "photos/0.jpg", "nowhere", "nowhere.mp4"):
        assert not is_bare(tmp_path / path)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda p: p / "nowhere", "does not exist"),
        (lambda p: (p / "empty").mkdir() or p / "empty", "holds no photographs"),
        (lambda p: [(p / "bad.jpg").write_bytes(b"nonsense"), p / "bad.jpg"][1], "unknown format"),
        (lambda p: [(p / "layers.psd").write_bytes(b"8BPS"), p / "layers.psd"][1], "format is not read"),
        (lambda p: [(p / "raw.cr2").write_bytes(b"II*\0"), p / "raw.cr2"][1], r"\(raw.cr2: it is cut short or damaged"),
    ],
)
def test_nothing_to_see_is_said_in_one_sentence(tmp_path, make, says):
    with pytest.raises(LumigraphError, match=says):
        gather([make(tmp_path)], tmp_path / "work")


def heic(path: Path, image: Image.Image, exif: Image.Exif) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pillow_heif.encode("RGB", image.size, image.tobytes(), path, exif=exif.tobytes(), quality=90)
    return path


@pytest.mark.parametrize(("orientation", "undo"), [(1, None), (6, "ROTATE_90")])
def test_heic_of_a_phone_is_turned_upright_once(tmp_path, orientation, undo):
    """A phone's file: stored on its side, with a turn for decoders and the same in EXIF."""
    upright = Image.fromarray(gaussian_filter(np.asarray(view(100)), (2, 2, 0)))
    stored = upright.transpose(Image.Transpose[undo]) if undo else upright
    exif = tags({0xA405: 26}, orientation=orientation, make="Apple", model="iPhone 14")
    path = heic(tmp_path / "photos" / "IMG_1.HEIC", stored, exif)
    photo = gather([path.parent], tmp_path / "work").photos[0]
    assert (photo.name, photo.size) == ("IMG_1.HEIC.jpg", SIZE)
    assert photo.focal == pytest.approx(26 / 43.2666 * math.hypot(*SIZE), rel=1e-4)
    assert list_images(path.parent) == ["IMG_1.HEIC"] and find_file(path.parent / "IMG_1") == path
    assert upright_size({1: path}) == SIZE
    for pixels in (np.asarray(Image.open(photo.path)), read_image(path, True, SIZE), read_image(path, False, SIZE)):
        assert np.abs(pixels.astype(int) - np.asarray(upright, int)).mean() < 3


def test_heic_that_cannot_be_read_says_why(tmp_path, monkeypatch):
    path = heic(tmp_path / "photos" / "IMG_1.HEIC", view(0), tags())
    misnamed = path.with_name("sent.jpg")
    misnamed.write_bytes(path.read_bytes())
    assert names(gather([misnamed], tmp_path / "work")) == ["sent.jpg"]
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    reads_heic.cache_clear()
    with pytest.raises(LumigraphError, match="pip install pi-heif"):
        gather([path], tmp_path / "work")
    with pytest.raises(LumigraphError, match="pip install pi-heif"):
        read_image(path, True, SIZE)
    monkeypatch.undo()
    reads_heic.cache_clear()
    for share in (0.02, 0.5, 0.98):
        path.write_bytes(misnamed.read_bytes()[: round(share * misnamed.stat().st_size)])
        with pytest.raises(LumigraphError, match=r"\(IMG_1.HEIC: it is cut short or damaged\); copy them again"):
            gather([path], tmp_path / "work")


def test_files_that_are_no_pictures_are_named_and_the_rest_is_used(tmp_path):
    walk_past(tmp_path / "photos", 2)
    (tmp_path / "photos" / "bad.jpg").write_bytes(b"nonsense")
    whole = (tmp_path / "photos" / "0.jpg").read_bytes()
    (tmp_path / "photos" / "half.jpg").write_bytes(whole[: len(whole) // 2])
    turned = store(tmp_path / "photos" / "turned.jpg", view(0), exif=tags(orientation=6))
    turned.write_bytes(turned.read_bytes()[:9000])
    intake = gather([tmp_path / "photos"], tmp_path / "work")
    assert names(intake) == ["0.jpg", "1.jpg"]
    assert list(intake.unreadable) == ["bad.jpg", "half.jpg", "turned.jpg"]
    assert all("truncated" in intake.unreadable[name] for name in ("half.jpg", "turned.jpg"))


# Upright copies


@pytest.mark.parametrize("orientation", range(2, 9))
def test_turned_photographs_become_upright_copies(tmp_path, orientation):
    undo = {2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE"}
    undo |= {6: "ROTATE_90", 7: "TRANSVERSE", 8: "ROTATE_270"}
    upright = Image.fromarray(gaussian_filter(np.asarray(view(100)), (3, 3, 0)))
    stored = upright.transpose(Image.Transpose[undo[orientation]])
    path = store(tmp_path / "photos" / "A.JPEG", stored, exif=tags(orientation=orientation), quality=98)
    before = path.read_bytes()
    photo = gather([path.parent], tmp_path / "work").photos[0]
    assert (photo.name, photo.size) == ("A.JPEG", SIZE)
    assert photo.path != path and path.read_bytes() == before
    with Image.open(photo.path) as copy:
        assert copy.getexif().get(ORIENTATION, 1) == 1
        assert np.abs(np.asarray(copy, int) - np.asarray(upright, int)).mean() < 2


def test_copies_are_made_again_only_when_their_source_changed(tmp_path):
    path = store(tmp_path / "photos" / "a.jpg", view(0), exif=tags(orientation=6))
    copy = gather([path], tmp_path / "work").photos[0].path
    copy.write_bytes(copy.read_bytes() + b"mark")  # unnoticed by the date, so that it shows who wrote it
    os.utime(copy, ns=(0, path.stat().st_mtime_ns))
    gather([path], tmp_path / "work")
    assert copy.read_bytes().endswith(b"mark")
    store(path, view(200), exif=tags(orientation=6))
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 10**9))
    gather([path], tmp_path / "work")
    assert not copy.read_bytes().endswith(b"mark")


def test_rare_formats_become_plain_ones(tmp_path):
    colour, folder = view(0), tmp_path / "photos"
    grey16 = Image.fromarray(np.asarray(colour.convert("L"), np.uint16) * 257)
    see_through = colour.copy()
    see_through.putalpha(Image.fromarray(WALL[-SIZE[1] :, -SIZE[0] :, 0]))
    store(folder / "a.webp", colour)
    store(folder / "b.tif", colour)
    store(folder / "c.jpg", colour.convert("CMYK"))
    store(folder / "d.png", colour.quantize(256))
    store(folder / "e.png", grey16)
    store(folder / "f.png", see_through, exif=tags(orientation=3))
    store(folder / "g.tif", see_through)
    intake = gather([folder], tmp_path / "work")
    assert names(intake) == ["a.webp.jpg", "b.tif.jpg", "c.jpg", "d.png", "e.png", "f.png", "g.tif.png"]
    for photo in intake.photos:
        assert tmp_path / "work" in photo.path.parents
        with Image.open(photo.path) as copy:
            assert copy.mode in ("RGB", "RGBA") and copy.size == photo.size == SIZE
            assert (copy.mode == "RGBA") == (photo.name[0] in "fg")
            if photo.name[0] not in "f":
                error = np.abs(np.asarray(copy.convert("L"), int) - np.asarray(colour.convert("L"), int)).mean()
                assert error < 4, photo.name
    with Image.open(intake.photos[5].path) as copy:  # bit-exact
        assert (np.asarray(copy) == np.asarray(see_through)[::-1, ::-1]).all()


def test_sixteen_bits_of_colour_become_eight(tmp_path):
    """Pillow reads such files and cannot write them, so here is one byte by byte."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    pixels = np.asarray(view(0), ">u2") * 257
    rows = b"".join(b"\0" + row.tobytes() for row in pixels.astype(">u2"))
    header = struct.pack(">IIBBBBB", *SIZE, 16, 2, 0, 0, 0)
    path = tmp_path / "photos" / "deep.png"
    path.parent.mkdir()
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    photo = gather([path], tmp_path / "work").photos[0]
    assert photo.path != path
    assert photo.path.read_bytes()[24] == 8
    assert np.abs(np.asarray(Image.open(photo.path), int) - np.asarray(view(0), int)).max() <= 1


# What EXIF says

CAMERA = {"make": "NIKON CORPORATION", "model": "NIKON D3200"}


def test_focal_length_from_the_35_mm_equivalent(tmp_path):
    photo = only(tmp_path, tags({0xA405: 60, 0x920A: 40.0}, **CAMERA))
    assert photo.focal == pytest.approx(60 / 43.2666 * math.hypot(*SIZE), rel=1e-4)
    assert photo.device == "NIKON D3200, 40 mm, 480x320"


def test_focal_length_from_the_sensor(tmp_path):
    """A sensor 23.2 mm wide behind 40 mm, exposed at 3000 pixels, reduced since; turned by the camera or not."""
    facts = {0x920A: 40.0, 0xA20E: 3000 / 23.2 * 10, 0xA210: 3, 0xA002: 3000, 0xA003: 2000}
    for orientation in (1, 6):
        photo = only(tmp_path, tags(facts, orientation=orientation, **CAMERA))
        assert photo.focal == pytest.approx(40 / 23.2 * max(SIZE), rel=1e-4)


@pytest.mark.parametrize(
    ("facts", "focal"),
    [
        ({0xA210: 2, 0xA20E: 2540.0}, 500.0),  # pixels per inch
        ({0xA20E: 2540.0}, 500.0),  # the same, unsaid
        ({0xA210: 3, 0xA20E: 1000.0}, 500.0),  # per centimetre
        ({0xA210: 2, 0xA20E: 2540.0, 0xA002: 480, 0xA003: 320}, 500.0),
        ({0xA210: 2, 0xA20E: 2540.0, 0xA002: 960, 0xA003: 640}, 250.0),  # reduced to half since
        ({0xA210: 2, 0xA20E: 2540.0, 0xA002: 640, 0xA003: 960}, 250.0),  # and turned
        ({0xA210: 2, 0xA20E: 2540.0, 0xA002: 960}, 250.0),
        ({0xA210: 2, 0xA20E: 2540.0, 0xA002: 480, 0xA003: 360}, 500.0),  # 40 rows cut off
        ({0xA210: 2, 0xA20E: 2540.0, 0xA002: 640, 0xA003: 480}, None),  # cropped and reduced
        ({0xA405: 36, 0xA002: 480, 0xA003: 360}, 36 / 43.2666 * 600),  # cropped, with the 35 mm equivalent
    ],
)
def test_focal_length_in_pixels_from_the_sensor(tmp_path, facts, focal):
    """5 mm on a sensor with 100 pixels per millimetre."""
    found = only(tmp_path, tags({0x920A: 5.0} | facts)).focal
    assert found == (None if focal is None else pytest.approx(focal, rel=1e-4))


@pytest.mark.parametrize(
    "facts",
    [
        {},
        {0xA405: 0, 0x920A: 0.0},  # zero stands for unknown
        {0x920A: 40.0},  # no sensor
        {0x920A: 40.0, 0xA20E: 1e-3, 0xA210: 3},  # a sensor of kilometres
        {0xA405: 60, 0xA002: 4000, 0xA003: 2250},  # cropped since
    ],
)
def test_no_focal_length_rather_than_a_wrong_one(tmp_path, facts):
    assert only(tmp_path, tags(facts)).focal is None


def test_place(tmp_path):
    north = {1: "N", 2: (48.0, 30.0, 36.0), 3: "E", 4: (2.0, 20.0, 0.0), 5: b"\x00", 6: 120.5}
    south = north | {1: "S", 3: "W", 5: b"\x01", 6: 3.0}
    assert only(tmp_path, tags(gps=north)).gps == pytest.approx((48.51, 2 + 1 / 3, 120.5))
    assert only(tmp_path, tags(gps=south)).gps == pytest.approx((-48.51, -2 - 1 / 3, -3))
    for nowhere in ({}, {1: "N", 2: (0.0,) * 3, 3: "E", 4: (0.0,) * 3}, {1: "N", 2: (95.0, 0.0, 0.0)} | {4: north[4]}):
        assert only(tmp_path, tags(gps=nowhere)).gps is None


def test_an_altitude_that_is_missing_is_taken_from_the_others(tmp_path):
    place = {1: "N", 2: (48.0, 30.0, 36.0), 3: "E", 4: (2.0, 20.0, 0.0)}
    for i, more in enumerate([{6: 10.0}, {6: 12.0}, {6: 30.0}, {}]):
        store(tmp_path / "photos" / f"{i}.jpg", view(40 * i), exif=tags(gps=place | more))
    assert [p.gps[2] for p in gather([tmp_path / "photos"], tmp_path / "work").photos] == [10, 12, 30, 12]


def test_time(tmp_path):
    taken = {0x9003: "2019:07:11 15:07:32", 0x9291: "50"}
    assert only(tmp_path, tags(taken)).time == 1562857652.5
    assert only(tmp_path, tags(taken | {0x9011: "+02:00"})).time == 1562857652.5 - 7200
    assert only(tmp_path, tags({0x9003: "0000:00:00 00:00:00"})).time is None
    assert only(tmp_path, tags()).device is None


# Sharp or blurred


def test_sharpness_of_known_pictures():
    """1 for a ramp, 4 for clean edges in every direction, 16 for noise; and contrast does not matter."""
    ramp = np.add.outer(np.arange(300.0), np.arange(300.0)).astype(np.float32)
    y, x = np.mgrid[:300, :300]
    edges = np.where((x > 150) ^ (y > 150) ^ (x + y > 300) ^ (x > y), 200, 50).astype(np.float32)
    noise = np.random.default_rng(0).normal(128, 30, (300, 300)).astype(np.float32)
    assert sharpness(ramp) == pytest.approx(1, abs=0.01)
    assert sharpness(edges) == pytest.approx(4, rel=0.1)
    assert sharpness(noise) == pytest.approx(16, rel=0.05)
    assert sharpness(edges / 5) == pytest.approx(sharpness(edges), rel=0.02)
    assert sharpness(np.full((100, 100), 7, np.float32)) == 1
    assert sharpness(np.full((1, 3), 7, np.float32)) == 1


def test_blur_in_any_one_direction_shows():
    grey = np.asarray(view(0).convert("L"), np.float32)
    sharp = sharpness(grey)
    values = [sharpness(gaussian_filter(grey, sigma)) for sigma in (0.5, 1, 2, 4)]
    assert sharp > values[0] > values[1] > values[2] > values[3]
    assert values[2] < sharp / 2
    for angle in (0, 45, 90, 135):
        turned = np.asarray(Image.fromarray(grey).rotate(angle, Image.Resampling.BICUBIC, expand=True))
        moved = Image.fromarray(uniform_filter1d(turned, 14, axis=1)).rotate(-angle, Image.Resampling.BICUBIC)
        middle = np.asarray(moved)[moved.height // 2 - 90 :, moved.width // 2 - 90 :][:180, :180]
        assert sharpness(middle) < sharp / 2, angle


def test_brightness_counts_stops():
    encode = {stop: round(255 * (1.055 * (0.5**stop) ** (1 / 2.4) - 0.055)) for stop in (0, 1, 3)}
    for stop, value in encode.items():
        assert judge(Image.new("L", (50, 50), value)).brightness == pytest.approx(-stop, abs=0.02)


def test_only_those_far_below_the_others_are_blurred():
    def named(*values: float) -> str:
        return "".join(blurred(dict(zip("abcdefgh", values, strict=False))))

    assert named() == named(4) == named(4, 4.4, 3.6, 4.1) == ""
    assert named(3, 3.1, 3.2, 2.9, 3, 1.6) == "f"
    assert named(7, 7.3, 6.8, 7, 7.1, 2.4) == "f"
    assert named(9, 9.3, 8.8, 9, 9.1, 4.2) == "", "less than the others, but crisp"
    assert named(2.0, 4, 3.0, 6, 2.5, 5) == "", "where all differ none stands out"
    assert named(1.2, 1.3, 1.2) == "abc", "where all are bad all are named"


def test_blurred_and_repeated_photographs_are_named_exactly(tmp_path):
    """As folders are: two shots shaken, one out of focus, one copied, one sent by a messenger, one turned."""
    folder = tmp_path / "photos"
    files = walk_past(folder, 14, 60)

    def spoil(path: Path, blur) -> None:
        pixels = np.asarray(Image.open(path), np.float32)
        store(path, Image.fromarray(blur(pixels).clip(0, 255).astype(np.uint8)))

    spoil(files[2], lambda x: gaussian_filter(x, (2.5, 2.5, 0)))
    spoil(files[6], lambda x: uniform_filter1d(x, 12, axis=1))
    spoil(files[9], lambda x: uniform_filter1d(x, 12, axis=0))
    shutil.copy(files[4], folder / "copy of 4.jpg")
    Image.open(files[11]).resize((240, 160)).save(folder / "0 sent.jpg", quality=40)
    turned = Image.open(files[13]).transpose(Image.Transpose.ROTATE_90)
    store(folder / "z turned.jpg", turned.resize((300, 450)), exif=tags(orientation=6))
    intake = gather([folder], tmp_path / "work")
    assert set(intake.blurred) == {"2.jpg", "6.jpg", "9.jpg"}
    assert intake.duplicates == {"0 sent.jpg": "11.jpg", "copy of 4.jpg": "4.jpg", "z turned.jpg": "13.jpg"}
    assert len(intake.photos) == 17
    assert all(photo.sharpness < MIN_SHARPNESS * 1.5 for photo in intake.photos if photo.name in intake.blurred)


def test_neighbours_are_no_duplicates(tmp_path):
    walk_past(tmp_path / "photos", 6, step=6)
    intake = gather([tmp_path / "photos"], tmp_path / "work")
    assert intake.duplicates == {} and intake.blurred == {}


def test_photographs_too_far_from_every_other_are_named():
    found = {f"{i}.jpg": details(view(40 + 120 * i, 3 * i)) for i in range(5)}
    found["far.jpg"] = details(view(900, 1000))  # another place of the wall

    def count(one, other):
        return shared(found[one], found[other])

    walk = [name for name in found if name != "far.jpg"]
    assert apart(walk, count) == [] and count("0.jpg", "1.jpg") > 4 * MIN_SHARED
    assert apart([*walk, "far.jpg"], count) == ["far.jpg"]
    assert apart(["far.jpg", "0.jpg", "3.jpg", "1.jpg", "4.jpg", "2.jpg"], count) == ["far.jpg"]  # in any order
    nothing = details(Image.new("RGB", (300, 200), (90, 150, 240)))
    assert shared(nothing, found["far.jpg"]) == 0 and details(Image.new("RGB", (1, 1))).shape == (0, 128)


def test_pictures_of_nothing_do_no_harm(tmp_path):
    store(tmp_path / "photos" / "dot.png", Image.new("RGB", (1, 1)))
    store(tmp_path / "photos" / "sky.jpg", Image.new("RGB", (300, 200), (90, 150, 240)))
    intake = gather([tmp_path / "photos"], tmp_path / "work")
    assert names(intake) == ["dot.png", "sky.jpg"] and intake.duplicates == {}
    assert all(math.isfinite(photo.brightness) for photo in intake.photos)


# Videos


def film(path: Path, places: list[int], fps: float = 30, turn: int = 0, blur: dict[int, float] | None = None) -> Path:
    """A camera moving along the wall; place by place, in pixels."""
    with open_video(path, fps) as video:
        for i, place in enumerate(places):
            pixels = np.asarray(view(place, size=(192, 128)))
            if sigma := (blur or {}).get(i, 0):
                pixels = gaussian_filter(pixels, (sigma, sigma, 0))
            video.add(torch.from_numpy(np.rot90(pixels, turn).copy()))
    return path


def test_a_film_gives_its_sharpest_frames_in_order(tmp_path):
    places = [10 + 4 * i for i in range(60)]
    blur = {i: 3.0 for i in range(60) if i % 5 != 2}  # a hand that is still every fifth frame
    path = film(tmp_path / "film.mp4", places, blur=blur)
    intake = gather([path], tmp_path / "work", frames=12)
    assert names(intake) == [f"{i:06d}.jpg" for i in range(2, 60, 5)]
    assert intake.in_order and not intake.blurred and not intake.duplicates
    assert [p.time for p in intake.photos] == pytest.approx([i / 30 for i in range(2, 60, 5)], abs=1e-3)
    assert {p.device for p in intake.photos} == {"film.mp4"}
    with Image.open(intake.photos[3].path) as frame:
        expected = np.asarray(view(places[17], size=(192, 128)), int)
        assert np.abs(np.asarray(frame, int) - expected).mean() < 6, "the frame that its name says"


def test_a_resting_camera_gives_few_frames(tmp_path):
    places = [10] * 40 + [10 + 6 * i for i in range(40)]
    seconds = [t for _, t in extract(film(tmp_path / "film.mp4", places), tmp_path / "frames", 16)]
    resting = [t for t in seconds if t < 39 / 30]
    assert len(resting) == 1, "the others would show the same"
    assert len(seconds) >= 12 and max(np.diff([t for t in seconds if t >= 39 / 30])) < 0.25


def test_frames_are_kept_for_the_same_film_and_options_only(tmp_path):
    path = film(tmp_path / "film.mp4", [10 + 8 * i for i in range(24)])
    first = extract(path, tmp_path / "frames", 6)
    first[0][0].write_bytes(b"mark")
    assert extract(path, tmp_path / "frames", 6) == first and first[0][0].read_bytes() == b"mark"
    with pytest.raises(LumigraphError, match="is damaged"):
        shutil.copytree(tmp_path / "frames", tmp_path / "work" / "frames")
        gather([path], tmp_path / "work", 6)
    first[0][0].unlink()
    extract(path, tmp_path / "frames", 6)
    assert Image.open(first[0][0]).size == (192, 128), "taken anew"
    assert len(extract(path, tmp_path / "frames", 8)) == 8
    film(path, [800 - 8 * i for i in range(24)])
    again = extract(path, tmp_path / "frames", 8)
    expected = np.asarray(view(800 - 8 * int(again[0][0].stem), size=(192, 128)), int)
    assert np.abs(np.asarray(Image.open(again[0][0]), int) - expected).mean() < 6


def turned_film(path: Path, clockwise: int) -> Path:
    """What a phone held upright writes: pixels as the sensor lies, and in the track's header how to turn them."""
    film(path, [10 + 8 * i for i in range(12)], turn=clockwise // 90)
    data = bytearray(path.read_bytes())
    begin = data.index(b"tkhd") + 4 + 4 + 20 + 16  # version and flags, times and ids, reserved and layers
    one, cos, sin = 1 << 16, round(math.cos(math.radians(clockwise))), round(math.sin(math.radians(clockwise)))
    matrix = (cos * one, sin * one, 0, -sin * one, cos * one, 0, 0, 0, 1 << 30)
    data[begin : begin + 36] = b"".join(v.to_bytes(4, "big", signed=True) for v in matrix)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("clockwise", [90, 180, 270])
def test_a_film_held_otherwise_is_turned_upright(tmp_path, clockwise):
    frames = extract(turned_film(tmp_path / "film.mp4", clockwise), tmp_path / "frames", 4)
    first = Image.open(frames[0][0])
    number = int(frames[0][0].stem)
    expected = np.asarray(view(10 + 8 * number, size=(192, 128)), int)
    assert first.size == (192, 128)
    assert np.abs(np.asarray(first, int) - expected).mean() < 6


def test_a_film_of_uneven_pace_is_timed_by_its_clock(tmp_path):
    path, clock = tmp_path / "film.mkv", np.cumsum([0, *([20, 80] * 10)])
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 192, 128, "yuv420p"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        for i, at in enumerate(clock.tolist()):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(np.asarray(view(10 + 12 * i, size=(192, 128)))))
            frame.pts, frame.time_base = at, stream.codec_context.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    found = extract(path, tmp_path / "frames", 21)
    assert len(found) > 15
    assert [t for _, t in found] == pytest.approx([clock[int(p.stem)] / 1000 for p, _ in found], abs=2e-3)


def test_films_that_are_none_are_told_in_one_sentence(tmp_path):
    def told(path: Path, says: str, frames: int | None = None) -> None:
        with pytest.raises(LumigraphError, match=says):
            gather([path], tmp_path / "work", frames)
        assert not (tmp_path / "work" / "frames").exists()

    for name, data in (("empty.mp4", b""), ("text.mov", b"no film" * 100)):
        (tmp_path / name).write_bytes(data)
        told(tmp_path / name, "cannot be read as a video")
    sound = tmp_path / "sound.mp4"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        silence.sample_rate = 44100
        container.mux(stream.encode(silence))
        container.mux(stream.encode(None))
    told(sound, "holds no pictures")
    whole = film(tmp_path / "film.mp4", [10 + 8 * i for i in range(8)])
    told(whole, "ask for 2", frames=1)
    with pytest.raises(LumigraphError, match="is a video among other things"):
        gather([whole, sound], tmp_path / "work")


def test_a_film_that_breaks_off_gives_what_it_has(tmp_path):
    path = film(tmp_path / "film.mp4", [10 + 8 * i for i in range(48)])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    with pytest.warns(LumigraphWarning, match=r"breaks off after [01]\.\d of 1\.6 s"):
        found = extract(path, tmp_path / "frames", 10)
    assert len(found) >= 5 and found[-1][1] < 1.5


def test_choice_is_even_where_all_are_alike():
    numbers, seconds = list(range(100)), np.linspace(0, 10, 100)
    chosen = choose(numbers, seconds, np.ones(100), 3 * seconds, 10)
    assert len(chosen) == 10 and set(np.diff(chosen)) <= {9, 10, 11} and chosen[0] in (4, 5)
    assert len(choose(numbers, seconds, np.ones(100), 3 * seconds)) == 25, "2.5 a second"
    assert len(choose([0], np.zeros(1), np.ones(1), np.zeros(1), 10)) == 1
    sharp = np.ones(100)
    sharp[17] = 2
    assert 17 in choose(numbers, seconds, sharp, 3 * seconds, 10)


def test_the_odometer_counts_pixels_but_neither_noise_nor_trembling():
    rng = np.random.default_rng(0)
    rests, moves = Odometer(), Odometer()
    wall = gaussian_filter(WALL[..., 0].astype(np.float32), 1)
    for i in range(30):
        noise = rng.normal(0, 3, (100, 180)).astype(np.float32)
        at_rest = rests.show(wall[i % 2 : i % 2 + 100, :180] + noise)  # in a hand that trembles
        moving = moves.show(wall[2 * i : 2 * i + 100, :180] + noise)
    assert at_rest <= 1
    assert moving == pytest.approx(58, rel=0.25)


def test_jpegs_are_judged_from_a_fraction_of_their_size(tmp_path):
    """Decoding at 1/2, 1/4 or 1/8 must not change the verdict."""
    large = Image.fromarray(WALL).resize((2000, 2000), Image.Resampling.BICUBIC)
    quick = io.BytesIO()
    large.save(quick, "JPEG", quality=92)
    a, b = judge(Image.open(quick)), judge(large)
    assert a.sharpness == pytest.approx(b.sharpness, rel=0.1)
    assert a.brightness == pytest.approx(b.brightness, abs=0.05)
    assert a.signature @ b.signature > 0.98
