"""Spaces: coordinates for networks, the way along a ray, and which capture gets which."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from captures import Tiny, look_at, write_blender, write_ngp

from lumigraph.camera.lens import Equirectangular, Pinhole
from lumigraph.camera.rays import Rays
from lumigraph.components.fields.spaces import INFINITY, NDC, Box, Contraction, space_of
from lumigraph.datasets.scene import Forward, Frame
from lumigraph.opening import open_scene
from lumigraph.readers import Capture, Shot
from lumigraph.readers.assemble import assemble

POSE = torch.from_numpy(look_at(np.array([0.3, -2.0, 0.4]), np.array([0.1, 0.5, 0.2]))[:3])
FORWARD = Forward(tuple((a, b, c, d) for a, b, c, d in POSE.tolist()), (1.5, 2.0), 0.8)
FRAMES = {
    "box": Frame(bounds=((-0.5, -1.0, -0.8), (0.5, 1.0, 0.9)), near=0.1),
    "ndc": Frame(reach=8.0, near=0.01, forward=FORWARD),
    "contraction": Frame(reach=16.0, near=0.2),
}
SPACES = {name: space_of(frame) for name, frame in FRAMES.items()}
each = pytest.mark.parametrize("space", SPACES.values(), ids=SPACES.keys())


def in_world(points: torch.Tensor) -> torch.Tensor:
    """Points of the mean camera's frame."""
    return points @ POSE[:, :3].T + POSE[:, 3]


def some_rays(count: int, generator: torch.Generator) -> Rays:
    """Rays from around the mean camera into what it sees, in double precision."""
    origins = 0.2 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    towards = torch.cat([torch.randn(count, 2, generator=generator), torch.full((count, 1), 3.0)], 1).double()
    directions = torch.nn.functional.normalize(towards, dim=-1) @ POSE[:, :3].T
    return Rays(in_world(origins), directions, torch.full((count,), 1e-3, dtype=torch.float64))


def some_points(count: int, generator: torch.Generator) -> torch.Tensor:
    """Points beyond the near plane, some inside the unit ball and some far out."""
    depth = 0.9 + 12 * torch.rand(count, 1, generator=generator, dtype=torch.float64) ** 3
    points = torch.randn(count, 2, generator=generator, dtype=torch.float64) * 0.5
    return in_world(torch.cat([points * depth, depth], 1))


def test_a_scene_gets_the_space_that_suits_it():
    assert [type(space) for space in SPACES.values()] == [Box, NDC, Contraction]
    assert isinstance(space_of(replace(FRAMES["ndc"], reach=1.0)), Box)  # an object stays one however it is looked at


@each
def test_the_jacobian_is_the_derivative_of_the_warp(space, generator):
    points = some_points(50, generator)
    expected = torch.stack([torch.autograd.functional.jacobian(space.warp, point) for point in points])
    torch.testing.assert_close(space.jacobian(points), expected)
    torch.testing.assert_close(space.stretch(points), torch.linalg.det(expected).abs() ** (1 / 3))


@each
def test_variances_of_small_gaussians_are_those_of_samples(space, generator):
    points = some_points(6, generator)
    directions = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator, dtype=torch.float64), dim=-1)
    along, across = torch.full((6,), 4e-6, dtype=torch.float64), torch.full((6,), 1e-6, dtype=torch.float64)
    means, variances = space.warp_gaussians(points, directions, along, across)
    noise = torch.randn(200_000, 6, 3, generator=generator, dtype=torch.float64)
    ahead = (noise * directions).sum(-1, keepdim=True) * directions
    seen = space.warp(points + along.sqrt()[:, None] * ahead + across.sqrt()[:, None] * (noise - ahead))
    torch.testing.assert_close(means, space.warp(points))
    torch.testing.assert_close(seen.var(0), variances, rtol=0.02, atol=0)


def test_gaussians_in_a_box_are_those_of_mip_nerf(generator):
    """Barron 2021, eq. 16."""
    directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator), dim=-1)
    along, across = torch.rand(9, generator=generator), torch.rand(9, generator=generator)
    _, variances = SPACES["box"].warp_gaussians(torch.zeros(9, 3), directions, along, across)
    squared = directions.square()
    torch.testing.assert_close(variances, along[:, None] * squared + across[:, None] * (1 - squared))


@each
def test_the_way_along_a_ray_begins_near_and_ends_far_and_only_grows(space, generator):
    rays = some_rays(64, generator)
    near, far = space.interval(rays)
    share = torch.linspace(0, 1, 33, dtype=torch.float64).expand(64, 33)
    t = space.distance(share, rays, near, far)
    assert torch.equal(t[:, 0], near) and torch.equal(t[:, -1], far)
    hit = far > near
    assert hit.sum() > 10 and (near[hit] >= 0).all()
    assert (t[hit].diff(dim=1) > 0).all() and (t[~hit] == near[~hit, None]).all()


