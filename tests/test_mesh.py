"""Meshes and points of exact solids: shape, closedness, colours, pieces, files, the source's frame, faults."""

from __future__ import annotations

import json
import math
import struct
import sys
import warnings
from collections import defaultdict
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import tiny
import torch
import trimesh
from budgets import budget
from listing import names
from scipy.spatial import cKDTree
from solids import SOLID, Measured, Seen, Solid, around, ball, painted, shell, together, torus

from lumigraph.camera import Camera
from lumigraph.camera.crop import CropBox, Sphere
from lumigraph.camera.rays import Rendering
from lumigraph.commands.cli import main
from lumigraph.datasets.mesh import Mesh
from lumigraph.datasets.scene import Frame, Scene
from lumigraph.depth_maps import Tolerance, agreed, render_depth_maps
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.exchange import write_gaussians
from lumigraph.export.mesh import best_way, extract_mesh, meshed_box
from lumigraph.export.mesh_file import write_mesh
from lumigraph.export.options import MeshOptions, PointsOptions
from lumigraph.export.points import PointCloud, extract_points, thinned, write_points
from lumigraph.export.surface import BLOCK, Grid, border, majority, manifold, simplified, smoothed, zero_level
from lumigraph.files.ply import read_rows
from lumigraph.gaussians import Gaussians
from lumigraph.kernels.spherical_harmonics import K00
from lumigraph.readers.surveyed import read_surveyed
from lumigraph.run import Run
from lumigraph.training import fit

pytestmark = budget("exports", 25)

CELL = 1 / 24
# A scene that was shrunk to half, turned a quarter about z and moved.
MOVED = ((0.0, -2.0, 0.0, 5.0), (2.0, 0.0, 0.0, -1.0), (0.0, 0.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0))

OPEN = Frame(bounds=((-1.0,) * 3, (1.0,) * 3), near=0.1, reach=4.0)


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False)


@pytest.fixture(scope="module")
def solid_ball() -> Mesh:
    return extract_mesh(Solid(ball()), around(), MeshOptions(cell_size=CELL, level=SOLID / 2))


@pytest.mark.parametrize("kind", [Measured, Solid, Seen], ids=["distance", "density", "depth"])
@pytest.mark.parametrize("name", ["ball", "torus"])
def test_a_mesh_is_closed_and_lies_on_the_surface(kind, name):
    distance = {"ball": ball(), "torus": torus()}[name]
    volume = {"ball": 4 / 3 * math.pi * 0.6**3, "torus": 2 * math.pi**2 * 0.55 * 0.2**2}[name]
    assert best_way(kind(distance))[0] == {Measured: "distance", Solid: "density", Seen: "depth"}[kind]
    mesh = extract_mesh(kind(distance), around(), MeshOptions(cell_size=CELL))
    solid = as_trimesh(mesh)
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.euler_number == {"ball": 2, "torus": 0}[name]
    # The density's own ramp is a third of a cell wide, and its surface is said to be where it begins.
    assert solid.volume == pytest.approx(volume, rel=0.12 if kind is Solid else 0.03)
    away = distance(torch.from_numpy(mesh.vertices).float()).abs()
    assert away.mean() < (0.35 if kind is Solid else 0.1) * CELL and away.max() < CELL
    diagonal = np.linalg.norm(solid.extents)
    assert away.mean() < 0.01 * diagonal


def test_a_level_is_met_to_a_small_part_of_a_cell(solid_ball):
    assert as_trimesh(solid_ball).volume == pytest.approx(4 / 3 * math.pi * 0.6**3, rel=0.02)
    away = np.abs(np.linalg.norm(solid_ball.vertices, axis=-1) - 0.6)
    assert away.mean() < 0.1 * CELL and away.max() < 0.4 * CELL


def test_the_chamfer_distance_is_far_below_a_hundredth_of_the_diagonal(solid_ball):
    """Mean distance from samples of the mesh to the solid, and back from the solid to the samples; half their sum."""
    exact = np.random.default_rng(0).normal(size=(2000, 3))
    exact *= 0.6 / np.linalg.norm(exact, axis=-1, keepdims=True)
    samples, _ = trimesh.sample.sample_surface(as_trimesh(solid_ball), 20_000, seed=0)
    there = np.abs(np.linalg.norm(samples, axis=-1) - 0.6).mean()
    back = cKDTree(samples).query(exact)[0]
    assert back.max() < CELL and 0.5 * (there + back.mean()) < 0.003 * 1.2 * math.sqrt(3)


