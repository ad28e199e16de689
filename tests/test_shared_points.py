"""Poses from points that photographs share: features, matches, bundle adjustment."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from torch.nn.functional import grid_sample, normalize

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.components.training.bundle_adjustment import adjusted, pixel_angle, rotation_vector
from lumigraph.components.training.pose_refinement import PoseRefinement
from lumigraph.components.training.shared_points import Seen, neighbours, tracks
from lumigraph.datasets.alignment import moves
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Scene
from lumigraph.geometry import look_at, rotated

pytestmark = budget("methods", 8)

SIZE = 160


def jittered(cameras: Camera, amount: float = 2.0) -> Camera:
    """Cameras turned by so many degrees, and moved by as many percent of a box that is 2 wide."""
    chance = torch.Generator().manual_seed(3)
    omega, shift = (normalize(torch.randn(len(cameras), 3, generator=chance), dim=-1) for _ in range(2))
    axes = [rotated(cameras.pose[:, :, i], math.radians(amount) * omega) for i in range(3)]
    return replace(cameras, pose=torch.stack([*axes, cameras.position + amount / 50 * shift], -1))


def test_wrong_matches_let_go():
    """Points in a box, seen by each camera to a tenth of a pixel; a fifth of the matches are of other points."""
    true, chance = tiny.made(10, 100, 150.0).cameras, torch.Generator().manual_seed(0)
    points = torch.rand(150, 3, generator=chance) - 0.5
    seen = []
    for i in range(len(true)):
        pixels, _ = true[i].project(points)
        noise = 0.1 * torch.randn(pixels.shape, generator=chance)
        seen.append(Seen(true[i].lens.unproject(pixels + noise), torch.zeros(len(points), 128)))
    matches = {}
    for pair in combinations(range(len(true)), 2):
        mine = torch.randperm(150, generator=chance)[:50]
        other = torch.where(torch.rand(50, generator=chance) < 0.2, mine.roll(1), mine)
        matches[pair] = torch.stack([mine, other], -1)
    given, frame = jittered(true), tiny.scene().frame
    found = adjusted(given, seen, matches, 2.0, 0.2 * pixel_angle(true[0]))
    before, after = moves(given, true, frame).median, moves(found, true, frame).median
    assert before[0] > 1.5 and after[0] < 0.1 and after[1] < 0.15
    assert torch.equal(adjusted(given, seen, {}, 2.0, 1e-3).pose, given.pose)  # nothing is shared


def test_points_that_a_photograph_shows_twice_are_none():
    seen = [Seen(torch.eye(3), torch.zeros(3, 128)) for _ in range(3)]
    shared = tracks(
        seen, {(0, 1): torch.tensor([[0, 0], [1, 1]]), (1, 2): torch.tensor([[0, 2]]), (0, 2): torch.tensor([[2, 0]])}
    )
    assert sorted(zip(shared.point.tolist(), shared.view.tolist(), strict=True)) == [
        (0, 0),
        (0, 1),
        (0, 2),
        (1, 0),
        (1, 1),
        (2, 0),
        (2, 2),
    ]
    twice = {(0, 1): torch.tensor([[0, 0]]), (1, 2): torch.tensor([[0, 0]]), (0, 2): torch.tensor([[1, 0]])}
    assert len(tracks(seen, twice).point) == 0


def test_views_that_turn_away_are_not_compared():
    cameras = tiny.made(12, 16, 20.0).cameras
    for i, j in neighbours(cameras):
        assert i < j and float((cameras.forward[i] * cameras.forward[j]).sum()) > math.cos(math.radians(75))


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.3])
def test_a_rotation_vector_is_found_again(angle):
    omega = angle * torch.tensor([[0.6, 0.0, -0.8]]).double()
    turn = rotated(torch.eye(3).double(), omega.expand(3, 3)).T[None]
    torch.testing.assert_close(rotation_vector(turn), omega, atol=1e-12, rtol=1e-6)


def photographed(cameras: Camera) -> list[np.ndarray]:
    """A corner of three walls in patterns of their own."""
    pattern = torch.rand(3, 1, 40, 40, generator=torch.Generator().manual_seed(1))
    pictures = []
    for i in range(len(cameras)):
        rays = cameras[i].rays(cameras[i].pixels())
        t = (-0.4 - rays.origins) / rays.directions
        t = torch.where(t > 0, t, torch.inf)
        near, wall = t.min(-1)
        hit = rays.at(near.clamp(max=100))
        across = torch.stack([hit.gather(1, ((wall + k) % 3)[:, None])[:, 0] for k in (1, 2)], -1)
        each = torch.cat(
            [
                grid_sample(pattern[k : k + 1], across[None, None], padding_mode="reflection", align_corners=False)[
                    0, :, 0
                ]
                for k in range(3)
            ]
        )
        grey = each.gather(0, wall[None])[0].reshape(SIZE, SIZE, 1)
        pictures.append(np.uint8(255 * grey.expand(-1, -1, 3).numpy()))
    return pictures


def test_photographs_bring_their_cameras_back():
    """Seven photographs of a corner, whose cameras are said to be 2 degrees and 2 % off."""
    angles = torch.linspace(0.35, 1.2, 7)
    eyes = 2.5 * torch.stack([angles.cos(), angles.sin(), 0.5 + 0.4 * (3 * angles).sin()], -1)
    lens = Pinhole(torch.full((7, 2), 1.5 * SIZE), torch.full((7, 2), SIZE / 2))
    pose = look_at(eyes, -eyes, torch.tensor([0.0, 0.0, 1.0]))
    true = Camera(pose, lens, torch.full((7, 2), SIZE), image_index=torch.arange(7))
    frame = replace(tiny.scene().frame, image_count=7, has_alpha=False)
    images, names = ImageStore.from_arrays(photographed(true)), [str(i) for i in range(7)]
    scene = Scene(jittered(true), images, frame, {"train": torch.arange(7)}, names)
    poses = PoseRefinement(7)
    poses.find(scene)
    before, after = (moves(cameras, true, frame).median for cameras in (scene.cameras, poses.refined(scene.cameras)))
    assert poses.found and before[0] > 1.0 and after[0] < 0.2 and after[1] < 0.3
    assert poses.rate(0.2) < 0.2 * poses.learning_rate
