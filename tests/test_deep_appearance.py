"""Deep appearance: unwrapping, the grid's mesh, and codes between expressions."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import torch
import trimesh
from budgets import budget

from lumigraph.components.image_based import depth
from lumigraph.errors import LumigraphError
from lumigraph.methods.deep_appearance import (
    DeepAppearance,
    charted_hull,
    grid_faces,
    sampled,
    texel_places,
    textured,
    tracked_meshes,
    unwrapped,
)
from lumigraph.run.checkpoint import take_shapes

pytestmark = budget("methods", 5)


def sphere(rows: int, columns: int, radius: float = 0.6) -> torch.Tensor:
    polar, around = torch.linspace(0, torch.pi, rows)[:, None], torch.linspace(0, 2 * torch.pi, columns)[None]
    flat = polar.sin()
    return radius * torch.stack([flat * around.cos(), flat * around.sin(), polar.cos() + 0 * around], -1)


def test_a_photograph_is_unwrapped():
    """The ball's colour is where its surface points, so the texture is known."""
    vertices, (faces, uv) = sphere(49, 65).view(-1, 3), grid_faces(49, 65)
    rgb, shown = unwrapped(tiny.scene().photograph(1), vertices, faces, *texel_places(vertices, faces, uv, 64))
    centre = (torch.arange(64) + 0.5) / 64
    place = sphere(49, 65).movedim(-1, 0)[None]
    v, u = torch.meshgrid(centre, centre, indexing="ij")
    at = torch.nn.functional.grid_sample(place, torch.stack([2 * u - 1, 2 * v - 1], -1)[None], align_corners=True)[0]
    error = (rgb.float() / 255 - (0.5 + at / 1.2)).abs()[shown.expand(3, -1, -1)]
    assert 0.15 < shown.float().mean() < 0.5 and float(error.mean()) < 0.02


def test_unwrapping_and_rendering_are_inverse():
    vertices, (faces, uv) = sphere(49, 65).view(-1, 3), grid_faces(49, 65)
    photograph = tiny.scene().photograph(1)
    rgb, shown = unwrapped(photograph, vertices, faces, *texel_places(vertices, faces, uv, 128))
    from lumigraph import kernels

    beside = kernels.neighbours(faces)
    seen = textured(vertices, rgb.float() / 255, faces, faces, beside, uv, photograph.camera, torch.ones(1, 3))
    inner = tiny.ball(photograph.camera.pose[0])[0] < 2.6
    assert float((seen.rgb - photograph.rgb)[inner].abs().mean()) < 0.02
    assert float((seen.depth - tiny.ball(photograph.camera.pose[0])[0])[inner].abs().max()) < 0.02


def test_faces_look_outwards():
    faces, uv = grid_faces(9, 13)
    a, b, c = sphere(9, 13).view(-1, 3)[faces].unbind(1)
    outwards = (torch.linalg.cross(b - a, c - a) * (a + b + c)).sum(-1)
    assert (outwards > -1e-6).all() and (outwards > 0).sum() > 150
    assert sampled(torch.rand(3, 4, 4), uv).shape == (len(uv), 3)


def expressive() -> tuple[DeepAppearance, object]:
    """The tiny scene as three moments of a ball that grows, with tracked meshes."""
    scene = tiny.scene()
    count = len(scene.names)
    time = torch.arange(count) % 3 / 2
    meshes = torch.stack([sphere(25, 33, 0.55 + 0.1 * float(t)) for t in time])
    moving = replace(scene, cameras=replace(scene.cameras, time=time), about={"vertices": meshes})
    moving = replace(moving, frame=replace(scene.frame, times=(0.0, 1.0)))
    method = DeepAppearance(moving.frame, DeepAppearance.smallest())
    method.begin(moving)
    return method, moving


