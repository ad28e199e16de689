"""Sphere tracing: crossings with spheres and boxes, their gradients against formulas and finite differences."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from lumigraph.camera.rays import Rays
from lumigraph.components.sampling.sphere_trace import March, sphere_trace

BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]], dtype=torch.float64)


def rays_to(targets, origin=(0.1, -2.5, 0.2)) -> Rays:
    origins = torch.tensor(origin, dtype=torch.float64).expand(len(targets), 3)
    return Rays(origins, nn.functional.normalize(targets - origins, dim=-1), torch.zeros(len(targets)))


@pytest.fixture
def rays(generator) -> Rays:
    return rays_to(1.6 * torch.rand(400, 3, generator=generator, dtype=torch.float64) - 0.8)


def sphere_of(rays, radius):
    """Distance at which each ray enters a sphere around the origin; NaN where it passes it."""
    b = (rays.origins * rays.directions).sum(-1)
    return -b - (b * b - rays.origins.square().sum(-1) + radius**2).sqrt()


@pytest.mark.parametrize("slope", [0.5, 1.0, 1.7])
def test_rays_meet_a_sphere_where_geometry_says(rays, slope):
    """Also where the function grows slower than a distance, or faster, so that steps go too far."""
    march = March(step_scale=min(1.0, 1 / slope)) if slope < 1.5 else March()
    found = sphere_trace(lambda x: slope * (x.norm(dim=-1) - 0.6), rays, BOX, march)
    expected = sphere_of(rays, 0.6)
    assert 0.2 < found.hit.double().mean() < 0.9
    clear = (rays.origins - (rays.origins * rays.directions).sum(-1, keepdim=True) * rays.directions).norm(dim=-1)
    sure = (clear - 0.6).abs() > 1e-3  # grazing rays stay inside for less than a step
    assert torch.equal(found.hit[sure], ~expected.isnan()[sure])
    both = found.hit & ~expected.isnan() & sure
    torch.testing.assert_close(found.t[both], expected[both], atol=1e-5, rtol=0)
    assert found.t[~found.hit].isinf().all()
    beside = (clear > 0.65) & (clear < 0.8)
    closest = -(rays.origins * rays.directions).sum(-1)
    assert (found.closest - closest)[beside].abs().median() < 0.1


def test_gradients_are_those_of_the_crossing(rays):
    """In radius, centre, origins and directions: those of the closed form."""
    radius, found = torch.tensor(0.6, dtype=torch.float64, requires_grad=True), []
    rays = rays[sphere_of(rays, 0.59).isfinite()]
    for exact in (False, True):
        origins, directions = (x.clone().requires_grad_() for x in (rays.origins, rays.directions))
        moved = Rays(origins, nn.functional.normalize(directions, dim=-1), rays.radius)
        t = sphere_of(moved, radius) if exact else sphere_trace(lambda x: x.norm(dim=-1) - radius, moved, BOX).t
        found.append(torch.autograd.grad(t.sum(), [radius, origins, directions]))
    for traced, expected in zip(*found, strict=True):
        torch.testing.assert_close(traced, expected, atol=1e-4, rtol=1e-4)


def test_gradients_of_a_network_are_finite_differences(generator):
    """A weight moves, all crossings are traced again."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 16), nn.Softplus(20), nn.Linear(16, 1)).double()

    def distance(x):
        return x.norm(dim=-1) - 0.5 + 0.1 * network(x)[:, 0]

    rays = rays_to(0.3 * torch.rand(50, 3, generator=generator, dtype=torch.float64) - 0.15)
    weight = network[0].weight
    (gradient,) = torch.autograd.grad(sphere_trace(distance, rays, BOX).t.sum(), weight)
    changed = []
    for change in (1e-4, -1e-4):
        with torch.no_grad():
            weight[3, 1] += change
            changed.append(sphere_trace(distance, rays, BOX, March(refinements=12)).t.sum())
            weight[3, 1] -= change
    assert float(gradient[3, 1]) == pytest.approx(float(changed[0] - changed[1]) / 2e-4, rel=1e-4)


def test_even_steps_find_levels_of_functions_that_are_no_distances(rays):
    """An occupancy network's logits are steep; only a step of even length is sure to find them."""
    march = March(max_steps=256, min_step=0.02, max_step=0.02)
    found = sphere_trace(lambda x: 40 * torch.tanh(9 * (x.norm(dim=-1) - 0.6)), rays, BOX, march)
    hit = sphere_of(rays, 0.59).isfinite()
    torch.testing.assert_close(found.t[hit], sphere_of(rays, 0.6)[hit], atol=1e-5, rtol=0)


def test_rays_that_begin_inside_hit_there_without_a_gradient():
    rays = rays_to(torch.zeros(1, 3, dtype=torch.float64), origin=(0.0, 0.3, 0.0))
    radius = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
    found = sphere_trace(lambda x: x.norm(dim=-1) - radius, rays, BOX)
    assert found.hit.all() and not found.t.requires_grad and float(found.t) == 0


def test_rays_that_are_done_are_not_evaluated_again(rays):
    asked = []

    def distance(x):
        asked.append(len(x))
        return x.norm(dim=-1) - 0.6

    with torch.no_grad():
        found = sphere_trace(distance, rays, BOX)
    evenly = len(rays) * len(asked)
    assert sum(asked) < 0.35 * evenly and found.hit.any()
