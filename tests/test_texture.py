"""Textures of exact solids: colours from exact cameras, occlusion, exposure, detail, files, faults."""

from __future__ import annotations

import io
import json
import shutil
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from budgets import budget
from listing import names
from PIL import Image
from solids import around
from textured import bilinear

from lumigraph.camera import Camera
from lumigraph.camera.lens import OpenCV
from lumigraph.commands.cli import main
from lumigraph.components.fields.charts import unwrap
from lumigraph.datasets.mesh import Mesh
from lumigraph.datasets.scene import Frame, GeographicOrigin
from lumigraph.depth_maps import DepthMap
from lumigraph.errors import LumigraphError
from lumigraph.export.collision import convex_pieces
from lumigraph.export.mesh_file import write_mesh
from lumigraph.export.options import CollisionOptions
from lumigraph.export.surface import tangents, vertex_normals
from lumigraph.export.texture import PosedPicture, textured
from lumigraph.export.texture.atlas import texels_of
from lumigraph.export.texture.colours import RANKS, TexelColours, first_surface, gains
from lumigraph.export.texture.detail import normal_map
from lumigraph.files.ply import read_header
from lumigraph.run import Run

pytestmark = budget("exports", 12)

Paint = Callable[[np.ndarray], np.ndarray]  # colours in [0, 1] of points
TOLERANCE = 0.02  # scene units


def waves(points: np.ndarray) -> np.ndarray:
    """A smooth pattern that differs on all sides of a cube."""
    return 0.5 + 0.3 * np.sin(6 * points + [0, 1, 2]) * np.cos(4 * np.roll(points, 1, -1))


