"""Films and photographs that say what their colours are: all give the pixels that a screen in sRGB shows."""

from __future__ import annotations

import io
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pillow_heif
import pytest
import torch
from av.stream import Disposition
from av.video.reformatter import ColorRange, Colorspace
from budgets import budget
from deep_files import write_png16
from PIL import Image, ImageCms, PngImagePlugin

import lumigraph
from lumigraph.color import display
from lumigraph.color.srgb import linear_from_srgb, srgb_from_linear
from lumigraph.color.tags import SRGB_PROFILE
from lumigraph.datasets.mesh import Mesh, MeshTexture
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.export.mesh_file import write_mesh
from lumigraph.export.panorama import save_sphere
from lumigraph.export.video import open_video
from lumigraph.figures import png, save_picture, to_bytes
from lumigraph.files.exr import LUMINANCE, from_luminance
from lumigraph.light import EnvironmentLight
from lumigraph.readers.numbers import read_numbers
from lumigraph.readers.pictures import read_deep, read_image, reads_heic
from lumigraph.readers.profiles import colours_of, curve_of
from lumigraph.sfm.photos import gather
from lumigraph.sfm.photos.film import opened, tags_of

pytestmark = budget("capture", 12)

SIZE = 192, 128
PATCHES = np.array([[200, 40, 30], [40, 170, 60], [50, 60, 190], [128, 128, 128], [230, 225, 215], [20, 25, 30]])


