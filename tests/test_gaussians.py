"""Clouds of Gaussians and pictures of them, asked for mathematics: other frames, exact footprints, lenses."""

from __future__ import annotations

import math

import pytest
import torch
from budgets import budget

from lumigraph import kernels
from lumigraph.camera import Camera
from lumigraph.camera.lens import Equirectangular, OpenCV, Pinhole
from lumigraph.errors import LumigraphError
from lumigraph.gaussians import Gaussians
from lumigraph.gaussians.splatting import render, splat, view_of
from lumigraph.geometry import multiply, to_matrix, to_quaternion
from lumigraph.kernels.spherical_harmonics import K00
from lumigraph.metrics import psnr

pytestmark = budget("methods")

WIDTH, HEIGHT = 64, 48


def camera(position=(0.0, 0.0, -3.0), turn=0.0, lens=None) -> Camera:
    """Looking along z from a position, turned around y."""
    c, s = math.cos(turn), math.sin(turn)
    rotation = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    pose = torch.cat([rotation, torch.tensor(position)[:, None]], 1)[None]
    lens = lens or Pinhole(torch.tensor([[60.0, 62.0]]), torch.tensor([[WIDTH / 2, HEIGHT / 2]]))
    return Camera(pose, lens, torch.tensor([[WIDTH, HEIGHT]]))


def cloud(count: int = 60, degree: int = 3, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        0.5 * torch.randn(count, 3, generator=g),
        torch.randn(count, 4, generator=g),
        0.5 * torch.randn(count, 3, generator=g) - 2.5,
        torch.randn(count, generator=g),
        0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=g),
    )


def similarity(seed: int = 1, scale: float = 1.7) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    matrix = torch.eye(4, dtype=torch.float64)
    q = torch.randn(4, generator=g, dtype=torch.float64)
    matrix[:3, :3] = scale * to_matrix(q[None])[0]
    matrix[:3, 3] = torch.randn(3, generator=g, dtype=torch.float64)
    return matrix


def test_a_cloud_in_another_frame_looks_the_same():
    """Seen by a camera that moved along: rotation, scale and view-dependent colours all follow."""
    before, matrix, eye = cloud(), similarity(), camera()
    here = render(before, eye, (0.2, 0.3, 0.4))
    there = render(before.transformed(matrix), eye.transformed(matrix), (0.2, 0.3, 0.4))
    assert psnr(here.rgb, there.rgb) > 75 and here.opacity.max() > 0.5
    solid = here.opacity > 0.5
    torch.testing.assert_close(there.depth[solid], 1.7 * here.depth[solid], rtol=1e-3, atol=0)


