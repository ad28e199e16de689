"""Raw photographs: what is read of them, how they are developed, what a scene remembers of them."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import raws
import tiny
import torch
from PIL import Image

from lumigraph.color.srgb import srgb_from_linear
from lumigraph.datasets.images import resized
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.opening import open_scene
from lumigraph.readers.raw import RawPhoto, is_raw, open_raw
from lumigraph.readers.raw.library import turned_pattern
from lumigraph.readers.raw.photo import demosaiced, repeated
from lumigraph.sfm.photos import gather
from lumigraph.sfm.reconstruction import also_unreadable
from lumigraph.synthetic.sensor import BLACK_LEVEL, DN_PER_PHOTON, READ_NOISE, WHITE_LEVEL, Sensor


def bytes_of(rgb: np.ndarray) -> np.ndarray:
    return np.rint(srgb_from_linear(rgb.clip(0, 1)) * 255).astype(int)


@pytest.mark.parametrize("pattern", raws.PATTERNS.values(), ids=raws.PATTERNS)
def test_demosaicing_keeps_what_was_measured_and_finds_a_plane_exactly(pattern):
    y, x = np.mgrid[:9, :12]
    grey = 0.1 + 0.02 * x + 0.03 * y
    rgb = demosaiced(grey, pattern)
    inner = (slice(2, -2), slice(2, -2))
    np.testing.assert_allclose(rgb[inner], np.repeat(grey[..., None], 3, -1)[inner], atol=1e-12)
    noise = np.random.default_rng(0).random((9, 12))
    own = np.take_along_axis(demosaiced(noise, pattern), repeated(pattern, (12, 9)).astype(int)[..., None], -1)
    np.testing.assert_array_equal(own[..., 0], noise)


@pytest.mark.parametrize("name", ["a.png", "a.raw"])
@pytest.mark.parametrize("pattern", raws.PATTERNS)
def test_a_mosaic_becomes_the_picture_that_it_was_made_of(tmp_path, name, pattern):
    rgb = raws.gradient()
    folder = raws.write_mosaics(tmp_path, {name: raws.mosaic_of(rgb, pattern)}, {name: 0.5}, pattern=pattern)
    assert is_raw(folder / name) and not is_raw(folder / "mosaics.json")
    photo = open_raw(folder / name)
    assert photo.size == (48, 32) and photo.exposure == 0.5 and photo.gains == raws.GAINS
    assert np.abs(photo.developed(1.0)[2:-2, 2:-2] - bytes_of(rgb)[2:-2, 2:-2]).max() <= 1


def test_noise_below_black_stays(tmp_path):
    numbers = np.array([[raws.BLACK - 30, raws.BLACK, raws.WHITE, 65_535]] * 4, np.uint16)
    light = open_raw(raws.write_mosaics(tmp_path, {"a.png": numbers}) / "a.png").read()
    np.testing.assert_allclose(light[0, :3], [-30 / 12_000, 0, 1], atol=1e-7)
    assert light.dtype == np.float32 and light[0, 3] > 5


@pytest.mark.parametrize("size", [(8, 6), (7, 6), (8, 5), (7, 5)], ids=str)
@pytest.mark.parametrize("turns", range(4))
def test_a_turned_mosaic_has_its_pattern_turned(size, turns):
    pattern = raws.PATTERNS["GRBG"]
    turned = np.rot90(repeated(pattern, size), turns)
    width, height = size[::-1] if turns % 2 else size
    np.testing.assert_array_equal(repeated(turned_pattern(pattern, size, turns), (width, height)), turned)


@pytest.mark.parametrize("size", [(6, 4), (5, 4), (12, 8)], ids=str)
def test_a_mosaic_made_smaller_is_one(size):
    """Each of its pixels holds the mean of those of its own filter within it, and the filters repeat as before."""
    pattern = raws.PATTERNS["RGGB"]
    filters = repeated(pattern, (24, 16))
    mosaic = np.array([3.0, 5.0, 8.0])[filters].astype(np.float32)
    small, laid = resized(mosaic, size, "mosaic"), resized(filters, size, "filter")
    np.testing.assert_array_equal(laid, repeated(pattern, size))
    np.testing.assert_allclose(small, np.array([3.0, 5.0, 8.0])[laid])
    ramp = np.broadcast_to(np.arange(24, dtype=np.float32), (16, 24))
    centres = (np.arange(6) + 0.5) * 4 - 0.5
    assert np.abs(resized(ramp, (6, 4), "mosaic") - centres).max() <= 0.5  # two columns of four have its phase


# Cameras' own files


@pytest.fixture(scope="module")
def dng(tmp_path_factory):
    pytest.importorskip("rawpy")
    return raws.write_dng(tmp_path_factory.mktemp("dng") / "a.dng", raws.mosaic_of(raws.gradient()))


def test_a_dng_is_read_through_rawpy(dng):
    photo = open_raw(dng)
    assert photo.size == (48, 32) and photo.pattern == ((0, 1), (1, 2))
    assert photo.exposure == pytest.approx(1 / 30 / 2.8**2, rel=1e-4)
    np.testing.assert_allclose(photo.gains, raws.GAINS, rtol=1e-3)
    numbers = raws.mosaic_of(raws.gradient())
    np.testing.assert_allclose(photo.read(), (numbers - 500.0) / 12_000, atol=1e-6)
    assert np.abs(photo.developed(1.0)[2:-2, 2:-2] - bytes_of(raws.gradient())[2:-2, 2:-2]).max() <= 1


@pytest.mark.parametrize(("orientation", "turns"), [(3, 2), (6, 3), (8, 1)])
def test_a_dng_stands_upright(tmp_path, dng, orientation, turns):
    numbers = raws.mosaic_of(raws.gradient())
    photo = open_raw(raws.write_dng(tmp_path / "turned.dng", numbers, orientation))
    straight = open_raw(dng)
    np.testing.assert_array_equal(photo.read(), np.rot90(straight.read(), turns))
    np.testing.assert_array_equal(photo.filters, np.rot90(straight.filters, turns))
    assert photo.size == photo.read().shape[::-1]


def test_raw_files_that_cannot_be_read_say_why(tmp_path, dng):
    cut, other = tmp_path / "cut.dng", tmp_path / "other.nef"
    cut.write_bytes(dng.read_bytes()[:2000])
    other.write_bytes(b"no camera wrote this" * 100)
    with pytest.raises(LumigraphError, match=r"cut.dng is cut short or damaged"):
        open_raw(cut).read()
    with pytest.raises(
        LumigraphError, match="other.nef is no raw file, or of a camera that LibRaw .* convert it to DNG"
    ):
        open_raw(other)


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ({"black": None}, "does not say the black of a.raw"),
        ({"white": 400}, "white level 400 at or below black 500"),
        ({"width": 47}, "has 3,072 bytes, and 47x32 pixels of 16 bits are 3,008"),
        ({"pattern": "XYZW"}, "pattern"),
        ({"gains": [1, -1, 1]}, "gains"),
    ],
    ids=lambda x: next(iter(x)) if isinstance(x, dict) else "",
)
def test_what_mosaics_json_says_is_checked(tmp_path, said, sentence):
    raws.write_mosaics(tmp_path, {"a.raw": raws.mosaic_of(raws.gradient())}, **said)
    with pytest.raises(LumigraphError, match=re.escape(sentence)):
        open_raw(tmp_path / "a.raw")


# Developed for capture


def test_a_folder_of_raw_files_is_developed_beside_it_and_equally_bright(tmp_path):
    rgb, exposures = raws.gradient(), {"a.png": 1.0, "b.png": 0.25, "c.png": 0.5}
    mosaics = {name: raws.mosaic_of(rgb, exposure=e) for name, e in exposures.items()}
    folder = raws.write_mosaics(tmp_path / "photos", mosaics, exposures)
    before = sorted(folder.iterdir())
    intake = gather([folder], tmp_path / "work")
    assert sorted(folder.iterdir()) == before and not intake.unreadable
    assert [photo.name for photo in intake.photos] == ["a.png.jpg", "b.png.jpg", "c.png.jpg"]
    brightness = {name: one.brightness for name, one in intake.raw.items()}
    assert brightness["b.png.jpg"] == pytest.approx(4 * brightness["a.png.jpg"])
    a, b = (np.asarray(Image.open(photo.path)).astype(int) for photo in intake.photos[:2])
    assert np.abs(a - b).mean() < 2 and a.mean() > 100
    made = {photo.path: photo.path.stat().st_ino for photo in intake.photos}
    assert {photo.path: photo.path.stat().st_ino for photo in gather([folder], tmp_path / "work").photos} == made


def test_raw_files_among_others_are_refused_and_damaged_ones_named(tmp_path):
    folder = raws.write_mosaics(tmp_path / "photos", {f"{k}.raw": raws.mosaic_of(raws.gradient()) for k in "abc"})
    (folder / "b.raw").write_bytes(b"short")
    intake = gather([folder], tmp_path / "work")
    assert intake.unreadable["b.raw"].startswith("it has 5 bytes") and len(intake.photos) == 2
    assert also_unreadable(intake).startswith(" (b.raw could not be used: it has 5 bytes")
    assert not also_unreadable(replace(intake, unreadable={}))
    Image.new("RGB", (48, 32)).save(folder / "d.jpg")
    with pytest.raises(LumigraphError, match=r"3 raw files and 1 other photograph, such as a.raw and d.jpg"):
        gather([folder], tmp_path / "other")


# What a scene remembers


def scene_of(folder, exposures=(1.0, 0.5, 0.25, 1.0)):
    """Four pictures with poses, developed from mosaics that lie elsewhere."""
    names = [f"{k}.png" for k in range(4)]
    mosaics = {name: raws.mosaic_of(raws.gradient()) for name in names}
    said = dict(zip(names, exposures, strict=True)) if exposures else None
    elsewhere = raws.write_mosaics(folder / "elsewhere", mosaics, said)
    scene = folder / "scene"
    (scene / "images").mkdir(parents=True)
    frames, remembered = [], {}
    for k, name in enumerate(names):
        Image.fromarray(open_raw(elsewhere / name).developed(1.0)).save(scene / "images" / f"{name}.jpg")
        pose = np.eye(4)
        pose[:3] = tiny.poses(4)[k] @ torch.diag(torch.tensor([1.0, -1, -1, 1]))
        frames.append({"file_path": f"images/{name}.jpg", "transform_matrix": pose.tolist()})
        remembered[f"{name}.jpg"] = {"file": str(elsewhere / name), "brightness": 2.0}
    layout = {"fl_x": 40, "w": 48, "h": 32, "frames": frames}
    (scene / "transforms.json").write_text(json.dumps(layout))
    (scene / "raw.json").write_text(json.dumps({"photographs": remembered}))
    return scene


def test_a_scene_has_the_light_of_its_raw_files(tmp_path):
    scene = open_scene(scene_of(tmp_path))
    shot = scene.photograph(1, layers=("mosaic", "filter"))
    numbers = raws.mosaic_of(raws.gradient())
    np.testing.assert_allclose(shot.extra["mosaic"].numpy(), (numbers - 500.0) / 12_000, atol=1e-6)
    assert shot.extra["filter"][:2, :2].tolist() == [[0, 1], [1, 2]] and scene.layers["filter"].names[2] == "blue"
    assert scene.about["exposure"].tolist() == [1.0, 0.5, 0.25, 1.0] and scene.about["brightness"].tolist() == [2.0] * 4
    np.testing.assert_allclose(scene.about["white_balance"][0], raws.GAINS)
    batch = scene.sample_rays(64, torch.Generator().manual_seed(0), layers=("mosaic", "filter"))
    assert batch.extra["mosaic"].shape == (64,) and set(batch.extra["filter"].tolist()) == {0, 1, 2}


def test_what_is_lacking_is_said(tmp_path):
    folder = scene_of(tmp_path, exposures=None)
    with pytest.warns(LumigraphWarning, match="4 of 4 raw files do not say how long they were exposed"):
        open_scene(folder)
    (tmp_path / "elsewhere" / "2.png").unlink()
    with pytest.raises(LumigraphError, match=r"2.png, from which .* was developed, does not exist"):
        open_scene(folder)


def test_a_folder_of_raw_files_beside_the_photographs_is_found(tmp_path):
    folder = scene_of(tmp_path)
    (folder / "raw.json").unlink()
    assert "mosaic" not in open_scene(folder).layers
    (tmp_path / "elsewhere").rename(folder / "raw")
    for path in (folder / "images").iterdir():
        path.rename(path.with_name(path.name.replace(".png", "")))
    listing = folder / "transforms.json"
    listing.write_text(listing.read_text().replace(".png.jpg", ".jpg"))
    assert len(open_scene(folder).layers["mosaic"]) == 4


# The sensor of procedural scenes


def test_noise_has_the_variance_and_the_mean_that_it_should():
    """Photon transfer: variance = read noise² + worth of a photon · mean, also where the mean is no light at all."""
    sensor = Sensor(sensitivity=0.02)
    for light in (0.0, 0.02, 0.5):
        radiance = np.full((64, 64, 3), light)
        photo = sensor.photograph(lambda radiance=radiance: radiance, (64, 64), 0)
        assert isinstance(photo, RawPhoto)
        green = photo.read()[photo.filters == 1] * (WHITE_LEVEL - BLACK_LEVEL)
        expected = light * 0.02 * (WHITE_LEVEL - BLACK_LEVEL)
        variance = READ_NOISE**2 + DN_PER_PHOTON * expected + 1 / 12
        assert green.mean() == pytest.approx(expected, abs=4 * (variance / green.size) ** 0.5)
        assert green.var() == pytest.approx(variance, rel=0.15)


def test_night_tells_what_it_measured_and_the_light_that_there_was():
    scene = open_scene("procedural:night,size=32,views=3")
    assert sorted(set(scene.about["exposure"].tolist())) == [1 / 16, 1 / 4, 1.0]
    train = [int(i) for i in scene.splits["train"]]
    shots = [scene.photograph(i, layers=("mosaic", "filter", "radiance")) for i in train]
    for index, shot in zip(train, shots, strict=True):
        light = shot.extra["mosaic"] * scene.about["brightness"][index]
        light = light * scene.about["white_balance"][index][shot.extra["filter"]]
        bright = shot.extra["radiance"].amax(-1) < 0.9
        assert float(light[bright].mean()) == pytest.approx(float(shot.extra["radiance"][bright].mean()), rel=0.25)
    assert (shots[0].extra["mosaic"] < 0).any()  # noise below black stays
