"""Scenes that move: their exact motion against geometry, what is held out of them, and scores of what moves alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from captures import Tiny, write_nerfies, write_ngp, write_nr_nerf

from lumigraph import synthetic as procedural
from lumigraph.components.sampling.occupancy import visual_hull
from lumigraph.errors import LumigraphWarning
from lumigraph.evaluation.held_out import held_out_kinds
from lumigraph.evaluation.views import evaluate
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene
from lumigraph.readers.hull import Silhouette, hull_box
from lumigraph.synthetic import scenes, signed_distance
from lumigraph.synthetic.shapes import SoftCapsule

pytestmark = budget("capture", 6)
NAMES = ("jelly", "clockwork", "street")


@pytest.fixture(scope="module", params=NAMES)
def stage(request):
    return scenes.stage(request.param, size=24, views=9)


def test_a_soft_capsule_deforms_and_returns():
    shape = SoftCapsule(0.3, 0.4, curvature=1.7, stretch=1.2)
    points = np.random.default_rng(0).uniform(-0.29, 0.29, (50, 3)) * (1, 1, 2.3)
    there = shape.deformed(points)
    np.testing.assert_allclose(shape.at_rest(there), points, atol=1e-12)
    step = 1e-5
    jacobian = [(shape.deformed(points + d) - shape.deformed(points - d)) / (2 * step) for d in step * np.eye(3)]
    volume = np.linalg.det(np.stack(jacobian, -1)[np.abs(points[:, 2]) < 0.39])
    aside = points[np.abs(points[:, 2]) < 0.39][:, 0] / np.sqrt(1.2)
    np.testing.assert_allclose(volume, 1 - 1.7 * aside, atol=1e-6)  # 1 on the axis: the volume stays


def test_a_straight_capsule_is_the_limit_of_bent_ones():
    points = np.random.default_rng(1).uniform(-1, 1, (30, 3))
    straight, left, right = (SoftCapsule(0.3, 0.4, curvature).deformed(points) for curvature in (0.0, 1e-7, -1e-7))
    np.testing.assert_allclose(straight, points, atol=1e-12)
    np.testing.assert_allclose(left, points, atol=1e-6)
    np.testing.assert_allclose(right, points, atol=1e-6)


def test_carried_points_lie_on_the_later_surface_and_return(stage):
    camera = stage.cameras["train"][2]
    rays, now, later = camera.rays(camera.pixels()), stage.world_of(camera), stage.moving(0.9)
    seen = procedural.trace(now, rays, shaded=False)
    hit = np.isin(seen.identity, stage.moving_things)
    assert 20 < hit.sum()
    points = rays.origins.double().numpy()[hit] + seen.depth[hit, None] * rays.directions.double().numpy()[hit]
    there = now.carried(points, seen.identity[hit], later)
    assert np.linalg.norm(there - points, axis=1).max() > 0.1
    assert signed_distance(later, torch.from_numpy(there)).abs().max() < 1e-5
    np.testing.assert_allclose(later.carried(there, seen.identity[hit], now), points, atol=1e-9)
    flow = procedural.scene_flow(stage, camera, 0.9).reshape(-1, 3)
    np.testing.assert_allclose(flow[hit], there - points, atol=1e-9)
    assert np.abs(flow[(seen.identity >= 0) & ~hit]).max() < 1e-12 and np.isnan(flow[seen.identity < 0]).all()


def test_colours_travel_with_points(stage):
    """The albedo at a point is the same at any moment, where it is seen at both: textures are fixed to what moves."""
    camera = stage.cameras["train"][1]
    rays, now, later = camera.rays(camera.pixels()), stage.world_of(camera), stage.moving(0.35)
    rays = replace(rays, radius=rays.radius * 1e-3)
    seen = procedural.trace(now, rays, shaded=False)
    hit = np.isin(seen.identity, stage.moving_things)
    points = rays.origins.double().numpy()[hit] + seen.depth[hit, None] * rays.directions.double().numpy()[hit]
    there = torch.from_numpy(now.carried(points, seen.identity[hit], later))
    toward = there - rays.origins.double()[0]
    away = toward.norm(dim=-1, keepdim=True)
    again = procedural.trace(later, replace(rays[torch.from_numpy(hit)], directions=(toward / away).float()), False)
    visible = np.abs(again.depth - away[:, 0].numpy()) < 1e-3
    assert visible.sum() > 10
    same = np.abs(again.reflectance - seen.reflectance[hit])[visible].max(-1) < 0.1
    assert same.mean() > 0.9  # but for edges of the texture, by rounding


def test_cameras_stay_outside_and_motion_inside_the_bounds(stage):
    positions = torch.cat([cameras.position for cameras in stage.cameras.values()])
    for time in np.linspace(0, 1, 5).tolist():
        low, high = stage.moving(time).bounds()
        assert (low >= stage.bounds[0]).all() and (high <= stage.bounds[1]).all()
        assert signed_distance(stage.moving(time), positions).min() > stage.near


def test_every_moment_is_seen_by_a_held_out_camera():
    mono, rig = (scenes.stage("jelly", size=16, views=24, rig=rig).cameras for rig in (0, 4))
    assert len(mono["train"]) == len(rig["train"]) == 24 and len(mono["train"].time.unique()) == 24
    assert len(rig["train"].time.unique()) == 6 and len(rig["train"].pose.flatten(1).unique(dim=0)) == 4
    for cameras in (mono, rig):
        assert set(cameras["train"].time.tolist()) < set(cameras["test"].time.tolist())
        assert not (cameras["test"].pose[:, None] == cameras["train"].pose).flatten(2).all(-1).any()


def moving_scene():
    """The ball, photographed at three moments by four cameras; its left half is said to move."""
    ball = tiny.scene()
    times = torch.arange(12) // 4 * 1.0
    pose = ball.cameras.pose[torch.arange(12) % 4]
    cameras = replace(ball.cameras, time=times, pose=pose)
    return replace(ball, cameras=cameras, frame=replace(ball.frame, times=(0.0, 2.0)))


def test_held_out_views_are_of_new_cameras_new_moments_or_both():
    scene = moving_scene()
    for train, kinds in (
        ([1, 2, 3, 5, 6, 7, 9, 10, 11], {0: "new cameras", 1: "known cameras and moments"}),
        ([0, 1, 2, 3, 8, 9, 10, 11], {4: "new moments"}),
        ([1, 2, 9, 10], {4: "new cameras and moments", 5: "new moments", 8: "new cameras"}),
    ):
        found = held_out_kinds(replace(scene, splits={"train": torch.tensor(train)}))
        assert {i: found[i] for i in kinds} == kinds
    assert held_out_kinds(tiny.scene()) == [None] * 12


def test_nothing_is_carved_away_that_is_empty_at_some_moments_only():
    assert visual_hull(moving_scene(), 16).all() and not visual_hull(tiny.scene(), 16).all()
    centres, radius = np.array([[-0.6, 0, 0], [0.6, 0, 0]]), 0.2  # of a ball that is here, then there
    cameras = tiny.scene().cameras
    outlines = []
    for i in range(len(cameras)):
        rays = cameras[i].rays(cameras[i].pixels())
        toward = torch.from_numpy(centres[i % 2]).float() - rays.origins
        aside = torch.linalg.cross(toward, rays.directions).norm(dim=-1)
        outlines.append(Silhouette(cameras[i], (aside < radius).view(tiny.SIZE, tiny.SIZE)))
    found = hull_box(outlines, np.zeros(3), 1.5, moves=True)
    assert found is not None and found[0][0] < -0.75 and found[1][0] > 0.75


def test_evaluation_names_what_was_held_out_and_what_moves():
    scene = open_scene("procedural:jelly,size=24,views=9")
    assert not scene.frame.is_open
    method = tiny.method(scene.frame)
    found = evaluate(method, scene)
    said = found.to_json()
    kinds = said["by_held_out"]
    assert set(kinds) == {"new cameras", "new cameras and moments"}
    assert kinds["new cameras"]["views"] == 9 and len(found.views) == 9 + kinds["new cameras and moments"]["views"]
    assert {score.name for score in found.scores} >= {"moving PSNR", "moving SSIM"}
    index = int(scene.splits["test"][0])
    shot = scene.photograph(index, ["moving"])
    moving = shot.extra["moving"] == 1
    assert 0.02 < moving.float().mean() < 0.5
    rgb, truth = method.render(shot.camera).rgb, shot.before(scene.frame.background)
    assert found.views[0].moving_psnr == pytest.approx(psnr(rgb.clamp(0, 1)[moving], truth[moving]))


def test_captures_of_what_moves_have_their_moments(tmp_path):
    source = Tiny()
    nerfies, nr_nerf = (
        open_scene(write_nerfies(tmp_path / "a", source)),
        open_scene(write_nr_nerf(tmp_path / "b", source)),
    )
    assert nerfies.frame.times == (0.0, 18.0) and nr_nerf.frame.times == (0.0, 9.0)
    for i, name in enumerate(nerfies.names):
        assert nerfies.cameras.time[i] == 2 * int(name[-2:])
    assert len(nerfies.splits["test"]) == 3 and len(nerfies.points) == 200
    halved = open_scene(tmp_path / "a", downscale=2)
    assert halved.cameras.size.unique(dim=0).tolist() == [[24, 18]]


def test_times_missing_for_some_photographs_are_told(tmp_path):
    source = Tiny()
    frames = source.frames("images/", ".png")
    frames = [frame | ({"time": i / 9} if i != 3 else {}) for i, frame in enumerate(frames)]
    with pytest.warns(LumigraphWarning, match="no time of 1 photograph, such as images/view_03.png"):
        scene = open_scene(write_ngp(tmp_path, source, frames=frames))
    assert scene.frame.times is None