def test_there_and_back():
    before, matrix = cloud(), similarity()
    after = before.transformed(matrix).transformed(torch.linalg.inv(matrix))
    for name in ("means", "log_scales", "opacities", "harmonics"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(to_matrix(after.quaternions), to_matrix(before.quaternions), rtol=0, atol=1e-5)


def test_quaternions_multiply_as_rotations_do(generator):
    a, b = torch.randn(2, 5, 4, generator=generator)
    torch.testing.assert_close(to_matrix(multiply(a, b)), to_matrix(a) @ to_matrix(b), rtol=1e-4, atol=1e-5)
    for q in a:
        back = to_quaternion(to_matrix(q[None])[0]).float()
        unit = q / q.norm()
        assert min((back - unit).abs().max(), (back + unit).abs().max()) < 1e-5


def one(mean, scale, opacity=0.8, colour=(0.9, 0.5, 0.1)) -> Gaussians:
    harmonics = ((torch.tensor(colour) - 0.5) / K00)[None, None]
    return Gaussians(
        torch.tensor([mean]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([scale]).log(),
        torch.tensor([opacity]).logit(),
        harmonics,
    )


def test_one_ball_is_the_bell_curve_that_it_should_be():
    """On the optical axis the footprint is exact: deviation f s / z, widened by the blur."""
    seen = render(one((0.0, 0.0, 0.0), (0.2, 0.1, 0.3)), camera(), (0.0, 0.0, 0.0))
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    variance_x, variance_y = (60 * 0.2 / 3) ** 2 + 0.3, (62 * 0.1 / 3) ** 2 + 0.3
    bell = 0.8 * torch.exp(-0.5 * ((x - WIDTH / 2) ** 2 / variance_x + (y - HEIGHT / 2) ** 2 / variance_y))
    bell = torch.where(bell < 1 / 255, 0, bell)
    torch.testing.assert_close(seen.opacity, bell, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(seen.rgb, bell[..., None] * torch.tensor([0.9, 0.5, 0.1]), rtol=1e-4, atol=1e-5)


def test_depth_is_the_distance_along_the_ray():
    """A flat disc across the view: its depth along the axis is everywhere the same, distance grows to the sides."""
    seen = render(one((0.0, 0.0, 1.0), (2.0, 2.0, 1e-4), 0.9), camera(), (0.0, 0.0, 0.0))
    rays = camera().rays(camera().pixels())
    expected = (4 / rays.directions[:, 2]).view(HEIGHT, WIDTH)
    solid = seen.opacity > 0.1
    assert solid.sum() > 1000
    torch.testing.assert_close(seen.depth[solid], expected[solid], rtol=1e-4, atol=0)
    assert seen.depth[~solid & (seen.opacity == 0)].isinf().all()


def test_what_is_in_front_hides_what_is_behind():
    front, back = one((0.0, 0.0, -1.0), (0.3, 0.3, 0.3), 0.99), one((0.0, 0.0, 1.0), (0.3, 0.3, 0.3), 0.99, (0, 1, 0))
    for order in ((front, back), (back, front)):
        both = Gaussians(*(torch.cat([getattr(c, n) for c in order]) for n in NAMES))
        middle = render(both, camera(), (0.0, 0.0, 0.0)).rgb[HEIGHT // 2, WIDTH // 2]
        torch.testing.assert_close(middle, torch.tensor([0.9, 0.5, 0.1]), rtol=0, atol=0.03)


NAMES = ("means", "quaternions", "log_scales", "opacities", "harmonics")


def test_a_distorting_lens_puts_a_gaussian_where_it_puts_a_point():
    distortion = torch.tensor([[-0.25, 0.08, 0.01, -0.015, 0.0, 0.0, 0.0, 0.0]])
    lens = OpenCV(torch.tensor([[60.0, 62.0]]), torch.tensor([[WIDTH / 2, HEIGHT / 2]]), distortion)
    eye, mean = camera(lens=lens), torch.tensor([[1.0, -0.6, 0.0]])
    seen = splat(one(tuple(mean[0].tolist()), (0.02, 0.02, 0.02)), view_of(eye))
    pixel, valid = eye.project(mean)
    assert valid.all()
    torch.testing.assert_close(seen.centres, pixel, rtol=0, atol=1e-3)


def test_beyond_its_limits_a_lens_does_not_fold_back():
    """A point far outside the picture, which the bent polynomial alone would bring back into it."""
    distortion = torch.tensor([[-0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    lens = OpenCV(torch.tensor([[60.0, 62.0]]), torch.tensor([[WIDTH / 2, HEIGHT / 2]]), distortion)
    seen = splat(one((5.4, 0.0, 0.0), (0.05, 0.05, 0.05)), view_of(camera(lens=lens)))
    assert seen.opacity.max() == 0


def test_the_compensated_blur_adds_no_light():
    """A speck far smaller than a pixel: with the 2-D filter compensated, its light is that of its true size."""
    speck, eye = one((0.0, 0.0, 0.0), (0.005, 0.005, 0.005), 0.9), camera()
    light = {}
    for antialiased in (False, True):
        seen = render(Gaussians(*(getattr(speck, n) for n in NAMES), antialiased=antialiased), eye, (0.0, 0.0, 0.0))
        light[antialiased] = seen.opacity.sum().item()
    true = 0.9 * 2 * math.pi * (60 * 0.005 / 3) * (62 * 0.005 / 3)
    assert abs(light[True] / true - 1) < 0.2 and light[False] > 10 * true


def test_an_empty_cloud_shows_the_background():
    seen = render(cloud(0), camera(), (0.2, 0.3, 0.4))
    torch.testing.assert_close(seen.rgb, torch.tensor([0.2, 0.3, 0.4]).expand(HEIGHT, WIDTH, 3))
    assert seen.depth.isinf().all()


def test_a_lens_without_a_flat_picture_is_refused():
    with pytest.raises(LumigraphError, match="Equirectangular"):
        view_of(camera(lens=Equirectangular(torch.tensor([[64.0, 48.0]]))))


@pytest.mark.parametrize("engine", ["reference", "cpu", "gpu"])
def test_all_engines_show_one_picture(engine):
    some, view = cloud(40), view_of(camera())
    expected = splat(some, view).rgb
    with kernels.using(engine):
        found = splat(some, view).rgb
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-3)  # a pixel may hang on 1/255
    assert (found - expected).abs().mean() < 1e-5
