"""Splatting from few photographs: Gaussians left out at random, depth between the photographs, plain colours."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget
from test_gaussian_splatting import new

from lumigraph.components.clouds.addition import TrainingViews
from lumigraph.components.clouds.cloud import Cloud
from lumigraph.components.clouds.initialization import random_cloud, round_gaussians
from lumigraph.components.training.dense_points import Points
from lumigraph.components.training.regularizers import camera_between, places_between
from lumigraph.gaussians.splatting import splat, view_of
from lumigraph.methods.gaussian_splatting.few_views import (
    FewViewNumbers,
    FewViews,
    depth_roughness,
    drop_gaussians,
    surface_error,
    visible_points,
)
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

    def roughness(cloud):
        return depth_roughness(splat(cloud, view_of(camera_between(cameras, chance()), 0.1), bands=1))

    smooth, heap = float(roughness(flat)), float(roughness(rough))
    assert smooth < 0.2 * heap
    means = rough.means.clone().requires_grad_()
    before = roughness(replace(rough, means=means))
    before.backward()
    length = 0.05 * float(means.detach().std()) / float(means.grad.norm(dim=-1).max())
    after = roughness(replace(rough, means=(means - length * means.grad).detach()))
    assert float(after) < float(before.detach())


def test_few_views_have_plain_colours_and_a_term_of_depth():
    method, _ = new(few_views="yes")
    scene = replace(tiny.scene(), splits={"train": torch.arange(5)})
    fit(method, scene, steps=12, show=False, rehearsal=False)
    assert method.bands == 1 and not method.cloud.harmonics[:, 1:].any()
    terms = method.loss(method.batch(scene, chance()), 12)
    assert float(terms["depth"]) > 0
    terms["depth"].backward()
    assert method.cloud.means.grad.any()


def test_places_between_lie_on_the_way_to_near_cameras():
    stands = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]])
    found = places_between(torch.zeros(64, 3), stands, chance())
    assert (found.count_nonzero(dim=1) <= 1).all() and (found <= stands[1:4].amax(0)).all()  # never to the fifth
    assert (found.amax(0) > 0.5 * stands[1:4].amax(0)).all()  # each of the three is chosen
    assert torch.equal(places_between(stands[:1], stands[:1], chance()), stands[:1])  # a single camera has none


def test_a_camera_between_stands_near_two_of_them():
    cameras = tiny.scene().cameras
    position = cameras.position
    for seed in range(20):
        camera = camera_between(cameras, chance(seed))
        away = torch.cdist(camera.position, position)[0].sort().values
        assert float(away[1]) < float(torch.cdist(position, position).max())
        assert torch.allclose(camera.pose[0, :, :3] @ camera.pose[0, :, :3].T, torch.eye(3), atol=1e-5)
        assert float(torch.det(camera.pose[0, :, :3])) == pytest.approx(1.0, abs=1e-5)
    one = camera_between(cameras[:1], chance())
    assert torch.allclose(one.pose, cameras.pose[:1], atol=1e-5)


def test_points_behind_others_are_hidden():
    camera = tiny.scene().cameras[:1]
    near, far = camera.position[0] + 1.5 * camera.forward[0], camera.position[0] + 2.0 * camera.forward[0]
    behind = camera.position[0] - camera.forward[0]
    place, depth, index = visible_points(torch.stack([far, near, behind]), camera)
    assert index.tolist() == [1] and float(depth[0]) == pytest.approx(1.5, abs=1e-5)
    assert place[0].tolist() == [int(camera.size[0, 1]) // 2] and place[1].tolist() == [int(camera.size[0, 0]) // 2]


def test_known_surfaces_carve_away_what_floats_in_front():
    """Opacity of a blob before a wall has a positive slope, that of the wall behind it none or a negative one."""
    cloud, camera = wall(0.0)
    forward, position = camera.forward[0], camera.position[0]
    floater = round_gaussians(torch.stack([0.5 * position, 0.55 * position]), torch.rand(2, 3, generator=chance()), 0)
    both = type(cloud)(
        *(torch.cat([getattr(x, name) for x in (cloud, floater)]) for name in ("means", "quaternions", "log_scales")),
        torch.cat([cloud.opacities, torch.zeros(2)]).requires_grad_(),
        torch.cat([cloud.harmonics, floater.harmonics]),
    )
    seen = splat(both, view_of(camera, 0.1), bands=1)
    place, depth, index = visible_points(cloud.means, camera)
    surface_error(seen, place, depth, torch.full((len(index), 3), 0.5)).backward()
    assert (both.opacities.grad[-2:] > 0).all()
    assert float(both.opacities.grad[:-2].sum()) < 0
    assert forward @ position < 0  # the blobs lie between the camera and the wall


def test_a_capture_is_sparse_if_sweeps_agree_little_on_up_to_forty_photographs_of_a_place():
    scene, points = tiny.scene(), Points(*(torch.ones(5, 3),) * 2, torch.ones(5), torch.zeros(5, 3), 0.1)
    place = replace(scene, frame=replace(scene.frame, reach=4.0, has_alpha=False))
    cloud = Cloud(random_cloud(scene.frame, 2, 0, chance()))
    many = replace(place, splits={"train": torch.arange(41) % 4})
    agreed = replace(points, share=0.3)
    for data, found, expected in (
        (scene, points, scene.frame.is_open),
        (place, points, True),
        (place, agreed, False),
        (many, points, False),
    ):
        part = FewViews(FewViewNumbers("auto"))
        part.begin_scene(
            cloud, TrainingViews(None, lambda cameras: cameras, 0.0, 0.0, move=False), data, lambda found=found: found
        )
        assert bool(part.active) == expected and len(part.surface) == 5 * expected
