"""Clouds of Gaussians come back from every format as near as it promises; files assembled by hand; every fault."""

from __future__ import annotations

import contextlib
import gzip
import math
import os
import struct
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from budgets import budget
from listing import names
from ply_files import ply_file

from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.exchange import REORDERED, SUFFIXES, is_splat_file, read_gaussians, write_gaussians
from lumigraph.exchange.codes import morton_order
from lumigraph.exchange.spz import gzipped
from lumigraph.files.ply import read_rows, write_rows
from lumigraph.gaussians import Gaussians, turned
from lumigraph.geometry import to_matrix
from lumigraph.kernels import spherical_harmonics

pytestmark = budget("exports", 10)

C0 = math.sqrt(1 / (4 * math.pi))
HALF_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # between the axes of .spz and those of .ply
MATRIX = [".ply", ".compressed.ply", ".spz"]  # the formats that hold any number of Gaussians of any degree


def make(count: int, degree: int = 3, antialiased: bool = False, seed: int = 0) -> Gaussians:
    """Gaussians within what every format can say: scales from e^-8 to e^-2, colours in [0, 1], harmonics in ±0.9."""
    g = torch.Generator().manual_seed(seed)
    harmonics = torch.rand(count, (degree + 1) ** 2, 3, generator=g) * 1.8 - 0.9
    harmonics[:, 0] = (torch.rand(count, 3, generator=g) - 0.5) / C0
    return Gaussians(
        torch.randn(count, 3, generator=g),
        torch.randn(count, 4, generator=g) * 3,
        torch.rand(count, 3, generator=g) * 6 - 8,
        torch.randn(count, generator=g) * 2,
        harmonics,
        antialiased,
    )


def same(a: Gaussians, b: Gaussians) -> bool:
    return a.antialiased == b.antialiased and all(
        torch.equal(getattr(a, field.name), getattr(b, field.name))
        for field in fields(a)
        if field.name != "antialiased"
    )


def round_trip(gaussians: Gaussians, path: Path) -> Gaussians:
    """Through a file and back; Morton's order undone where a format has it."""
    write_gaussians(path, gaussians)
    found = read_gaussians(path)
    if path.name.endswith(REORDERED):
        order = torch.from_numpy(morton_order(gaussians.means.numpy()))
        found = found[order.argsort()]
    return found


def components_apart(a: Gaussians, b: Gaussians) -> float:
    """The largest difference between components of unit quaternions, where q and -q are the same rotation."""
    a, b = (torch.nn.functional.normalize(x.quaternions.double(), dim=-1) for x in (a, b))
    b = b * (a * b).sum(-1, keepdim=True).sign()
    return float((a - b).abs().max()) if len(a) else 0.0


def opacity_apart(a: Gaussians, b: Gaussians) -> float:
    return float((a.opacities.sigmoid() - b.opacities.sigmoid()).abs().max()) if len(a) else 0.0


def apart(a: torch.Tensor, b: torch.Tensor) -> float:
    assert a.shape == b.shape
    return float((a - b).abs().max()) if a.numel() else 0.0


def chunk_range(values: torch.Tensor, means: torch.Tensor) -> float:
    """The widest range of a quantity within any 256 Gaussians that stand together in a compressed PLY file."""
    order = torch.from_numpy(morton_order(means.numpy()))
    parts = values[order].split(256)
    return max(float((part.amax(0) - part.amin(0)).max()) for part in parts)


# --- round trips ---


@pytest.mark.parametrize("count", [0, 1, 257])
@pytest.mark.parametrize("degree", range(4))
def test_ply_keeps_everything(tmp_path, degree, count):
    for antialiased in (False, True):
        cloud = make(count, degree, antialiased)
        before = replace(cloud, means=cloud.means.clone(), harmonics=cloud.harmonics.clone())
        assert same(round_trip(cloud, tmp_path / "a.ply"), cloud)
        assert same(cloud, before)
    assert (tmp_path / "a.ply").stat().st_size - (56 + 12 * (degree + 1) ** 2) * count < 2000


@pytest.mark.parametrize("count", [0, 1, 257])
@pytest.mark.parametrize("degree", range(4))
def test_spz_keeps_what_it_promises(tmp_path, degree, count):
    cloud = make(count, degree, antialiased=degree % 2 == 1)
    found = round_trip(cloud, tmp_path / "a.spz")
    assert (len(found), found.degree, found.antialiased) == (count, degree, cloud.antialiased)
    assert apart(found.means, cloud.means) <= 2**-17 + 1e-6
    assert apart(found.log_scales, cloud.log_scales) <= 1 / 32 + 1e-5
    assert components_apart(found, cloud) <= 0.0021  # the largest is worked out from the others
    assert opacity_apart(found, cloud) <= 1 / 510 + 1e-6
    assert C0 * apart(found.harmonics[:, :1], cloud.harmonics[:, :1]) <= 0.0037
    assert apart(found.harmonics[:, 1:4], cloud.harmonics[:, 1:4]) <= 1 / 32 + 1e-6
    assert apart(found.harmonics[:, 4:], cloud.harmonics[:, 4:]) <= 1 / 16 + 1e-6


