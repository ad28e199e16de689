"""Fitting meshes and voxels: preconditioning, uniform steps, remeshing, pictures of meshes, surfaces of voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
import trimesh
from budgets import budget

from lumigraph.datasets.mesh import Mesh
from lumigraph.errors import LumigraphError
from lumigraph.kernels import neighbours
from lumigraph.methods.mesh_fit import MeshFit, surface_of
from lumigraph.methods.mesh_fit.optimizer import UniformAdam
from lumigraph.methods.mesh_fit.surface import MeshSurface, Solver, remeshed
from lumigraph.methods.voxel_fit import VoxelFit

pytestmark = budget("methods", 8)


def ball(radius: float = 0.6, subdivisions: int = 3, centre=(0.0, 0.0, 0.0)) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions, radius)
    grey = np.full(made.vertices.shape, 128, np.uint8)
    return Mesh(np.asarray(made.vertices) + np.array(centre), np.asarray(made.faces, np.int64), grey)


def teach(method, data, steps: int):
    """So many steps as the trainer takes them."""
    optimizers, chance = method.optimizers(), torch.Generator().manual_seed(0)
    method.train().begin(data)
    for step in range(steps):
        method.before_step(step, step / steps)
        rates = method.learning_rates(step, step / steps)
        for group in (group for optimizer in optimizers for group in optimizer.param_groups):
            group["lr"] = rates[group["name"]]
        sum(method.loss(method.batch(data, chance), step).values()).backward()
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad()
        method.after_step(step)
    return method.eval()


def test_preconditioned_places_give_the_vertices_back():
    """u = (I + lambda L) x, and the solver returns x; L of a constant is zero, so a translation of u is one of x."""
    mesh = ball(subdivisions=2)
    surface = MeshSurface(mesh, 19.0)
    x = torch.from_numpy(mesh.vertices).float()
    torch.testing.assert_close(surface.vertices(), x, atol=1e-5, rtol=0)
    with torch.no_grad():
        surface.places += torch.tensor([0.1, -0.2, 0.3])
    torch.testing.assert_close(surface.vertices(), x + torch.tensor([0.1, -0.2, 0.3]), atol=1e-5, rtol=0)


def test_a_pull_at_one_vertex_moves_its_surroundings():
    """Smoothness spreads the gradient: (I + lambda L)^-1 of a unit vector, of sum 1 and falling with distance."""
    mesh = ball(subdivisions=3)
    spread = Solver(len(mesh.vertices), mesh.faces, 19.0)(torch.eye(len(mesh.vertices))[:, :1])[:, 0]
    away = np.linalg.norm(mesh.vertices - mesh.vertices[0], axis=1)
    assert float(spread.sum()) == pytest.approx(1, abs=1e-4) and float(spread.min()) > 0
    near, middle, far = (float(spread[(away >= a) & (away < b)].mean()) for a, b in ((0, 0.1), (0.1, 0.3), (0.3, 2)))
    assert near > 2 * middle > 8 * far


def test_uniform_steps_go_along_the_gradient():
    """Unlike Adam's, which are equally long along each axis."""
    p, gradient = torch.nn.Parameter(torch.zeros(2, 3)), torch.tensor([[3.0, 0.3, 0.0], [0.0, -0.03, 1.0]])
    optimizer = UniformAdam([p], lr=0.1)
    p.grad = gradient
    optimizer.step()
    torch.testing.assert_close(p.detach(), -0.1 * gradient / 3)


def test_remeshing_keeps_the_surface_and_drops_what_lies_inside():
    """Two balls through each other, and one within: one closed surface, in triangles of a cell."""
    balls = [ball(0.5), ball(0.5, centre=(0.5, 0, 0)), ball(0.2)]
    counts = np.cumsum([0, *(len(one.vertices) for one in balls)])
    faces = np.concatenate([one.faces + n for one, n in zip(balls, counts, strict=False)])
    vertices, colours = (np.concatenate([getattr(one, name) for one in balls]) for name in ("vertices", "colours"))
    joined = Mesh(vertices, faces, colours)
    made = remeshed(joined, 32)
    away = np.minimum(*(np.linalg.norm(made.vertices - np.array(c), axis=1) for c in ((0, 0, 0), (0.5, 0, 0))))
    np.testing.assert_allclose(away, 0.5, atol=0.01)
    assert (neighbours(torch.from_numpy(made.faces)) >= 0).all()
    a, b, c = made.vertices[made.faces].swapaxes(0, 1)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.125 * 2 - np.pi * 0.25**2 * (1.5 - 0.25) / 3 * 2, rel=0.02)


