"""Environment light: orientation, files, sums over the sphere, and sentences about maps that are none."""

from __future__ import annotations

import math
from fractions import Fraction

import av
import numpy as np
import pytest
import torch
from budgets import budget
from PIL import Image

from lumigraph.camera.lens import Equirectangular
from lumigraph.errors import LumigraphError
from lumigraph.geometry import look_at
from lumigraph.light import EnvironmentLight, direction, directions

pytestmark = budget("capture", 3)


def ramp(rows: int = 16) -> torch.Tensor:
    return torch.rand(rows, 2 * rows, 3, generator=torch.Generator().manual_seed(0)) * 20


def save(path, values: np.ndarray) -> None:
    """Write a map as Radiance HDR or OpenEXR, by FFmpeg."""
    codec = av.CodecContext.create(path.suffix[1:], "w")
    codec.height, codec.width = values.shape[:2]
    codec.pix_fmt, codec.time_base = "gbrpf32le", Fraction(1)
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(values, np.float32), format="gbrpf32le")
    path.write_bytes(b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)]))


def test_map_is_what_an_upright_camera_along_y_sees():
    rows, columns = 6, 12
    pose = look_at(torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    pixels = torch.stack(torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy"), -1) + 0.5
    lens = Equirectangular(torch.tensor([[float(columns), float(rows)]]))
    seen = lens.unproject(pixels.reshape(-1, 2), torch.zeros(rows * columns, dtype=torch.long)) @ pose[:, :3].T
    assert torch.allclose(seen.reshape(rows, columns, 3), directions(rows, columns), atol=1e-6)


def test_cardinal_directions():
    light = EnvironmentLight(ramp(32))
    middle = light.radiance[15:17, [31, 32]].mean((0, 1))
    assert torch.allclose(light.at(direction(0, 0)[None])[0], middle, atol=1e-4)
    right = light.radiance[15:17, [47, 48]].mean((0, 1))
    assert torch.allclose(light.at(torch.tensor([[1.0, 0.0, 0.0]]))[0], right, atol=1e-4)
    assert torch.allclose(light.at(light.directions.reshape(-1, 3)), light.radiance.reshape(-1, 3), atol=1e-2)


@pytest.mark.parametrize("suffix", [".hdr", ".exr", ".npy", ".png"])
def test_files_keep_rows_and_colours(tmp_path, suffix):
    path, values = tmp_path / f"light{suffix}", ramp().numpy()
    if suffix == ".npy":
        np.save(path, values)
    elif suffix == ".png":
        values = values / 20
        encoded = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
        Image.fromarray((encoded * 255 + 0.5).astype(np.uint8)).save(path)
    else:
        save(path, values)
    found = EnvironmentLight.open(path).radiance.numpy()
    tolerance = {".hdr": 0.01, ".png": 0.01}.get(suffix, 1e-6) * values.max(-1, keepdims=True).clip(0.5)
    assert (np.abs(found - values) <= tolerance).all()


def rgbe(values: np.ndarray) -> np.ndarray:
    """Bytes of mantissas and exponent (Ward 1991)."""
    most = values.max(-1)
    exponent = np.where(most > 0, np.frexp(most)[1], -128)
    mantissas = np.floor(values / np.ldexp(1.0, exponent)[..., None] * 256)
    return np.concatenate([mantissas, exponent[..., None] + 128], -1).astype(np.uint8)


def runs(line: np.ndarray) -> bytes:
    """A line of runs for each channel: pairs of equal bytes as runs, the others one by one."""
    found = bytes((2, 2, len(line) >> 8, len(line) & 255))
    for channel in line.T.tolist():
        at = 0
        while at < len(channel):
            twice = channel[at : at + 2] == [channel[at]] * 2
            found += bytes((130, channel[at]) if twice else (1, channel[at]))
            at += 2 if twice else 1
    return found


def repeats(line: np.ndarray) -> bytes:
    """A line of the first format: a pixel, then how often it is repeated."""
    found, at = b"", 0
    while at < len(line):
        same = 1
        while at + same < len(line) and (line[at + same] == line[at]).all() and same < 250:
            same += 1
        found += line[at].tobytes() + (bytes((1, 1, 1, same - 1)) if same > 1 else b"")
        at += same
    return found


def write_radiance(path, values, order="-Y +X", lines="FORMAT=32-bit_rle_rgbe", encode=runs, first="#?RADIANCE"):
    """A Radiance picture whose lines are in an order."""
    turned = values if "Y" in order[:2] else values.swapaxes(0, 1)
    flips = [sign != ("-" if axis == "Y" else "+") for sign, axis in (order[:2], order[3:])]
    turned = turned[:: -1 if flips[0] else 1, :: -1 if flips[1] else 1]
    size = f"{order[:2]} {turned.shape[0]} {order[3:]} {turned.shape[1]}"
    pixels = b"".join(encode(line) for line in rgbe(turned))
    path.write_bytes(f"{first}\n{lines}\n\n{size}\n".encode() + pixels)


@pytest.mark.parametrize("order", ["-Y +X", "+Y +X", "-Y -X", "+X -Y", "-X +Y", "+X +Y"])
@pytest.mark.parametrize("encode", [runs, repeats, np.ndarray.tobytes])
def test_radiance_of_every_order_and_encoding(tmp_path, order, encode):
    values = ramp(8).numpy()
    values[2:4, 3:9] = values[2, 3]
    values[5] = 0
    write_radiance(tmp_path / "light.hdr", values, order, encode=encode)
    found = EnvironmentLight.open(tmp_path / "light.hdr").radiance.numpy()
    assert (np.abs(found - values) <= values.max(-1, keepdims=True) / 128).all()


@pytest.mark.parametrize(
    ("lines", "factor"),
    [
        ("#?RADIANCE\nFORMAT=32-bit_rle_rgbe", 1.0),
        ("# made by hand\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2.0\nEXPOSURE= 4", 0.125),
        ("SOFTWARE=x\nGAMMA=1\nPRIMARIES=0.64 0.33 0.3 0.6 0.15 0.06 0.3127 0.329\nFORMAT=32-bit_rle_rgbe", 1.0),
        ("COLORCORR= 2 2 2\nFORMAT=32-bit_rle_rgbe", 0.5),
    ],
)
def test_headers_of_radiance(tmp_path, lines, factor):
    values = ramp(8).numpy()
    for first in ("#?RADIANCE", "#?RGBE"):
        write_radiance(tmp_path / "light.hdr", values, lines=lines, first=first)
        found = EnvironmentLight.open(tmp_path / "light.hdr").radiance.numpy()
        assert (np.abs(found - factor * values) <= factor * values.max(-1, keepdims=True) / 128).all()


def test_radiance_in_xyz_and_faults(tmp_path):
    path, white = tmp_path / "light.hdr", np.full((8, 16, 3), 4.0)
    write_radiance(path, white, lines="FORMAT=32-bit_rle_xyze")
    assert EnvironmentLight.open(path).radiance.sub(4).abs().max() < 0.05
    whole = path.read_bytes()
    for broken in (whole[:-9], whole[:40], whole.replace(b"-Y 8 +X 16", b"-Y 80000 +X 160000"), b"#?RADIANCE\n\n"):
        path.write_bytes(broken)
        with pytest.raises(LumigraphError, match="cannot be read"):
            EnvironmentLight.open(path)


def test_resizing_keeps_energy_and_mean():
    light = EnvironmentLight(ramp(24))
    smaller, odd = light.resized(16, 32), light.resized(7, 10)
    energy = [(x.radiance * x.solid_angles[..., None]).sum((0, 1)) for x in (light, smaller, odd)]
    assert torch.allclose(energy[0], energy[1], rtol=1e-4) and torch.allclose(energy[0], energy[2], rtol=1e-4)
    assert abs(float(light.solid_angles.sum()) - 4 * math.pi) < 1e-4


def test_turning_moves_the_sun_and_the_map_together():
    light = EnvironmentLight.outdoors(20, 30)
    turned = light.turned(90)
    assert torch.allclose(turned.toward[0], direction(110, 30), atol=1e-5)
    marked = torch.zeros(16, 32, 3)
    marked[8, 16] = 1
    there = EnvironmentLight(marked).turned(90).radiance[..., 0].argmax()
    assert (int(there) // 32, int(there) % 32) == (8, 24)


def test_white_matt_surfaces_have_the_radiance_that_sun_and_sky_are_given_in():
    """Radiance of white is irradiance over pi."""
    up = torch.tensor([[0.0, 0.0, 1.0]])
    sky = EnvironmentLight.outdoors(0, 90, sun=0.0, sky=0.4).irradiance_on(up) / math.pi
    assert abs(float(sky.mean()) - 0.4) < 0.005
    sun = EnvironmentLight.outdoors(70, 35, sun=2.0, sky=0.0)
    facing = sun.irradiance_on(direction(70, 35)[None]) / math.pi
    assert abs(float(facing[0, 0]) - 2.0) < 1e-5
    assert torch.allclose(EnvironmentLight.uniform().irradiance_on(up) / math.pi, torch.ones(1, 3), atol=0.005)
    assert float(EnvironmentLight.outdoors(0, -5, sky=0.0).irradiance_on(up).max()) == 0


def test_harmonics_give_irradiance():
    """Three bands hold the irradiance of a smooth light (Ramamoorthi and Hanrahan 2001, eq. 9)."""
    from lumigraph.kernels import spherical_harmonics

    d = directions(32, 64)
    light = EnvironmentLight((1 + d[..., :1] + 0.5 * d[..., 2:] ** 2).expand(32, 64, 3).contiguous())
    normals = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    cosine = torch.tensor([math.pi, *[2 * math.pi / 3] * 3, *[math.pi / 4] * 5])
    found = spherical_harmonics(normals, 3) @ (cosine[:, None] * light.harmonics(3))
    assert torch.allclose(found, light.irradiance_on(normals), rtol=0.01)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (np.ones((1, 3, 3), np.float32), "3 x 1 pixels"),
        (np.ones((16, 20, 3), np.float32), "twice as wide as high"),
        (np.full((8, 16, 3), -1, np.float32), "384 values that are negative or not finite"),
        (np.full((8, 16, 3), np.nan, np.float32), "not finite"),
    ],
)
def test_maps_that_are_none(tmp_path, values, sentence):
    np.save(tmp_path / "light.npy", values)
    with pytest.raises(LumigraphError, match=sentence):
        EnvironmentLight.open(tmp_path / "light.npy")


def test_files_that_are_no_maps(tmp_path):
    save(tmp_path / "three.hdr", np.ones((1, 3, 3)))
    (tmp_path / "text.exr").write_text("no picture")
    (tmp_path / "light.jpg").write_text("")
    for name, sentence in [
        ("three.hdr", "pixels"),
        ("text.exr", "cannot be read"),
        ("light.jpg", "by its name"),
        ("gone.hdr", "does not exist"),
    ]:
        with pytest.raises(LumigraphError, match=sentence):
            EnvironmentLight.open(tmp_path / name)
