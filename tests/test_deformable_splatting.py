"""Deformable splatting: planes of space and time, bounded offsets, rigidity, and Gaussians that stand still."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.components.clouds.addition import Step
from lumigraph.geometry import multiply, rotated
from lumigraph.methods.deformable_splatting import DeformableSplatting
from lumigraph.methods.deformable_splatting.planes import PAIRS, PLANE_SCALES, PlaneMotion, SpaceTimePlanes, spread

pytestmark = budget("methods", 5)
FRAME = replace(tiny.scene().frame, times=(1.0, 3.0))


def moving(seed: int = 0) -> DeformableSplatting:
    """A method whose Gaussians move at random."""
    method = DeformableSplatting(FRAME, DeformableSplatting.smallest()).eval()
    generator = torch.Generator().manual_seed(seed)
    for parameter in method.motion.parameters():
        parameter.data += 0.5 * torch.randn(parameter.shape, generator=generator)
    method.motion.active.fill_(True)
    return method


def test_features_are_products_of_interpolated_planes():
    planes = SpaceTimePlanes(DeformableSplatting.smallest().motion)
    for plane, (a, b) in zip(
        planes.planes, PAIRS * PLANE_SCALES, strict=True
    ):  # each holds a linear function of its two axes
        rows, columns = (torch.linspace(-1, 1, n) for n in plane.shape[2:])
        plane.data[:] = (2 + a + columns)[None, :] + (0.5 * b * rows)[:, None]
    places = torch.rand(20, 4, generator=torch.Generator().manual_seed(0)) * 2 - 1
    expected = torch.ones(20)
    for a, b in PAIRS:
        expected = expected * (2 + a + places[:, a] + 0.5 * b * places[:, b])
    torch.testing.assert_close(planes(places), expected[:, None].expand(20, 4 * PLANE_SCALES))


def test_nothing_moves_at_first_and_nothing_leaves_the_scene():
    fresh = DeformableSplatting(FRAME, DeformableSplatting.smallest())
    fresh.motion.active.fill_(True)
    cloud = fresh.filtered()
    at_end = fresh.motion.at(cloud, 3.0)
    torch.testing.assert_close(at_end.means, cloud.means, atol=1e-3, rtol=0)
    torch.testing.assert_close(at_end.log_scales, cloud.log_scales, atol=1e-3, rtol=0)
    method = moving()
    method.motion.heads.bias.data += 1e4
    offset, turn, _ = method.motion.offsets(cloud.means, 2.0)
    assert offset.abs().max() <= 0.5 * 2 * 3**0.5 + 1e-4  # half the diagonal of the box
    torch.testing.assert_close(turn.norm(dim=1), torch.ones(len(cloud)))


def test_pictures_and_exports_are_of_a_moment():
    method, camera = moving(), tiny.scene().cameras[0]
    first, last = (method.given(time=t) for t in (1.0, 3.0))
    assert not torch.allclose(first.gaussians().means, last.gaussians().means)
    assert torch.equal(method.gaussians().means, first.gaussians().means)
    of_camera = method.render(replace(camera, time=torch.tensor([3.0]))).rgb
    assert torch.equal(of_camera, last.render(camera).rgb)
    assert not torch.allclose(of_camera, first.render(camera).rgb)
    assert [control.name for control in method.controls] == ["time"]
    assert not DeformableSplatting(tiny.scene().frame, DeformableSplatting.smallest()).controls


def test_gaussians_that_hardly_move_stand_still():
    method = moving()
    motion, cloud = method.motion, method.filtered()
    every = motion.at(cloud, 3.0)
    motion.moves[::2] = False
    some = motion.at(cloud, 3.0)
    torch.testing.assert_close(some.means[1::2], every.means[1::2])
    assert torch.equal(some.means[::2], cloud.means[::2]) and torch.equal(some.log_scales[::2], cloud.log_scales[::2])
    for parameter in (motion.heads.weight, motion.heads.bias):
        parameter.data.zero_()
    motion.heads.bias.data[0] = 0.001 * motion.diagonal  # below the least offset that counts
    step = method.step_on(tiny.scene().photograph(0), 10)
    step.due = True
    motion.finish(step)
    assert not motion.moves.any()
    motion.heads.bias.data[0] = 0.003 * motion.diagonal
    motion.finish(step)
    assert motion.moves.all()


def test_a_rigid_motion_does_not_bend():
    """A motion field that turns all as one, in place of the planes: no bending; one that stretches: its square."""
    cloud = DeformableSplatting(FRAME, DeformableSplatting.smallest()).filtered()
    numbers, generator = DeformableSplatting.smallest().motion, torch.Generator().manual_seed(0)
    motion, noded = PlaneMotion(FRAME, replace(numbers, nodes=0), 50), PlaneMotion(FRAME, numbers, 50)
    for each in (motion, noded):
        each.follow_cloud(cloud.means.detach())
    angle = torch.tensor([0.0, 0.0, 0.7])
    turn = torch.tensor([torch.cos(angle[2] / 2), 0, 0, torch.sin(angle[2] / 2)])

    def turning(means, time):
        there = rotated(means, angle.expand(len(means), 3)) + 0.3
        return there - means, turn.expand(len(means), 4), torch.zeros_like(means)

    def stretching(means, time):
        return 0.1 * means, torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4), torch.zeros_like(means)

    for each in (motion, noded):
        each.offsets = turning
        assert float(each.bending(cloud, 2.0, generator)) < 1e-8
        each.offsets = stretching
        assert float(each.bending(cloud, 2.0, generator)) == pytest.approx(0.01, rel=1e-3)
    keep = torch.arange(len(cloud)) % 3 > 0
    places = cloud.means.detach()
    before = places[motion.neighbours]
    motion.follow(keep.nonzero()[:, 0])
    found, own = places[keep][motion.neighbours], places[keep][:, None]
    assert ((found == before[keep]) | (found == own)).all() and (found != own).any()


def test_nodes_carry_gaussians_rigidly():
    """Under a motion that turns all as one, Gaussians that nodes carry are turned exactly."""
    method = moving()
    motion, cloud = method.motion, method.filtered()
    motion.follow_cloud(cloud.means.detach())
    assert 6 < int(motion.node_count) <= 20
    angle = torch.tensor([0.1, -0.3, 0.5])
    turn = torch.cat([(angle.norm() / 2).cos()[None], (angle.norm() / 2).sin() * angle / angle.norm()])

    def turning(means, time):
        there = rotated(means, angle.expand(len(means), 3)) + 0.3
        return there - means, turn.expand(len(means), 4), torch.full_like(means, 0.2)

    motion.offsets = turning
    there = motion.at(cloud, 2.0)
    torch.testing.assert_close(there.means, rotated(cloud.means, angle.expand(len(cloud), 3)) + 0.3, atol=1e-5, rtol=0)
    torch.testing.assert_close(there.quaternions, multiply(turn[None], cloud.quaternions), atol=1e-5, rtol=0)
    torch.testing.assert_close(there.log_scales, cloud.log_scales + 0.2)
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    chosen = spread(points, 40)
    assert 20 < len(chosen) <= 40 and len(set(chosen.tolist())) == len(chosen)
    assert torch.cdist(points, points[chosen]).amin(1).max() < 0.5
    assert len(spread(points[:3], 40)) == 3


def test_moments_join_from_the_middle_on():
    scene = tiny.scene()
    times = torch.linspace(1, 3, len(scene.cameras))
    timed = replace(scene, cameras=replace(scene.cameras, time=times))
    method, train = moving(), scene.splits["train"]
    spans = []
    for progress in (0.0, 0.15, 0.3):
        method.progress = progress
        joined = method.joined_photographs(timed)
        spans.append(float((times[joined] - 2).abs().max()))
        assert set(joined.tolist()) <= set(train.tolist())
    assert spans[0] < 0.25 < spans[1] < 0.6 and len(joined) == len(train)


def test_points_are_followed_with_the_gaussians_around_them():
    method = moving()
    method.cloud.opacities.data.fill_(3.0)
    angle = torch.tensor([0.2, 0.4, -0.3])
    turn = torch.cat([(angle.norm() / 2).cos()[None], (angle.norm() / 2).sin() * angle / angle.norm()])

    def turning(means, time):
        share = (time - 1.0) / 2
        if not share:
            return torch.zeros_like(means), torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4), torch.zeros_like(means)
        there = rotated(means, angle.expand(len(means), 3)) + 0.2
        return there - means, turn.expand(len(means), 4), torch.zeros_like(means)

    method.motion.offsets = turning
    points = method.cloud.means.detach()[:20] + 0.05
    expected = rotated(points, angle.expand(20, 3)) + 0.2
    torch.testing.assert_close(method.follow(points, 1.0, 3.0), expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(method.follow(expected, 3.0, 1.0), points, atol=1e-4, rtol=0)


def test_without_rigidity_the_motion_is_the_releases():
    """A head for each output, offsets without a bound, and nothing told apart."""
    numbers = replace(DeformableSplatting.smallest().motion, rigidity=0.0, nodes=0)
    motion, points = PlaneMotion(FRAME, numbers, 20), torch.zeros(20, 3)
    for head, value in zip(motion.heads, (100.0, 0.0, 2.0), strict=True):
        head[-1].weight.data.zero_()
        head[-1].bias.data.fill_(value)
    offset, turn, size = motion.offsets(points, 2.0)
    assert (offset == 100).all() and (size == 2).all()
    assert torch.equal(turn, torch.tensor([[1.0, 0, 0, 0]]).expand(20, 4))
    step = object.__new__(Step)
    step.due, step.progress, step.learnt = True, 0.9, SimpleNamespace(means=points)
    motion.heads[0][-1].bias.data.zero_()  # nothing moves now, and all may still move
    motion.active.fill_(True)
    motion.finish(step)
    assert motion.moves.all()