def test_in_single_precision_the_ends_are_exact_too(generator):
    rays = some_rays(64, generator)
    rays = Rays(rays.origins.float(), rays.directions.float(), rays.radius.float())
    for space in SPACES.values():
        near, far = space.interval(rays)
        t = space.distance(torch.tensor([[0.0, 1.0]]).expand(64, 2), rays, near, far)
        assert t.dtype == torch.float32 and torch.equal(t[:, 0], near) and torch.equal(t[:, 1], far)


# A box


def test_an_object_is_looked_at_where_rays_cross_its_bounds():
    ahead, radius = torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1)
    rays = [Rays(torch.tensor([origin]), ahead, radius) for origin in ([0.0, -3.0, 0.0], [0.0, 0.0, 0.0])]
    assert [[float(t) for t in SPACES["box"].interval(r)] for r in rays] == [[2.0, 4.0], [pytest.approx(0.1), 1.0]]
    beside = Rays(torch.tensor([[3.0, -3.0, 0.0], [0.0, 3.0, 0.0]]), ahead.expand(2, 3), radius.expand(2))
    near, far = SPACES["box"].interval(beside)
    assert torch.equal(near, far) and near.isfinite().all()


# Normalised device coordinates


def test_points_of_a_ray_lie_on_the_paper_s_ray(generator):
    """Mildenhall 2020, appendix C, in its own convention: right, up and backward, rays moved to the near plane."""
    space, n, (scale_x, scale_y) = SPACES["ndc"], FORWARD.near, FORWARD.scale
    rays = some_rays(40, generator)
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    o, d = (rays.origins - POSE[:, 3]) @ POSE[:, :3] * flip, rays.directions @ POSE[:, :3] * flip
    moved = -(n + o[:, 2]) / d[:, 2]
    ox, oy, oz = (o + moved[:, None] * d).T
    dx, dy, dz = d.T
    origin = torch.stack([-scale_x * ox / oz, -scale_y * oy / oz, 1 + 2 * n / oz], -1)
    direction = torch.stack([-scale_x * (dx / dz - ox / oz), -scale_y * (dy / dz - oy / oz), -2 * n / oz], -1)
    near, far = space.interval(rays)
    torch.testing.assert_close(near, moved)
    share = torch.rand(40, 5, generator=generator, dtype=torch.float64)
    t = space.distance(share, rays, near, far)
    paper = 1 - oz[:, None] / (oz[:, None] + (t - moved[:, None]) * dz[:, None])  # t' of the same points
    torch.testing.assert_close(paper, share * (1 - 1 / INFINITY))  # even in t', up to nearly infinity
    for k in range(5):
        seen = space.warp(rays.at(t[:, k])) * flip.abs() * torch.tensor([1.0, -1.0, 1.0])
        torch.testing.assert_close(seen, origin + paper[:, k, None] * direction)


def test_the_frustum_beyond_the_plane_is_a_cube():
    x, y, n = 1 / FORWARD.scale[0], 1 / FORWARD.scale[1], FORWARD.near
    corners = torch.tensor([[-x, -y, 1.0], [x, y, 1.0]], dtype=torch.float64)
    seen = SPACES["ndc"].warp(in_world(torch.cat([n * corners, 1e9 * corners])))
    expected = [[-1, -1, -1], [1, 1, -1], [-1, -1, 1], [1, 1, 1]]
    torch.testing.assert_close(seen, torch.tensor(expected, dtype=torch.float64))


def test_rays_that_look_sideways_or_back_see_nothing():
    looks = torch.tensor([[0.0, 0, -1], [1.0, 0, 0], [1.0, 0, 1e-9], [0.6, 0, -0.8]], dtype=torch.float64)
    rays = Rays(in_world(torch.zeros(4, 3).double()), looks @ POSE[:, :3].T, torch.zeros(4).double())
    near, far = SPACES["ndc"].interval(rays)
    assert torch.equal(near, far) and near.isfinite().all()
    t = SPACES["ndc"].distance(torch.rand(4, 7).double(), rays, near, far)
    assert torch.equal(t, near[:, None].expand(4, 7)) and SPACES["ndc"].warp(rays.at(near)).isfinite().all()


def test_a_camera_beyond_the_plane_looks_from_where_it_stands():
    rays = Rays(in_world(torch.tensor([[0.0, 0, 2.0]]).double()), POSE[:, 2][None], torch.zeros(1).double())
    near, far = SPACES["ndc"].interval(rays)
    assert float(near) == FRAMES["ndc"].near and float(far) == pytest.approx(INFINITY * FORWARD.near - 2)


# The contraction


