"""SurfaceMethod: pictures of a ball whose distance is a formula; meshes of its zero level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from budgets import budget

from lumigraph.camera import dome, ring
from lumigraph.components.sampling.surface_method import AMBIENT, DIFFUSE, SurfaceMethod
from lumigraph.datasets.scene import Frame
from lumigraph.export.mesh import extract_mesh
from lumigraph.export.options import MeshOptions

pytestmark = budget("methods", 6)
RADIUS, BACKGROUND = 0.6, (0.2, 0.4, 0.8)


@dataclass(frozen=True)
class Config:
    seed: int = 0


class Ball(SurfaceMethod):
    Config = Config

    def batch(self, data, generator):
        raise NotImplementedError

    def distance(self, points):
        return points.norm(dim=-1) - RADIUS


@pytest.fixture
def ball() -> Ball:
    return Ball(Frame(background=BACKGROUND), Config()).eval()


def test_a_picture_has_the_balls_depth_normals_and_background(ball):
    camera = ring(ball.frame.bounds, size=32)[2]
    seen = ball.given(shading="normals").render(camera)
    rays = camera.rays(camera.pixels())
    b = (rays.origins * rays.directions).sum(-1)
    under = b * b - (rays.origins.square().sum(-1) - RADIUS**2)
    sure = under.abs() > 1e-2
    hit = seen.opacity.flatten() == 1
    assert torch.equal(hit[sure], (under > 0)[sure]) and 0.1 < hit.float().mean() < 0.9
    both = hit & (under > 0)
    depth = seen.depth.flatten()
    torch.testing.assert_close(depth[both], (-b - under.clamp_min(0).sqrt())[both], atol=1e-3, rtol=0)
    normals = seen.extra["normals"].reshape(-1, 3)
    torch.testing.assert_close(normals[both], rays[both].at(depth[both]) / RADIUS, atol=1e-2, rtol=0)
    rgb = seen.rgb.reshape(-1, 3)
    torch.testing.assert_close(rgb[both], 0.5 + 0.5 * normals[both])
    torch.testing.assert_close(rgb[~hit], torch.tensor(BACKGROUND).expand(int((~hit).sum()), 3))
    assert depth[~hit].isinf().all() and not normals[~hit].any()


def test_grey_is_brightest_where_the_surface_faces_the_camera(ball):
    camera = ring(ball.frame.bounds, size=33)[0]
    rgb = ball.render(camera).rgb
    assert float(rgb[16, 16, 0]) == pytest.approx(AMBIENT + DIFFUSE, abs=1e-2)
    shown = rgb[16, :, 0][ball.render(camera).opacity[16] == 1]
    assert shown[0] < 0.6 * shown[len(shown) // 2]


def test_its_zero_level_becomes_a_mesh(ball):
    """Without its renderings: every vertex lies on the ball, also where no camera looked."""
    cameras = dome(ring(ball.frame.bounds, size=24, count=4))
    mesh = extract_mesh(ball, cameras, MeshOptions(cell_size=1 / 12, smooth=0, views=4, size=24))
    radius = np.linalg.norm(mesh.vertices, axis=-1)
    assert np.abs(radius - RADIUS).max() < 0.01 and len(mesh.faces) > 500
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)