@pytest.mark.parametrize("count", [0, 1, 257, 1025])
@pytest.mark.parametrize("degree", range(4))
def test_compressed_ply_keeps_what_it_promises(tmp_path, degree, count):
    cloud = make(count, degree, antialiased=degree % 2 == 1)
    found = round_trip(cloud, tmp_path / "a.compressed.ply")
    assert (len(found), found.degree, found.antialiased) == (count, degree, cloud.antialiased)
    if count:
        assert apart(found.means, cloud.means) <= chunk_range(cloud.means, cloud.means) / 2046 + 1e-6
        assert apart(found.log_scales, cloud.log_scales) <= chunk_range(cloud.log_scales, cloud.means) / 2046 + 1e-6
        colours = chunk_range(cloud.harmonics[:, 0], cloud.means)
        assert apart(found.harmonics[:, 0], cloud.harmonics[:, 0]) <= colours / 510 + 1e-5
    assert components_apart(found, cloud) <= 0.0021
    assert opacity_apart(found, cloud) <= 1 / 510 + 1e-6
    assert apart(found.harmonics[:, 1:], cloud.harmonics[:, 1:]) <= 1 / 64 + 1e-6


@pytest.mark.parametrize("count", [1, 257])
@pytest.mark.parametrize("degree", range(4))
def test_splat_keeps_what_it_promises(tmp_path, degree, count):
    cloud = make(count, degree, antialiased=True)
    found = round_trip(cloud, tmp_path / "a.splat")
    assert (tmp_path / "a.splat").stat().st_size == 32 * count
    assert (len(found), found.degree, found.antialiased) == (count, 0, False)
    assert torch.equal(found.means, cloud.means)
    assert apart(found.log_scales, cloud.log_scales) <= 1e-6
    assert components_apart(found, cloud) <= 1 / 100
    assert opacity_apart(found, cloud) <= 1 / 510 + 1e-6
    assert C0 * apart(found.harmonics, cloud.harmonics[:, :1]) <= 1 / 510 + 1e-6


@pytest.mark.parametrize(
    ("suffix", "error"),
    [(".splat", 0), (".spz", 2**-17 + 1e-6), (".compressed.ply", 4e-3), (".sog", 2e-4), (".glb", 0)],
)
def test_what_was_rounded_once_stays(tmp_path, suffix, error):
    """ply -> format -> ply: the second time through a format changes (almost) nothing, and .ply nothing at all."""
    original = round_trip(make(300), tmp_path / "a.ply")
    once = round_trip(original, tmp_path / f"a{suffix}")
    by_ply = round_trip(once, tmp_path / "b.ply")
    assert same(by_ply, once) and apart(by_ply.means, original.means) <= error
    twice = round_trip(by_ply, tmp_path / f"c{suffix}")
    assert apart(twice.means, once.means) <= 1e-6
    assert apart(twice.log_scales, once.log_scales) <= 1e-5
    assert opacity_apart(twice, once) <= 1e-6
    assert apart(twice.harmonics, once.harmonics) <= 1e-5
    # Of two components that are nearly alike, another may be the largest the second time.
    assert components_apart(twice, once) <= {".splat": 1 / 100, ".sog": 3 * 0.0028}.get(suffix, 1e-6)


def test_spz_turns_half_around_x(tmp_path):
    """Written numbers are those of the cloud in the other axes, whose harmonics need no table of signs."""
    cloud = make(50)
    data = gzip.decompress(gzipped(cloud))
    turned_by = torch.eye(4)
    turned_by[:3, :3] = HALF_TURN
    there = cloud.transformed(turned_by)
    codes = np.frombuffer(data, np.uint8)[16 + 50 * 9 :]
    rest = torch.from_numpy((codes[50 * 11 :].reshape(50, 15, 3) - 128.0) / 128)
    assert apart(rest.float(), there.harmonics[:, 1:]) <= 1 / 16 + 1e-5
    assert apart(turned(cloud.harmonics, HALF_TURN), there.harmonics) == 0
    fixed = np.frombuffer(data[16 : 16 + 450], np.uint8).reshape(50, 3, 3) @ (1 << np.array([0, 8, 16]))
    fixed = torch.from_numpy((fixed - (fixed > 2**23 - 1) * 2**24) / 2.0 ** data[13])
    assert apart(fixed.float(), there.means) <= 2**-17 + 1e-6
    write_gaussians(tmp_path / "a.spz", cloud)
    found = read_gaussians(tmp_path / "a.spz")
    assert components_apart(found.transformed(turned_by), there) <= 0.0021


