"""Dense points by plane sweeps: they lie on the surface, for every lens, and only where photographs say something."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import tiny
import torch
from budgets import budget
from torch.nn.functional import normalize

from lumigraph.camera import Camera
from lumigraph.camera.lens import Fisheye, OpenCV, Pinhole
from lumigraph.components.clouds import initialization
from lumigraph.components.training import dense_points
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Frame, Scene
from lumigraph.depth_maps.flat_view import flat_view

pytestmark = budget("methods", 8)

RADIUS, SIZE, FOCAL, COUNT = 0.6, 48, 64.0, 6

LENSES = {
    "pinhole": Pinhole(torch.full((COUNT, 2), FOCAL), torch.full((COUNT, 2), SIZE / 2)),
    "opencv": OpenCV(
        torch.full((COUNT, 2), FOCAL),
        torch.full((COUNT, 2), SIZE / 2),
        torch.tensor([0.3, 0.1, 0.01, -0.01, 0.0, 0.0, 0.0, 0.0]).repeat(COUNT, 1),
    ),
    "fisheye": Fisheye(torch.full((COUNT, 2), FOCAL), torch.full((COUNT, 2), SIZE / 2), torch.zeros(COUNT, 4)),
}


def dense_cloud(scene, seconds=math.inf):
    return dense_points.thinned(dense_points.seen_points(scene, seconds))


def texture(places: torch.Tensor) -> torch.Tensor:
    """A colour at each place: waves of some pixels in many directions."""
    chance = torch.Generator().manual_seed(0)
    waves = 30 * normalize(torch.randn(12, 3, generator=chance), dim=-1)
    heights = (places @ waves.T + 6 * torch.rand(12, generator=chance)).sin()
    return (0.5 + 0.12 * heights @ torch.randn(12, 3, generator=chance)).clamp(0, 1)


@cache
def ball(lens: str = "pinhole", alpha: bool = True) -> Scene:
    """Photographs of a patterned ball around the origin; without alpha it hangs inside a patterned ball of radius 6."""
    pose = tiny.poses(30)[:COUNT]
    cameras = Camera(pose, LENSES[lens], torch.full((COUNT, 2), SIZE), image_index=torch.arange(COUNT))
    pictures = []
    for camera in (cameras[i] for i in range(COUNT)):
        rays = camera.rays(camera.pixels())
        b = (rays.origins * rays.directions).sum(-1)
        c = rays.origins.square().sum(-1)
        under = b * b - c + RADIUS**2
        near = rays.origins + (-b - under.clamp_min(0).sqrt())[:, None] * rays.directions
        far = rays.origins + (-b + (b * b - c + 36).sqrt())[:, None] * rays.directions
        rgb = torch.where(under[:, None] > 0, texture(near), texture(0.25 * far))
        rgba = torch.cat([rgb, (under > 0).float()[:, None]], -1)[:, : 4 if alpha else 3]
        pictures.append((255 * rgba).byte().view(SIZE, SIZE, -1).numpy())
    frame = Frame(near=1.0, reach=1.0 if alpha else 8.0, has_alpha=alpha, image_count=COUNT)
    splits = {"train": torch.arange(COUNT), "test": torch.arange(0)}
    return Scene(cameras, ImageStore.from_arrays(pictures), frame, splits, [f"{i}" for i in range(COUNT)], "in memory")


@cache
def dense(lens: str = "pinhole", alpha: bool = True) -> dense_points.Points:
    """Points that sweeps find in these photographs, in which none is known."""
    return dense_cloud(ball(lens, alpha))


def off_surface(points: torch.Tensor) -> torch.Tensor:
    """How far points are from the ball, in distances of the cameras."""
    return (points.norm(dim=-1) - RADIUS).abs() / tiny.DISTANCE


@pytest.mark.parametrize("lens", LENSES)
def test_points_without_any_known_lie_on_the_surface(lens):
    found = dense(lens)
    assert len(found.positions) > 500
    off = off_surface(found.positions)
    assert off.median() < 0.005
    assert (off < 0.02).float().mean() > 0.95
    assert (found.colours - texture(found.positions)).abs().mean() < 0.1
    assert found.sizes.median() == pytest.approx((tiny.DISTANCE - RADIUS) / FOCAL, rel=0.2)


def test_the_background_is_found_too():
    positions = dense(alpha=False).positions
    far = positions.norm(dim=-1) > 3
    assert far.sum() > 200 and (~far).sum() > 200
    assert (off_surface(positions[~far]) < 0.02).float().mean() > 0.8  # windows widen edges


def test_nothing_is_found_where_photographs_are_not_to_be_trusted():
    scene = ball(alpha=False)
    images = [scene.images[i].numpy() for i in range(COUNT)]
    masks = [torch.zeros(SIZE, SIZE, dtype=torch.bool).numpy() for _ in images]
    for mask in masks:
        mask[:, : SIZE // 2] = True
    found = dense_cloud(replace(scene, images=ImageStore.from_arrays(images, masks)))
    cameras = scene.cameras
    columns = torch.stack([cameras[i].project(found.positions)[0][:, 0] for i in range(COUNT)])
    assert len(found.positions) > 100
    assert (columns.amin(0) < SIZE // 2 + 1).all()


def test_one_photograph_alone_has_no_dense_points():
    scene = ball()
    alone = replace(scene, splits={"train": torch.tensor([3])})
    assert len(dense_cloud(alone).positions) == 0


def test_a_cloud_begins_at_known_points_dense_ones_and_far_out(generator):
    scene = ball(alpha=False)
    known = RADIUS * normalize(torch.randn(300, 3, generator=generator), dim=-1)
    begun = initialization.initial_cloud(
        replace(scene, points=known), "dense", 200, 2000, 1, generator, lambda: dense(alpha=False)
    )
    assert len(begun) == 667  # a third
    assert {tuple(p) for p in known.tolist()} <= {tuple(p) for p in begun.means.tolist()}
    begun = initialization.initial_cloud(scene, "dense", 200, 5000, 1, generator, lambda: dense(alpha=False))
    assert (begun.means[-40:].norm(dim=-1) > 1.7).all()  # a fifth of 200, outside the box
    swept = initialization.initial_cloud(scene, "sparse", 200, 5000, 1, generator, lambda: dense(alpha=False))
    assert len(swept) == len(begun)  # a place without known points
    for object_or_none, kind in ((ball(), "sparse"), (scene, "random")):
        assert len(initialization.initial_cloud(object_or_none, kind, 200, 5000, 1, generator)) == 200


def test_the_same_photographs_give_the_same_cloud():
    begun = initialization.initial_cloud(ball(), "dense", 9, 300, 1, torch.Generator().manual_seed(3))
    positions = dense().positions
    chosen = torch.randperm(len(positions), generator=torch.Generator().manual_seed(3))[:100]
    assert torch.equal(begun.means, positions[chosen])


def test_a_flat_view_sees_what_the_lens_sees():
    """A pixel of the flat picture has the colour that the world has along its ray."""
    scene = ball("opencv", alpha=False)
    view = flat_view(scene.photograph(2), 240)
    origin = view.pose[:, 3]
    directions = normalize(view.rays, dim=-1)
    b = directions @ origin
    under = b * b - origin @ origin + RADIUS**2
    inside = (under > 0.05) & (view.trust == 1)
    places = origin + (-b - under.clamp_min(0).sqrt())[..., None] * directions
    assert inside.sum() > 300
    assert (view.rgb - texture(places))[inside].abs().mean() < 0.05


def test_a_warp_is_a_projection(generator):
    views = [flat_view(ball().photograph(i), 240) for i in (0, 1)]
    depth = 2.0
    places = views[0].pose[:, 3] + depth * views[0].rays[20, 30:33]
    there, _ = views[1].project(places)
    warp = views[0].warp_to(views[1])
    pixels = torch.tensor([[x + 0.5, 20.5, 1.0] for x in (30, 31, 32)])
    u = pixels @ warp[:, :3].T + warp[:, 3] / depth
    torch.testing.assert_close(u[:, :2] / u[:, 2:], there, rtol=1e-4, atol=1e-3)


def test_a_short_budget_asks_fewer_photographs(monkeypatch):
    clock, swept = iter(range(1000)), []

    def alone(views, *_):
        swept.append(len(views))
        return [[] for _ in views]

    monkeypatch.setattr(dense_points.time, "perf_counter", lambda: next(clock))  # so that a sweep takes a second
    monkeypatch.setattr(dense_points, "MIN_VIEWS", 3)
    monkeypatch.setattr(dense_points, "choose_neighbours", alone)
    for seconds in (2.0, 8.0, math.inf):
        dense_cloud(ball(), seconds)
    assert swept == [3, 3, 4, 4, COUNT, COUNT]  # twice each, as no point is known


def test_a_near_distance_that_is_much_too_small_keeps_the_neighbours():
    scene = ball()
    found = dense_cloud(replace(scene, frame=replace(scene.frame, near=0.05)))
    assert len(found.positions) > 0.5 * len(dense().positions)
    assert off_surface(found.positions).median() < 0.01
