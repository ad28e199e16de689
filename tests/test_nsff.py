"""NSFF: blending, warps along scene flow, and priors against a field whose motion is known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.datasets.scene import Batch
from lumigraph.files.ranges import changed
from lumigraph.method import Field
from lumigraph.methods.nsff import NSFF, Hop
from lumigraph.methods.nsff.priors import checked_flow, partners
from lumigraph.volume import composite

pytestmark = budget("methods", 6)
SPEED = torch.tensor([0.02, -0.03, 0.01])  # scene units from a moment to the next
RADIUS = 0.5


def moving_scene():
    """The ball of the tests, photographed at a moment of its own by each of twelve cameras."""
    scene = tiny.scene()
    times = torch.arange(12).float()
    cameras = replace(scene.cameras, time=times)
    return replace(scene, cameras=cameras, frame=replace(scene.frame, times=(0.0, 11.0)))


class Ball(Field):
    """A ball that moves at a constant speed, and knows it."""

    deforms = True

    def __init__(self, method: NSFF, speed: torch.Tensor = SPEED):
        super().__init__()
        self.largest, self.speed = method.config.flow.max_flow, speed

    def geometry(self, points, code=None):
        away = points - 11 * code[:, :1] * SPEED
        return 30.0 * torch.sigmoid(20 * (RADIUS - away.norm(dim=-1))), away

    def colour(self, features, directions, code=None):
        return 0.5 + 0.4 * torch.sin(4 * features)

    def raw_heads(self, features, points, code=None):
        flow = torch.cat([self.speed, -self.speed]) / self.largest
        return torch.cat([flow.atanh().expand(len(points), 6), points.new_full((len(points), 2), 9.0)], 1)


def ball_method(speed: torch.Tensor = SPEED, **flow) -> NSFF:
    config = NSFF.smallest()
    method = NSFF(moving_scene().frame, replace(config, static_field=False, flow=replace(config.flow, **flow)))
    method.begin(moving_scene())
    method.network.dynamic = Ball(method, speed)
    method.before_step(0, 0.5)
    return method.train()


def rays_of(method: NSFF, image: int) -> Batch:
    """Rays of a training photograph, with the colours that the method shows."""
    camera = moving_scene().cameras[image]
    pixels = camera.pixels()[::5]
    rays = camera.rays(pixels)
    seen = method.sampler.sample(rays, method.network, method.code(rays), torch.Generator().manual_seed(0))[0]
    look = seen.look(method.network)
    target = composite(look.samples, look.density, look.rgb, method.background).rgb
    return Batch(rays, target, extra={"place": pixels / camera.size[0]})


def warp_terms(method: NSFF, image: int, way: int) -> dict[str, float]:
    batch = rays_of(method, image)
    seen = method.sampler.sample(batch.rays, method.network, method.code(batch.rays), torch.Generator().manual_seed(0))
    packed, directions = seen[0].samples, seen[0].directions
    points, code = packed.along(batch.rays)[0], seen[0].code_of_samples(method.code(batch.rays))
    dynamic, features = method.network.dynamic, seen[0].features[0]
    start = (points, code, seen[0].density, dynamic.colour(features, directions), dynamic.raw_heads(features, points))
    ways = torch.full((len(batch),), way)
    terms = method.warped(batch, packed, directions, Hop(*start), ways, batch.rgb, method.background)
    return {name: float(term) for name, term in terms.items()}


@pytest.mark.parametrize("way", [0, 1])
def test_rays_along_true_flow_show_the_same_colours_at_neighbouring_moments(way):
    image = 7 - 2 * way  # by way of 6; photographs 4 and 8 are held out
    right = warp_terms(ball_method(flow_weight=0.0), image, way)
    wrong = warp_terms(ball_method(-SPEED, flow_weight=0.0), image, way)
    assert right["photometric"] < 1e-8 < 1e-5 < wrong["photometric"]
    assert right["cycle"] < 1e-6 and right["occlusion"] < 1e-3


def test_a_second_neighbour_is_reached_along_two_flows():
    chained, single = (warp_terms(ball_method(-SPEED, flow_weight=0.0, neighbours=n), 5, 1) for n in (2, 1))
    assert chained["photometric"] > 3 * single["photometric"]  # twice the way off adds four times the error, or so
    assert warp_terms(ball_method(flow_weight=0.0, neighbours=2), 5, 1)["photometric"] < 1e-7


def test_there_is_nothing_before_the_first_moment():
    assert warp_terms(ball_method(-SPEED, flow_weight=0.0), 1, 0)["photometric"] == 0  # 0 is held out, so 1 is first


def test_optical_flow_is_the_projection_of_scene_flow():
    method = ball_method(flow_weight=1.0, neighbours=1)
    scene, moments = moving_scene(), [i for i in range(12) if i % 4]
    flow = torch.full((len(moments), 2, tiny.SIZE, tiny.SIZE, 2), torch.nan)
    image, after = 5, 6
    camera, batch = scene.cameras[image], rays_of(method, 5)
    depth = method.given(time=5.0).eval().render(camera).depth.nan_to_num(posinf=1.0).flatten()
    points = camera.rays(camera.pixels()).at(depth)
    there, _ = scene.cameras[after].project(points + SPEED)
    flow[moments.index(image), 1] = (there - camera.pixels()).view(tiny.SIZE, tiny.SIZE, 2)
    method.train()
    method.priors.flow.rows = flow.half().view(-1, 2)
    method.before_step(0, 0.0)
    error = {speed: 0.0 for speed in (1, -1)}
    for sign in error:
        method.network.dynamic.speed = sign * SPEED
        terms = warp_terms(method, image, 1)
        error[sign] = terms["flow"]
    assert error[1] < 0.1 * error[-1] and len(batch) > 50


def test_points_are_followed_along_scene_flow():
    method, points = ball_method(flow_weight=0.0), torch.zeros(4, 3)
    torch.testing.assert_close(method.follow(points, 1.0, 6.0), points + 4 * SPEED, atol=1e-5, rtol=0)  # 4 is held out
    there = method.follow(points, 1.0, 1.5)
    torch.testing.assert_close(there, points + 0.5 * SPEED, atol=1e-5, rtol=0)
    torch.testing.assert_close(method.follow(there, 1.5, 1.0), points, atol=1e-5, rtol=0)


def test_two_fields_blend_by_the_weight_of_the_static_one():
    method = NSFF(moving_scene().frame, NSFF.smallest())
    points, directions = torch.rand(50, 3) - 0.5, torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    network = method.network
    for parameter in network.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    code = method.code_at(torch.linspace(0, 11, 50))
    still, features = network.static.geometry(points)
    v = network.static.raw_heads(features, points)[:, 0].sigmoid()
    moving, of_moving = network.dynamic.geometry(points, code)
    density, rgb = network(points, directions, code)
    torch.testing.assert_close(density, v * still + (1 - v) * moving)
    expected = (v * still)[:, None] * network.static.colour(features, directions)
    expected = expected + ((1 - v) * moving)[:, None] * network.dynamic.colour(of_moving, directions)
    torch.testing.assert_close(density[:, None] * rgb, expected, atol=1e-4, rtol=1e-4)
    alone = [network.geometry(points, code + torch.tensor([0.0, shift]))[0] for shift in (-1, 1)]
    torch.testing.assert_close(alone[0], moving)
    torch.testing.assert_close(alone[1], still)


def test_both_kinds_of_fields_know_time_and_get_all_gradients():
    config = NSFF.smallest()
    config = changed(config, depth=3, skip_layer=2, position_frequencies=3, samples=8, rays_per_step=64)
    scene = moving_scene()
    for field in ("hash", "network"):
        numbers = changed(config, field=field, both_ways=field == "network", depth_source="files")
        method = NSFF(scene.frame, numbers).train()
        method.begin(scene)
        assert method.priors.depth.rows.isfinite().any() and method.priors.flow.rows.isfinite().any()
        method.before_step(0, 0.0)
        terms = method.loss(method.batch(scene, torch.Generator().manual_seed(0)), 0)
        assert {"blended", "dynamic", "photometric", "cycle", "flow", "depth", "smooth", "least"} < set(terms)
        torch.stack(list(terms.values())).sum().backward()
        lacking = [n for n, p in method.named_parameters() if p.grad is None or not p.grad.to_dense().isfinite().all()]
        assert not lacking
        assert not torch.equal(*(method.given(time=t).density(torch.rand(20, 3) - 0.5) for t in (0.0, 5.0)))


def test_optical_flow_is_kept_where_it_returns():
    texture = torch.rand(3, 96, 96, generator=torch.Generator().manual_seed(0))
    texture = (255 * torch.nn.functional.avg_pool2d(texture, 5, 1, 2)).movedim(0, -1).byte()
    first, second = texture[8:72, 8:72], texture[10:74, 5:69]  # what is at x, y is then at x + 3, y - 2
    flow = checked_flow(first, second)
    known = flow[8:-8, 8:-8].isfinite().all(-1)
    assert known.float().mean() > 0.9
    assert (flow[8:-8, 8:-8][known] - torch.tensor([3.0, -2.0])).abs().mean() < 0.2
    assert flow[:2, 8:-8].isnan().all() and flow[8:-8, -3:].isnan().all()  # it leads out of the picture
    covered = second.clone()
    covered[20:40, 20:40] = 0
    assert checked_flow(first, covered).isnan().sum() > flow.isnan().sum()


def test_partners_are_the_nearest_cameras_of_neighbouring_moments():
    cameras = tiny.scene().cameras
    rig = replace(cameras, time=torch.arange(12) // 4 * 1.0, pose=cameras.pose[torch.arange(12) % 4])
    found = partners(rig, torch.arange(12))
    assert found[:4, 0].tolist() == [-1] * 4 and found[:8, 1].tolist() == list(range(4, 12))
    assert found[4:, 0].tolist() == list(range(8))


def test_priors_are_annealed_away():
    method = ball_method(prior_interval=0.25)
    found = []
    for progress in (0.0, 0.24, 0.26, 0.8):
        method.before_step(0, progress)
        found.append(method.prior_scale)
    assert found == pytest.approx([1, 1, 0.1, 1e-3])