@pytest.mark.parametrize("kind", [Solid, Seen], ids=["density", "depth"])
def test_colours_are_those_of_the_field(kind):
    mesh = extract_mesh(kind(ball()), around(), MeshOptions(cell_size=CELL))
    expected = 255 * painted(torch.from_numpy(mesh.vertices).float()).numpy()
    assert np.abs(mesh.colours - expected).mean() < 1.5 and np.abs(mesh.colours - expected).max() < 6


def test_faces_look_outward(solid_ball):
    normals = as_trimesh(solid_ball).face_normals
    centres = solid_ball.vertices[solid_ball.faces].mean(1)
    assert ((normals * centres).sum(-1) > 0.5).all()


@pytest.mark.parametrize(("keep", "pieces"), [(0.01, 2), (0.05, 1)])
def test_small_pieces_are_dropped(keep, pieces):
    method = Solid(together(ball(), ball(0.1, (0.0, 0.0, 0.85))))  # a share of 0.028 of the area
    mesh = extract_mesh(method, around(), MeshOptions(cell_size=CELL, keep=keep, smooth=0))
    assert as_trimesh(mesh).body_count == pieces


def test_there_are_no_caves_inside():
    mesh = as_trimesh(extract_mesh(Solid(shell()), around(), MeshOptions(cell_size=CELL, level=SOLID / 2)))
    assert mesh.body_count == 1 and mesh.volume == pytest.approx(4 / 3 * math.pi * 0.6**3, rel=0.02)


@pytest.mark.parametrize("kind", [Solid, Seen], ids=["density", "depth"])
def test_what_no_camera_sees_is_closed_or_cut(kind):
    above = around(lowest=20)
    closed = as_trimesh(extract_mesh(kind(ball()), above, MeshOptions(cell_size=CELL, unseen="close")))
    cut = as_trimesh(extract_mesh(kind(ball()), above, MeshOptions(cell_size=CELL, unseen="cut")))
    assert closed.is_watertight and closed.vertices[:, 2].min() < -0.55
    assert not cut.is_watertight and -0.5 < cut.vertices[:, 2].min() < -0.1
    assert np.abs(np.linalg.norm(cut.vertices, axis=-1) - 0.6).max() < CELL


def test_a_surface_that_leaves_the_box_is_closed_there_or_open():
    wide = Solid(ball(), Frame(bounds=((-1.0, -1.0, -0.3), (1.0, 1.0, 1.0)), near=0.1))
    closed, cut = (
        extract_mesh(wide, around(), MeshOptions(cell_size=CELL, unseen="close" if x else "cut")) for x in (True, False)
    )
    assert as_trimesh(closed).is_watertight and not as_trimesh(cut).is_watertight
    assert all(abs(x.vertices[:, 2].min() + 0.3) < 1.5 * CELL for x in (closed, cut))


@pytest.mark.parametrize("kind", [Solid, Seen], ids=["density", "depth"])
def test_a_crop_is_all_that_is_meshed(kind):
    crop = Sphere((0.5, 0.0, 0.0), 0.4)
    mesh = as_trimesh(extract_mesh(kind(ball()), around(), MeshOptions(cell_size=CELL, smooth=0), crop=crop))
    away = np.linalg.norm(mesh.vertices - crop.middle, axis=-1)
    assert mesh.is_watertight and away.max() < 0.4 + CELL
    assert np.linalg.norm(mesh.vertices[away < 0.35], axis=-1) == pytest.approx(0.6, abs=CELL)
    with pytest.raises(LumigraphError, match="outside the scene"):
        extract_mesh(kind(ball()), around(), MeshOptions(cell_size=CELL), crop=Sphere((9.0, 0.0, 0.0), 0.4))


