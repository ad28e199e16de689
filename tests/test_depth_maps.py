"""Depth maps of a wall: back-projection, visibility, what is unknown, and the signed distance of several."""

from __future__ import annotations

import pytest
import torch

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.camera.rays import Rendering
from lumigraph.depth_maps import TSDF, DepthMap, Tolerance, back_project, free

WALL, SIZE = 2.0, 16  # the wall's z, seen from the origin along +z; pixels a side


def camera(x: float = 0.0) -> Camera:
    pose = torch.eye(3, 4)[None].clone()
    pose[0, 0, 3] = x
    return Camera(pose, Pinhole(torch.full((1, 2), 16.0), torch.full((1, 2), SIZE / 2)), torch.tensor([[SIZE, SIZE]]))


def wall(x: float = 0.0) -> DepthMap:
    """Nothing in the first column, unknown in the last."""
    seen = camera(x)
    depth = (WALL / seen.rays(seen.pixels()).directions[:, 2]).view(SIZE, SIZE)
    depth[:, 0], depth[:, -1] = torch.inf, torch.nan
    return DepthMap.measured(seen, depth, torch.full((SIZE, SIZE, 3), 0.25))


def test_points_lie_on_the_wall_and_look_back():
    found = wall(0.5).points()
    assert len(found) == SIZE * (SIZE - 2)
    torch.testing.assert_close(found.points[:, 2], torch.full((len(found),), WALL))
    torch.testing.assert_close(found.normals, torch.tensor([[0.0, 0.0, -1.0]]).expand(len(found), 3), atol=1e-3, rtol=0)
    assert (found.colours == 0.25).all() and (found.origins == torch.tensor([0.5, 0.0, 0.0])).all()
    seen = camera(0.5)
    along_axis = back_project(seen, seen.pixels(), torch.full((SIZE * SIZE,), WALL), along_axis=True)
    torch.testing.assert_close(along_axis[wall(0.5).solid.flatten()], found.points)


def test_points_are_visible_hidden_outside_or_unknown():
    near, behind, outside, sky, unknown = [0.0, 0, 1], [0.0, 0, 3], [9.0, 0, 1], [-0.97, 0, 2], [0.97, 0, 2]
    compared = wall().compare(torch.tensor([near, behind, outside, sky, unknown]))
    assert compared.ahead[:2].tolist() == pytest.approx([1.0, -1.0], abs=0.02)
    assert compared.ahead[[2, 4]].isnan().all() and compared.smooth.tolist()[:2] == [True, True]
    points = torch.tensor([near, behind, outside, unknown])
    assert wall().sees(points).tolist() == [True, False, False, False]
    assert wall().sees(points, Tolerance(1.1)).tolist() == [True, True, False, False]
    assert wall().sees_past(points).tolist() == [True, False, False, False]
    assert free(points, [wall(), wall(0.1)]).tolist() == [True, False, False, False]


def test_the_signed_distance_is_zero_on_the_wall():
    z = torch.tensor([1.0, 1.9, 2.0, 2.05, 2.5])
    points = torch.stack([0 * z, 0 * z, z], -1)
    found = TSDF([wall(), wall(0.2)], Tolerance(0.1))(points)
    torch.testing.assert_close(found.distance[:4], torch.tensor([1.0, 1.0, 0.0, -0.5]), atol=0.02, rtol=0)
    assert found.distance[4].isnan() and found.pictured.all()
    nowhere = TSDF([wall()], Tolerance(0.1))(torch.tensor([[0.97, 0.0, 2.0], [0.0, 0.0, -1.0]]))
    assert nowhere.distance.isnan().all() and not nowhere.pictured.any()


def test_a_rendering_loses_its_background():
    opacity = torch.full((SIZE, SIZE), 0.75)
    rgb = 0.75 * torch.tensor([0.2, 0.4, 0.6]) + 0.25
    found = DepthMap.of_rendering(
        camera(), Rendering(rgb.expand(SIZE, SIZE, 3), torch.full((SIZE, SIZE), 3.0), opacity), (1.0, 1.0, 1.0)
    )
    torch.testing.assert_close(found.rgb[0, 0], torch.tensor([0.2, 0.4, 0.6]))
    assert found.solid.all() and (found.surface_depth == 3.0).all()