@pytest.mark.parametrize(("reach", "bits"), [(1.0, 16), (127.0, 16), (129.0, 15), (5000.0, 10), (8e6, 0)])
def test_spz_spends_its_bits_on_what_is_there(tmp_path, reach, bits):
    cloud = make(9, 0)
    means = cloud.means / cloud.means.abs().max() * reach
    found = round_trip(replace(cloud, means=means), tmp_path / "a.spz")
    assert (tmp_path / "a.spz").read_bytes()[13] == bits
    assert apart(found.means, means) <= 2.0 ** -(bits + 1) + 1e-6 * reach
    with pytest.raises(LumigraphError, match="scale the cloud down"):
        write_gaussians(tmp_path / "b.spz", replace(cloud, means=means * 1e7 / reach))
    assert not (tmp_path / "b.spz").exists()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_bytes_are_reproducible_and_the_input_stays(tmp_path, suffix):
    cloud = make(300, antialiased=True)
    kept = [getattr(cloud, field.name) for field in fields(cloud)]
    copies = [x.clone() if isinstance(x, torch.Tensor) else x for x in kept]
    write_gaussians(tmp_path / f"a{suffix}", cloud)
    write_gaussians(str(tmp_path / f"b{suffix}"), cloud)
    first, second = (tmp_path / f"{x}{suffix}" for x in "ab")
    assert first.read_bytes() == second.read_bytes()
    assert same(cloud, Gaussians(*copies))
    before = first.read_bytes(), first.stat().st_mtime_ns
    read_gaussians(first).means.zero_()  # what was read is no view of the file
    assert before == (first.read_bytes(), first.stat().st_mtime_ns)
    assert names(tmp_path) == [first.name, second.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_extremes_are_cut_and_nothing_else(tmp_path, suffix):
    """Infinite logits, scales beyond a format's and rotations of length zero come back as the nearest that is sound."""
    cloud = replace(
        make(4, 1),
        opacities=torch.tensor([math.inf, -math.inf, 30.0, -200.0]),
        log_scales=torch.tensor([[-300.0, 90.0, 0.0]]).repeat(4, 1),
        quaternions=torch.tensor([[0.0, 0, 0, 0], [1e-30, 0, 0, 0], [0, 1e30, 0, 0], [0, 0, 0, -2]]),
    )
    found = round_trip(cloud, tmp_path / f"a{suffix}")
    assert found.opacities.isfinite().all() and found.log_scales.isfinite().all()
    torch.testing.assert_close(found.opacities.sigmoid(), torch.tensor([1.0, 0, 1, 0]), atol=1 / 500, rtol=0)
    assert (found.log_scales[:, 0] <= -10).all() and (found.log_scales[:, 1] > 5.9).all()
    assert found.log_scales[:, 2].abs().max() <= (40 / 2046 if "compressed" in suffix else 1e-6)
    if "compressed" in suffix:
        torch.testing.assert_close(found.log_scales[:, :2], torch.tensor([[-20.0, 20.0]]).repeat(4, 1))
    rotations = found.quaternions.double().abs()
    rotations = rotations / rotations.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(rotations, torch.eye(4)[[0, 0, 1, 3]].double(), atol=3e-3, rtol=0)


def test_compressed_chunks_hold_neighbours(tmp_path):
    """Along Morton's curve a chunk of 256 of 16384 is small, though the cloud came in any order and has an outlier."""
    cloud = make(2**14, 0)
    cloud = replace(cloud, means=torch.rand(2**14, 3, generator=torch.Generator().manual_seed(1)))
    cloud.means[7] = 1000.0
    found = round_trip(cloud, tmp_path / "a.compressed.ply")
    near = torch.arange(2**14) != 7
    distance = (found.means - cloud.means)[near].norm(dim=-1)
    assert distance.median() < 1.5e-4  # a quarter of the box has 1/4 / 2046 at most; as one chunk it would be 0.2


def test_means_of_a_wide_chunk_are_not_lost_to_float32(tmp_path):
    cloud = replace(make(3, 0), means=torch.tensor([[-3e38, 0, 1], [3e38, 0, 1], [0, 0, 1]]))
    found = round_trip(cloud, tmp_path / "a.compressed.ply")
    torch.testing.assert_close(found.means[:2], cloud.means[:2])


# --- files assembled by hand ---


def test_reads_spz_3_by_hand(tmp_path):
    """Two Gaussians, degree 1, 12 bits behind the point; and the same bytes come out where nothing was rounded."""
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, 2, 1, 12, 1, 0)
    positions = [(1 << 12, 2 << 12, -3 << 12), (-1, 0, 1)]
    positions = b"".join((x & 0xFFFFFF).to_bytes(3, "little") for row in positions for x in row)
    alphas = bytes([255, 51])
    colours = bytes([0, 255, 51, 128, 128, 128])
    scales = bytes([0, 160, 255, 16, 32, 48])
    # The largest of x, y, z, w is w, then x; the others in that order, each a sign and 9 bits of sqrt(1/2).
    rotations = struct.pack(
        "<II", 3 << 30 | 0 << 20 | (512 | 511) << 10 | 0, 0 << 30 | 256 << 20 | 0 << 10 | (512 | 128)
    )
    rest = bytes([0, 64, 128, 192, 255, 136, 120, 128, 160] + [128] * 9)  # per coefficient y, z, x: red, green, blue
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header + positions + alphas + colours + scales + rotations + rest))
    found = read_gaussians(path)
    assert found.antialiased and found.degree == 1
    torch.testing.assert_close(found.means, torch.tensor([[1.0, -2, 3], [-1 / 4096, 0, -1 / 4096]]))
    torch.testing.assert_close(found.opacities.sigmoid(), torch.tensor([254.5 / 255, 0.2]))
    plain = [[-0.5 / 0.15, 0.5 / 0.15, -0.3 / 0.15], [0.5 / 255 / 0.15] * 3]
    torch.testing.assert_close(found.harmonics[:, 0], torch.tensor(plain), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found.log_scales, torch.tensor([[-10, 0, 5.9375], [-9, -8, -7]]))
    s = math.sqrt(0.5)
    # In the axes of .spz (w, x, y, z) is (s, 0, -s, 0): half a turn around x makes y and z of the axis negative.
    b, c = s * 256 / 511, -s * 128 / 511  # y and w of the second
    expected = torch.tensor([[s, 0, s, 0], [c, math.sqrt(1 - b * b - c * c), -b, 0]])
    torch.testing.assert_close(found.quaternions, expected, atol=1e-6, rtol=0)
    y, z, x = ([v / 128 for v in row] for row in ([-128, -64, 0], [64, 127, 8], [-8, 0, 32]))
    expected = torch.tensor([[[-v for v in y], [-v for v in z], x], [[0.0] * 3] * 3])
    torch.testing.assert_close(found.harmonics[:, 1:], expected)


