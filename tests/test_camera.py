"""Cameras: rays and projection invert one another in the world, and follow the scene wherever it is moved."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from test_lens import CAMERAS, KINDS, SPHERES, random_lens, random_pixels, uniform
from torch import Tensor

from lumigraph.camera import PIXEL_RADIUS, Camera
from lumigraph.camera.lens import Equirectangular, Lens, Mixed, Pinhole


def random_rotations(generator, count):
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    return (q * torch.linalg.det(q)[:, None, None]).float()


def random_camera(kind, generator, **more) -> Camera:
    lens, size = random_lens(kind, generator)
    position = torch.randn(CAMERAS, 3, 1, generator=generator)
    return Camera(torch.cat([random_rotations(generator, CAMERAS), position], -1), lens, size.long(), **more)


def doubled(camera: Camera) -> Camera:
    pose = camera.pose.double()
    u, _, vt = torch.linalg.svd(pose[:, :, :3])  # as good a rotation as float64 can be
    return Camera(torch.cat([u @ vt, pose[:, :, 3:]], -1), camera.lens._map(torch.Tensor.double), camera.size)


def pixel_error(camera, found, pixels, directions, index):
    """Pixels between two places. On an equirectangular picture, counted where columns are widest: at the equator."""
    off = (found - pixels).abs()
    if isinstance(camera.lens, Equirectangular):
        inward = torch.einsum("rji,rj->ri", camera.pose[index, :, :3], directions)
        off[:, 0] *= inward[:, [0, 2]].norm(dim=-1)
    return off.max()


@pytest.mark.parametrize("kind", KINDS)
def test_project_inverts_rays(kind, generator):
    camera = random_camera(kind, generator)
    pixels, index = random_pixels(camera.size, generator)
    rays = camera.rays(pixels, index)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(len(rays)), rtol=0, atol=2e-6)
    found, valid = camera.project(rays.at(uniform(generator, 1, 20, len(rays))), index)
    assert valid.all()
    assert pixel_error(camera, found, pixels, rays.directions, index) < 1e-3

    exact = doubled(camera)
    rays = exact.rays(pixels.double(), index)
    found, valid = exact.project(rays.at(uniform(generator, 0.1, 20, len(rays)).double()), index)
    assert valid.all()
    assert pixel_error(exact, found, pixels, rays.directions, index) < 1e-5


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_behind_is_not_seen(kind, generator):
    camera = random_camera(kind, generator)
    index = torch.arange(CAMERAS)
    behind, valid = camera.project(camera.position - 2 * camera.forward, index)
    if "fisheye" not in kind and "thin prism" not in kind:  # some of them see behind themselves
        assert valid.tolist() == [kind in SPHERES] * CAMERAS
    assert behind.isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_moved_scene_gives_the_moved_rays(kind, generator):
    camera = random_camera(kind, generator)
    rotation, scale, shift = random_rotations(generator, 1)[0], 2.5, torch.tensor([1.0, -2.0, 3.0])
    similarity = torch.eye(4)
    similarity[:3, :3], similarity[:3, 3] = scale * rotation, shift
    pixels, index = random_pixels(camera.size, generator)
    before, after = camera.rays(pixels, index), camera.transformed(similarity).rays(pixels, index)
    torch.testing.assert_close(after.directions, before.directions @ rotation.T, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.origins, scale * before.origins @ rotation.T + shift, atol=1e-4, rtol=0)
    torch.testing.assert_close(after.radius, before.radius)  # an angle, whatever the units


@pytest.mark.parametrize("factor", [0.5, 0.37, 2.0])
@pytest.mark.parametrize("kind", KINDS)
def test_a_resized_camera_sees_the_same_directions(kind, factor, generator):
    camera = random_camera(kind, generator)
    small = camera.resized(factor)
    assert torch.equal(small.size, (camera.size * factor).round().long())
    pixels, index = random_pixels(camera.size, generator)
    scale = (small.size / camera.size)[index]  # of the rounded sizes, so that edges stay edges
    before, after = camera.rays(pixels, index), small.rays(pixels * scale, index)
    torch.testing.assert_close(after.directions, before.directions, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.radius * scale.prod(-1).sqrt(), before.radius, rtol=1e-3, atol=0)


def test_a_picture_is_never_smaller_than_a_pixel(generator):
    assert random_camera("pinhole", generator).resized(1e-6).size.tolist() == [[1, 1]] * CAMERAS


def test_pixels_row_by_row():
    camera = Camera(torch.eye(3, 4)[None], Pinhole(torch.ones(1, 2), torch.ones(1, 2)), torch.tensor([[3, 2]]))
    assert camera.pixels().tolist() == [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [0.5, 1.5], [1.5, 1.5], [2.5, 1.5]]


@pytest.mark.parametrize("kind", KINDS)
def test_cosines_are_those_of_the_rays(kind, generator):
    camera = replace(random_camera(kind, generator)[0], size=torch.tensor([[13, 7]]))
    along = camera.rays(camera.pixels()).directions @ camera.forward[0]
    assert torch.allclose(camera.cosines(), along.view(7, 13), atol=1e-6)


def test_pixels_of_several_cameras_at_once_are_refused(generator):
    with pytest.raises(ValueError, match="one camera at a time"):
        random_camera("pinhole", generator).pixels()


@pytest.mark.parametrize("index", [2, np.int64(2), torch.tensor(2), slice(2, 3), torch.tensor([2]), -2])
def test_one_camera_by_any_integer(index):
    cameras = Camera(torch.eye(3, 4).repeat(4, 1, 1), Pinhole(torch.rand(4, 2) + 9, torch.rand(4, 2)),
                     torch.tensor([[8, 6]] * 4), torch.arange(4.0), torch.arange(4))  # fmt: skip
    one = cameras[index]
    assert len(one) == 1 and one.image_index.tolist() == [2] and torch.equal(one.lens.focal, cameras.lens.focal[2:3])


@pytest.mark.parametrize("kind", KINDS)
def test_one_camera_needs_no_index(kind, generator):
    cameras = random_camera(kind, generator, time=torch.rand(CAMERAS), image_index=torch.arange(CAMERAS) + 100)
    pixels, _ = random_pixels(cameras.size[5:6], generator)
    index = torch.full((len(pixels),), 5)
    alone, among = cameras[5].rays(pixels), cameras.rays(pixels, index)
    for one, other in zip(
        (alone.origins, alone.directions, alone.radius, alone.time, alone.image_index),
        (among.origins, among.directions, among.radius, among.time, among.image_index),
        strict=True,
    ):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)
    points = among.at(torch.ones(len(pixels)))
    # Beside the poles of panoramas the last bit of a direction is thousandths of a pixel.
    atol = 5e-3 if kind in ("equirectangular", "stereo") else 2e-3
    torch.testing.assert_close(cameras[5].project(points), cameras.project(points, index), atol=atol, rtol=0)


def test_each_ray_knows_its_photograph_and_moment(generator):
    cameras = random_camera("pinhole", generator, time=torch.rand(CAMERAS), image_index=torch.arange(CAMERAS) + 100)
    pixels, index = random_pixels(cameras.size, generator)
    rays = cameras.rays(pixels, index)
    assert torch.equal(rays.image_index, index + 100)
    assert torch.equal(rays.time, cameras.time[index])
    bare = random_camera("pinhole", generator).rays(pixels, index)
    assert bare.time is None and bare.image_index is None


@pytest.mark.parametrize("kind", KINDS)
def test_radius_is_the_footprint_at_distance_one(kind, generator):
    """A cone whose cross-section has the variance of one pixel's square (mip-NeRF)."""
    camera = doubled(random_camera(kind, generator))
    pixels, index = random_pixels(camera.size, generator)
    pixels = pixels.double()
    rays = camera.rays(pixels, index)
    right, below = (camera.rays(pixels + torch.tensor(step), index).directions for step in ([0.01, 0.0], [0.0, 0.01]))
    area = torch.linalg.cross(right - rays.directions, below - rays.directions).norm(dim=-1) * 1e4
    clear = area > 0.05 * area.max()  # of the poles, where the pixels shrink faster than the step
    torch.testing.assert_close(rays.radius[clear], PIXEL_RADIUS * area[clear].sqrt(), rtol=5e-3, atol=0)