def test_the_box_may_be_larger_or_smaller_and_grows_in_the_open():
    frame = Frame(bounds=((-0.4,) * 3, (0.4,) * 3), near=0.1, reach=4.0)
    assert meshed_box(frame, None).upper == pytest.approx((0.6,) * 3)
    assert meshed_box(frame, 100.0) == CropBox((-4.0,) * 3, (4.0,) * 3)
    assert meshed_box(replace(frame, reach=1.0), None).upper == pytest.approx((0.4,) * 3)
    mesh = extract_mesh(Seen(ball(), frame), around(), MeshOptions(cell_size=CELL, extent=2.0))
    assert as_trimesh(mesh).is_watertight and as_trimesh(mesh).extents.min() > 1.1


class Scanned(Seen):
    """A room of 8 x 6 x 3 whose walls were measured, around a box of interest of 2, and a small piece above it."""

    def __init__(self):
        super().__init__(ball(), OPEN)

    def mesh(self) -> Mesh:
        room = trimesh.creation.box((8.0, 6.0, 3.0)).subdivide().subdivide().subdivide()
        lamp = trimesh.creation.box((0.3, 0.3, 0.2), trimesh.transformations.translation_matrix((0, 0, 1.7)))
        room = trimesh.util.concatenate([room, lamp])
        colours = np.full((len(room.vertices), 3), 9, np.uint8)
        return Mesh(np.array(room.vertices), np.array(room.faces), colours)


def test_a_measured_mesh_is_whole_and_a_cut_is_said():
    options = MeshOptions(smooth=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = extract_mesh(Scanned(), around(), options)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (8, 6, 3.3))
    with pytest.warns(LumigraphWarning, match=r"outside the meshed region and is left out; a larger --extent") as said:
        part = extract_mesh(Scanned(), around(), replace(options, extent=3.5))
    whole, kept = (float(as_trimesh(x).area) for x in (mesh, part))
    assert f"{100 * (1 - kept / whole):.2g} %" in str(said[0].message) and kept < 0.7 * whole
    assert (part.vertices.max(0) <= 3.5).all()


def test_what_a_box_cuts_is_said():
    """A ball of radius 1.4 that a box of interest of half-size 1 cuts."""
    cameras, big = around(), Seen(ball(1.4), Frame(near=0.1, reach=4.0))
    with pytest.warns(LumigraphWarning, match="of the surface lies outside the meshed region"):
        extract_mesh(big, cameras, MeshOptions(cell_size=1 / 8, extent=1.0))
    with pytest.warns(LumigraphWarning, match="of the surface lies outside the crop"):
        extract_points(big, cameras, PointsOptions(count=100), Sphere((1.4, 0.0, 0.0), 1.0))


def test_smoothing_takes_noise_and_leaves_the_volume():
    solid = trimesh.creation.icosphere(4)
    noise = 0.01 * np.random.default_rng(0).normal(size=len(solid.vertices))
    rough = np.asarray(solid.vertices) * (1 + noise[:, None])
    smooth = smoothed(rough, np.asarray(solid.faces), 20)
    before, after = (trimesh.Trimesh(v, solid.faces, process=False) for v in (rough, smooth))
    assert after.volume == pytest.approx(before.volume, rel=0.01)
    assert np.linalg.norm(smooth, axis=-1).std() < 0.5 * np.linalg.norm(rough, axis=-1).std()
    half = np.asarray(solid.faces)[solid.triangles_center[:, 2] > 0]
    rim = trimesh.Trimesh(rough, half, process=False).outline().referenced_vertices
    even = smoothed(rough, half, 20)[rim]
    assert even[:, 2].std() < 0.6 * rough[rim][:, 2].std()  # a jagged border becomes even, and stays where it was
    assert np.hypot(*even[:, :2].T).mean() == pytest.approx(np.hypot(*rough[rim][:, :2].T).mean(), rel=0.01)


def test_edges_have_two_faces_and_vertices_one_fan():
    """Two boxes that share an edge, two that share a corner, and a face that has shrunk to a line."""
    box, rng = trimesh.creation.box(), np.random.default_rng(0)
    apart = [np.asarray(box.vertices) + shift for shift in ((0, 0, 0), (1, 1, 0), (-1, -1, -1))]
    where, same = np.unique(np.concatenate(apart), axis=0, return_inverse=True)
    faces = same[np.concatenate([np.asarray(box.faces) + 8 * k for k in range(3)])]
    faces = np.concatenate([faces, [[0, 0, 1]]])[rng.permutation(len(faces) + 1)]
    assert len(where) == 24 - 2 - 1 and not is_manifold(faces)
    taken, split = manifold(faces)
    assert is_manifold(split) and len(split) == 36
    assert (where[taken][split] == where[faces[(faces != np.roll(faces, 1, 1)).all(-1)]]).all()
    assert trimesh.Trimesh(where[taken], split, process=False).body_count == 3
    wild = rng.integers(0, 9, (60, 3))  # any faces at all
    assert not is_manifold(wild) and is_manifold(manifold(wild)[1])