def patches() -> np.ndarray:
    """Six colours, side by side."""
    return np.repeat(np.repeat(PATCHES[None], SIZE[1], 0), SIZE[0] // len(PATCHES), 1).astype(np.uint8)


def means(picture: np.ndarray) -> np.ndarray:
    """The colours of the patches of a picture, away from their edges."""
    height, width = picture.shape[:2]
    step = width // len(PATCHES)
    rows = slice(height // 4, 3 * height // 4)
    return np.array([picture[rows, i * step + step // 4 : (i + 1) * step - step // 4].mean((0, 1)) for i in range(6)])


def signal_of(primaries: int, transfer: int, white: float = display.WHITE) -> np.ndarray:
    """The patches as another screen's signal, 0 to 1; the inverse by search of `display.curve`."""
    light = linear_from_srgb(patches() / 255) @ np.linalg.inv(display.to_bt709(primaries)).T
    curve = display.curve(transfer).astype(np.float64)
    return np.interp(light * (white if transfer in (display.PQ, display.HLG) else 1), curve, np.linspace(0, 1, 65536))


def film(path: Path, signal: np.ndarray, codec: str = "libx264", form: str = "yuv444p", **about) -> Path:
    """A film of 12 frames that are the same. about: attributes of the codec's context, or options as `options`"""
    options = {"crf": "4", **about.pop("options", {})}
    matrix, whole = about.pop("matrix", Colorspace.ITU709), about.pop("whole", False)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=15)
        stream.width, stream.height, stream.pix_fmt = signal.shape[1], signal.shape[0], form
        stream.options = options
        context = stream.codec_context
        context.colorspace, context.color_range = int(matrix), 2 if whole else 1
        for name, value in about.items():
            setattr(context, name, value)
        pixels = np.rint(signal * 65535).astype(np.uint16)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb48le").reformat(
            format=form, dst_colorspace=matrix, dst_color_range=ColorRange.JPEG if whole else ColorRange.MPEG
        )
        for i in range(12):
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def first_picture(path: Path) -> np.ndarray:
    with opened(path) as one:
        return np.asarray(one.picture(next(one.frames())[0]))


PLAIN = patches() / 255


@pytest.mark.parametrize(
    ("name", "options"),
    {
        "BT.709": {},
        "full range": {"whole": True},
        "BT.601 of a large film": {"matrix": Colorspace.ITU601, "color_primaries": 6, "color_trc": 6, "primaries": 6},
        "Display P3": {"color_primaries": 12, "color_trc": 13, "primaries": 12},
        "BT.2020, no HDR": {"matrix": Colorspace.BT2020, "color_primaries": 9, "color_trc": 14, "primaries": 9},
        "gamma 2.8": {"color_primaries": 5, "color_trc": 5, "primaries": 5, "transfer": 5},
    }.items(),
)
def test_films_of_other_screens_look_as_they_do_there(tmp_path, name, options):
    signal = PLAIN
    primaries, transfer = options.pop("primaries", 1), options.pop("transfer", 1)
    if (primaries, transfer) != (1, 1):
        signal = signal_of(primaries, transfer)
    path = film(tmp_path / "a.mp4", signal, **options)
    np.testing.assert_allclose(means(first_picture(path)), PATCHES, atol=3, err_msg=name)


@pytest.mark.parametrize(("transfer", "white"), [(display.PQ, 203), (display.HLG, 203), (display.HLG, 1000)])
def test_films_of_hdr_keep_the_colours_below_white(tmp_path, transfer, white):
    signal = signal_of(display.BT2020, transfer, white)
    path = film(
        tmp_path / "a.mov", signal, "libx265", "yuv444p10le", matrix=Colorspace.BT2020, color_primaries=9,
        color_trc=transfer, options={"x265-params": "log-level=none"},
    )  # fmt: skip
    tags = tags_of(path)
    assert (tags.transfer, tags.primaries, tags.matrix, tags.white) == (transfer, 9, 9, white)
    np.testing.assert_allclose(means(first_picture(path)), PATCHES, atol=4)


def test_what_is_brighter_than_white_is_rolled_off():
    light = np.array([[10.0, 10, 10], [90, 90, 90], [203, 203, 203], [600, 300, 150], [1000, 1000, 1000]], np.float32)
    shown = display.rolled_off(light, 203, 1000)
    assert (np.diff(shown.max(1)) > 0).all() and shown.max() == pytest.approx(203, rel=1e-3)
    # 1.2e-5 off where a processor's powers are of single precision, and exact where they are not
    np.testing.assert_allclose(shown[:1], light[:1], rtol=3e-5)
    np.testing.assert_allclose(shown[3] / shown[3, 0], [1, 0.5, 0.25], rtol=1e-5)
    assert display.rolled_off(light, 203, 200) is light


def test_pixels_become_square_and_frames_whole(tmp_path):
    narrow = film(tmp_path / "a.mp4", PLAIN[:, ::2], sample_aspect_ratio=2)
    assert first_picture(narrow).shape[:2] == (SIZE[1], SIZE[0])
    np.testing.assert_allclose(means(first_picture(narrow)), PATCHES, atol=3)
    fields = {"x264-params": "tff=1", "flags": "+ildct+ilme"}
    lined = film(tmp_path / "b.mp4", PLAIN, options=fields)
    with opened(lined) as one:
        assert one.tags.interlaced and len(list(one.frames())) == 12


def mirrored(film: bytes, width: int) -> bytes:
    """An MP4 file whose display matrix mirrors it."""
    begin = film.index(b"tkhd") + 4 + 4 + 20 + 16
    return film[:begin] + struct.pack(">9i", -65536, 0, 0, 0, 65536, 0, width << 16, 0, 1 << 30) + film[begin + 36 :]


def test_a_mirrored_film_is_turned_back(tmp_path):
    path = film(tmp_path / "a.mp4", PLAIN)
    path.write_bytes(mirrored(path.read_bytes(), SIZE[0]))
    np.testing.assert_allclose(means(first_picture(path)), PATCHES[::-1], atol=3)


def test_a_cover_is_no_film(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 64, 64, "yuvj420p"
        cover.disposition = Disposition.attached_pic
        stream = container.add_stream("libx264", rate=15)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv444p"
        container.mux(cover.encode(av.VideoFrame(64, 64, "yuvj420p")))
        frame = av.VideoFrame.from_ndarray(patches())
        for _ in range(12):
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        container.mux(cover.encode(None))
    assert first_picture(path).shape[:2] == SIZE[::-1]


def test_colours_that_are_not_known_are_told(tmp_path):
    path = film(tmp_path / "a.mp4", PLAIN, color_primaries=10, color_trc=17)
    assert "are not converted" in tags_of(path).fault
    assert any("are not converted" in text for text in gather([path], tmp_path / "work").remarks)


# Photographs


def icc(primaries: int, gamma: float) -> bytes:
    """A profile of a matrix and a gamma (ICC.1)."""
    white = np.array([0.9642, 1.0, 0.8249])
    to_d50 = np.linalg.inv(
        np.array(
            [
                [3.1338561, -1.6168667, -0.4906146],
                [-0.9787684, 1.9161415, 0.0334540],
                [0.0719453, -0.2289914, 1.4052427],
            ]
        )
    )  # of linear sRGB; fmt: skip
    columns = to_d50 @ display.to_bt709(primaries)

    def xyz(values: np.ndarray) -> bytes:
        return b"XYZ " + bytes(4) + struct.pack(">3i", *np.rint(values * 65536).astype(int))

    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)
    text = b"desc" + bytes(4) + struct.pack(">I", 5) + b"made\0" + bytes(79)
    bodies = {
        b"desc": text,
        b"wtpt": xyz(white),
        b"rTRC": curve,
        b"gTRC": curve,
        b"bTRC": curve,
        b"cprt": b"text" + bytes(8),
    }
    bodies |= {name: xyz(column) for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns.T, strict=True)}
    at, table, data = 132 + 12 * len(bodies), b"", b""
    for name, body in bodies.items():
        table += name + struct.pack(">II", at + len(data), len(body))
        data += body + bytes(-len(body) % 4)
    head = bytearray(128)
    head[8:12], head[12:24] = b"\x02\x10\0\0", b"mntrRGB XYZ "
    head[36:40], head[68:80] = b"acsp", struct.pack(">3i", *np.rint(white * 65536).astype(int))
    whole = bytes(head) + struct.pack(">I", len(bodies)) + table + data
    return struct.pack(">I", len(whole)) + whole[4:]


def wide(primaries: int, gamma: float) -> np.ndarray:
    """The patches in another space, from 0 to 1."""
    light = linear_from_srgb(patches() / 255) @ np.linalg.inv(display.to_bt709(primaries)).T
    return light.clip(0, 1) ** (1 / gamma)


def as_bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(255 * values).astype(np.uint8)


P3 = icc(display.P3, 2.2)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".avif", ".heic"])
def test_photographs_with_a_profile_are_read_as_srgb(tmp_path, suffix):
    assert reads_heic()
    path, options = tmp_path / f"a{suffix}", {} if suffix in (".png", ".tif") else {"quality": 98}
    options |= {".jpg": {"subsampling": 0}, ".avif": {"subsampling": "4:4:4"}}.get(suffix, {})
    image = Image.fromarray(as_bytes(wide(display.P3, 2.2)))
    if suffix == ".heic":
        pillow_heif.from_pillow(image).save(path, icc_profile=P3, quality=98)
    else:
        image.save(path, icc_profile=P3, **options)
    lossy = 7 if suffix == ".avif" else 4
    np.testing.assert_allclose(means(read_image(path, True, SIZE)), PATCHES, atol=lossy)


