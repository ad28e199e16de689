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
