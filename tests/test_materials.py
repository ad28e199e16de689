"""Procedural materials under an environment map: furnaces, shadows, layers, and options."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from budgets import budget

from lumigraph.color.srgb import linear_from_srgb
from lumigraph.errors import LumigraphError
from lumigraph.light import EnvironmentLight, direction
from lumigraph.methods.nerfactor.shading import microfacet
from lumigraph.opening import open_scene
from lumigraph.synthetic import Material, Object, Pose, Sky, World, lit, scenes, trace, unoccluded
from lumigraph.synthetic.cameras import look_at, pinhole
from lumigraph.synthetic.shapes import Ball, Cuboid
from lumigraph.synthetic.textures import Plain

pytestmark = budget("capture", 8)
CAMERA = pinhole(look_at((0.0, -3.0, 1.0), (0.0, 0.0, 0.0))[None], 24, 30.0)


def ball_in(light: EnvironmentLight, material: Material) -> World:
    return World((Object(Ball(0.5), material),), sky=Sky(visible=False), environment=light)


def test_matt_ball_in_a_white_furnace_shows_its_albedo():
    albedo = linear_from_srgb((0.7, 0.5, 0.3))
    seen = lit(ball_in(EnvironmentLight.uniform(), Material(Plain((0.7, 0.5, 0.3)))), CAMERA, 4, 64)
    inside = seen[..., 3] == 1
    assert inside.sum() > 50
    error = seen[inside][:, :3].mean(0) / albedo - 1
    assert np.abs(error).max() < 0.01


@pytest.mark.parametrize(("roughness", "least"), [(0.3, 0.97), (1.0, 0.3)])
def test_microfacets_reflect_no_more_than_all(roughness, least):
    """Single scattering loses what is masked, and no light is made (Heitz 2014, section 5)."""
    white = Material(Plain((1.0, 1.0, 1.0)), roughness=roughness, metal=1.0)
    seen = lit(ball_in(EnvironmentLight.uniform(), white), CAMERA, 4, 128)
    mean = float(seen[seen[..., 3] == 1][:, :3].mean())
    assert least < mean < 1.005


def test_shading_of_the_method_is_that_of_the_tracer():
    """One sun on a satin ball, by two implementations of the equation."""
    sun = EnvironmentLight(torch.zeros(4, 8, 3), direction(200, 50)[None], torch.full((1, 3), 2.0))
    grey = Material(Plain((0.6, 0.6, 0.6)), gloss=1.0, roughness=0.5)
    seen = lit(ball_in(sun, grey), CAMERA, 1, 1).reshape(-1, 4)
    offsets = CAMERA.pixels()
    rays = CAMERA.rays(offsets)
    hits = trace(ball_in(sun, grey), rays, shaded=False)
    there = hits.identity >= 0
    normals = torch.from_numpy(hits.normal[there]).float()
    nl = normals @ sun.toward[0]
    eyes = -rays.directions[torch.from_numpy(there)]
    f = microfacet(nl, (normals * eyes).sum(-1), eyes @ sun.toward[0], torch.tensor(0.5))
    expected = 2.0 * nl.clamp_min(0) * (f + float(linear_from_srgb(0.6)) / math.pi)
    assert torch.allclose(expected, torch.from_numpy(seen[there, 0]), atol=2e-3)


def test_shadow_falls_away_from_the_sun():
    """A sun in the east (+x, azimuth 90) puts the shadow of a ball on a floor west of it."""
    floor = Object(Cuboid((2.0, 2.0, 0.05)), Material(Plain((0.8, 0.8, 0.8))), Pose.at(0, 0, -0.05))
    ball = Object(Ball(0.2), Material(Plain((0.8, 0.8, 0.8))), Pose.at(0, 0, 0.4))
    world = World((floor, ball), sky=Sky(visible=False))
    x = np.linspace(-1, 1, 41)
    points = np.stack([x, 0 * x, 0 * x], -1)
    up = np.tile([0.0, 0.0, 1.0], (41, 1))
    free = unoccluded(world, points, up, direction(90, 45)[None].double().numpy())[:, 0]
    assert np.allclose(x[~free].mean(), -0.4, atol=0.03)
    below = unoccluded(world, points, up, np.array([[0.0, 0.6, -0.8]]))
    assert not below.any()


def test_bounce_adds_light_where_surfaces_face_each_other():
    light, matt = EnvironmentLight.uniform(), Material(Plain((0.8, 0.8, 0.8)))
    floor = Object(Cuboid((1.0, 1.0, 0.05)), matt, Pose.at(0, 0, -0.05))
    wall = Object(Cuboid((1.0, 0.05, 1.0)), matt, Pose.at(0, 0.5, 0.9))
    world = World((floor, wall), sky=Sky(visible=False), environment=light)
    camera = pinhole(look_at((0.0, -2.0, 2.0), (0.0, 0.3, 0.2))[None], 12, 20.0)
    once, twice = (lit(replace(world, bounces=k), camera, 4, 64)[..., :3].mean() for k in (0, 1))
    albedo = float(linear_from_srgb(0.8))
    assert once < albedo and 1.05 * once < twice < albedo


def test_scene_has_exact_layers_and_its_light():
    scene = open_scene("procedural:materials,size=16,views=2,light=1")
    shot = scene.photograph(0, ("raw", "albedo", "roughness", "visibility", "normals"))
    covered = shot.extra["raw"][..., 3] > 0.99
    known = torch.tensor([0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.75, 0.8])
    assert torch.isin((100 * shot.extra["roughness"][covered]).round(), (100 * known).round()).all()
    visible = shot.extra["visibility"][covered]
    assert 0.5 < float(visible.nanmean()) <= 1 and float(visible.nan_to_num().max()) <= 1
    assert scene.about["environment"].shape == (3, 16, 32, 3)
    with pytest.raises(LumigraphError, match="light"):
        open_scene("procedural:materials,light=9")


def test_lights_differ_and_are_finite():
    means = [scenes.scene("materials").environment(k).radiance for k in range(5)]
    assert all(x.isfinite().all() and (x >= 0).all() for x in means)
    assert len({round(float(x.mean()), 4) for x in means}) == 5