def test_profiles_in_other_places_count_too(tmp_path):
    pixels = Image.fromarray(as_bytes(wide(display.P3, 2.2)))
    chunk = PngImagePlugin.PngInfo()
    chunk.add(b"cICP", bytes([display.P3, 4, 0, 1]))
    pixels.save(tmp_path / "a.png", pnginfo=chunk)
    pixels.save(tmp_path / "b.tif", icc_profile=P3, compression="lzw")
    adobe = Image.Exif()
    adobe.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.fromarray(as_bytes(wide(display.ADOBE, 563 / 256))).save(
        tmp_path / "c.jpg", exif=adobe, quality=98, subsampling=0
    )
    srgb = Image.fromarray(as_bytes(signal_of(display.P3, 13)))
    pillow_heif.from_pillow(srgb).save(
        tmp_path / "d.heic", quality=98, color_primaries=12, transfer_characteristics=13, matrix_coefficients=1,
        full_range_flag=1,
    )  # fmt: skip
    for name in ("a.png", "b.tif", "c.jpg", "d.heic"):
        np.testing.assert_allclose(means(read_image(tmp_path / name, True, SIZE)), PATCHES, atol=4, err_msg=name)


def with_profile(png: bytes, profile: bytes) -> bytes:
    """A PNG file with a profile, behind its header."""
    body = b"iCCP" + b"made\0\0" + zlib.compress(profile)
    return png[:33] + struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body)) + png[33:]


