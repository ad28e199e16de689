"""Points and meshes of trained fields, one for each family, with the constants that are shipped: they lie on the ball.

The contract exports every method, after steps so few that it must count half-transparent scenes as solid. Coordinate
networks are left out: they need minutes to be solid.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Scene
from lumigraph.export.mesh import extract_mesh
from lumigraph.export.options import MeshOptions
from lumigraph.export.points import extract_points
from lumigraph.files.ranges import changed
from lumigraph.method.capabilities import HasDensity, can
from lumigraph.run import build
from lumigraph.training import fit

pytestmark = [budget("methods", 15), pytest.mark.filterwarnings("ignore:The cloud stops growing")]

RADIUS, SIZE, CELL = 0.6, 48, 1 / 12
HASH = {"samples_per_step": 1 << 14, "occupancy_resolution": 32, "levels": 6, "max_resolution": 48}
CLOUD = {"max_gaussians": 3000, "initial_gaussians": 1000}
FAMILIES = {  # a method, its steps, numbers beside those of its smallest configuration
    "hash table": ("instant-ngp", 200, HASH | {"refine_cameras": False, "exposure_correction": "no"}),
    "voxel grid": ("dvgo", 250, {}),
    "cloud": ("gaussian-splatting", 300, CLOUD | {"refine_cameras": False, "opacity_reset_interval": 1000}),
}


@cache
def patterned() -> Scene:
    """The ball in 24 pictures of 48 x 48, with waves on it by which its surface can be found."""
    scene = tiny.made(24, SIZE, 64.0)
    pictures = []
    for i in range(len(scene)):
        rays = scene.cameras[i].rays(scene.cameras[i].pixels())
        middle = (rays.origins * rays.directions).sum(-1)
        under = middle**2 - (rays.origins.square().sum(-1) - RADIUS**2)
        places = rays.at(-middle - under.clamp_min(0).sqrt())
        rgb = (0.5 + 0.2 * torch.sin(14 * places) + 0.25 * places / RADIUS).clamp(0, 1)
        rgba = torch.cat([rgb, torch.ones_like(rgb[:, :1])], -1) * (under > 0)[:, None]
        pictures.append((255 * rgba).byte().view(SIZE, SIZE, 4).numpy())
    return replace(scene, images=ImageStore.from_arrays(pictures))


@pytest.fixture(scope="session", params=FAMILIES)
def field(request):
    name, steps, numbers = FAMILIES[request.param]
    kind, scene = methods.find(name), patterned()
    method = build(kind, scene.frame, changed(kind.smallest(), **numbers), torch.device("cpu"), 0)
    fit(method, scene, steps=steps, show=False, rehearsal=False)
    return method.eval()


def off(places: np.ndarray) -> np.ndarray:
    """Distances from the ball's surface, positive outside."""
    return np.linalg.norm(places, axis=1) - RADIUS


def test_points_lie_on_the_surface(field):
    """Depth is a mean over what is half-transparent, so that points lie a little inside: measured medians are -0.02 to
    -0.06, of radius 0.6, and the 5 % that are deepest begin at -0.04 to -0.11."""
    points = extract_points(field, patterned().cameras, 400)
    found = off(points.positions)
    assert len(found) > 200 and -0.09 < np.median(found) < 0.02
    assert np.quantile(found, 0.05) > -0.15 and found.max() < 0.05
    outward = (points.positions * points.normals).sum(-1) / np.linalg.norm(points.positions, axis=1)
    assert np.median(outward) > 0.8  # 0.88 of the cloud


@pytest.mark.parametrize("way", ["depth", "density"])
def test_a_mesh_is_the_surface(field, way):
    """Cells have a side of 0.083; measured medians are -0.02 to 0, and 90 % lie within 0.05."""
    if way == "density" and not can(field, HasDensity):
        return
    mesh = extract_mesh(field, patterned().cameras, MeshOptions(cell_size=CELL, way=way))
    found = off(mesh.vertices)
    assert len(mesh.faces) > 1000 and abs(np.median(found)) < 0.03
    assert np.quantile(np.abs(found), 0.9) < CELL
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.15)