def is_manifold(faces: np.ndarray) -> bool:
    """True if no edge has more than two faces, and the edges across from each vertex are one chain."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    if (np.unique(edges, axis=0, return_counts=True)[1] > 2).any():
        return False
    across = defaultdict(list)
    for face in faces.tolist():
        for vertex in set(face):
            across[vertex].append(set(face) - {vertex})
    for left in across.values():
        chain = left.pop()
        while touching := [edge for edge in left if edge & chain]:
            chain = chain.union(*touching)
            left = [edge for edge in left if edge not in touching]
        if left:
            return False
    return True


def test_an_open_surface_is_cut_where_one_camera_alone_sees_it():
    floor = Seen(lambda points: points[:, 2] + 0.02 * (9 * points[:, :2]).sin().sum(-1), OPEN)
    cameras = around(9, lowest=40.0, distance=1.5)
    one, all_of_them = (extract_mesh(floor, x, MeshOptions(cell_size=CELL, smooth=0)) for x in (cameras[:1], cameras))
    assert len(one.faces) > 1000  # nobody can confirm what it sees
    assert is_manifold(all_of_them.faces) and as_trimesh(all_of_them).body_count == 1
    points = torch.from_numpy(all_of_them.vertices).float()
    maps = render_depth_maps(floor.render, cameras, OPEN.background)
    once = ~agreed(points, maps, Tolerance(5 * CELL))
    inner = ~np.isin(np.arange(len(points)), border(len(points), all_of_them.faces).nonzero()[0])
    assert once[inner].float().mean() < 0.02 and agreed(points, maps[:1], Tolerance(5 * CELL)).float().mean() < 0.9


@pytest.mark.parametrize("kind", [Measured, Solid, Seen], ids=["distance", "density", "depth"])
def test_what_masks_leave_out_is_no_surface(kind):
    """A ball on a plate, with masks of the ball alone."""
    cameras = around(24, lowest=10.0)
    scene = kind(together(ball(), lambda points: (points[:, 2] + 0.7).abs() - 0.06))
    alone = render_depth_maps(Seen(ball()).render, cameras, scene.frame.background)
    store = SimpleNamespace(mask=lambda index: alone[index].solid)
    photographs = Mock(Scene, images=store, splits={"train": torch.arange(len(cameras))})
    both, masked = (
        extract_mesh(scene, cameras, MeshOptions(cell_size=CELL), photographs=x) for x in (None, photographs)
    )
    assert both.vertices[:, 2].min() < -0.7 and both.vertices[:, 0].max() > 0.9
    assert as_trimesh(masked).is_watertight and as_trimesh(masked).body_count == 1
    assert as_trimesh(masked).volume == pytest.approx(4 / 3 * math.pi * 0.6**3, rel=0.1)
    assert np.abs(masked.vertices[:, :2]).max() < 0.6 + CELL and masked.vertices[:, 2].max() < 0.6 + CELL


def test_the_outline_of_a_mask_becomes_even():
    """A square of a grid of triangles, with a thread that leaves it and a hole of one vertex."""
    side = 40
    number = np.arange(side * side).reshape(side, side)
    a, b, c, d = (number[i : side - 1 + i, j : side - 1 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    square = np.zeros((side, side), bool)
    square[8:28, 8:28] = True
    spoilt = square.copy()
    spoilt[15, 28:38], spoilt[20, 20] = True, False
    found = majority(spoilt.ravel(), faces, 30).reshape(side, side)
    assert found[20, 20] and not found[:, 30:].any()
    assert (found ^ square).sum() < 0.1 * square.sum() and (majority(square.ravel(), faces, 0) == square.ravel()).all()


def test_fewer_faces_keep_shape_and_colours():
    mesh = extract_mesh(Seen(ball()), around(), MeshOptions(cell_size=CELL, faces=1000))
    solid = as_trimesh(mesh)
    assert 900 < len(mesh.faces) <= 1000 and solid.is_watertight
    assert solid.volume == pytest.approx(4 / 3 * math.pi * 0.6**3, rel=0.02)
    expected = 255 * painted(torch.from_numpy(mesh.vertices).float()).numpy()
    assert np.abs(mesh.colours - expected).mean() < 2
    assert simplified(mesh.vertices, mesh.faces, 5000)[1] is mesh.faces


def test_blocks_fit_together_and_unknown_places_are_left_open():
    grid = Grid.around((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.05, 1.5)
    blocks = np.array([-(-n // BLOCK) for n in grid.shape])
    centres = np.array(grid.low) + grid.cell * BLOCK * (np.stack(np.indices(blocks), -1) + 0.5)
    radius = np.linalg.norm(centres, axis=-1)
    near = np.abs(radius - 0.7) < 0.87 * BLOCK * grid.cell
    assert 0.2 < near.mean() < 0.9

    def value(points):
        return (5 * (0.7 - points.norm(dim=-1))).clamp(-1, 1)

    vertices, faces = zero_level(grid, value, near, np.where(radius < 0.7, 1.0, -1.0))
    solid = trimesh.Trimesh(vertices, faces, process=False)
    assert solid.is_watertight and solid.volume == pytest.approx(4 / 3 * math.pi * 0.7**3, rel=0.01)
    whole = zero_level(grid, value, np.ones(blocks, bool), np.zeros(blocks))
    assert len(whole[0]) == len(vertices) and len(whole[1]) == len(faces)
    torch.manual_seed(0)
    noise = torch.randn(1, 1, 20, 20, 20)

    def jumble(points):
        found = torch.nn.functional.grid_sample(noise, points[None, None, None], align_corners=True)[0, 0, 0, 0]
        return torch.where((points.abs() < 1).all(-1), found.clamp(-1, 1), -1.0)

    vertices, faces = zero_level(grid, jumble, np.ones(blocks, bool), -np.ones(blocks))
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()  # closed, however wild

    def half(points):
        return torch.where(points[:, 0] < 0.2, value(points), torch.nan)

    vertices, _ = zero_level(grid, half, np.ones(blocks, bool), -np.ones(blocks))
    assert 0.1 < vertices[:, 0].max() < 0.21 and np.isfinite(vertices).all()


def test_normals_and_depths_of_a_view():
    method = Seen(ball())
    seen = render_depth_maps(method.render, around(4), method.frame.background)[0]
    rays = seen.camera.rays(seen.camera.pixels())
    points = rays.at(seen.surface_depth.reshape(-1)).reshape(*seen.depth.shape, 3)
    squarely = seen.facing > 0.4
    assert squarely.sum() > 300
    normals, outward = seen.surface_normals[squarely], torch.nn.functional.normalize(points[squarely], dim=-1)
    assert (normals * outward).sum(-1).min() > 0.98
    moved = points[squarely] - 0.1 * rays.directions.reshape(points.shape)[squarely]
    compared = seen.compare(moved, Tolerance(0.1))
    assert (compared.ahead - 0.1).abs().median() < 1e-4
    behind = seen.compare(seen.camera.position - seen.camera.forward, Tolerance(0.1))
    assert behind.ahead.isnan().all()


# Files


@pytest.mark.parametrize("ending", [".ply", ".obj", ".glb"])
def test_files_open_elsewhere_with_their_colours(solid_ball, tmp_path, ending):
    path = tmp_path / f"ball{ending}"
    write_mesh(path, solid_ball)
    scene = trimesh.load_scene(path, process=False)
    (found,) = scene.geometry.values()
    np.testing.assert_allclose(found.vertices, solid_ball.vertices, atol=1e-6)
    np.testing.assert_array_equal(found.faces, solid_ball.faces)
    assert found.is_watertight and found.volume > 0
    if ending != ".glb":
        np.testing.assert_array_equal(found.visual.vertex_colors[:, :3], solid_ball.colours)
    else:
        linear = np.asarray(found.visual.vertex_attributes["color"], np.float64)
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        np.testing.assert_allclose(255 * encoded, solid_ball.colours, atol=0.01)
    assert names(tmp_path) == [path.name]


def test_a_glb_is_unlit_and_well_formed(solid_ball, tmp_path):
    write_mesh(tmp_path / "ball.glb", solid_ball)
    data = (tmp_path / "ball.glb").read_bytes()
    magic, version, length, size = struct.unpack("<4sIII", data[:16])
    assert (magic, version, length) == (b"glTF", 2, len(data)) and size % 4 == 0
    about = json.loads(data[20 : 20 + size])
    assert "KHR_materials_unlit" in about["materials"][0]["extensions"]
    assert all(view["byteOffset"] % 4 == 0 for view in about["bufferViews"])
    assert about["buffers"][0]["byteLength"] == struct.unpack("<I", data[20 + size : 24 + size])[0]


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, -0.8), (0.0, 1.0, 0.0)])
def test_a_glb_stands_upright_elsewhere(solid_ball, tmp_path, up):
    """Vertices are the source's, and the node above them brings up to +y, as glTF demands."""
    path, up = tmp_path / "ball.glb", np.array(up)
    far = int((solid_ball.vertices @ up).argmax())
    write_mesh(path, solid_ball, up)
    scene = trimesh.load_scene(path, process=False)
    (name,) = scene.graph.nodes_geometry
    placed, _ = scene.graph.get(name)
    np.testing.assert_allclose(placed[:3, :3] @ up, [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(placed[:3, :3] @ placed[:3, :3].T, np.eye(3), atol=1e-6)
    (seen,) = scene.dump()
    assert int(seen.vertices[:, 1].argmax()) == far and seen.volume > 0
    about = json.loads((data := path.read_bytes())[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    np.testing.assert_allclose(about["nodes"][0]["extras"]["source_from_upright"], placed[:3, :3].T, atol=1e-6)


def test_another_frame_moves_scales_and_keeps_the_outside_outside(solid_ball):
    moved = solid_ball.in_source(Frame(source_from_scene=MOVED))
    np.testing.assert_allclose(moved.vertices.mean(0), (5, -1, 0.5), atol=0.05)
    assert as_trimesh(moved).volume == pytest.approx(8 * as_trimesh(solid_ball).volume, rel=1e-6)
    mirrored = solid_ball.transformed(np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert as_trimesh(mirrored).volume == pytest.approx(as_trimesh(solid_ball).volume, rel=1e-6)


# Points


def test_points_lie_on_the_surface_evenly():
    points = extract_points(Seen(torus()), around(), PointsOptions(3000))
    away = torus()(torch.from_numpy(points.positions).float()).abs()
    assert 2700 < len(points.positions) <= 3000 and away.mean() < 0.005 and away.max() < 0.05
    expected = 255 * painted(torch.from_numpy(points.positions).float()).numpy()
    assert np.abs(points.colours - expected).mean() < 2
    ring = points.positions * [1, 1, 0]
    ring *= 0.55 / np.linalg.norm(ring, axis=-1, keepdims=True)
    outward = (points.positions - ring) / np.linalg.norm(points.positions - ring, axis=-1, keepdims=True)
    assert (points.normals * outward).sum(-1).mean() > 0.98
    upper = (points.positions[:, 2] > 0).mean()
    assert 0.45 < upper < 0.55


class Floater(Seen):
    """A ball; and to the first camera alone, something in front of it."""

    def render(self, camera: Camera) -> Rendering:
        seen = super().render(camera)
        if torch.allclose(camera.position[0], around().position[0], atol=1e-4):
            seen.depth[40:56, 40:56] = 1.0
        return seen


def test_what_one_camera_alone_sees_is_no_point():
    points = extract_points(Floater(ball()), around(), PointsOptions(3000))
    assert np.abs(np.linalg.norm(points.positions, axis=-1) - 0.6).max() < 0.05


def test_thinning_gives_at_most_so_many_of_equal_spacing():
    some = np.random.default_rng(0).random((20_000, 4))
    few = thinned(some, 500)
    assert 400 < len(few) <= 500 and thinned(some[:100], 500) is not some and len(thinned(some[:100], 500)) == 100
    np.testing.assert_allclose(few.mean(0), 0.5, atol=0.05)


def test_a_file_of_points(tmp_path):
    frame = Frame(source_from_scene=MOVED)
    points = extract_points(Seen(ball()), around(), PointsOptions(500))
    write_points(tmp_path / "points.ply", points.in_source(frame))
    vertex = read_rows(tmp_path / "points.ply", ["vertex"])["vertex"]
    position, normal = (np.stack([vertex[x] for x in names], -1) for names in (("x", "y", "z"), ("nx", "ny", "nz")))
    np.testing.assert_allclose(np.linalg.norm(position - [5, -1, 0.5], axis=-1), 1.2, atol=0.05)
    np.testing.assert_allclose(normal, (position - [5, -1, 0.5]) / 1.2, atol=0.25)
    assert vertex["red"].dtype == np.uint8 and len(vertex) == len(points.positions)


# Commands and faults


def test_commands_write_in_the_frame_of_the_photographs(tmp_path, capsys):
    plain = tiny.scene()
    made = replace(plain, frame=replace(plain.frame, source_from_scene=MOVED))
    run = Run.create(tmp_path / "run", method := tiny.method(made.frame), made)
    fit(method, made, run, steps=80, show=False)
    options = ["--device", "cpu", "--views", "9"]
    mesh, points = tmp_path / "ball.glb", tmp_path / "ball.ply"
    assert main(["export", "mesh", str(run.folder), str(mesh), "--cell-size", "0.15", *options]) == 0
    assert main(["export", "points", str(run.folder), str(points), "--count", "300", *options]) == 0
    assert "triangles" in capsys.readouterr().out
    scene = trimesh.load_scene(mesh, process=False)
    (found,) = scene.geometry.values()
    assert found.is_watertight
    np.testing.assert_allclose(found.bounds.mean(0), (5, -1, 0.5), atol=0.3)
    np.testing.assert_allclose(scene.bounds.mean(0), (5, 0.5, 1), atol=0.3)  # +z of the source is up
    assert found.volume == pytest.approx(4 / 3 * math.pi * 1.2**3, rel=0.35)


def test_a_splat_file_is_looked_at_from_a_dome(tmp_path):
    """A ball of flat Gaussians; splat files have y pointing down."""
    generator = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator), dim=-1)
    quaternions = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(4000, 4)
    harmonics = (means / 2 / K00)[:, None] * torch.tensor([0.8, 0.8, 0.8])
    cloud = Gaussians(means, quaternions, torch.full((4000, 3), -3.2), torch.full((4000,), 4.0), harmonics)
    write_gaussians(tmp_path / "ball.ply", cloud)
    options = ["--size", "100", "--views", "24", "--device", "cpu"]
    assert main(["export", "points", str(tmp_path / "ball.ply"), str(tmp_path / "points.ply"), *options]) == 0
    options += ["--cell-size", "0.06"]
    assert main(["export", "mesh", str(tmp_path / "ball.ply"), str(tmp_path / "mesh.ply"), *options]) == 0
    found = trimesh.load(tmp_path / "points.ply")
    assert np.linalg.norm(found.vertices, axis=-1).mean() == pytest.approx(1, abs=0.05)
    assert np.abs(found.colors[:, :3] / 255 - (0.5 + 0.4 * found.vertices)).mean() < 0.08
    mesh = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    height = -mesh.vertices[:, 1]  # y points down
    assert (height < -0.5).sum() < 0.9 * (height > 0.5).sum() and height.max() > 0.95
    assert np.linalg.norm(mesh.vertices, axis=-1).mean() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"cell_size": 1e-4}, "--cell-size"),
        ({"cell_size": 1.5}, "--cell-size"),
        ({"way": "density"}, "holds no density"),
    ],
)
def test_nothing_to_make_a_mesh_of(options, said):
    method = Seen(ball()) if options.get("way") == "density" else Solid(ball())
    with pytest.raises(LumigraphError, match=said):
        extract_mesh(method, around(8, 32), MeshOptions(**{"cell_size": CELL} | options))


