"""Reprojection: a moving picture with the detail of a sharp one, against a scene known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from budgets import budget
from torch.nn.functional import interpolate

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.geometry import look_at
from lumigraph.viewer.cameras import ViewRequest
from lumigraph.viewer.reprojection import SharpPicture, sharpened
from lumigraph.viewer.visitor import Visitor

pytestmark = budget("exports", 5)
WIDTH, HEIGHT, DIVISOR = 96, 72, 6


def seen(position, size=(WIDTH, HEIGHT), depth_factor=1.0):
    """A camera that looks at a wavy pattern on the plane z = 0, its picture, and distances along rays."""
    eye = torch.tensor([position])
    pose = look_at(eye, -eye + torch.tensor([[0.1, 0.0, 0.0]]), torch.tensor([0.0, 1.0, 0.0]))
    width, height = size
    lens = Pinhole(torch.tensor([[1.2 * width, 1.2 * width]]), torch.tensor([[width / 2, height / 2]]))
    camera = Camera(pose, lens, torch.tensor([[width, height]]))
    rays = camera.rays(camera.pixels())
    distance = -rays.origins[:, 2] / rays.directions[:, 2]
    x, y, _ = rays.at(distance).unbind(-1)
    waves = torch.stack([(25 * x).sin(), (25 * y).sin(), (18 * (x + y)).sin()], -1)
    return camera, (0.5 + 0.4 * waves).view(height, width, 3), depth_factor * distance.view(height, width)


def enlarged(small):
    return interpolate(small.permute(2, 0, 1)[None], (HEIGHT, WIDTH), mode="bilinear", align_corners=False)[0].permute(
        1, 2, 0
    )


def small_of(position):
    return seen(position, (WIDTH // DIVISOR, HEIGHT // DIVISOR))[1:]


def error(found, expected):
    """Away from the edges, which the sharp picture need not show."""
    return float((found - expected)[12:-12, 12:-12].abs().mean())


def test_the_same_view_is_the_sharp_picture():
    camera, picture, depth = seen((0.3, 0.2, 2.0))
    found = sharpened(*small_of((0.3, 0.2, 2.0)), camera, SharpPicture(picture, depth, camera, None))
    torch.testing.assert_close(found, picture, rtol=0, atol=2e-3)


def test_another_view_has_the_detail_of_the_plane():
    """Detail lost in a picture of a sixth of the size comes from the other view, to a fraction of a pixel."""
    source, picture, depth = seen((0.3, 0.2, 2.0))
    camera, expected, _ = seen((0.16, 0.25, 1.9))
    small = small_of((0.16, 0.25, 1.9))
    found = sharpened(*small, camera, SharpPicture(picture, depth, source, None))
    assert error(found, expected) < 0.15 * error(enlarged(small[0]), expected)


@pytest.mark.parametrize("factor", [0.8, 1.3, math.inf])
def test_another_surface_is_not_mistaken_for_it(factor):
    source, picture, depth = seen((0.3, 0.2, 2.0), depth_factor=factor)
    camera, _, _ = seen((0.16, 0.25, 1.9))
    small = small_of((0.16, 0.25, 1.9))
    found = sharpened(*small, camera, SharpPicture(torch.zeros_like(picture), depth, source, None))
    torch.testing.assert_close(found, enlarged(small[0]), rtol=0, atol=1e-5)


def test_where_nothing_is_the_sharp_background_remains():
    source, picture, depth = seen((0.3, 0.2, 2.0), depth_factor=math.inf)
    small = small_of((0.3, 0.2, 2.0))[0]
    empty = torch.full(small.shape[:2], torch.inf)
    found = sharpened(small, empty, source, SharpPicture(picture, depth, source, None))
    torch.testing.assert_close(found, picture, rtol=0, atol=2e-3)


def test_detail_is_that_of_the_same_settings():
    camera, picture, depth = seen((0.3, 0.2, 2.0))
    pose = tuple(tuple(row) for row in camera.pose[0].tolist())
    request = ViewRequest(pose, 2 * math.atan(HEIGHT / (2.4 * WIDTH)), (WIDTH, HEIGHT), 1024, "colour", (0.0, 0.0, 0.0))
    small = small_of((0.3, 0.2, 2.0))
    visitor = SimpleNamespace(_sharp=None, _shared=SimpleNamespace(step=3))

    def shown(request, moving, picture, depth):
        return Visitor._with_detail(visitor, picture, depth, camera, request, moving)

    assert shown(request, True, *small) is small[0]  # no picture at rest yet
    assert shown(request, False, picture, depth) is picture
    torch.testing.assert_close(shown(request, True, *small), picture, rtol=0, atol=2e-3)
    assert shown(replace(request, settings=(("time", 0.5),)), True, *small) is small[0]
    visitor._shared.step = 4
    assert shown(request, True, *small) is small[0]  # it has learnt since
    half = picture[::2, ::2], depth[::2, ::2]
    visitor._shared.step = 3
    assert shown(request, True, *half) is half[0]
