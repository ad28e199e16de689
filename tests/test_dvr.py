"""DVR: the surface and its gradient against a ball's, the terms of its loss, the march, photographs without masks."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.camera.rays import Rays, Samples
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Batch
from lumigraph.errors import LumigraphError
from lumigraph.methods.dvr import DVR, NORMAL_WEIGHT, first_of_each, sum_of_lengths
from lumigraph.methods.dvr.fields import LOGIT_SCALE
from lumigraph.run import build

pytestmark = budget("methods", 6)

RADIUS, AWAY = 0.5, 2.0  # of the ball; distance from which rays begin
OFFSETS = torch.tensor([0.0, 0.2, -0.35, 0.48, 0.6])  # of rays from the ball's centre; the last one misses it


def ball(**changes) -> DVR:
    """A field that is a ball: the network behind the table gives 0."""
    kind = methods.find("dvr")
    method = build(kind, tiny.scene().frame, replace(kind.smallest(), **changes), torch.device("cpu"), 0)
    with torch.no_grad():
        method.network.network.weights[-1].zero_()
    return method


def towards_the_ball() -> Rays:
    count = len(OFFSETS)
    origins = torch.stack([OFFSETS, torch.zeros(count), torch.full((count,), -AWAY)], -1)
    return Rays(origins, torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3), torch.full((count,), 0.01))


def test_a_ray_meets_a_ball_where_geometry_says_and_sees_its_normal():
    method, rays = ball(march_steps=64), towards_the_ball()
    t, normals = method.met(rays)
    expected = AWAY - (RADIUS**2 - OFFSETS[:-1].square()).sqrt()
    torch.testing.assert_close(t[:-1], expected, atol=1e-4, rtol=0)
    assert math.isinf(t[-1]) and not normals[-1].any()
    torch.testing.assert_close(normals[:-1], rays[torch.arange(4)].at(t[:-1]) / RADIUS, atol=1e-3, rtol=0)


def test_the_gradient_of_depth_is_that_of_the_implicit_function():
    """Of a ball dt / dR = -R / sqrt(R^2 - x^2) (Niemeyer 2020, eq. 10)."""
    method = ball(march_steps=64)
    method.network.radius.requires_grad_(True)
    t, _ = method._met(towards_the_ball())
    for number, offset in enumerate(OFFSETS[:-1]):
        (gradient,) = torch.autograd.grad(t[number], method.network.radius, retain_graph=True)
        assert float(gradient) == pytest.approx(-RADIUS / float((RADIUS**2 - offset**2).sqrt()), rel=2e-2)


def test_colour_errors_reach_the_surface_through_the_texture():
    """The gradient of a colour by the radius is grad t . r dt / dR."""
    method = ball(march_steps=64)
    method.network.radius.requires_grad_(True)
    torch.nn.init.normal_(method.network.network.weights[-1])
    with torch.no_grad():
        method.network.network.weights[-1][0] = 0
    torch.nn.init.normal_(method.network.table, std=0.5)
    rays = towards_the_ball()[torch.tensor([1])]

    def seen() -> torch.Tensor:
        t, _ = method._met(rays)
        return method.colour(rays.at(t)).sum()

    (gradient,) = torch.autograd.grad(seen(), method.network.radius)
    with torch.no_grad():
        step = 1e-3
        method.network.radius += step
        ahead = seen()
        method.network.radius -= 2 * step
        difference = (ahead - seen()) / (2 * step)
    assert float(gradient) == pytest.approx(float(difference), rel=0.05) and abs(float(gradient)) > 1e-2


def lesson(alpha: list[float], rgb: float = 0.5, **extra) -> Batch:
    rays = towards_the_ball()
    return Batch(rays, torch.full((len(rays), 3), rgb), torch.tensor(alpha), extra)


def test_rays_beside_the_object_empty_the_surface_that_they_meet():
    """Cross-entropy at occupancy 1/2 is log 2; rays of the object that meet it have no such term."""
    method = ball(march_steps=64)
    terms = method.loss(lesson([0.0, 1.0, 0.0, 1.0, 1.0]), 0)
    assert float(terms["freespace"].detach()) == pytest.approx(2 * math.log(2) / 5, rel=1e-2)


def test_rays_of_the_object_that_miss_it_fill_a_place_along_them():
    """Only the last ray misses. The logit anywhere along it is that of a place outside of the ball."""
    method = ball(march_steps=64)
    term = float(method.loss(lesson([1.0] * 5), 0)["occupancy"].detach())
    least, most = (LOGIT_SCALE * away / 5 for away in (0.6 - RADIUS, math.hypot(0.6, 1.0) - RADIUS))
    assert least < term < most


def test_colours_and_depths_are_compared_where_object_and_surface_agree():
    method = ball(march_steps=64, depth_weight=2.0)
    t, _ = method.met(towards_the_ball())
    depth = t.clone() + 0.1
    depth[0] = float("nan")  # not measured
    terms = method.loss(lesson([1.0, 1.0, 1.0, 0.0, 1.0], rgb=0.3, depth=depth), 0)
    assert float(terms["depth"]) == pytest.approx(2.0 * 2 * 0.1 / 5, rel=1e-2)
    assert float(terms["colour"]) == pytest.approx(3 * 3 * 0.2 / 5, rel=1e-3)  # the texture is grey of 0.5


def test_smoothness_compares_normals_and_has_a_gradient():
    method = ball(march_steps=64, difference_step=0.02, neighbour_distance=0.1)
    points = torch.tensor([[RADIUS, 0.0, 0.0], [0.0, RADIUS, 0.0]])
    normals = torch.nn.functional.normalize(method._differences(points), dim=-1)
    torch.testing.assert_close(normals, points / RADIUS, atol=1e-2, rtol=0)
    assert float(sum_of_lengths(normals, normals)) < 1e-5
    term = method.loss(lesson([1.0] * 5), 0)["normal"]
    (gradient,) = torch.autograd.grad(term, method.network.network.weights[-1])
    assert gradient.isfinite().all() and gradient[0].any()
    # neighbours up to 0.05 away along each axis turn the normal by at most that over the radius
    assert 0 < float(term) < NORMAL_WEIGHT * 0.05 * math.sqrt(3) / RADIUS


def test_steps_along_rays_double():
    method = ball(march_steps=64, first_march_steps=16, march_settling=0.5)
    steps = []
    for progress in (0.0, 0.1, 0.3, 0.5, 1.0):
        method.before_step(0, progress)
        steps.append(method._march_steps)
    assert steps == [16, 16, 32, 64, 64]
    with pytest.raises(LumigraphError, match="first-march-steps"):
        replace(method.config, first_march_steps=128).check()


def test_the_first_sample_of_each_ray_is_found():
    samples = Samples(torch.zeros(6), torch.ones(6), torch.tensor([0, 3, 3, 6]))
    chosen = torch.tensor([False, True, True, False, False, True])
    assert first_of_each(chosen, samples).tolist() == [1, 6, 5]


def test_photographs_without_masks_are_refused():
    scene = tiny.scene()
    images = ImageStore.from_arrays([scene.images[i].numpy()[..., :3].copy() for i in range(len(scene))])
    bare, place = replace(scene, images=images), replace(scene, frame=replace(scene.frame, reach=8.0))
    for data, lacking in ((bare, "masks"), (place, "without bounds")):
        with pytest.raises(LumigraphError, match=lacking):
            ball().begin(data)
        with pytest.raises(LumigraphError, match=lacking):  # before that, kernels are compiled with a batch
            ball().batch(data, torch.Generator())


def test_the_papers_network_learns_the_same_terms():
    kind = methods.find("dvr")
    config = replace(kind.smallest(), field="network", hull_cells=0)
    method = build(kind, tiny.scene().frame, config, torch.device("cpu"), 0)
    method.begin(tiny.scene())
    terms = method.loss(method.batch(tiny.scene(), torch.Generator().manual_seed(0)), 0)
    torch.stack([*terms.values()]).sum().backward()
    assert all(x.grad is not None and x.grad.isfinite().all() for x in method.parameters() if x.requires_grad)