@pytest.mark.parametrize("version", [1, 2])
def test_reads_older_spz_by_hand(tmp_path, version):
    header = struct.pack("<IIIBBBB", 0x5053474E, version, 1, 0, 8, 0, 0)
    position = struct.pack("<eee", 1.5, -2, 0.25)
    if version == 2:
        position = b"".join((int(x * 256) & 0xFFFFFF).to_bytes(3, "little") for x in (1.5, -2, 0.25))
    body = position + bytes([102]) + bytes([51, 102, 204]) + bytes([80, 96, 112]) + bytes([204, 102, 51])
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header + body))
    found = read_gaussians(path)
    assert found.means.tolist() == [[1.5, 2, -0.25]] and not found.antialiased
    torch.testing.assert_close(found.opacities.sigmoid(), torch.tensor([0.4]))
    torch.testing.assert_close(found.log_scales, torch.tensor([[-5.0, -4, -3]]))
    torch.testing.assert_close(found.harmonics, torch.tensor([[[-2.0, -2 / 3, 2]]]))
    w = math.sqrt(1 - 0.36 - 0.04 - 0.36)
    torch.testing.assert_close(found.quaternions, torch.tensor([[w, 0.6, 0.2, 0.6]]))
    path.write_bytes(header + body)  # and without gzip
    assert same(read_gaussians(path), found)
    path.write_bytes(gzip.compress(header[:14] + b"\x02\x00" + body + b"an extension"))
    with pytest.warns(LumigraphWarning, match="extensions passed over: 0x65206e61$"):
        assert same(read_gaussians(path), found)


AXES = {"R": [1.0, 0, 0], "L": [-1.0, 0, 0], "D": [0.0, 1, 0], "U": [0.0, -1, 0], "F": [0.0, 0, 1], "B": [0.0, 0, -1]}