def test_radius_of_a_central_pinhole_pixel_by_hand():
    camera = Camera(
        torch.eye(3, 4)[None], Pinhole(torch.tensor([[200.0, 200.0]]), torch.zeros(1, 2)), torch.ones(1, 2).int()
    )
    assert camera.rays(torch.zeros(1, 2)).radius.item() == pytest.approx(2 / math.sqrt(12) / 200)


@pytest.mark.parametrize("kind", KINDS)
def test_rays_are_differentiable_in_the_poses(kind, generator):
    camera = doubled(random_camera(kind, generator)[:3])
    pixels, index = random_pixels(camera.size, generator)
    pixels, index = pixels[:6].double(), index[:6]

    def rays_of(pose):
        rays = Camera(pose, camera.lens, camera.size).rays(pixels, index)
        return rays.origins, rays.directions

    assert torch.autograd.gradcheck(rays_of, camera.pose.requires_grad_())


def test_some_of_the_cameras(generator):
    cameras = random_camera("fisheye", generator, time=torch.rand(CAMERAS), image_index=torch.arange(CAMERAS))
    for index, expected in [(3, [3]), (-1, [CAMERAS - 1]), (slice(4, 8, 2), [4, 6]), (torch.tensor([9, 1]), [9, 1])]:
        some = cameras[index]
        assert len(some) == len(some.lens) == len(expected)
        assert some.image_index.tolist() == expected
        assert torch.equal(some.pose, cameras.pose[expected]) and torch.equal(some.size, cameras.size[expected])
        assert torch.equal(some.lens.focal, cameras.lens.focal[expected])