def test_pictures_of_a_mesh_are_those_of_its_shape():
    scene = tiny.scene()
    method = MeshFit(scene.frame, MeshFit.smallest()).eval()
    method.surface.replace(ball())
    camera = scene.cameras[1]
    seen = method.render(camera)
    expected = torch.tensor(tiny.picture(camera.pose[0]))[..., 3] / 255
    assert float((seen.opacity - expected).abs().max()) < 0.6  # the photograph is not antialiased
    outline = tiny.FOCAL * 0.6 / (tiny.DISTANCE**2 - 0.6**2) ** 0.5  # radius in pixels
    assert float(seen.opacity.sum()) == pytest.approx(np.pi * outline**2, rel=0.01)
    hit = seen.depth.isfinite()
    points = camera.rays(camera.pixels()).at(seen.depth.flatten().nan_to_num(posinf=1.0))[hit.flatten()]
    torch.testing.assert_close(points.norm(dim=-1), torch.full((len(points),), 0.6), atol=0.01, rtol=0)
    inner = hit & (seen.opacity == 1)
    cosine = (seen.extra["normals"][inner] * points[inner[hit]] / 0.6).sum(-1)
    assert float(cosine.min()) > 0.98


def test_a_sphere_becomes_the_photographed_ball():
    """From half the box to a radius of 0.6, by silhouettes and colours, and coloured as the photographs are."""
    scene = tiny.scene()
    config = replace(MeshFit.smallest(), cells=12, learning_rate=3e-2, final_learning_rate=3e-3)
    method = teach(MeshFit(scene.frame, config), scene, 80)
    radius = method.surface.vertices().norm(dim=-1)
    assert float((radius - 0.6).abs().mean()) < 0.02 and int(method.remeshings) == 1
    mesh = method.mesh()
    assert np.abs(mesh.colours / 255 - (0.5 + mesh.vertices / 1.2)).mean() < 0.08


def test_voxels_become_a_mesh_and_the_mesh_is_refined():
    scene = tiny.scene()
    voxels = VoxelFit(scene.frame, VoxelFit.smallest())
    grid = voxels.network.grid
    places = torch.cartesian_prod(*[torch.linspace(-1, 1, n) for n in grid.shape])
    with torch.no_grad():
        grid.values[:, 0] = 20 * (0.6 - places.norm(dim=-1)) - voxels.network.shift
        grid.values[:, 1:] = 2 * places
    mesh = voxels.mesh()
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.6, atol=0.05)
    np.testing.assert_allclose(mesh.colours / 255, 1 / (1 + np.exp(-2 * mesh.vertices)), atol=0.02)
    refined = MeshFit(scene.frame, MeshFit.smallest())
    refined.from_field(voxels, scene.cameras)
    np.testing.assert_allclose(refined.mesh().vertices, mesh.vertices, atol=1e-4)


def test_a_mesh_begins_on_the_surfaces_that_any_method_renders():
    scene = tiny.scene()
    teacher = MeshFit(scene.frame, MeshFit.smallest()).eval()
    teacher.surface.replace(ball())
    made = surface_of(teacher, scene.cameras, 24)
    np.testing.assert_allclose(np.linalg.norm(made.vertices, axis=1).mean(), 0.6, atol=0.03)


@pytest.mark.parametrize("kind", [MeshFit, VoxelFit])
def test_open_captures_are_refused(kind):
    scene = tiny.scene()
    open_scene = replace(scene, frame=replace(scene.frame, reach=4.0))
    with pytest.raises(LumigraphError, match="horizon"):
        kind(scene.frame, kind.smallest()).check_data(open_scene)


def test_voxels_without_anything_solid_have_no_mesh():
    with pytest.raises(LumigraphError, match="no surface"):
        VoxelFit(tiny.scene().frame, VoxelFit.smallest()).mesh()
