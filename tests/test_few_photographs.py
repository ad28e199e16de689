"""Splatting from few photographs: Gaussians left out at random, depth between the photographs, plain colours."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget
from test_gaussian_splatting import new

from lumigraph.methods.gaussian_splatting.few_views import depth_roughness, drop_gaussians
from lumigraph.methods.gaussian_splatting.initialization import round_gaussians
from lumigraph.training import fit

pytestmark = budget("methods")


def chance(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def plates(count: int, spread: float = 0.0):
    """Gaussians along x at distances that differ, each opaque to a half."""
    x = torch.linspace(-1, 1, count)
    z = spread * torch.randn(count, generator=chance())
    cloud = round_gaussians(torch.stack([x, 0 * x, z], -1), torch.full((count, 3), 0.5), 0)
    return replace(cloud, opacities=torch.zeros(count))


def test_a_share_is_gone_and_the_others_make_up_for_it():
    cloud = plates(20_000)
    cloud.opacities.requires_grad_()
    seen = drop_gaussians(cloud, 0.2, chance()).opacities.sigmoid()
    there = seen > 1e-6
    assert float(there.float().mean()) == pytest.approx(0.8, abs=0.01)
    assert torch.allclose(seen[there], torch.tensor(0.5 / 0.8))
    assert float(seen.detach().mean()) == pytest.approx(0.5, abs=0.01)  # as much light is stopped on average
    seen.sum().backward()
    assert torch.equal(cloud.opacities.grad != 0, there)  # what is gone learns nothing


def test_nothing_is_left_out_at_first():
    cloud = plates(100)
    assert torch.allclose(drop_gaussians(cloud, 0.0, chance()).opacities, cloud.opacities, atol=1e-6)


def test_what_is_opaque_stays_possible():
    cloud = replace(plates(100), opacities=torch.full((100,), 20.0))
    seen = drop_gaussians(cloud, 0.2, chance()).opacities
    assert seen.isfinite().all() and float(seen.max()) < math.log(1000)


def wall(bumps: float):
    """A wall of Gaussians through the middle of the tiny scene, that faces its first camera."""
    camera = tiny.scene().cameras[:1]
    right, down, forward = camera.pose[0, :, :3].T
    steps = torch.linspace(-1.5, 1.5, 40)
    across, along = (x.flatten()[:, None] for x in torch.meshgrid(steps, steps, indexing="ij"))
    depth = bumps * torch.randn(1600, 1, generator=chance())
    cloud = round_gaussians(across * right + along * down + depth * forward, torch.full((1600, 3), 0.5), 0)
    return replace(cloud, opacities=torch.full((1600,), 4.0)), camera


def test_a_wall_is_smoother_than_a_heap():
    """And the slope of roughness takes bumps away."""
    (flat, camera), (rough, _) = wall(0.0), wall(0.2)
    cameras = type(camera).cat([camera, camera])  # so that what is between them is seen from there too
    smooth, heap = (float(depth_roughness(x, cameras, 0.1, chance())) for x in (flat, rough))
    assert smooth < 0.2 * heap
    means = rough.means.clone().requires_grad_()
    before = depth_roughness(replace(rough, means=means), cameras, 0.1, chance())
    before.backward()
    length = 0.05 * float(means.detach().std()) / float(means.grad.norm(dim=-1).max())
    after = depth_roughness(replace(rough, means=(means - length * means.grad).detach()), cameras, 0.1, chance())
    assert float(after) < float(before)


def test_few_views_have_plain_colours_and_a_term_of_depth():
    method, _ = new(few_views=True, depth_weight=2.0)
    fit(method, tiny.scene(), steps=12, show=False, rehearsal=False)
    assert method.bands == 1 and not method.cloud.harmonics[:, 1:].any()
    terms = method.loss(method.batch(tiny.scene(), chance()), 12)
    assert float(terms["depth"]) > 0
    terms["depth"].backward()
    assert method.cloud.means.grad.any()