def test_sixteen_bits_keep_their_precision(tmp_path):
    ramp = np.linspace(0.2, 0.3, SIZE[0])
    values = np.repeat(np.repeat(ramp[None, :, None], SIZE[1], 0), 3, -1)
    deep = np.rint(values * 65535).astype(np.uint16)
    write_png16(tmp_path / "plain.png", deep)
    (tmp_path / "a.png").write_bytes(with_profile((tmp_path / "plain.png").read_bytes(), P3))
    found = read_deep(tmp_path / "a.png", True)
    assert found.dtype == np.uint16 and len(np.unique(found)) > 150
    expected = srgb_from_linear(values**2.2)  # grey has the same primaries
    np.testing.assert_allclose(found / 65535, expected, atol=2e-3)


def test_grey_cmyk_and_damaged_profiles(tmp_path):
    grey = Image.fromarray(np.tile(np.arange(0, 192, dtype=np.uint8), (128, 1)))
    gamma = ImageCms.ImageCmsProfile(io.BytesIO(SRGB_PROFILE)).tobytes()
    grey.save(tmp_path / "grey.png", icc_profile=gamma)  # of colours, where the picture is grey: passed over
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png", True, SIZE)[0, :, 0], np.arange(192))
    Image.fromarray(patches()).convert("CMYK").save(tmp_path / "c.jpg", quality=98, icc_profile=b"no profile")
    np.testing.assert_allclose(means(read_image(tmp_path / "c.jpg", True, SIZE)), PATCHES, atol=4)
    Image.fromarray(patches()).save(tmp_path / "d.png", icc_profile=P3[:200])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(means(read_image(tmp_path / "d.png", True, SIZE)), PATCHES)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


@pytest.mark.parametrize(("amplitude", "least", "most"), [(0, 45, 70), (25, 30, 40)])
def test_one_picture_in_two_profiles_agrees_as_far_as_jpeg_lets_it(tmp_path, amplitude, least, most):
    """Each file is rounded by JPEG on its own, quality 82 and 4:2:0, and a reading sees the sum of both errors.

    A photograph of 144 x 256 pixels with its saturation doubled, as Display P3 and as sRGB: 36.4 dB between the two
    with an exact conversion in floats; 36.9 dB at 4:4:4, so chroma is not the cause; 57.2 dB without JPEG, which is the
    8 bits of P3; one JPEG alone 39.5 dB. Every intent, with black point compensation or without, agrees to 0.03 dB. A
    textured picture therefore cannot reach 40 dB by any reading, and a smooth one must. What is held here besides is
    that the reading loses nothing to an exact one.
    """
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    waves = np.stack([np.sin(x / 31 + i) * np.cos(y / (23 + 5 * i)) for i in range(3)], -1)
    rng = np.random.default_rng(0)
    picture = np.clip(128 + 60 * waves + amplitude * rng.standard_normal((*SIZE[::-1], 3)), 0, 255) / 255
    matrix = display.to_bt709(display.P3)
    light = linear_from_srgb(picture) @ np.linalg.inv(matrix).T
    for name, values, more in (("p3", light.clip(0, 1) ** (1 / 2.2), {"icc_profile": P3}), ("srgb", picture, {})):
        Image.fromarray(as_bytes(values)).save(tmp_path / f"{name}.jpg", quality=82, subsampling=2, **more)
    found, other = (np.asarray(read_image(tmp_path / f"{name}.jpg", True, SIZE)) for name in ("p3", "srgb"))
    with Image.open(tmp_path / "p3.jpg") as coded:
        exact = 255 * srgb_from_linear(((np.asarray(coded) / 255) ** (563 / 256) @ matrix.T).clip(0, 1))
    assert least < psnr(found, other) < most
    assert psnr(found, exact) > 52  # 8 bits of the result, and lcms's own
    assert psnr(found, other) > psnr(np.rint(exact), other) - 0.1