def surface(solid: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(solid.vertices, np.float64), np.asarray(solid.faces, np.int64)


def picture(camera: Camera, solid: tuple[np.ndarray, np.ndarray], paint: Paint, gain: float = 1.0) -> PosedPicture:
    """An exact photograph of a solid before black: the colour of the point that each pixel's ray meets first."""
    face, depth = first_surface(camera, *solid)
    rays = camera.rays(camera.pixels())
    points = rays.at(torch.from_numpy(depth).reshape(-1)).double().numpy()
    seen = np.isfinite(depth).reshape(-1)
    rgb = np.zeros((len(points), 3))
    rgb[seen] = gain * paint(points[seen])
    shape = (*depth.shape, 3)
    rgb8 = torch.from_numpy(np.rint(255 * rgb.clip(0, 1)).astype(np.uint8)).view(shape)
    opacity = torch.from_numpy(seen).view(depth.shape)
    known = DepthMap(camera, torch.from_numpy(depth), opacity.float(), rgb8 / 255)
    return PosedPicture(camera, rgb8, opacity, known)


def pictures(solid: tuple[np.ndarray, np.ndarray], paint: Paint, cameras: Camera) -> Iterator[PosedPicture]:
    for i in range(len(cameras)):
        yield picture(cameras[i], solid, paint)


def on_surface(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Points spread over a mesh, and its texture's colours there, bilinear as a GPU looks them up."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(solid, 4000, seed=0)
    share = trimesh.triangles.points_to_barycentric(solid.triangles[face], points)
    places = (share[..., None] * mesh.texture.uv[mesh.faces[face]]).sum(1)
    return np.asarray(points), bilinear(mesh.texture.colours, places) / 255


@pytest.fixture(scope="module")
def cube() -> tuple[np.ndarray, np.ndarray]:
    return surface(trimesh.creation.box(extents=(1.0, 1.0, 1.0)))


@pytest.fixture(scope="module")
def painted_cube(cube) -> Mesh:
    views = list(pictures(cube, waves, around(24, size=160)))
    return textured(cube, [lambda _: views], TOLERANCE, 256)


def test_photographs_of_a_cube_give_its_pattern_back(painted_cube):
    points, found = on_surface(painted_cube)
    error = np.abs(found - waves(points))
    assert error.mean() < 0.003 and np.quantile(error, 0.99) < 0.03, (error.mean(), np.quantile(error, 0.99))
    assert painted_cube.texture.colours.shape == (256, 256, 3) and painted_cube.texture.normals is None


def test_a_lens_that_bends_changes_nothing(cube):
    cameras = around(16, size=120)
    lens = OpenCV(cameras.lens.focal, cameras.lens.centre, torch.tensor([[-0.2, 0.05, *[0.0] * 6]]).expand(16, 8))
    bent = replace(cameras, lens=lens)
    fine = trimesh.creation.box(extents=(1.0, 1.0, 1.0)).subdivide().subdivide()
    mesh = textured(surface(fine), [lambda _: pictures(surface(fine), waves, bent)], TOLERANCE, 128)
    points, found = on_surface(mesh)
    assert np.abs(found - waves(points)).mean() < 0.004


def in_front(points: np.ndarray) -> np.ndarray:
    """Red above the cube, the pattern of the cube elsewhere."""
    return np.where(points[:, 2:] > 0.6, [1.0, 0.0, 0.0], 0.3 * waves(points))


@pytest.mark.parametrize("part_of_the_mesh", [True, False])
def test_what_is_hidden_takes_no_colour_from_what_hides_it(cube, part_of_the_mesh):
    """A red plate floats above a cube. Where it is no part of the mesh, the method's depth knows of it."""
    plate = surface(trimesh.creation.box(extents=(0.7, 0.7, 0.02), transform=np.diag([1.0, 1, 1, 1])))
    plate = plate[0] + [0, 0, 0.75], plate[1]
    both = np.concatenate([cube[0], plate[0]]), np.concatenate([cube[1], plate[1] + len(cube[0])])
    views = list(pictures(both, in_front, around(30, size=160)))
    mesh = textured(both if part_of_the_mesh else cube, [lambda _: views], TOLERANCE, 256)
    points, found = on_surface(mesh)
    below = points[:, 2] < 0.55
    assert found[below][:, 0].max() < 0.4
    error = np.abs(found - in_front(points))[below].mean()
    assert error < 0.012, error
    if part_of_the_mesh:
        assert np.abs(found - in_front(points))[~below].mean() < 0.02


def test_exposures_are_equalised(cube):
    """Each photograph so many times brighter or darker; but one factor for all, the pattern comes back."""
    cameras, strength = around(24, size=100), np.exp(np.random.default_rng(0).normal(0, 0.2, 24))
    views = [picture(cameras[i], cube, lambda x: 0.6 * waves(x), strength[i]) for i in range(24)]
    mesh = textured(cube, [lambda _: views], TOLERANCE, 128)
    points, found = on_surface(mesh)
    truth = 0.6 * waves(points)
    factor = np.median(found / truth)
    assert 0.8 < factor < 1.25 and np.abs(found / factor - truth).mean() < 0.012
    plain = np.abs(found / factor - truth) / truth
    assert np.quantile(plain, 0.95) < 0.08  # against 0.2 in single photographs


def test_gains_solve_for_exposures():
    """Three views of gray texels, each pair compared in some; against the closed form."""
    rng, exposures = np.random.default_rng(1), np.array([0.0, 0.3, -0.2])
    views = np.stack([rng.permutation(3) for _ in range(3000)])
    colours = 90 * np.exp(exposures[views])[..., None] * np.ones(3)
    padded = np.zeros((3000, RANKS, 3), np.uint8)
    padded[:, :3] = np.rint(colours)
    scores, numbers = np.zeros((3000, RANKS), np.float32), np.zeros((3000, RANKS), np.int32)
    scores[:, :3], numbers[:, :3] = 1, views
    found = gains(TexelColours(padded, scores, numbers))
    np.testing.assert_allclose(found - found.mean(), (exposures.mean() - exposures)[:, None] * np.ones(3), atol=0.02)


def test_what_no_picture_shows_takes_the_next_source_or_the_nearest_colours(cube):
    views = list(pictures(cube, waves, around(16, size=100, lowest=30.0)))
    near = textured(cube, [lambda _: views], TOLERANCE, 128)
    points, found = on_surface(near)
    inner = np.abs(points[:, :2]).max(-1) < 0.48  # edges are interpolated with the sides
    below, lid = inner & (points[:, 2] < -0.499), inner & (points[:, 2] > 0.499)
    assert 0.1 < found[below].min() and found[below].max() < 0.9
    assert np.abs(found - waves(points))[lid].mean() < 0.01
    then = textured(cube, [lambda _: views, lambda _: pictures(cube, waves, around(16, size=100))], TOLERANCE, 128)
    assert np.abs(on_surface(then)[1] - waves(points)).mean() < 0.01


def test_texels_around_charts_are_filled(painted_cube):
    """No texel keeps the black of an empty picture."""
    assert painted_cube.texture.colours.min() > 20


# Geometry


def test_charts_cover_the_surface_once_and_evenly():
    solid = surface(trimesh.creation.icosphere(3))
    original, charts, uv = unwrap(*solid, 256)
    assert (original[charts] == solid[1]).all() and 0 <= uv.min() and uv.max() <= 1
    texels = texels_of(solid[0][original], charts, uv, 256)
    assert len(np.unique(texels.index)) == len(texels)
    points = texels.interpolated(solid[0][original], charts)
    inside = (texels.shares > 0).all(1)
    assert np.abs(np.linalg.norm(points[inside], axis=-1) - 1).max() < 0.02
    areas = np.bincount(texels.face[inside], minlength=len(charts)) * texels.spacing**2
    truth = trimesh.Trimesh(*solid).area_faces
    assert abs(areas.sum() / truth.sum() - 1) < 0.1


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_normal_map_of_a_known_bump(mirrored):
    """A flat square whose detail is z = h sin(kx) cos(ky): normals (-dz/dx, -dz/dy, 1) in the frame of u and v."""
    side, h, k = 300, 0.01, 12.0
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
    dense = np.stack([x, y, h * np.sin(k * x) * np.cos(k * y)], -1).reshape(-1, 3)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    dense_faces = np.concatenate([np.stack([a, a + side, a + 1], -1), np.stack([a + side, a + side + 1, a + 1], -1)])
    flat, faces = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    u = flat[:, 0] * (-0.45 if mirrored else 0.45) + 0.5
    uv = np.stack([u, 0.5 - 0.45 * flat[:, 1]], -1)  # upwards in the picture is +y
    texels = texels_of(flat, faces, uv, 256)
    found = normal_map(texels, (flat, faces), uv, vertex_normals(flat, faces), (dense, dense_faces))
    px, py = texels.interpolated(flat, faces)[:, :2].T
    inside = (np.abs(px) < 0.97) & (np.abs(py) < 0.97)
    slope = -h * k * np.cos(k * px) * np.cos(k * py), h * k * np.sin(k * px) * np.sin(k * py)
    truth = np.stack([slope[0] * (-1 if mirrored else 1), slope[1], np.ones_like(px)], -1)
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    decoded = found / 255 * 2 - 1
    cosine = (decoded * truth).sum(-1) / np.linalg.norm(decoded, axis=-1)
    assert np.degrees(np.arccos(cosine[inside].clip(-1, 1))).mean() < 0.6
    frame = tangents(flat, faces, uv, vertex_normals(flat, faces))
    assert (frame[:, 3] == (-1 if mirrored else 1)).all()
    np.testing.assert_allclose(frame[:, :3], np.broadcast_to([-1 if mirrored else 1, 0, 0], (4, 3)), atol=1e-12)


# Files


@pytest.fixture(scope="module")
def detailed_cube(cube) -> Mesh:
    fine = surface(trimesh.creation.box(extents=(1.0, 1.0, 1.0)).subdivide().subdivide())
    views = list(pictures(cube, waves, around(12, size=64)))
    return textured(cube, [lambda _: views], TOLERANCE, 128, detailed=fine)


def test_a_glb_holds_texture_and_normal_map(detailed_cube, tmp_path):
    path = tmp_path / "cube.glb"
    write_mesh(path, detailed_cube, lit=True)
    (found,) = trimesh.load_scene(path, process=False).geometry.values()
    np.testing.assert_allclose(found.vertices, detailed_cube.vertices, atol=1e-6)
    np.testing.assert_array_equal(found.faces, detailed_cube.faces)
    np.testing.assert_allclose(found.visual.uv * [1, -1] + [0, 1], detailed_cube.texture.uv, atol=1e-6)
    material = found.visual.material
    assert (material.metallicFactor, material.roughnessFactor) == (0, 1)
    colours = np.asarray(material.baseColorTexture.convert("RGB")).astype(int)
    assert np.abs(colours - detailed_cube.texture.colours).mean() < 2
    np.testing.assert_array_equal(np.asarray(material.normalTexture.convert("RGB")), detailed_cube.texture.normals)
    assert names(tmp_path) == ["cube.glb"]
    about, _ = parts_of(path)
    assert "extensionsUsed" not in about
    write_mesh(path, detailed_cube)
    about, binary = parts_of(path)
    assert about["extensionsUsed"] == ["KHR_materials_unlit"]
    assert all(view["byteOffset"] % 4 == 0 for view in about["bufferViews"])
    primitive = about["meshes"][0]["primitives"][0]
    frame = about["bufferViews"][about["accessors"][primitive["attributes"]["TANGENT"]]["bufferView"]]
    tangent = np.frombuffer(binary, "<f4", frame["byteLength"] // 4, frame["byteOffset"]).reshape(-1, 4)
    np.testing.assert_allclose(np.linalg.norm(tangent[:, :3], axis=-1), 1, atol=1e-5)
    assert set(np.abs(tangent[:, 3])) == {1}
    for image, kind in zip(about["images"], ("JPEG", "PNG"), strict=True):
        view = about["bufferViews"][image["bufferView"]]
        data = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        assert Image.open(io.BytesIO(data)).format == kind


def parts_of(path) -> tuple[dict, bytes]:
    """JSON and numbers of a .glb file."""
    data = path.read_bytes()
    (size,) = struct.unpack("<I", data[12:16])
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def test_an_obj_lies_beside_its_material_and_pictures(detailed_cube, tmp_path):
    path = tmp_path / "cube.obj"
    written = write_mesh(path, detailed_cube)
    assert names(tmp_path) == ["cube-normals.png", "cube.mtl", "cube.obj", "cube.png"]
    assert sorted(file.name for file in written) == names(tmp_path)
    (found,) = trimesh.load_scene(path, process=False).geometry.values()
    corners = found.vertices[found.faces]
    np.testing.assert_allclose(corners, detailed_cube.vertices[detailed_cube.faces], atol=1e-6)
    places = found.visual.uv[found.faces] * [1, -1] + [0, 1]
    np.testing.assert_allclose(places, detailed_cube.texture.uv[detailed_cube.faces], atol=1e-6)
    np.testing.assert_array_equal(np.asarray(found.visual.material.image.convert("RGB")), detailed_cube.texture.colours)
    assert "norm cube-normals.png" in (tmp_path / "cube.mtl").read_text()


@pytest.mark.parametrize("lit", [False, True])
def test_a_usdz_holds_the_texture(detailed_cube, tmp_path, lit, monkeypatch):
    usd, checks = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdValidation")
    monkeypatch.setitem(sys.modules, "pxr", None)  # text, as without usd-core
    path = tmp_path / "cube.usdz"
    write_mesh(path, detailed_cube, lit=lit)
    with zipfile.ZipFile(path) as packed:
        text = packed.read("scene.usda").decode()
        pictures = {name: np.asarray(Image.open(io.BytesIO(packed.read(name)))) for name in packed.namelist()[1:]}
    np.testing.assert_array_equal(pictures["colours.png"], detailed_cube.texture.colours)
    assert ("normals.png" in pictures) == ("inputs:normal.connect" in text) == lit
    assert ("diffuseColor.connect" in text) == lit and ("emissiveColor.connect" in text) != lit
    validators = checks.ValidationRegistry().GetOrLoadAllValidators()
    assert not checks.ValidationContext(validators).Validate(usd.Stage.Open(str(path)))


# Faults


def test_surfaces_that_have_no_texture(cube):
    def fault(vertices, faces) -> str:
        with pytest.raises(LumigraphError) as caught:
            textured((vertices, faces), [], TOLERANCE, 64)
        return str(caught.value)

    assert "no faces" in fault(cube[0], cube[1][:0])
    broken = cube[0].copy()
    broken[3, 1] = np.nan
    assert "1 vertices of the mesh are not finite" in fault(broken, cube[1])


def test_a_texture_that_does_not_fit_into_memory(cube, monkeypatch):
    monkeypatch.setattr("lumigraph.system.memory.free_memory", lambda: 10**8)
    with pytest.raises(LumigraphError, match="1024 x 1024 texels would need 0.2 GB .* smaller --texture-size"):
        textured(cube, [], TOLERANCE, 1024)


def test_a_ply_holds_no_texture(detailed_cube, tmp_path):
    with pytest.raises(LumigraphError, match=r"cube\.ply cannot hold a texture"):
        write_mesh(tmp_path / "cube.ply", detailed_cube)
    assert names(tmp_path) == []


# The unit of exports, and convex pieces


def test_one_known_length_scales_every_export_of_a_run(ball_run, tmp_path, capsys):
    """Two points 0.5 apart in the photographs' frame, which are 3 m apart; again, and the run is the same."""
    folder = shutil.copytree(ball_run.folder, tmp_path / "run")
    options = ["--device", "cpu", "--views", "6", "--level", "2"]
    known = ["--scale-by", "0", "0.1", "0", "0.3", "0.1", "0.4", "3"]
    plain, metric, again = (tmp_path / name for name in ("plain.ply", "metric.ply", "again.ply"))
    assert main(["export", "mesh", str(folder), str(plain), "--cell-size", "0.15", *options]) == 0
    for path in (metric, again):
        assert main(["export", "mesh", str(folder), str(path), "--cell-size", "0.9", *known, *options]) == 0
    a, b, c = (np.asarray(trimesh.load(path, process=False).vertices) for path in (plain, metric, again))
    np.testing.assert_allclose(b, 6 * a, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(b, c)
    run = Run(folder)
    assert run.frame.scale == pytest.approx(6) and run.frame.to_source.matrix.equal(ball_run.frame.to_source.matrix)
    assert main(["export", "points", str(folder), str(plain), "--scale-by", *"0 0 0 0 0 0 1".split()]) == 2
    assert "one point twice" in capsys.readouterr().err


def test_a_position_on_earth_is_carried_along(detailed_cube, tmp_path):
    origin = GeographicOrigin(50.087, 14.421, 230.5)
    frame = Frame.from_json(json.loads(json.dumps(Frame(origin=origin, scale=2.0).to_json())))
    assert frame.origin == origin and frame.scale == 2
    write_mesh(tmp_path / "cube.glb", detailed_cube, origin=origin)
    about, _ = parts_of(tmp_path / "cube.glb")
    said = about["nodes"][1]["extras"]
    assert said["origin"] == origin.to_json() and "WGS 84" in said["reference"]
    write_mesh(tmp_path / "cube.ply", replace(detailed_cube, texture=None), origin=origin)
    assert origin.sentence in read_header(tmp_path / "cube.ply").comments
    assert len(trimesh.load(tmp_path / "cube.ply", process=False).faces) == 12


def test_convex_pieces_cover_an_angle(tmp_path):
    """Two boxes at a right angle: two convex pieces, as large as the boxes, beside the mesh in one file."""
    pytest.importorskip("coacd")
    outline = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]], np.float64)
    vertices = np.concatenate([np.pad(outline, [(0, 0), (0, 1)], constant_values=z) for z in (0, 1)])
    lid = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    a, b = np.arange(6), np.roll(np.arange(6), -1)
    sides = np.concatenate([np.stack([a, b, b + 6], -1), np.stack([a, b + 6, a + 6], -1)])
    mesh = Mesh(vertices, np.concatenate([lid[:, ::-1], lid + 6, sides]), np.full((12, 3), 160, np.uint8))
    pieces = convex_pieces(mesh)
    hulls = [trimesh.Trimesh(*piece) for piece in pieces.values()]
    assert len(pieces) == 2 and all(hull.is_convex and hull.is_watertight for hull in hulls)
    assert sum(hull.volume for hull in hulls) == pytest.approx(5, rel=0.05)
    assert len(convex_pieces(mesh, CollisionOptions(pieces=1))) == 1
    write_mesh(tmp_path / "angle.glb", mesh, pieces=pieces)
    scene = trimesh.load_scene(tmp_path / "angle.glb", process=False)
    assert set(scene.graph.nodes_geometry) == {"source", "UCX_source_00", "UCX_source_01"}
    np.testing.assert_allclose(scene.bounds, [[0, 0, -3], [3, 1, 0]], atol=0.05)  # upright, as the mesh itself
