"""glTF with KHR_gaussian_splatting: what comes back, nodes, whole numbers, meshes beside, and every fault."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from test_exchange import apart, components_apart, make, opacity_apart, refusal, round_trip
from test_gaussians import camera, similarity
from test_gaussians import cloud as soft_cloud

from lumigraph.commands import cli
from lumigraph.errors import LumigraphError
from lumigraph.exchange import is_splat_file, read_gaussians, write_gaussians
from lumigraph.exchange.glb import EXTENSION
from lumigraph.gaussians.splatting import render
from lumigraph.geometry import to_matrix
from lumigraph.large import open_any
from lumigraph.metrics import psnr

TURN = torch.diag(torch.tensor([1.0, -1, -1, 1]))


def parts(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def put(path: Path, about: dict, buffer: bytes) -> Path:
    text = json.dumps(about).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def written(tmp_path: Path, count: int = 5, degree: int = 1) -> tuple[dict, bytes]:
    write_gaussians(tmp_path / "a.glb", make(count, degree))
    return parts(tmp_path / "a.glb")


@pytest.mark.parametrize("count", [1, 257])
@pytest.mark.parametrize("degree", range(4))
def test_it_keeps_what_float32_can(tmp_path, degree, count):
    cloud = make(count, degree, antialiased=degree == 1)
    found = round_trip(cloud, tmp_path / "a.glb")
    assert (found.degree, found.antialiased) == (degree, cloud.antialiased)
    assert torch.equal(found.means, cloud.means) and torch.equal(found.harmonics, cloud.harmonics)
    assert apart(found.log_scales, cloud.log_scales) <= 2e-6
    assert components_apart(found, cloud) <= 1e-6 and opacity_apart(found, cloud) <= 1e-6
    assert (tmp_path / "a.glb").stat().st_size - (52 + 12 * (degree + 1) ** 2) * count < 6000


def test_it_looks_the_same(tmp_path):
    cloud = soft_cloud(200, degree=2)
    write_gaussians(tmp_path / "a.glb", cloud)
    before, after = (render(x, camera(), (0.0, 0.0, 0.0)).rgb for x in (cloud, read_gaussians(tmp_path / "a.glb")))
    assert before.max() > 0.3 and psnr(before, after) > 80


def test_it_is_as_the_extension_says(tmp_path):
    """Numbers of the first Gaussian, read by hand, in axes with y up."""
    cloud = make(3, 1)
    write_gaussians(tmp_path / "a.glb", cloud)
    about, buffer = parts(tmp_path / "a.glb")
    (primitive,) = about["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and about["extensionsUsed"] == [EXTENSION] and "extensionsRequired" not in about
    assert primitive["extensions"] == {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    assert about["buffers"][0]["byteLength"] == len(buffer)

    def first(name: str, numbers: int) -> torch.Tensor:
        accessor = about["accessors"][primitive["attributes"][name]]
        view = about["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0 and accessor["count"] == 3
        kind = {5126: "<f4", 5123: "<u2"}[accessor["componentType"]]
        return torch.from_numpy(np.frombuffer(buffer, kind, numbers, view["byteOffset"]).astype(np.float32))

    there = cloud.transformed(TURN)  # by the matrices of harmonics rather than by signs
    torch.testing.assert_close(first("POSITION", 3), there.means[0])
    stored = first(f"{EXTENSION}:ROTATION", 4).roll(1)
    axes = to_matrix(stored[None]).mT @ to_matrix(there.quaternions[:1])
    assert stored.norm() == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(axes[0].abs(), torch.eye(3), atol=1e-5, rtol=0)  # an ellipsoid's may point either way
    torch.testing.assert_close(first(f"{EXTENSION}:SCALE", 3), cloud.log_scales[0].exp())
    torch.testing.assert_close(first(f"{EXTENSION}:OPACITY", 1), cloud.opacities[:1].sigmoid())
    for i, name in enumerate(["0_COEF_0", "1_COEF_0", "1_COEF_1", "1_COEF_2"]):
        torch.testing.assert_close(first(f"{EXTENSION}:SH_DEGREE_{name}", 3), there.harmonics[0, i])
    colour = cloud.harmonics[0, 0] * 0.28209479 + 0.5
    light = torch.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
    torch.testing.assert_close(first("COLOR_0", 3) / 65535, light, atol=1e-4, rtol=1e-4)


def test_nodes_place_clouds(tmp_path):
    """A matrix, and a translation below a turn and a scale, are what `transformed` does; two clouds become one."""
    cloud, matrix = make(20, 2), similarity()
    write_gaussians(tmp_path / "a.glb", cloud)
    about, buffer = parts(tmp_path / "a.glb")
    s = 2**-0.5
    about["nodes"] = [
        {"mesh": 0, "matrix": matrix.T.flatten().tolist()},
        {"children": [2], "rotation": [0, 0, s, s], "scale": [2, 2, 2]},
        {"mesh": 0, "translation": [1, 0, 0]},
        {"mesh": 0, "scale": [1, -1, 1]},  # is not in the scene
    ]
    about["scenes"] = [{"nodes": [0, 1]}]
    found = read_gaussians(put(tmp_path / "b.glb", about, buffer))
    other = torch.tensor([[0.0, -2, 0, 0], [2, 0, 0, 2], [0, 0, 2, 0], [0, 0, 0, 1]])
    for part, by in ((found[:20], matrix), (found[20:], other)):
        expected = cloud.transformed(TURN).transformed(by).transformed(TURN)
        assert apart(part.means, expected.means) <= 1e-5 and apart(part.log_scales, expected.log_scales) <= 1e-5
        assert apart(part.harmonics, expected.harmonics) <= 1e-5 and components_apart(part, expected) <= 1e-5


def test_whole_numbers_and_strides(tmp_path):
    """Rotations and opacities of 8 and 16 bits, scales of whole numbers, rows with room between them."""
    about, _ = written(tmp_path, 2, 0)
    rotations = struct.pack("<8b", 127, 0, 0, 0, 0, -127, 0, 0)
    opacities = struct.pack("<2H", 13107, 65535)
    scales = struct.pack("<3HH3HH", 1, 2, 3, 9, 4, 5, 6, 9)
    rest = np.arange(12, dtype="<f4").tobytes()
    buffer = rotations + opacities + scales + rest
    at = {"ROTATION": (0, 5120, "VEC4", True), "OPACITY": (1, 5123, "SCALAR", True), "SCALE": (2, 5123, "VEC3", False)}
    about["bufferViews"] = [
        {"buffer": 0, "byteOffset": 0, "byteLength": 8},
        {"buffer": 0, "byteOffset": 8, "byteLength": 4},
        {"buffer": 0, "byteOffset": 12, "byteLength": 16, "byteStride": 8},
        {"buffer": 0, "byteOffset": 28, "byteLength": 48},
    ]
    about["accessors"] = [
        {"bufferView": view, "componentType": kind, "type": shape, "count": 2, "normalized": normalised}
        for view, kind, shape, normalised in at.values()
    ] + [{"bufferView": 3, "byteOffset": start, "componentType": 5126, "type": "VEC3", "count": 2} for start in (0, 24)]
    attributes = {f"{EXTENSION}:{name}": i for i, name in enumerate(at)}
    about["meshes"][0]["primitives"][0]["attributes"] = attributes | {
        "POSITION": 3,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": 4,
    }
    about["buffers"] = [{"byteLength": len(buffer)}]
    found = read_gaussians(put(tmp_path / "b.glb", about, buffer))
    assert found.means.tolist() == [[0, -1, -2], [3, -4, -5]] and found.degree == 0
    torch.testing.assert_close(found.log_scales.exp(), torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    torch.testing.assert_close(found.opacities[0].sigmoid(), torch.tensor(0.2))
    assert found.opacities[1] == 20 and found.quaternions.abs().tolist() == [[0, 1, 0, 0], [0, 0, 1, 0]]


def test_a_glb_of_a_mesh_is_no_splat_file(tmp_path, capsys):
    mesh = tmp_path / "mesh.glb"
    trimesh.creation.box().export(mesh)
    write_gaussians(tmp_path / "a.glb", make(30, 1))
    assert is_splat_file(tmp_path / "a.glb") and not is_splat_file(mesh)
    assert "nothing in its scene has" in refusal(mesh)
    with pytest.raises(LumigraphError, match="none of the files that open"):
        open_any(mesh)
    assert cli.main(["info", str(tmp_path / "a.glb")]) == 0 and "30 Gaussians" in capsys.readouterr().out
    assert cli.main(["export", "splats", str(tmp_path / "a.glb"), str(mesh)]) == 2 and mesh.exists()
    seen = open_any(tmp_path / "a.glb")
    assert seen.method().render(seen.cameras()["train"][0].resized(0.05)).rgb.isfinite().all()


def test_what_is_short_or_not_known_is_said_in_a_sentence(tmp_path):
    about, buffer = written(tmp_path)
    text = json.dumps(about)

    def said(old: str = "", new: str = "", held: bytes = buffer) -> str:
        assert old in text
        return refusal(put(tmp_path / "b.glb", json.loads(text.replace(old, new)), held))

    assert "ends before" in said(held=buffer[:-4])
    assert "ends before" in said(held=b"")
    assert "attributes of [5, 6] rows" in said('"SCALAR", "count": 5', '"SCALAR", "count": 6')
    assert "promises 1,000,000,000,000 Gaussians" in said('"count": 5', '"count": 1000000000000')
    assert "promises 6 rows" in said('"count": 5', '"count": 6')
    assert "lacks KHR_gaussian_splatting:SCALE" in said(":SCALE", ":SIZE")
    assert "lacks KHR_gaussian_splatting:SH_DEGREE_1_COEF_1" in said("SH_DEGREE_1_COEF_1", "SH_DEGREE_9_COEF_1")
    assert "kernel 'box'" in said('"ellipse"', '"box"')
    assert "colours 'lin_rec709_display'" in said("srgb_rec709_display", "lin_rec709_display")
    assert "mode 4" in said('"mode": 0', '"mode": 4')
    assert "needs 'EXT_meshopt_compression'" in said(
        '"asset"', '"extensionsRequired": ["EXT_meshopt_compression"], "asset"'
    )
    assert "packs its Gaussians by 'KHR_x'" in said('"kernel"', '"extensions": {"KHR_x": {}}, "kernel"')
    assert "leads to other files" in said('"buffers": [{', '"buffers": [{"uri": "b.bin", ')
    assert "is of a kind" in said('"VEC4"', '"MAT4"')
    assert "names mesh 7" in said('"nodes": [{"mesh": 0}]', '"nodes": [{"mesh": 7}]')
    assert "in two places" in said('"nodes": [{"mesh": 0}]', '"nodes": [{"mesh": 0, "children": [0]}]')
    assert "stretches or mirrors" in said('"nodes": [{"mesh": 0}]', '"nodes": [{"mesh": 0, "scale": [1, 2, 1]}]')
    assert "is no place" in said('"nodes": [{"mesh": 0}]', '"nodes": [{"mesh": 0, "matrix": [1]}]')
    with pytest.raises(LumigraphError, match="bufferView is -1"):
        read_gaussians(put(tmp_path / "b.glb", json.loads(text.replace('"bufferView": 0', '"bufferView": -1')), buffer))
    path = tmp_path / "a.glb"
    data = path.read_bytes()
    path.write_bytes(data[:4] + struct.pack("<I", 1) + data[8:])
    assert "glTF of version 1" in refusal(path)
    path.write_bytes(data[:-1])
    assert "ends early" in refusal(path) and is_splat_file(path)


# OpenUSD


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usd"])
def test_usd_has_what_usd_core_reads(tmp_path, suffix):
    pxr = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdVol

    cloud = make(7, 2)
    write_gaussians(tmp_path / f"a{suffix}", cloud)
    stage = pxr.Stage.Open(str(tmp_path / f"a{suffix}"))
    found = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/Gaussians"))
    prim = found.GetPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat" and UsdGeom.GetStageUpAxis(stage) == "Y"
    turn = np.array([1, -1, -1])
    np.testing.assert_allclose(np.array(prim.GetAttribute("positions").Get()), cloud.means.numpy() * turn, rtol=1e-6)
    np.testing.assert_allclose(np.array(prim.GetAttribute("scales").Get()), cloud.log_scales.exp().numpy(), rtol=1e-5)
    np.testing.assert_allclose(
        np.array(prim.GetAttribute("opacities").Get()), cloud.opacities.sigmoid().numpy(), rtol=1e-5
    )
    turned = cloud.quaternions / cloud.quaternions.norm(dim=-1, keepdim=True) * torch.tensor([1, 1, -1, -1])
    for quaternion, expected in zip(prim.GetAttribute("orientations").Get(), turned, strict=True):
        np.testing.assert_allclose([quaternion.GetReal(), *quaternion.GetImaginary()], expected, atol=1e-6)
    harmonics = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()).reshape(7, 9, 3)
    np.testing.assert_allclose(harmonics[:, 0], cloud.harmonics[:, 0].numpy(), rtol=1e-6)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    low, high = found.GetExtentAttr().Get()
    assert all(low[i] < (cloud.means.numpy() * turn)[:, i].min() for i in range(3)) and high[0] > low[0]
    with pytest.raises(LumigraphError, match="written and not read"):
        read_gaussians(tmp_path / f"a{suffix}")


def test_usd_keeps_an_offset_in_doubles(tmp_path):
    pxr = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    near = make(5, 0)
    offset = torch.tensor([512345.0, 4649776.0, 312.0], dtype=torch.float64)
    write_gaussians(
        tmp_path / "a.usdc",
        replace(near, means=(near.means.double() + offset).requires_grad_(), log_scales=near.log_scales - 3),
    )
    stage = pxr.Stage.Open(str(tmp_path / "a.usdc"))
    cache = UsdGeom.XformCache()
    matrix = np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath("/World/Gaussians")))
    local = np.array(stage.GetPrimAtPath("/World/Gaussians").GetAttribute("positions").Get()).astype(float)
    places = (local @ matrix[:3, :3] + matrix[3, :3]) * np.array([1, -1, -1])
    np.testing.assert_allclose(places, (near.means.double() + offset).numpy(), atol=1e-6)