def test_copies_are_srgb_and_say_so(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    image = Image.fromarray(as_bytes(wide(display.P3, 2.2)))
    image.save(tmp_path / "a.jpg", icc_profile=P3, quality=98, subsampling=0, exif=exif)
    photo = gather([tmp_path / "a.jpg"], tmp_path / "work").photos[0]
    with Image.open(photo.path) as copy:
        assert copy.info["icc_profile"] == SRGB_PROFILE and copy.size == SIZE[::-1]
        np.testing.assert_allclose(means(np.rot90(np.asarray(copy))), PATCHES, atol=5)


def glb_texture(path: Path) -> bytes:
    data = path.read_bytes()
    return data[data.index(b"\xff\xd8\xff") :]


def in_archive(path: Path) -> bytes:
    with zipfile.ZipFile(path) as packed:
        return packed.read("colours.png")


RGB = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0))
TRIANGLE = np.eye(3), np.array([[0, 1, 2]])
PAINTED = Mesh(*TRIANGLE, np.zeros((3, 3), np.uint8), MeshTexture(np.eye(3)[:, :2], to_bytes(RGB).numpy(), None))
WRITERS: dict[str, Callable[[Path], object]] = {  # of pictures, by a file that one writes or that holds one
    "figure.png": lambda path: save_picture(path, RGB),
    "notebook.png": lambda path: path.write_bytes(png(RGB)),
    "sphere.png": lambda path: save_sphere(path, RGB, whole=True),
    "sphere.jpg": lambda path: save_sphere(path, RGB, whole=True),
    "mesh.glb": lambda path: write_mesh(path, PAINTED),
    "mesh.usdz": lambda path: write_mesh(path, PAINTED),
    "mesh.png": lambda path: write_mesh(path.with_suffix(".obj"), PAINTED),
}


@pytest.mark.parametrize("name", WRITERS)
def test_pictures_that_are_written_are_tagged_srgb(tmp_path, name):
    WRITERS[name](path := tmp_path / name)
    data = {".glb": glb_texture, ".usdz": in_archive}.get(path.suffix, Path.read_bytes)(path)
    with Image.open(io.BytesIO(data)) as image:
        assert image.info.get("srgb") == 0 or image.info.get("icc_profile") == SRGB_PROFILE
        assert colours_of(image).are_srgb and ("xmp" in str(image.info).lower()) == name.startswith("sphere")


def test_films_that_are_written_are_tagged_bt709(tmp_path):
    with open_video(tmp_path / "a.mp4") as film:
        film.add(to_bytes(RGB))
    tags = tags_of(tmp_path / "a.mp4")
    assert (tags.primaries, tags.transfer, tags.matrix, tags.full_range) == (1, 1, 1, False)


def test_pictures_without_a_tag_hold_numbers_or_lie_in_a_page():
    """Everything else is written by `color.tags`."""
    package, known = Path(lumigraph.__file__).parent, {
        "app/pictures.py", "app/reduce.py", "export/page.py",  # for browsers, which take them for sRGB
        "datasets/images/stream.py", "derive/parts.py", "exchange/snerg.py", "exchange/sog.py", "export/depth.py",
        "export/usdz.py", "light/probes/storage.py", "reading/data.py", "readers/objects/__init__.py", "sfm/folder.py",
    }  # fmt: skip
    untagged = re.compile(r'\.save\(.*"(PNG|JPEG|WEBP|png)"|(fromarray|to_image)\(.*\)\.save\(')
    found = {str(x.relative_to(package)) for x in package.rglob("*.py") if untagged.search(x.read_text())}
    assert found == known


