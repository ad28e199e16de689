"""Fog that scatters light once: the tracer against quadrature, and what a field of emission and absorption keeps."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from budgets import budget

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.geometry import look_at
from lumigraph.lab.explain import scattering
from lumigraph.lab.explain.scattering import henyey_greenstein, truncation
from lumigraph.synthetic import Fog, Lamp, Material, Object, Pose, Sky, World, scattered
from lumigraph.synthetic.shapes import Ball, Cuboid
from lumigraph.synthetic.textures import Plain

pytestmark = budget("methods", 4)

LAMP, POWER = (0.3, 0.2, 0.4), 0.5
CHALK = Material(Plain((1.0, 1.0, 1.0)))


def one_pixel(position, target) -> Camera:
    """A camera of one narrow pixel, which looks at a point."""
    eye, way = torch.tensor([position]), torch.tensor([target]) - torch.tensor([position])
    lens = Pinhole(torch.full((1, 2), 1e4), torch.full((1, 2), 0.5))
    return Camera(look_at(eye, way, torch.tensor([0.0, 0.0, 1.0])), lens, torch.ones(1, 2, dtype=torch.int64))


def world(g: float, *objects: Object) -> World:
    far = Object(Ball(0.01), CHALK, Pose.at(0, 0, -50), "far")
    lights = (Lamp(LAMP, 0.001, POWER),)
    return World((far, *objects), lights, Sky(visible=True), fog=Fog(0.5, 0.2, g, reach=1.0))


@pytest.mark.parametrize("g", [0.0, 0.3, 0.8])
def test_the_phase_function(g):
    """It integrates to 1, and its mean cosine is g; harmonics up to degree n leave the share that `truncation` says."""
    x, weight = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(400))
    p = henyey_greenstein(x, g)
    assert abs(2 * math.pi * float((weight * p).sum()) - 1) < 1e-6
    assert abs(2 * math.pi * float((weight * x * p).sum()) - g) < 1e-6
    left = p.clone()
    for band in range(3):
        legendre = torch.from_numpy(np.polynomial.legendre.Legendre.basis(band)(x.numpy()))
        left -= (2 * band + 1) / 2 * (weight * legendre * p).sum() * legendre
    assert abs(float((weight * left**2).sum() / (weight * p**2).sum()) - truncation(g, 2)) < 1e-5


@pytest.mark.parametrize("g", [0.0, 0.7])
def test_the_tracer_is_the_integral(g):
    """Single scattering along a ray through a ball of fog, against a fine sum."""
    eye, target = (-3.0, 0.1, 0.2), (0.0, 0.0, 0.1)
    found = float(scattered(world(g), one_pixel(eye, target), samples=16, along=256)[0, 0, 0])
    o, d = np.array(eye), np.array(target) - np.array(eye)
    d = d / np.linalg.norm(d)
    half = math.sqrt((o @ d) ** 2 - o @ o + 1)
    enter, leave = -(o @ d) - half, -(o @ d) + half
    s = enter + (leave - enter) * (np.arange(20_000) + 0.5) / 20_000
    to_lamp = np.array(LAMP) - (o + s[:, None] * d)
    r = np.linalg.norm(to_lamp, axis=-1)
    phase = henyey_greenstein(torch.from_numpy(to_lamp @ d / r), g).numpy()
    light = 0.5 * phase * math.pi * POWER / r**2 * np.exp(-0.7 * (s - enter + r))
    assert abs(found / (light.sum() * (leave - enter) / 20_000) - 1) < 0.01


def test_a_surface_in_fog_and_a_shadow():
    """Chalk that faces the lamp dims on both ways; a shield before the lamp leaves black."""
    floor = Object(Cuboid((0.5, 0.5, 0.01)), CHALK, Pose.at(0.3, 0.2, -0.01), "floor")
    clear = World((floor,), (Lamp(LAMP, 0.001, POWER),), Sky(visible=True), fog=Fog(0.0, 0.7, 0.0, reach=1.0))
    eye = (0.3, -0.1, 0.3)
    away = math.dist(eye, (0.3, 0.2, 0.0))
    expected = POWER / 0.4**2 * math.exp(-0.7 * (0.4 + away))
    assert abs(float(scattered(clear, one_pixel(eye, (0.3, 0.2, 0.0)))[0, 0, 0]) / expected - 1) < 0.01
    shield = Object(Cuboid((0.1, 0.1, 0.01)), CHALK, Pose.at(0.3, 0.2, 0.35), "shield")
    dark = World((floor, shield), clear.lights, clear.sky, fog=clear.fog)
    assert float(scattered(dark, one_pixel(eye, (0.3, 0.2, 0.0)))[0, 0, 0]) == 0


def test_a_field_keeps_the_lamp_that_it_was_taken_under(tmp_path, monkeypatch):
    """The fit is best under its own lamp, and harmonics give colour a direction."""
    for name, value in {"CELLS": 16, "VIEWS": 10, "TEST_VIEWS": 2, "LAMPS": (0, 45, 180), "DEGREES": (0, 1)}.items():
        monkeypatch.setattr(scattering, name, value)
    found, pictures = scattering.measure(0.6, steps=60, size=20)
    scattering.draw(tmp_path, found, pictures)
    flat, directed = found.fits
    for fit in found.fits:
        assert fit.moved[0] > fit.moved[1] > fit.moved[2]
        assert fit.moved[0] > fit.moved[2] + 3
    assert np.ptp(flat.phase) < 1e-3 < np.ptp(directed.phase)
    assert found.phase[0] > 5 > 1 > found.phase[-1]
    said = json.loads((tmp_path / "scattering.json").read_text())
    assert said["beyond_degree"]["0"] > said["beyond_degree"]["1"]
    assert all((tmp_path / name).stat().st_size for name in ("scattering.png", "lamps.svg", "phase.svg"))