def test_all_of_space_lies_in_a_ball(generator):
    space = SPACES["contraction"]
    points = torch.randn(500, 3, generator=generator, dtype=torch.float64) * torch.logspace(-2, 4, 500)[:, None]
    inside = points.norm(dim=-1) < 1
    seen = space.warp(points)
    torch.testing.assert_close(seen[inside], 0.5 * points[inside])
    assert seen.norm(dim=-1).max() < 1
    radius = points[~inside].norm(dim=-1, keepdim=True)
    torch.testing.assert_close(2 * seen[~inside], (2 - 1 / radius) * points[~inside] / radius)  # Barron 2022, eq. 10
    torch.testing.assert_close(torch.cross(seen, points, dim=-1), torch.zeros_like(points))


def test_samples_are_even_in_disparity(generator):
    space, rays = SPACES["contraction"], some_rays(3, generator)
    near, far = space.interval(rays)
    assert near.tolist() == [0.2] * 3 and far.tolist() == [pytest.approx(32 * math.sqrt(3))] * 3
    t = space.distance(torch.linspace(0, 1, 9, dtype=torch.float64).expand(3, 9), rays, near, far)
    steps = (1 / t).diff(dim=1)
    torch.testing.assert_close(steps, steps[:, :1].expand_as(steps))


# Which captures look one way


def facing(target: float = 8.0, **change) -> Capture:
    """Twelve cameras in a plane that look along +y, each a little its own way, and points beyond."""
    random = np.random.default_rng(2)
    places = random.uniform(-1, 1, (12, 3)) * [1, 0.05, 1]
    poses = [look_at(p, np.array([0, target, 0]) + random.normal(0, 0.2, 3))[:3] for p in places]
    lens = Pinhole(torch.tensor([[60.0, 60.0]]), torch.tensor([[24.0, 18.0]]))
    image = np.zeros((36, 48, 3), np.uint8)
    shots = [Shot(f"{i:02d}", pose, lens, (48, 36), image) for i, pose in enumerate(poses)]
    points = random.uniform([-3, 5, -2], [3, 30, 2], (400, 3))
    return replace(Capture("facing", shots, points), **change)


def near_in_source(scene) -> float:
    """The near plane's distance, in the source's units."""
    return scene.frame.forward.near * np.linalg.norm(np.array(scene.frame.source_from_scene)[0, :3])


def test_cameras_that_look_one_way_are_known_by_it():
    scene = assemble(facing())
    forward = scene.frame.forward
    assert forward is not None and scene.frame.reach > 1
    assert forward.scale < (60 / 24, 60 / 18)  # cameras beside the mean one see beyond its picture
    assert 0.7 * 5 < near_in_source(scene) < 0.8 * 5
    pose = torch.tensor(forward.pose)
    train = scene.cameras[scene.splits["train"]]
    torch.testing.assert_close(pose[:, 3], train.position.mean(0))
    torch.testing.assert_close(pose[:, :3].T @ pose[:, :3], torch.eye(3), atol=1e-5, rtol=0)
    assert (train.forward @ pose[:, 2]).min() > 0.97
    space = space_of(scene.frame)
    depths = space.warp(scene.points)[:, 2]
    assert (depths > -1).all() and (depths < 1).all()
    for camera in (train[i] for i in range(len(train))):
        rays = camera.rays(camera.pixels())
        for t in space.interval(rays):
            assert space.warp(rays.at(t)).abs().max() < 1 + 1e-3


def test_what_the_source_says_of_depths_comes_first():
    shots = [replace(shot, depths=(4.0, 40.0)) for shot in facing().shots]
    assert near_in_source(assemble(facing(shots=shots))) == pytest.approx(0.75 * 4, rel=0.03)
    unknown = assemble(facing(points=None))
    assert 0 < near_in_source(unknown) and unknown.frame.forward is not None


def test_other_captures_are_not_forward_facing(tmp_path):
    for write in (write_blender, write_ngp):  # all around
        assert open_scene(write(tmp_path / write.__name__, Tiny())).frame.forward is None
    assert assemble(facing(target=1.0)).frame.forward is None  # one looks far to the left, another to the right
    among = np.random.default_rng(0).uniform([-3, -0.5, -2], [3, 30, 2], (400, 3))
    assert assemble(facing(points=among)).frame.forward is None  # no plane lies between cameras and points
    wide = [replace(s, lens=Equirectangular(torch.tensor([[48.0, 36.0]]))) for s in facing().shots]
    assert assemble(facing(shots=wide)).frame.forward is None


def test_a_frame_comes_back_from_json():
    frame = FRAMES["ndc"]
    assert Frame.from_json(json.loads(json.dumps(frame.to_json()))) == frame


@each
def test_coordinates_lead_back_to_their_points(space, generator):
    points = some_points(200, generator)
    torch.testing.assert_close(space.unwarp(space.warp(points)), points, atol=1e-6, rtol=1e-6)
    beyond = space.unwarp(2 * torch.rand(100, 3, generator=generator, dtype=torch.float64) - 1)
    assert beyond.isfinite().all()