def test_expressions_are_interpolated():
    """Between two moments the code is between theirs; tracked meshes are those of the moments."""
    method, moving = expressive()
    c = method.config
    assert method.times.rows.tolist() == [0.0, 0.5, 1.0]
    given = tracked_meshes(moving, c.mesh_rows, c.mesh_columns)
    torch.testing.assert_close(given[0].norm(dim=-1).mean(), 0.55 + 0.1 * moving.cameras.time[1], atol=0.02, rtol=0)
    with torch.no_grad():
        first, half, second = (method.code_at(t) for t in (0.0, 0.25, 0.5))
    torch.testing.assert_close(half, 0.5 * (first + second))
    assert (first != second).any()
    assert [control.name for control in method.controls] == ["time"]


@pytest.fixture
def round_hull(monkeypatch):
    """The hull of the ball as from many sharp photographs: cells whose bounding ball touches it."""

    def cells_of(scene: object, cells: int) -> torch.Tensor:
        centres = (torch.arange(cells) + 0.5) * 2 / cells - 1
        places = torch.stack(torch.meshgrid(centres, centres, centres, indexing="ij"), -1)
        return places.norm(dim=-1) < 0.6 + 3**0.5 / cells

    monkeypatch.setattr(depth, "visual_hull", cells_of)
    monkeypatch.setattr("lumigraph.methods.deep_appearance.HULL_CELLS", 32)


def test_the_hull_of_a_ball_is_charted(round_hull):
    scene = tiny.scene()
    rows = charted_hull(scene, 600, 64)
    corners, uv = rows[:, :9].reshape(-1, 3), rows[:, 9:].reshape(-1, 2)
    assert len(rows) <= 620 and float((corners.norm(dim=-1) - 0.6).abs().max()) < 0.08
    assert 0 <= float(uv.min()) and float(uv.max()) <= 1
    faces = torch.arange(len(corners)).view(-1, 3)
    places, normals = texel_places(corners, faces, uv, 64)
    assert float((places.norm(dim=-1) - 0.6).abs().max()) < 0.1
    assert float((normals * places).sum(-1).mean()) > 0.5


def test_the_hull_keeps_holes_and_separate_things(monkeypatch):
    """A frame with a window, and a block beside it: two closed surfaces, one of genus 1."""
    solid = torch.zeros(64, 64, 64, dtype=torch.bool)
    solid[16:38, 26:33, 16:48] = True
    solid[22:32, :, 24:40] = False
    solid[42:50, 26:38, 26:38] = True
    monkeypatch.setattr(depth, "visual_hull", lambda scene, cells: solid)
    scene = tiny.scene()
    hull = depth.hull_surface(replace(scene, frame=replace(scene.frame, bounds=((-1, -1, -1), (1, 1, 1)))))
    made = trimesh.Trimesh(hull.vertices, hull.faces, process=False)
    assert made.is_watertight and made.volume > 0
    assert sorted(part.euler_number for part in made.split()) == [0, 2]


def test_a_still_object_is_shown_by_its_hull_and_kept(round_hull):
    scene = tiny.scene()
    method = DeepAppearance(scene.frame, DeepAppearance.smallest())
    old = method.state_dict()
    method.begin(scene)
    seen = method.eval().render(scene.cameras[1])
    assert float((seen.opacity - scene.photograph(1).alpha).abs().mean()) < 0.05
    again = DeepAppearance(scene.frame, DeepAppearance.smallest()).eval()
    take_shapes(again, method.state_dict())
    again.load_state_dict(method.state_dict())
    torch.testing.assert_close(again.render(scene.cameras[1]).rgb, seen.rgb)
    del old["hull.rows"]  # of a run before there were charts
    DeepAppearance(scene.frame, DeepAppearance.smallest()).load_state_dict(old)


def test_a_scene_without_a_surface_is_refused():
    scene = tiny.scene()
    bare = replace(scene, frame=replace(scene.frame, has_alpha=False))
    with pytest.raises(LumigraphError, match="neither tracked meshes"):
        DeepAppearance(bare.frame, DeepAppearance.smallest()).begin(bare)
