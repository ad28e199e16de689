"""NeuS: unbiased weights, the sphere that it begins as, the terms of its loss, what lies around the box."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera.rays import Rays, Samples
from lumigraph.components.fields.hash_field import TINY_TABLE
from lumigraph.datasets.scene import Frame
from lumigraph.methods.neus import Config, DistanceNumbers, HashDistance, NeuS, eikonal, first_sphere, mask_error
from lumigraph.methods.neus.fields import NetworkDistance, NeuSField
from lumigraph.methods.neus.sampler import in_order, section_weights
from lumigraph.volume import weights_of

pytestmark = budget("methods", 8)

UNIT = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
PAPER = replace(Config(), network=DistanceNumbers(depth=3, position_frequencies=3), hidden_width=48)
SHARPNESS, WALL = 64.0, 1.0  # s per scene unit; distance along the ray at which a plane is met


@pytest.fixture
def field() -> NeuSField:
    return NeuSField(HashDistance(TINY_TABLE, 16, None), UNIT)


def towards_a_plane(cosine: float, count: int = 800) -> tuple[Samples, torch.Tensor]:
    """Fine sections of a ray that meets a plane at an angle, and the distance in the middle of each."""
    t = torch.linspace(0, 2, count + 1)[None]
    samples = Samples.rows(t[:, :-1], t[:, -1])
    return samples, cosine * (WALL - samples.t)


@pytest.mark.parametrize("cosine", [1.0, 0.6, 0.2])
def test_weights_are_largest_where_the_distance_is_zero(field, cosine):
    """To first order (Wang 2021, section 3.1). With the logistic density itself as density they peak in front."""
    samples, distance = towards_a_plane(cosine)
    slope = torch.full_like(distance, -cosine)
    thickness = field.thickness(distance, slope, samples.length, SHARPNESS)
    peak = float(samples.t[weights_of(samples, thickness / samples.length).argmax()])
    assert peak == pytest.approx(WALL, abs=2e-3)
    logistic = SHARPNESS * torch.sigmoid(SHARPNESS * distance) * torch.sigmoid(-SHARPNESS * distance)
    naive = float(samples.t[weights_of(samples, logistic).argmax()])
    assert abs(naive - WALL) > 5e-3


def test_light_that_passes_is_what_the_logistic_distribution_says(field):
    """Alphas are those of eq. 13, and their product telescopes, however long the sections are."""
    edges = torch.tensor([0.0, 0.3, 0.85, 0.97, 1.01, 1.5])
    phi = torch.sigmoid(SHARPNESS * 0.6 * (WALL - edges))
    middle, length = 0.5 * (edges[1:] + edges[:-1]), edges.diff()
    thickness = field.thickness(0.6 * (WALL - middle), torch.full_like(middle, -0.6), length, SHARPNESS)
    torch.testing.assert_close(-torch.expm1(-thickness), (phi[:-1] - phi[1:]) / phi[:-1], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close((-thickness.sum()).exp(), phi[-1] / phi[0], atol=1e-7, rtol=1e-3)


def test_a_ray_that_leaves_a_surface_meets_nothing(field):
    samples, distance = towards_a_plane(-0.8)
    thickness = field.thickness(distance, torch.full_like(distance, 0.8), samples.length, SHARPNESS)
    assert not thickness.any()


def test_annealed_slopes_begin_with_half_of_every_direction():
    """With a = 0 a surface seen from behind counts as one at 1/2 - m/2."""
    share = tiny.scene().frame  # any frame: the schedule alone is looked at
    method = NeuS(replace(share, has_alpha=False), replace(NeuS.smallest(), cosine_annealing=0.5))
    assert method.network.annealed == 0.0
    slope = torch.tensor([-1.0, 0.0, 0.6])
    distance, length = torch.tensor([0.01, 0.01, 0.01]), torch.full((3,), 0.004)
    half = 0.5 * (0.5 - 0.5 * slope) * length
    expected = torch.sigmoid(SHARPNESS * (distance + half)) / torch.sigmoid(SHARPNESS * (distance - half))
    torch.testing.assert_close(method.network.thickness(distance, slope, length, SHARPNESS), expected.log())
    method.before_step(1, 0.5)
    assert method.network.annealed == 1.0 and not method.network.thickness(distance, slope, length, SHARPNESS)[2]


def points_in_box(count: int = 500) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8


@pytest.mark.parametrize("hollow", [False, True])
def test_the_distance_begins_as_that_of_a_sphere(hollow):
    """The table exactly but for its first entries of 1e-4; the paper's network about, as far as 256 random channels
    come to their mean (Atzmon 2020, theorem 1)."""
    centre, radius, points = torch.tensor([0.1, -0.05, 0.0]), 0.4, points_in_box()
    truth = ((points - centre).norm(dim=-1) - radius) * (-1 if hollow else 1)
    table = HashDistance(TINY_TABLE, 16, None)
    torch.manual_seed(0)
    network = NetworkDistance(DistanceNumbers(), 256)
    for shape, tolerance, deviation in ((table, 1e-3, 1e-2), (network, 0.16, 0.12)):
        shape.begin_as(centre, radius, hollow)
        with torch.no_grad():
            found = shape.surface(points)
        assert float((found.distance - truth).abs().mean()) < tolerance
        torch.testing.assert_close(found.distance, shape.distance(points), atol=1e-5, rtol=1e-4)
        assert float(eikonal(found.gradient)) < deviation


def test_taps_give_gradient_and_laplacian():
    """Of a sphere: the gradient leads away from its middle, the Laplacian is 2 / |x|."""
    shape = HashDistance(replace(TINY_TABLE, max_resolution=200), 16, None)
    with torch.no_grad():
        shape.table.table.zero_()
        points = points_in_box()
        points = points[points.norm(dim=-1) > 0.3]
        found = shape.surface(points)
    away = torch.nn.functional.normalize(points, dim=-1)
    assert float((found.gradient - away).norm(dim=-1).max()) < 0.04
    torch.testing.assert_close(found.laplacian, 2 / points.norm(dim=-1), atol=0.05, rtol=0.05)


def test_levels_that_join_make_taps_closer():
    method = NeuS(tiny.scene().frame, NeuS.smallest())
    first = method.network.shape.tap_distance
    method.before_step(1, 1.0)
    assert method.network.shape.tap_distance < 0.3 * first


def test_the_gradient_of_the_network_is_that_of_its_distance():
    torch.manual_seed(0)
    shape, points, step = NetworkDistance(PAPER.network, 48).double(), points_in_box(20).double(), 1e-5
    found = shape.surface(points).gradient
    for axis, way in enumerate(step * torch.eye(3, dtype=torch.float64)):
        slope = (shape.distance(points + way) - shape.distance(points - way)) / (2 * step)
        torch.testing.assert_close(found[:, axis], slope, atol=1e-5, rtol=1e-4)


def test_the_eikonal_term_is_none_for_a_distance_and_one_for_its_double():
    away = torch.nn.functional.normalize(points_in_box(), dim=-1)
    assert float(eikonal(away)) < 1e-12 and float(eikonal(2 * away)) == pytest.approx(1.0)
    assert float(eikonal(0 * away)) == pytest.approx(1.0)


def test_the_mask_term_is_least_where_opacity_is_alpha():
    alpha = torch.tensor([0.0, 1.0, 0.25])
    least = mask_error(alpha, alpha)
    expected = torch.tensor([-math.log(1 - 1e-3)] * 2 + [-0.25 * math.log(0.25) - 0.75 * math.log(0.75)]).mean()
    torch.testing.assert_close(least, expected)
    for other in (alpha + torch.tensor([0.1, 0, 0]), alpha - torch.tensor([0, 0.1, 0]), alpha + 0.1 * (alpha < 1)):
        assert mask_error(other, alpha) > least + 0.01


def test_the_first_sphere_is_half_of_what_silhouettes_hold():
    """A ball of radius 0.6 in the middle; every camera is far from it."""
    centre, radius, hollow = first_sphere(tiny.scene())
    assert float(centre.norm()) < 0.1 and 0.25 < radius < 0.45 and not hollow


def test_the_first_sphere_of_a_capture_without_silhouettes():
    """Half of the ball around its points, and of the way to the nearest camera; hollow around cameras in a room."""
    scene = tiny.scene()
    plain = replace(scene, frame=replace(scene.frame, reach=4.0, has_alpha=False))
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * 0.1 + torch.tensor([0.2, 0, 0])
    centre, radius, hollow = first_sphere(replace(plain, points=points))
    assert float((centre - torch.tensor([0.2, 0, 0])).norm()) < 0.03 and 0.1 < radius < 0.2 and not hollow
    near = plain.cameras.transformed(torch.diag(torch.tensor([0.1, 0.1, 0.1, 1.0])))
    assert first_sphere(replace(plain, cameras=near))[2]


def test_sections_gather_where_the_surface_is():
    """A sphere, without any learning: the sections that matter are near it, and hold all of the light."""
    method = NeuS(tiny.scene().frame, replace(NeuS.smallest(), rays=replace(Config().rays, coarse_samples=32)))
    method.network.shape.begin_as(torch.zeros(3), 0.5, False)
    method.network.max_sharpness = math.inf  # as of a finer table
    with torch.no_grad():
        method.network.deviation.fill_(0.6)  # s = 403
        rays = Rays(torch.tensor([[0.0, 0.0, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([0.01]))
        (seen,) = method.sampler.sample(rays, method.network)
    weights = weights_of(seen.samples, seen.density)
    assert float(weights.sum()) > 0.99
    assert float((weights * seen.samples.t).sum() / weights.sum()) == pytest.approx(2.5, abs=0.01)
    assert len(seen.samples) < 60 and float(seen.samples.length.median()) < 0.03


@pytest.mark.parametrize("field", ["hash", "network"])
def test_a_surface_is_no_thinner_than_its_table_resolves(field):
    """A table with cells of 2.2 / n has s of 1.3 n / 2.2 at most; a network has cells of no size."""
    method = NeuS(tiny.scene().frame, replace(NeuS.smallest(), field=field))
    with torch.no_grad():
        method.network.deviation.fill_(0.9)  # s = 8103
    bound = 1.3 * method.network.shape.table.levels.resolutions[-1] / 2.2 if field == "hash" else 8103.08
    assert float(method.network.sharpness) == pytest.approx(bound, rel=1e-3)


def test_slopes_of_sections_are_no_steeper_than_a_distance(field):
    """Places that a mask calls empty stand in with the distance between places: no surface appears at the mask."""
    t = torch.linspace(0, 1, 11)[None]
    distance = torch.full((1, 11), 0.1)
    assert not section_weights(field, t, distance, SHARPNESS).any()
    distance[0, 5:] = 0.9
    assert not section_weights(field, t, distance, SHARPNESS).any()


def test_samples_of_two_kinds_are_in_order_on_each_ray():
    first = Samples(torch.tensor([1.0, 2.0, 1.5]), torch.tensor([2.0, 3.0, 1.7]), torch.tensor([0, 2, 3, 3]))
    second = Samples(torch.tensor([5.0, 6.0]), torch.tensor([6.0, 7.0]), torch.tensor([0, 1, 1, 2]))
    both, order = in_order(first, second)
    assert both.t_start.tolist() == [1.0, 2.0, 5.0, 1.5, 6.0] and both.ray_starts.tolist() == [0, 3, 4, 5]
    assert order.tolist() == [0, 1, 3, 2, 4]


@pytest.mark.parametrize("config", [NeuS.smallest(), PAPER], ids=["hash", "network"])
def test_in_the_open_a_field_around_the_box_learns_too(config):
    """Every parameter gets a gradient from one step, the box ends where the field around it begins, and a resumed
    picture is the same."""
    scene = tiny.scene()
    frame = Frame(reach=4.0, near=0.1, image_count=len(scene))
    method = NeuS(frame, replace(config, rays=replace(config.rays, rays_per_step=64), cosine_annealing=0.0))
    method.begin(replace(scene, frame=frame))
    batch = scene.sample_rays(64, torch.Generator().manual_seed(0))
    method.before_step(0, 1.0)  # all levels have joined
    torch.stack([*method.loss(replace(batch, alpha=None), 0).values()]).sum().backward()
    for name, parameter in method.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all() and parameter.grad.any(), name
    (seen,) = method.sampler.sample(batch.rays, method.network)
    inside, ray = seen.features[1], seen.samples.ray_index
    points, _ = seen.samples.along(batch.rays)
    assert (points[inside].abs() <= 1).all() and inside.any() and not inside.all()
    assert (seen.samples.t_start.diff()[ray.diff() == 0] >= -1e-5).all()
    assert (~inside[1:] | inside[:-1] | (ray.diff() > 0)).all()  # within a ray nothing follows the field around


def test_the_number_of_rays_follows_the_sections_that_matter():
    """To fill the samples of a step; by a fifth more at once, from a quarter to four times as many as at first."""
    sampler = NeuS(tiny.scene().frame, replace(NeuS.smallest(), samples_per_step=2048)).sampler
    first, found = sampler.batch_size, []
    for evaluated in (4096, 512, 2048, 10**6, *[1] * 20):
        sampler.evaluated = evaluated
        sampler.after_step(None, 0)
        found.append(sampler.batch_size)
    assert found[:4] == [first // 2, int(1.2 * (first // 2)), int(1.2 * (first // 2)), first // 4]
    assert found[-1] == 4 * first


def test_where_the_hull_is_empty_the_distance_becomes_positive():
    """A sphere that sticks out of the visual hull costs something, and less once it is inside."""
    scene = tiny.scene()
    method, costs = NeuS(scene.frame, NeuS.smallest()), []
    method.begin(scene)
    batch = scene.sample_rays(192, torch.Generator().manual_seed(0))
    for radius in (0.95, 0.3):
        method.network.shape.begin_as(torch.zeros(3), radius, False)
        costs.append(float(method.loss(batch, 0)["empty"].detach()))
    assert costs[0] > 1e-3 and costs[1] < 1e-4