@pytest.mark.parametrize("options", [{}, {"level": SOLID / 2}, {"way": "depth"}])
def test_a_box_without_a_surface(options):
    frame = Frame(bounds=((0.5, 0.5, 0.5), (1.0, 1.0, 1.0)), near=0.1)
    with pytest.raises(LumigraphError, match="inside the box"):
        extract_mesh(Solid(ball(), frame), around(8, 32), MeshOptions(**options))


@pytest.mark.parametrize("make", [extract_mesh, extract_points])
def test_an_empty_scene(make):
    with pytest.raises(LumigraphError, match="anything solid"):
        make(Seen(ball(0.1, (0.0, 0.0, 50.0))), around(8, 32))


BAD = {
    "ending": ["mesh", "RUN", "ball.stl"],
    "cell size": ["mesh", "RUN", "ball.ply", "--cell-size", "-1"],
    "extent": ["mesh", "RUN", "ball.ply", "--extent", "0"],
    "empty box": ["mesh", "RUN", "ball.ply", "--box", *"0 0 0 1 1 -1".split()],
    "faces": ["mesh", "RUN", "ball.ply", "--faces", "0"],
    "share": ["mesh", "RUN", "ball.ply", "--keep", "2"],
    "no run": ["mesh", "RUN", "ball.ply"],
    "points' ending": ["points", "RUN", "ball.obj"],
    "no points": ["points", "RUN", "ball.ply", "--count", "0"],
    "no views": ["points", "RUN", "ball.ply", "--views", "0"],
}