@pytest.mark.parametrize(("number", "axes"), [(4, "RUB"), (7, "LUF"), (8, "RUF"), (12, "RFU"), (15, "LBU"), (0, "RUB")])
def test_spz_in_other_axes(tmp_path, number, axes):
    """Adobe's extension: positions, covariances and colours by direction are those that the letters give, mirrored too;
    its other one, and those that nobody knows, are named."""
    path, cloud = tmp_path / "a.spz", make(9)
    write_gaussians(path, cloud)
    plain, data = read_gaussians(path), path.read_bytes()
    block = struct.pack("<III", 0xADBE0003, 4, number) + struct.pack("<IIfff", 0xADBE0002, 12, 0, 1, 2)
    block += struct.pack("<II", 0x4E410001, 3) + b"abc"
    path.write_bytes(data[:14] + b"\x02" + data[15:16] + struct.pack("<I12x", 32 + len(block)) + block + data[32:])
    with pytest.warns(LumigraphWarning, match="passed over: SPZ_ADOBE_safe_orbit_camera, 0x4e410001$"):
        found = read_gaussians(path)
    matrix = torch.tensor([AXES[letter] for letter in axes]).T @ HALF_TURN
    torch.testing.assert_close(found.means, plain.means @ matrix.T)
    covariances = (
        rotation @ torch.diag_embed((2 * one.log_scales).exp()) @ rotation.mT
        for one in (plain, found)
        for rotation in [to_matrix(one.quaternions / one.quaternions.norm(dim=-1, keepdim=True))]
    )
    torch.testing.assert_close(matrix @ next(covariances) @ matrix.T, next(covariances), atol=1e-7, rtol=1e-5)
    seen = torch.nn.functional.normalize(torch.randn(9, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    before, after = (spherical_harmonics(x, 4) for x in (seen, seen @ matrix.T))
    colours = torch.einsum("dk,nkc->ndc", before, plain.harmonics)
    torch.testing.assert_close(torch.einsum("dk,nkc->ndc", after, found.harmonics), colours, atol=1e-5, rtol=0)


def test_spz_of_degree_4_keeps_degree_3(tmp_path):
    rest = bytes(range(60, 132))
    (tmp_path / "a.spz").write_bytes(spz(degree=4, body=bytes(20) + rest))
    (tmp_path / "b.spz").write_bytes(spz(degree=3, body=bytes(20) + rest[:45]))
    with pytest.warns(LumigraphWarning, match="degree 4 are passed over"):
        assert same(read_gaussians(tmp_path / "a.spz"), read_gaussians(tmp_path / "b.spz"))


def test_reads_splat_by_hand(tmp_path):
    record = struct.pack("<6f", 1, -2, 3.5, 1, math.e, 0.25) + bytes([0, 255, 51, 102, 192, 128, 0, 128])
    flat = struct.pack("<6f", 0, 0, 0, 0, 1, 1) + bytes([0, 0, 0, 0, 255, 128, 128, 128])
    path = tmp_path / "a.SPLAT"
    path.write_bytes(record + flat)
    found = read_gaussians(path)
    assert found.means.tolist() == [[1, -2, 3.5], [0, 0, 0]] and found.degree == 0
    torch.testing.assert_close(found.log_scales[0], torch.tensor([0, 1, math.log(0.25)]))
    assert found.log_scales[1].tolist() == [pytest.approx(-87.3, abs=0.1), 0, 0]
    torch.testing.assert_close(found.harmonics[0, 0], torch.tensor([-0.5, 0.5, -0.3]) / C0)
    torch.testing.assert_close(found.opacities.sigmoid(), torch.tensor([0.4, 0.5 / 255]))
    assert found.quaternions.tolist() == [[0.5, 0, -1, 0], [127 / 128, 0, 0, 0]]
    write_gaussians(tmp_path / "b.splat", found[:1])
    # but for the rotation, which has length 1 now
    assert (tmp_path / "b.splat").read_bytes()[:28] == pytest.approx(record[:28])


CHUNK = "min_x min_y min_z max_x max_y max_z min_scale_x min_scale_y min_scale_z max_scale_x max_scale_y max_scale_z"
CHUNK_COLOUR = " min_r min_g min_b max_r max_g max_b"


def compressed_by_hand(path: Path, colours: bool = True, sh: int = 9, element: str = "chunk") -> None:
    """One chunk of two Gaussians: at its lower ends, and at its upper ends but for the middle of y and of blue."""
    properties = (CHUNK + CHUNK_COLOUR * colours).split()
    lines = ["ply", "format binary_little_endian 1.0", "comment by hand", f"element {element} 1"]
    lines += [f"property float {name}" for name in properties] + ["element vertex 2"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    lines += ["element sh 2"] * bool(sh) + [f"property uchar f_rest_{i}" for i in range(sh)]
    chunk = [-1, -2, -3, 1, 2, 3, -9, -8, -7, -3, -2, -1] + [0.25, 0, 0, 0.5, 1, 2] * colours
    low = (0, 0 << 30 | 1023 << 20 | 0, 0, 0)
    high = (
        2047 << 21 | 341 << 11 | 2047,
        2 << 30 | 0 << 20 | 1023 << 10 | 0,
        2047 << 21 | 1023 << 11 | 2047,
        255 << 24 | 255 << 16 | 51 << 8 | 204,
    )
    rest = [bytes([0, 255, 128, 64, 192, 127, 1, 254, 100])[:sh], bytes([128] * sh)]
    body = struct.pack(f"<{len(properties)}f", *chunk) + struct.pack("<4I", *low) + struct.pack("<4I", *high)
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + body + b"".join(rest))


@pytest.mark.parametrize("colours", [True, False])
def test_reads_compressed_ply_by_hand(tmp_path, colours):
    compressed_by_hand(tmp_path / "a.ply", colours)
    found = read_gaussians(tmp_path / "a.ply")
    assert found.degree == 1 and not found.antialiased
    torch.testing.assert_close(found.means, torch.tensor([[-1.0, -2, -3], [1, -2 + 4 / 3, 3]]))
    torch.testing.assert_close(found.log_scales, torch.tensor([[-9.0, -8, -7], [-3, -2, -1]]))
    torch.testing.assert_close(found.opacities.sigmoid(), torch.tensor([0.5 / 255, 0.8]))
    rgb = [[0.25, 0, 0], [0.5, 1, 0.4]] if colours else [[0.0, 0, 0], [1, 1, 0.2]]
    torch.testing.assert_close(found.harmonics[:, 0] * C0 + 0.5, torch.tensor(rgb))
    s = math.sqrt(0.5)  # of w, x, y, z the first and then the third is worked out from the others
    expected = torch.tensor([[0, s, -s, -s], [-s, s, 0, -s]])
    torch.testing.assert_close(found.quaternions, expected, atol=1e-6, rtol=0)
    decoded = {0: -4, 255: 4}
    decoded |= {code: ((code + 0.5) / 256 - 0.5) * 8 for code in (128, 64, 192, 127, 1, 254, 100)}
    channels = [[0, 255, 128], [64, 192, 127], [1, 254, 100]]  # red's three coefficients, green's, blue's
    expected = torch.tensor([[decoded[code] for code in row] for row in channels]).T
    torch.testing.assert_close(found.harmonics[0, 1:], expected)


@pytest.mark.parametrize("order", ["<", ">", "text"])
def test_reads_ply_of_any_kind(tmp_path, order):
    """Text and big-endian files, other types, other orders of properties, other elements."""
    cloud = make(5, 1)
    write_gaussians(tmp_path / "a.ply", cloud)
    vertex = read_rows(tmp_path / "a.ply", ["vertex"])["vertex"]
    types = {name: "double" if name == "x" else "float" for name in sorted(vertex.dtype.names)}
    face = ("face", {"vertex_indices": "list uchar int"}, [([1, 1, 1],)] * 2)
    (tmp_path / "b.ply").write_bytes(ply_file([face, ("vertex", types, vertex[[*types]].tolist())], order))
    assert same(read_gaussians(tmp_path / "b.ply"), cloud)


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        ([], False),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["SplatRenderMode: mip"], True),
        (["SplatRenderMode: default"], False),
        (["antialiased 1", "SplatRenderMode: default"], False),
        (["not antialiased 1"], False),
    ],
)
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_comments_say_whether_a_cloud_is_antialiased(tmp_path, suffix, comments, antialiased):
    path = tmp_path / f"a{suffix}"
    write_gaussians(path, make(2))
    lines = "".join(f"comment {line}\n" for line in comments).encode()
    path.write_bytes(path.read_bytes().replace(b"comment written by Lumigraph\n", lines))
    assert read_gaussians(path).antialiased == antialiased