def test_cameras_of_several_kinds_join_into_one_batch(generator):
    parts = [random_camera(kind, generator)[:4] for kind in ("fisheye", "pinhole", "fisheye")]
    joined = Camera.cat(parts)
    assert len(joined) == 12 and isinstance(joined.lens, Mixed)
    pixels, index = random_pixels(joined.size, generator)
    rays = joined.rays(pixels, index)
    assert pixel_error(joined, joined.project(rays.at(torch.ones(len(rays)) * 3), index)[0], pixels, rays, index) < 2e-3
    middle = parts[1].rays(pixels[index == 5], torch.ones(int((index == 5).sum()), dtype=torch.int64))
    torch.testing.assert_close(rays[index == 5].directions, middle.directions)
    assert joined.time is None


@dataclass(frozen=True)
class Stereo(Lens):
    """A lens nobody knew of: a panorama for one eye, whose rays leave from a circle (Ishiguro 1992)."""

    size: Float[Tensor, "camera 2"]
    offset: Float[Tensor, " camera"]

    def unproject(self, pixels, index=None):
        return Equirectangular(self.size).unproject(pixels, index)

    def project(self, points, index=None):
        return Equirectangular(self.size).project(points, index)

    def origins(self, pixels, index=None):
        x, _, z = self.unproject(pixels, index).unbind(-1)
        return self.offset[0] * torch.stack([z, torch.zeros_like(z), -x], -1) / torch.hypot(x, z)[:, None]


def test_a_new_lens_touches_nothing_else(generator):
    rotation = random_rotations(generator, 1)
    pose = torch.cat([rotation, torch.tensor([[[1.0], [2.0], [3.0]]])], -1)
    camera = Camera(pose, Stereo(torch.tensor([[64.0, 32.0]]), torch.tensor([0.25])), torch.tensor([[64, 32]]))
    rays = camera.rays(camera.pixels())
    away = rays.origins - camera.position
    torch.testing.assert_close(away.norm(dim=-1), torch.full((64 * 32,), 0.25))
    assert (away * rays.directions).sum(-1).abs().max() < 1e-6  # on the circle's tangents
    assert (away @ rotation[0, :, 1]).abs().max() < 1e-6  # in the level plane
    assert isinstance(Lens.from_json(camera.lens.to_json()), Stereo)


def test_shapes_at_the_door_are_executed(generator):
    camera = random_camera("pinhole", generator)
    with pytest.raises(Exception, match="pixels"):
        camera.rays(torch.zeros(5, 3))
    with pytest.raises(Exception, match="index"):
        camera.rays(torch.zeros(5, 2), torch.zeros(4, dtype=torch.int64))
    with pytest.raises(Exception, match="index"):
        camera.rays(torch.zeros(5, 2), torch.zeros(5))  # not whole numbers