@pytest.mark.parametrize("arguments", BAD.values(), ids=BAD.keys())
def test_bad_input_gets_one_sentence(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", *arguments]) == 2
    told = capsys.readouterr()
    assert told.out == "" and len(told.err.splitlines()) == 1 and told.err.startswith("lumigraph: ")
    assert list(tmp_path.iterdir()) == []


FAR = np.array([512345.7, 4649776.2, 312.4])


@pytest.mark.parametrize("ending", [".ply", ".obj", ".glb", ".usdz"])
def test_far_from_the_origin_meshes_keep_their_places(tmp_path, solid_ball, ending):
    far = replace(solid_ball, vertices=solid_ball.vertices.astype(np.float64) + FAR)
    path = tmp_path / f"a{ending}"
    write_mesh(path, far)
    if ending == ".usdz":  # about its own base, with the place as data
        layer = pytest.importorskip("pxr.Sdf").Layer.FindOrOpen(str(path))
        x, y, z, _ = layer.customLayerData["sourceFromUpright"].GetRow(3)
        assert abs(x - FAR[0]) < 1 and abs(y - FAR[1]) < 1
        return
    found = trimesh.load(path, process=False, maintain_order=True)
    if ending == ".glb":
        matrix, name = found.graph["source"]
        upright, _ = found.graph["upright"]
        local = np.asarray(found.geometry[name].vertices, np.float64)
        places = (local @ matrix[:3, :3].T + matrix[:3, 3]) @ upright[:3, :3]
    else:
        places = np.asarray(found.vertices)
    distance, _ = cKDTree(far.vertices).query(places)
    assert distance.max() < 1e-4 and len(places) == len(far.vertices)


def test_far_points_are_doubles(tmp_path):
    laspy = pytest.importorskip("laspy")
    random = np.random.default_rng(0)
    near = random.normal(size=(500, 3))
    for offset, kind in ((0.0, "<f4"), (FAR, "<f8")):
        points = PointCloud(near + offset, np.tile([0.0, 0.0, 1.0], (500, 1)), np.full((500, 3), 9, np.uint8))
        write_points(tmp_path / "a.ply", points)
        rows = read_rows(tmp_path / "a.ply", ["vertex"])["vertex"]
        assert rows.dtype["x"].str == kind
        found = np.stack([rows[name] for name in "xyz"], 1)
        np.testing.assert_allclose(found, near + offset, atol=1e-5)
        for name in ("a.las", "a.laz"):
            write_points(tmp_path / name, points)
            np.testing.assert_allclose(read_surveyed(tmp_path / name).points, near + offset, atol=1e-4)
            there = laspy.read(tmp_path / name)
            assert set(there.green) == {9 * 257} and set(there.NormalZ) == {1} and set(there.NormalX) == {0}


def test_las_without_its_library_names_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(LumigraphError, match=r"lumigraph\[lidar\]"):
        write_points(tmp_path / "a.las", PointCloud(np.eye(3), np.eye(3), np.eye(3, dtype=np.uint8)))
