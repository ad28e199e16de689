"""Meshes for phones: an archive as the format demands, upright, whose picture gives each corner its colour."""

from __future__ import annotations

import io
import struct
import sys
import zipfile

import numpy as np
import pytest
import trimesh
from listing import names
from PIL import Image

from lumigraph.datasets.mesh import Mesh
from lumigraph.export.mesh_file import write_mesh
from lumigraph.export.usdz import ALIGNMENT_BYTES, baked, z_curve

UP = np.array([0.6, 0.0, 0.8])


@pytest.fixture(scope="module")
def cone() -> Mesh:
    """As tall as wide, its tip up, somewhere."""
    solid = trimesh.creation.cone(radius=0.5, height=1.0, sections=24)
    turn = trimesh.geometry.align_vectors([0, 0, 1], UP)[:3, :3]
    colours = (127 * (1 + np.sin(7 * solid.vertices + [0, 1, 2]))).astype(np.uint8)
    return Mesh(np.asarray(solid.vertices) @ turn.T + [30, -20, 10], np.asarray(solid.faces), colours)


@pytest.mark.parametrize("binary", [False, True])
def test_files_lie_as_they_are_at_multiples_of_64_bytes(cone, tmp_path, monkeypatch, binary):
    """The root is binary with OpenUSD's library, else text."""
    if binary:
        pytest.importorskip("pxr.Sdf")
    else:
        monkeypatch.setitem(sys.modules, "pxr", None)
    write_mesh(tmp_path / "cone.usdz", cone, UP)
    data = (tmp_path / "cone.usdz").read_bytes()
    with zipfile.ZipFile(io.BytesIO(data)) as packed:
        assert packed.testzip() is None
        layer, picture = packed.infolist()
        assert layer.filename == f"scene.usd{'ac'[binary]}" and picture.filename.endswith(".png")
        for entry in (layer, picture):
            name, extra = struct.unpack("<HH", data[entry.header_offset + 26 : entry.header_offset + 30])
            assert entry.compress_type == zipfile.ZIP_STORED
            assert (entry.header_offset + 30 + name + extra) % ALIGNMENT_BYTES == 0
        data = packed.read(layer)
        assert data.startswith(b"PXR-USDC" if binary else b"#usda 1.0")
    assert names(tmp_path) == ["cone.usdz"]


def test_the_picture_is_linear_between_the_corners(cone):
    """Bilinear interpolation, as a card samples textures, at random places in the triangles."""
    smooth = Mesh(cone.vertices, cone.faces, cone.colours // 3 + 80)  # b + c - a stays a colour
    picture, places = baked(smooth)
    assert 0 < places.min() and places.max() < 1
    share = np.random.default_rng(0).dirichlet(np.ones(3), len(places))
    at = (share[:, :, None] * places).sum(1) * [1, -1] + [0, 1]
    x, y = (at * np.array(picture.shape[1::-1]) - 0.5).T
    left, top = np.floor(x + 1e-9).astype(int), np.floor(y + 1e-9).astype(int)
    right, below = np.minimum(left + 1, picture.shape[1] - 1), np.minimum(top + 1, picture.shape[0] - 1)
    dx, dy = (x - left)[:, None], (y - top)[:, None]
    upper = (1 - dx) * picture[top, left] + dx * picture[top, right]
    lower = (1 - dx) * picture[below, left] + dx * picture[below, right]
    expected = (share[:, :, None] * smooth.colours[smooth.faces]).sum(1)
    np.testing.assert_allclose((1 - dy) * upper + dy * lower, expected, atol=1e-6)


def test_the_curve_fills_squares():
    x, y = z_curve(np.arange(16))
    assert sorted(zip(x.tolist(), y.tolist(), strict=True)) == [(i, k) for i in range(4) for k in range(4)]
    assert x[:4].tolist() == [0, 1, 0, 1] and y[:4].tolist() == [0, 0, 1, 1]


def test_another_program_sees_it_upright(cone, tmp_path):
    """Read by OpenUSD itself, where it is installed: valid, standing on the floor, and leading back to the source."""
    usd = pytest.importorskip("pxr.Usd")
    geometry, shading = pytest.importorskip("pxr.UsdGeom"), pytest.importorskip("pxr.UsdShade")
    checks = pytest.importorskip("pxr.UsdValidation")
    path = tmp_path / "cone.usdz"
    write_mesh(path, cone, UP)
    stage = usd.Stage.Open(str(path))
    assert geometry.GetStageUpAxis(stage) == "Y" and geometry.GetStageMetersPerUnit(stage) == 1
    validators = checks.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10 and not checks.ValidationContext(validators).Validate(stage)
    mesh = geometry.Mesh(stage.GetPrimAtPath("/Scene/Mesh"))
    points = np.array(mesh.GetPointsAttr().Get())
    assert points[points[:, 1].argmax()] == pytest.approx([0, 1, 0], abs=1e-5)  # the tip, above the base's middle
    assert points.min(0) == pytest.approx([-0.5, 0, -0.5], abs=0.01) and points[:, 1].min() == 0
    back = np.array(stage.GetRootLayer().customLayerData["sourceFromUpright"])
    np.testing.assert_allclose(points @ back[:3, :3] + back[3, :3], cone.vertices, atol=1e-5)
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), cone.faces)
    material, _ = shading.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    texture = surface.GetInput("emissiveColor").GetConnectedSource()[0]
    assert texture.GetInput("file").Get().path.endswith(".png")
    with zipfile.ZipFile(path) as packed:
        picture = np.asarray(Image.open(io.BytesIO(packed.read("colours.png"))))
    places = np.array(geometry.PrimvarsAPI(mesh.GetPrim()).GetPrimvar("st").Get()).reshape(-1, 3, 2)
    texels = np.floor((places * [1, -1] + [0, 1]) * picture.shape[1::-1]).astype(int)
    np.testing.assert_array_equal(picture[texels[..., 1], texels[..., 0]], cone.colours[cone.faces])