def test_curves_of_profiles():
    x = np.linspace(0, 1, 1 << 16)

    def body(kind: int, *numbers: float) -> bytes:
        return b"para" + bytes(4) + struct.pack(f">HH{len(numbers)}i", kind, 0, *(round(v * 65536) for v in numbers))

    np.testing.assert_allclose(
        curve_of(body(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)), linear_from_srgb(x), atol=1e-4
    )
    np.testing.assert_allclose(curve_of(body(0, 1.8)), x**1.8, atol=1e-4)
    table = b"curv" + bytes(4) + struct.pack(">I3H", 3, 0, 16384, 65535)
    assert curve_of(table)[32768] == pytest.approx(0.25, abs=1e-3)


def test_raw_files_beside_their_pictures_count_once(tmp_path):
    rng = np.random.default_rng(0)
    for i in range(3):
        Image.fromarray(rng.integers(0, 255, (64, 96, 3), dtype=np.uint8)).save(tmp_path / f"DSC_{i}.JPG")
        (tmp_path / f"DSC_{i}.NEF").write_bytes(b"MM\0*" + bytes(60))
    found = gather([tmp_path], tmp_path / "work")
    assert [photo.name for photo in found.photos] == ["DSC_0.JPG", "DSC_1.JPG", "DSC_2.JPG"]
    assert "3 photographs are raw files with pictures beside them" in found.remarks[0]


# OpenEXR


def exr(path: Path, channels: dict[str, np.ndarray], **header) -> Path:
    import OpenEXR

    named = {name: OpenEXR.Channel(name, values, *steps) for name, (values, *steps) in channels.items()}
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    with OpenEXR.File(about, named) as file:
        file.write(str(path))
    return path


def test_exr_of_all_kinds(tmp_path):
    import OpenEXR

    random = np.random.default_rng(0)
    light = random.uniform(0.1, 2, (36, 48, 3)).astype(np.float32)
    by_name = {name: (light[..., i].copy(),) for i, name in enumerate("RGB")}
    for i, compression in enumerate((OpenEXR.PXR24_COMPRESSION, OpenEXR.PIZ_COMPRESSION, OpenEXR.DWAA_COMPRESSION)):
        found = read_numbers(exr(tmp_path / f"{i}.exr", by_name, compression=compression))
        np.testing.assert_allclose(found, light, rtol=0.05)
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    np.testing.assert_array_equal(read_numbers(exr(tmp_path / "t.exr", by_name, **tiles)), light)
    layered = {f"beauty.{name}": values for name, values in by_name.items()} | {"depth.Z": (light[..., 0].copy(),)}
    np.testing.assert_array_equal(read_numbers(exr(tmp_path / "l.exr", layered)), light)
    flat = np.repeat(np.repeat(light[::2, ::2], 2, 0), 2, 1)
    y = (flat @ LUMINANCE).astype(np.float32)
    chroma = [((flat[..., i] - y) / y)[::2, ::2].astype(np.float32).copy() for i in (0, 2)]
    np.testing.assert_allclose(from_luminance(y, *chroma), flat, rtol=1e-4)
    part = {"dataWindow": (np.array([10, 5], np.int32), np.array([57, 40], np.int32)),
            "displayWindow": (np.array([0, 0], np.int32), np.array([59, 49], np.int32))}  # fmt: skip
    found = read_numbers(exr(tmp_path / "w.exr", by_name, **part))
    assert found.shape == (50, 60, 3) and not found[:5].any() and np.array_equal(found[5:41, 10:58], light)
    light[3, 4] = np.nan, np.inf, 1
    bad = exr(tmp_path / "n.exr", {name: (light[..., i].copy(),) for i, name in enumerate("RGB")})
    with pytest.warns(LumigraphWarning, match="1 pixels that are not finite"):
        assert read_image(bad, True, (48, 36))[3, 4].tolist() == [0, 0, 255]


def test_maps_of_other_shapes_are_named(tmp_path):
    for size, what in (((24, 144), "cube map"), ((64, 64), "mirrored ball"), ((50, 64), r"64 x 50 pixels;")):
        values = np.ones(size, np.float32)
        path = exr(tmp_path / f"{size[0]}.exr", {name: (values,) for name in "RGB"})
        with pytest.raises(LumigraphError, match=what):
            EnvironmentLight.open(path)
