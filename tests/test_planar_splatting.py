"""Planar splatting: planes, unbiased depth, and what agrees within a view and between two; the word surface."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget
from test_gaussians import cloud

from lumigraph import methods
from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.commands.cli import parse
from lumigraph.datasets.scene import Photograph
from lumigraph.gaussians import Gaussians, joined
from lumigraph.gaussians.splatting import splat, view_of
from lumigraph.geometry import look_at, to_matrix, unit
from lumigraph.methods.planar_splatting import Pair
from lumigraph.methods.planar_splatting.consistency import (
    PlaneView,
    correlation,
    multi_view_errors,
    near_views,
    patch_centres,
    single_view_error,
)
from lumigraph.methods.planar_splatting.planes import PlaneMaps, discs, normals_of, plane_maps, planes

pytestmark = budget("methods", 8)
SIZE, FOCAL, SIDE = 48, 60.0, 7
NORMAL = unit(torch.tensor([0.3, -0.2, 1.0]))  # of the plane through the origin that cameras look at
UP = torch.tensor([0.0, 1.0, 0.0])


def camera(*eye: float) -> Camera:
    position = torch.tensor([eye])
    lens = Pinhole(torch.full((1, 2), FOCAL), torch.full((1, 2), SIZE / 2))
    return Camera(look_at(position, -position, UP), lens, torch.tensor([[SIZE, SIZE]]))


def painted(points: torch.Tensor) -> torch.Tensor:
    """Brightness of places: waves that no displacement of a few pixels repeats."""
    return 0.5 + 0.2 * torch.sin(9 * points[..., 0] + 4 * points[..., 1]) + 0.2 * torch.sin(7 * points[..., 1] ** 2)


def view(eye: Camera, offset: float | torch.Tensor = 0.0, normal: torch.Tensor = NORMAL) -> PlaneView:
    """A camera that sees the true plane's paint, and takes it for a plane that lies an offset in front of it."""
    rays = eye.rays(eye.pixels()).directions.view(SIZE, SIZE, 3)
    position = eye.position[0]
    true = -(position @ NORMAL) / (rays @ NORMAL)
    far = offset - position @ normal
    ones = torch.ones(SIZE, SIZE)
    maps = PlaneMaps(rays, normal.expand(SIZE, SIZE, 3), far * ones, (far / (rays @ normal)).detach(), ones)
    return PlaneView(eye, painted(position + true[..., None] * rays), maps)


def disc(normal: torch.Tensor, thickness: float = 1e-4) -> Gaussians:
    """One wide, opaque disc through the origin, of whose picture the whole is opaque."""
    x, y, z = unit(normal).tolist()
    turn = torch.tensor([[1 + z, -y, x, 0.0]])
    scales = torch.tensor([[2.0, 2.0, thickness]])
    return Gaussians(torch.zeros(1, 3), turn, scales.log(), torch.tensor([9.0]), torch.zeros(1, 1, 3))


def test_a_disc_has_the_depth_of_its_plane_at_every_pixel():
    """The centre's own depth is off by up to a tenth there."""
    eye = camera(0.4, 0.3, 2.0)
    some = disc(NORMAL)
    picture = splat(some, view_of(eye), 1)
    maps = plane_maps(some, picture, eye, 1e-4)
    rays = eye.rays(eye.pixels()).directions.view(SIZE, SIZE, 3)
    true = -(eye.position[0] @ NORMAL) / (rays @ NORMAL)
    assert maps.crossed.all()
    torch.testing.assert_close(maps.depth, true, atol=1e-4, rtol=0)
    torch.testing.assert_close(unit(maps.normals), NORMAL.expand(SIZE, SIZE, 3), atol=1e-5, rtol=0)
    assert float((maps.mean - true).abs().max()) > 0.1
    torch.testing.assert_close(normals_of(maps.depth, maps), NORMAL.expand(SIZE - 2, SIZE - 2, 3), atol=1e-3, rtol=0)