def test_ply_has_the_layout_of_the_first_release(tmp_path):
    cloud = make(3, 1, antialiased=True)
    write_gaussians(tmp_path / "a.ply", cloud)
    data = (tmp_path / "a.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    names = [line.split()[2] for line in head.decode().splitlines() if line.startswith("property float ")]
    expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6 "
    expected += "f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert names == expected.split()
    assert b"\ncomment antialiased 1\ncomment SplatRenderMode: mip\nelement vertex 3\n" in head
    row = struct.unpack_from("<26f", body, 2 * 26 * 4)
    assert list(row[9:18]) == cloud.harmonics[2, 1:].T.flatten().tolist()  # red's, green's, blue's
    assert list(row[22:]) == cloud.quaternions[2].tolist()


# --- faults: one sentence each, and never another exception ---


def refusal(path: Path) -> str:
    with pytest.raises(LumigraphError) as caught:
        read_gaussians(path)
    sentence = str(caught.value)
    assert str(path) in sentence and "\n" not in sentence and "; " in sentence
    return sentence


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_truncated_anywhere(tmp_path, suffix, degree):
    write_gaussians(tmp_path / f"a{suffix}", make(9, degree))
    data = (tmp_path / f"a{suffix}").read_bytes()
    path = tmp_path / f"b{suffix}"
    for length in [*range(0, len(data), max(7, len(data) // 300)), len(data) - 1]:
        path.write_bytes(data[:length])
        if suffix == ".splat" and length and length % 32 == 0:  # no header says how many there should be
            assert len(read_gaussians(path)) == length // 32
        else:
            refusal(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_anywhere(tmp_path, suffix):
    """A byte changed: either a sentence or a sound cloud."""
    write_gaussians(tmp_path / f"a{suffix}", make(5, 1))
    data = (tmp_path / f"a{suffix}").read_bytes()
    generator = np.random.default_rng(0)
    path = tmp_path / f"b{suffix}"
    for position in range(0, len(data), max(5, len(data) // 300)):
        changed = bytearray(data)
        changed[position] ^= int(generator.integers(1, 256))
        path.write_bytes(changed)
        try:
            found = read_gaussians(path)
        except LumigraphError as fault:
            assert "\n" not in str(fault)
        else:
            assert all(getattr(found, field.name).isfinite().all() for field in fields(found)[:5])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_file_of_gaussians(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    assert "does not exist" in refusal(path)
    path.write_bytes(b"")
    assert "is empty" in refusal(path)
    path.write_text("These are the times that try men's souls.\n" * 32)
    refusal(path)
    path.write_bytes(os.urandom(1001))
    refusal(path)
    path.unlink()
    path.mkdir()
    assert "is a folder" in refusal(path)
    with pytest.raises(LumigraphError, match="is a folder"):
        write_gaussians(path, make(1))
    assert path.is_dir()


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root reads everything")
def test_what_may_not_be_read(tmp_path):
    write_gaussians(tmp_path / "a.ply", make(1))
    (tmp_path / "a.ply").chmod(0)
    assert "permissions" in refusal(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["a.obj", "a", "a.ply.txt", "ply"])
def test_unknown_suffix(tmp_path, name):
    (tmp_path / name).write_bytes(b"ply")
    assert all(suffix in refusal(tmp_path / name) for suffix in SUFFIXES)
    with pytest.raises(LumigraphError, match=r"\.spz"):
        write_gaussians(tmp_path / name, make(1))
    assert (tmp_path / name).read_bytes() == b"ply"


def test_names_of_splat_files(tmp_path):
    (tmp_path / "folder.ply").mkdir()
    for name in ("a.ply", "a.PLY", "a.compressed.ply", "a.splat", "missing.spz"):
        assert is_splat_file(tmp_path / name) and is_splat_file(str(tmp_path / name))
    for name in ("a.obj", "plain", "folder.ply"):
        assert not is_splat_file(tmp_path / name)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", ["means", "quaternions", "log_scales", "opacities", "harmonics"])
def test_nothing_unsound_is_written(tmp_path, suffix, name):
    cloud = make(4)
    getattr(cloud, name)[2] = math.nan
    with pytest.raises(LumigraphError, match=r"1 of 4 Gaussians .* finite .*: 1"):
        write_gaussians(tmp_path / f"a{suffix}", cloud)
    assert not list(tmp_path.iterdir())
    for count in (0, 2, 25):
        with pytest.raises(LumigraphError, match=f"{count} harmonics"):
            write_gaussians(tmp_path / f"a{suffix}", replace(make(2), harmonics=torch.zeros(2, count, 3)))


def test_nothing_unsound_is_read(tmp_path):
    cloud = make(5, 1)
    write_gaussians(tmp_path / "a.ply", cloud)
    rows = read_rows(tmp_path / "a.ply", ["vertex"])["vertex"].copy()
    rows["x"][:2] = np.nan, -np.inf
    rows["f_rest_4"][1:3] = np.inf
    rows["opacity"][:] = np.inf, -np.inf, 1, 1, 1  # as they occur in good files
    write_rows(tmp_path / "b.ply", "splats", {"vertex": rows})
    rows["rot_0"][4:] = rows["rot_1"][4:] = rows["rot_2"][4:] = rows["rot_3"][4:] = 0  # a row that was never written
    write_rows(tmp_path / "c.ply", "splats", {"vertex": rows})
    for name, left, told in (("b", [3, 4], "3 of 5"), ("c", [3], "4 of 5")):
        with pytest.warns(LumigraphWarning, match=rf"{told} Gaussians .*means: 2, colours: 2.* are left out") as found:
            read = read_gaussians(tmp_path / f"{name}.ply")
        assert "opacities" not in str(found[0].message) and ("no rotation: 1" in str(found[0].message)) == (name == "c")
        torch.testing.assert_close(read.means, cloud.means[left])
    record = struct.pack("<6f", 1, 1, 1, 1, -1, 1) + bytes(8)
    (tmp_path / "c.splat").write_bytes(record)
    assert "scales: 1" in refusal(tmp_path / "c.splat")


def test_a_point_cloud_is_no_cloud_of_gaussians(tmp_path):
    types = dict.fromkeys("xyz", "float") | dict.fromkeys(["red", "green", "blue"], "uchar")
    (tmp_path / "a.ply").write_bytes(ply_file([("vertex", types, [(0,) * 6] * 7)]))
    assert "7 points and no Gaussians" in refusal(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["x", "opacity", "scale_1", "rot_0", "f_dc_1", "f_rest_0", "f_rest_44"])
def test_missing_properties(tmp_path, name):
    write_gaussians(tmp_path / "a.ply", make(2))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(f"float {name}\n".encode(), b"float other\n"))
    assert ("44 properties f_rest_*" if "rest" in name else f"lacks {name}") in refusal(tmp_path / "a.ply")


def test_parts_of_a_compressed_ply_that_do_not_fit(tmp_path):
    path = tmp_path / "a.compressed.ply"
    compressed_by_hand(path, sh=8)
    assert "8 properties f_rest_*" in refusal(path)
    compressed_by_hand(path, element="other")
    assert "2 points and no Gaussians" in refusal(path)
    compressed_by_hand(path)
    good = path.read_bytes()
    for old, new, said in [
        (b"min_scale_y", b"miss", "lacks min_scale_y"),
        (b"max_b", b"miss", "lacks max_b"),
        (b"packed_color", b"miss", "lacks packed_color"),
        (b"element chunk 1", b"element chunk 2", "chunks"),
        (b"element sh 2", b"element sh 1", "rows of harmonics"),
    ]:
        path.write_bytes(good.replace(old, new) + bytes(200))
        assert said in refusal(path)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", [10**6, 10**12, 10**30])
@pytest.mark.parametrize("newline", ["\n", "\r", "\r\n"])
def test_a_ply_header_that_lies_allocates_nothing(tmp_path, kind, count, newline):
    lines = ["ply", f"format {kind} 1.0", f"element vertex {count}", "property float x", "property list uchar int y"]
    (tmp_path / "a.ply").write_bytes(newline.join([*lines, "end_header", "0 0"]).encode())
    sentence = refusal(tmp_path / "a.ply")
    assert "ends early" in sentence and str(count) in sentence


@pytest.mark.parametrize(
    "header",
    [
        "ply\n",
        "ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n0 0\n",
        "ply\nformat ascii 2.0\nelement vertex 1\nproperty float x\nend_header\n0\n",
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty quaternion x\nend_header\n0\n",
        "ply\nformat ascii 1.0\nend_header\n",
        "plywood\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex " + "9" * 5000 + "\nproperty float x\nend_header\n0\n",
        "ply\nformat ascii 1.0\ncomment é\nelement vertex 1\nproperty quaternion x\nend_header\n0\n",
    ],
)
def test_ply_headers_that_cannot_be_understood(tmp_path, header):
    (tmp_path / "a.ply").write_text(header, encoding="utf-8", newline="")
    refusal(tmp_path / "a.ply")


def test_ply_rows_that_cannot_be_understood(tmp_path):
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {name}\n" for name in names)
    good = head + "end_header\n" + "1 2 3 4 5 6 7 8 9 10 11 12 13 14\n" * 2
    (tmp_path / "a.ply").write_text(good)
    assert len(read_gaussians(tmp_path / "a.ply")) == 2
    for old, new in [(" 14\n", "\n"), (" 14\n", " fourteen\n"), (" 7 ", " 7 7 "), (" 2 3", " nan 3"), (" 2 3", " é 3")]:
        (tmp_path / "a.ply").write_text(good.replace(old, new), encoding="utf-8")
        refusal(tmp_path / "a.ply")


def spz(version: int = 3, count: int = 1, degree: int = 0, magic: bytes = b"NGSP", body: bytes = bytes(20)) -> bytes:
    return gzip.compress(magic + struct.pack("<IIBBBB", version, count, degree, 12, 0, 0) + body, mtime=0)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (spz(magic=b"SPZ3"), "does not begin with NGSP"),
        (spz(version=0), "version 0"),
        (spz(version=4), "version 4"),
        (spz(version=2**32 - 1), "version 4294967295"),
        (gzip.decompress(spz(version=5)), "version 5"),
        (gzip.decompress(spz(version=4)), "no table"),  # it has its own container, not gzip's
        (b"NGSP\x04", "ends early"),
        (spz(degree=5), "degree 5"),
        (gzip.compress(gzip.decompress(spz())[:14] + b"\x80\0" + bytes(26), mtime=0), "levels of detail"),
        (spz(degree=1), "truncated"),
        (spz(count=2), "truncated"),
        (spz(count=2**32 - 1), "cannot be there"),
        (spz(count=0), "goes on after"),
        (spz(body=bytes(21)), "goes on after"),
        (spz(body=bytes(10**8)), "goes on after"),
        (spz(count=10**6, body=bytes(10**6)), "truncated"),
        (spz()[:-8] + bytes(8), "damaged"),
        (spz(body=bytes(0)), "truncated"),
        (b"\x1f\x8b\x08", "truncated"),
        (b"\x1f\x8b" + bytes(50), "damaged"),
    ],
)
def test_spz_files_that_cannot_be_read(tmp_path, data, said):
    (tmp_path / "a.spz").write_bytes(data)
    assert said in refusal(tmp_path / "a.spz")


def tabled(data: bytes) -> bytes:
    """A file of version 3 as version 4: the same bytes in a table of streams."""
    plain = gzip.decompress(data)
    count, degree, bits, flags = struct.unpack_from("<IBBB", plain, 8)
    widths, at, streams = [9, 1, 3, 3, 4] + [3 * ((degree + 1) ** 2 - 1)] * (degree > 0), 16, []
    for width in widths:
        streams.append(plain[at : at + count * width])
        at += count * width
    packed = [zstandard.ZstdCompressor().compress(stream) for stream in streams]
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, bits, flags, len(streams), 32)
    table = b"".join(struct.pack("<QQ", len(a), len(b)) for a, b in zip(packed, streams, strict=True))
    return header + table + b"".join(packed)


@pytest.mark.parametrize("degree", [0, 2])
def test_spz_version_4_says_the_same(tmp_path, degree):
    """Put together by hand from version 3, and as it is written."""
    cloud = make(70, degree, antialiased=True)
    (tmp_path / "three.spz").write_bytes(gzipped(cloud))
    data = tabled(gzipped(cloud))
    (tmp_path / "four.spz").write_bytes(data)
    write_gaussians(tmp_path / "written.spz", cloud)
    assert (tmp_path / "written.spz").read_bytes()[:32] == data[:32]
    three, *others = (read_gaussians(tmp_path / f"{name}.spz") for name in ("three", "four", "written"))
    for name in ("means", "quaternions", "log_scales", "opacities", "harmonics", "antialiased"):
        assert all(np.array_equal(getattr(three, name), getattr(other, name)) for other in others), name
    for end in range(1, len(data) - 1, 7):
        (tmp_path / "cut.spz").write_bytes(data[:end])
        refusal(tmp_path / "cut.spz")
    for at in range(8, 112, 3):  # the header and the table, and a byte of them wrong
        (tmp_path / "wrong.spz").write_bytes(data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :])
        with contextlib.suppress(LumigraphError):
            read_gaussians(tmp_path / "wrong.spz")


def test_a_splat_file_of_nothing_is_not_written(tmp_path):
    with pytest.raises(LumigraphError, match=r"no Gaussians; write it as \.ply"):
        write_gaussians(tmp_path / "a.splat", make(0))
    assert not (tmp_path / "a.splat").exists()


def test_a_fault_leaves_the_old_file(tmp_path, monkeypatch):
    cloud = make(3)
    for suffix in MATRIX:
        path = tmp_path / f"a{suffix}"
        write_gaussians(path, cloud)
        before = path.read_bytes()
        monkeypatch.setattr(os, "fsync", _full)
        with pytest.raises(LumigraphError, match="disk is full"):
            write_gaussians(path, make(5))
        monkeypatch.undo()
        assert path.read_bytes() == before
    assert len(names(tmp_path)) == len(MATRIX)


def _full(descriptor: int) -> None:
    raise OSError(28, "No space left on device")


def test_spz_3_for_readers_of_it(tmp_path):
    cloud = make(50, 2)
    write_gaussians(tmp_path / "a.spz", cloud, spz_version=3)
    write_gaussians(tmp_path / "b.spz", cloud)
    assert (tmp_path / "a.spz").read_bytes()[:2] == b"\x1f\x8b" and (tmp_path / "b.spz").read_bytes()[:4] == b"NGSP"
    torch.testing.assert_close(read_gaussians(tmp_path / "a.spz").means, read_gaussians(tmp_path / "b.spz").means)