def test_median_depth_ignores_discs_behind_the_one_at_which_half_the_light_is_spent():
    """The front disc stops 0.6 of the light in the middle: mean depth lies behind it, median depth on it."""
    front = replace(disc(UP.roll(1)), opacities=torch.tensor([0.6]).logit())
    both = joined([front, replace(front, means=torch.tensor([[0.0, 0.0, -0.5]]))])
    eye = camera(0.0, 0.0, 2.0)
    picture = splat(both, view_of(eye), 1)
    mean, median = (float(plane_maps(both, picture, eye, stop).depth[SIZE // 2, SIZE // 2]) for stop in (1e-4, 0.5))
    assert median == pytest.approx(2.0, abs=2e-3) and mean == pytest.approx(2.0 + 0.5 * 0.24 / 0.84, abs=5e-3)


def test_planes_face_the_eye_along_the_shortest_axis():
    some, eye = cloud(), torch.tensor([0.0, 0.2, 3.0])
    normals, distance = planes(some, eye)
    torch.testing.assert_close(distance, (normals * (some.means - eye)).sum(-1))
    assert (distance <= 0).all()
    for normal, axes, scales in zip(normals, to_matrix(some.quaternions), some.log_scales, strict=True):
        assert abs(float(normal @ axes[:, scales.argmin()])) == pytest.approx(1, abs=1e-5)


def test_gradients_of_depth_reach_the_discs():
    some = disc(NORMAL, 0.05)
    some = replace(some, means=some.means.clone().requires_grad_(), quaternions=some.quaternions.requires_grad_())
    eye = camera(0.4, 0.3, 2.0)
    plane_maps(some, splat(some, view_of(eye), 1), eye, 1e-4).depth.mean().backward()
    along = some.means.grad[0] @ NORMAL
    assert float(along) < 0 < float(some.quaternions.grad.abs().max())  # nearer to the camera is less deep


def test_normals_that_leave_the_depth_cost_but_not_at_edges():
    seen = view(camera(0.4, 0.3, 2.0))
    assert float(single_view_error(seen)) < 2e-3
    tilted = replace(seen.maps, normals=unit(NORMAL + torch.tensor([0.2, 0.0, 0.0])).expand(SIZE, SIZE, 3))
    depth = seen.maps.depth
    tilted = replace(tilted, distance=depth * (tilted.normals * tilted.rays).sum(-1))  # of the same depth
    smooth = replace(seen, maps=tilted, grey=torch.full((SIZE, SIZE), 0.5))
    error = float(single_view_error(smooth))
    assert error == pytest.approx(float((tilted.normals[0, 0] - NORMAL).abs().sum()), rel=0.1)
    ramp = replace(smooth, grey=torch.cat([torch.zeros(SIZE, SIZE // 2), torch.ones(SIZE, SIZE // 2) / 2], 1))
    ramp.grey[:, -8:] += torch.arange(8) / 8  # an edge of 0.5 counts for all, the slope of 1/4 for a quarter
    halves = float(single_view_error(ramp)) / error, float(single_view_error(ramp, 5)) / error
    flat, slope = (SIZE - 2 - 2 - 7) / (SIZE - 2), 7 / (SIZE - 2)
    assert halves[0] == pytest.approx(flat + slope * 0.5**2, abs=0.03)
    assert halves[1] == pytest.approx(flat + slope * 0.5**5, abs=0.03)
    checked = replace(smooth, grey=torch.arange(SIZE).expand(SIZE, SIZE) % 4 / 4)  # edges everywhere
    assert float(single_view_error(checked)) < 0.4 * error


def test_two_views_agree_on_the_true_plane_and_pull_towards_it():
    """Slopes of both errors in the plane's displacement; at the true plane that of the photometric one vanishes."""
    one, other = camera(0.5, 0.3, 2.0), camera(-0.2, 0.1, 2.1)
    photograph = Photograph(one, torch.zeros(SIZE, SIZE, 3))
    place = patch_centres(photograph, view(one).maps, SIDE, 300, torch.Generator().manual_seed(0))
    slopes = {}
    for offset in (0.0, 0.02, -0.02):
        moved = torch.tensor(offset, requires_grad=True)
        errors = multi_view_errors(view(one, moved), view(other), *place, SIDE)
        slopes[offset] = [float(torch.autograd.grad(x, moved, retain_graph=True)[0]) for x in errors]
        if not offset:
            assert errors[0] < 0.02 and errors[1] < 2e-3
        else:
            assert errors[1] > 0.1 and all(slope * offset > 0 for slope in slopes[offset])
    assert abs(slopes[0.0][0]) < 0.1 * abs(slopes[0.02][0])


def test_pixels_that_the_other_view_does_not_see_are_left_out():
    one, other = camera(0.5, 0.3, 2.0), camera(-0.2, 0.1, 2.1)
    photograph = Photograph(one, torch.zeros(SIZE, SIZE, 3))
    place = patch_centres(photograph, view(one).maps, SIDE, 300, torch.Generator().manual_seed(0))
    hidden = view(other, 0.8)  # something else stands before the plane
    assert [float(x) for x in multi_view_errors(view(one), hidden, *place, SIDE)] == [0.0, 0.0]


def test_patches_lie_in_trusted_parts_of_a_photograph():
    eye = camera(0.5, 0.3, 2.0)
    alpha, mask = torch.ones(SIZE, SIZE), torch.ones(SIZE, SIZE, dtype=torch.bool)
    alpha[:, :20], mask[30] = 0.0, False
    photograph = Photograph(eye, torch.zeros(SIZE, SIZE, 3), alpha, mask)
    row, column = patch_centres(photograph, view(eye).maps, SIDE, 10_000, torch.Generator().manual_seed(0))
    assert column.min() == 23 and column.max() == SIZE - 4 and row.min() == 3
    assert len(row) == (SIZE - 20 - 6) * (SIZE - 6 - 7) and not ((row >= 27) & (row <= 33)).any()


def test_correlation_is_blind_to_brightness_and_contrast():
    patch = torch.rand(1, 49, generator=torch.Generator().manual_seed(0))
    assert float(correlation(patch, 0.3 + 0.5 * patch)) == pytest.approx(1, abs=0.02)
    assert float(correlation(patch, 1 - patch)) < -0.97
    assert float(correlation(patch, torch.full_like(patch, 0.4))) == pytest.approx(0, abs=1e-4)


def test_near_views_look_the_same_way():
    cameras = Camera.cat([camera(0.0, 0.0, 2.0), camera(0.6, 0.0, 2.0), camera(0.2, 0.0, 2.0), camera(0.0, 0.1, -2.0)])
    assert near_views(cameras, 0, 8, 30.0).tolist() == [2, 1]
    assert near_views(cameras, 0, 1, 30.0).tolist() == [2]
    assert near_views(cameras, 3, 8, 30.0).tolist() == []


def test_discs_lie_in_the_plane_of_their_neighbours():
    generator = torch.Generator().manual_seed(0)
    flat = torch.rand(300, 3, generator=generator) * 2 - 1
    means = flat - (flat @ NORMAL)[:, None] * NORMAL
    some = Gaussians(means, torch.tensor([[1.0, 0, 0, 0]]).repeat(300, 1), torch.full((300, 3), -3.0), *_rest(300))
    normals, _ = planes(discs(some), 3 * NORMAL)
    assert float((normals @ NORMAL).min()) > math.cos(0.02)


def _rest(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.zeros(count), torch.zeros(count, 1, 3)


def test_a_step_compares_a_photograph_with_one_beside_it():
    kind, scene = methods.find("surface"), tiny.scene()
    method = kind(scene.frame, kind.smallest())
    method.begin(scene)
    method.before_step(10, 0.5)
    seen = method.batch(scene, torch.Generator().manual_seed(0))
    assert isinstance(seen, Pair) and seen.other is not None
    assert int(seen.other.camera.image_index) != int(seen.camera.image_index)
    assert {"l1", "ssim", "flatness", "normals", "photometric", "geometric"} == set(method.loss(seen, 10))


def test_surface_is_a_word_for_the_default_method():
    assert methods.check("surface") == "planar-splatting" and "surface" not in methods.available()
    bounded = tiny.scene()
    in_the_open = replace(bounded, frame=replace(bounded.frame, reach=4.0))
    plain = parse(["train", "surface", "SCENE"])
    assert (plain.chosen(bounded), plain.chosen(in_the_open)) == ("neus", "planar-splatting")
    assert parse(["train", "surface", "SCENE", "--normal-weight", "3"]).chosen(bounded) == "planar-splatting"
    assert parse(["train", "planar-splatting", "SCENE"]).chosen(bounded) == "planar-splatting"
