"""NeRFactor's equations: reflectance, visibility, surfaces, lights that are given."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera.rays import Samples
from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError
from lumigraph.geometry import unit
from lumigraph.light import EnvironmentLight, direction, directions, solid_angles
from lumigraph.methods.nerfactor import NeRFactor, facing, variation
from lumigraph.methods.nerfactor.shading import LearntReflectance, microfacet, rusinkiewicz, shaded
from lumigraph.methods.nerfactor.surface import SurfaceGrid, surface_distance
from lumigraph.run import build

pytestmark = budget("methods", 6)


def chance(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def ways(count: int, seed: int = 0) -> torch.Tensor:
    """Unit vectors above the plane z = 0."""
    found = unit(torch.randn(count, 3, generator=chance(seed), dtype=torch.float64))
    return torch.cat([found[:, :2], found[:, 2:].abs() + 0.05], -1) / 1.0


def test_reflectance_is_reciprocal_and_has_gradients():
    nl, nv = torch.rand(2, 20, generator=chance(), dtype=torch.float64) * 0.9 + 0.05
    vl = nl * nv
    roughness = torch.linspace(0.2, 1, 20, dtype=torch.float64, requires_grad=True)
    assert torch.allclose(microfacet(nl, nv, vl, roughness), microfacet(nv, nl, vl, roughness))
    assert torch.autograd.gradcheck(lambda r: microfacet(nl, nv, vl, r), roughness)


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
def test_white_furnace(roughness):
    """Light from everywhere is never amplified. Head-on a dielectric mirrors at most F0, and F0 (1 - ln 2) where alpha
    is 1 (the integral of Walter's terms); at grazing angles it mirrors more."""
    lights, angles = directions(128, 256).reshape(-1, 3), solid_angles(128, 256).reshape(-1, 1)
    normals = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    eyes = unit(torch.tensor([[0.0, 0.05, 1.0], [0.0, 1.0, 0.15]]))
    cosines = normals @ lights.T
    specular = microfacet(cosines, (normals * eyes).sum(-1, keepdim=True), eyes @ lights.T, torch.tensor(roughness))
    power = angles.expand(-1, 3)
    seen = shaded(torch.zeros(2, 3), specular, cosines.clamp_min(0), power)[:, 0]
    assert 0.04 * (1 - math.log(2)) < float(seen[0]) < 0.045 and float(seen[0]) < float(seen[1]) < 1
    matt = shaded(torch.full((2, 3), 0.5), 0 * specular, cosines.clamp_min(0), power)
    assert torch.allclose(matt, torch.full((2, 3), 0.5), atol=1e-3)


def ball_grid(resolution: int = 48) -> SurfaceGrid:
    grid = SurfaceGrid(Frame(), resolution)
    grid.fill(lambda x: 400.0 * (x.norm(dim=-1) < 0.5), chance())
    return grid


def test_normals_and_visibility_of_a_ball():
    grid, normals = ball_grid(), unit(torch.randn(40, 3, generator=chance(1)))
    points = 0.5 * normals
    found = grid.normals(points, normals)
    assert float((found * normals).sum(-1).min()) > 0.97
    lights = directions(8, 16).reshape(-1, 3)
    seen = grid.visibility(points, normals, lights)
    above = (normals @ lights.T) > 0.05
    assert float(seen[above].mean()) > 0.97 and float(seen[(normals @ lights.T) <= 0].max()) == 0
    # A floor point under the ball is in its shadow.
    floor = torch.tensor([[0.0, 0.0, -0.9], [0.8, 0.0, -0.9]])
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    assert torch.allclose(
        grid.visibility(floor, up, torch.tensor([[0.0, 0.0, 1.0]]))[:, 0], torch.tensor([0.0, 1.0]), atol=0.01
    )


def test_loop_is_its_definition():
    grid = SurfaceGrid(Frame(), 12)
    random = torch.rand(grid.extinction.shape, generator=chance())
    grid.extinction.copy_(torch.where(random > 0.9, 8 * random, 0))
    normals = unit(torch.randn(30, 3, generator=chance(1)))
    points = 0.6 * torch.randn(30, 3, generator=chance(2))
    lights = directions(6, 12).reshape(-1, 3)
    found = grid.visibility(points, normals, lights)
    assert torch.allclose(found, grid.marched(points + 2 * grid.cell * normals, normals, lights), atol=2e-3)
    assert 0.1 < float(found.mean()) < 0.9


def test_surface_of_fog():
    """A quarter of the opacity of fog of density s is reached at -log(1 - q / 4) / s."""
    t = torch.linspace(1, 5, 401)
    samples = Samples(torch.cat([t[:-1], t[:-1]]), torch.cat([t[1:], t[1:]]), torch.tensor([0, 400, 400, 800]))
    density = torch.cat([torch.full((400,), 2.0), torch.zeros(400)])
    distance, opacity = surface_distance(samples, density)
    q = 1 - math.exp(-8)
    assert float(opacity[0]) == pytest.approx(q, abs=1e-4)
    assert float(distance[0]) == pytest.approx(1 - math.log(1 - q / 4) / 2, abs=0.01)
    assert distance[1:].isinf().all()


def test_prior_learns_lobes():
    lobes = LearntReflectance(3, 2, 2, 32)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        first, last = lobes.learn(1, 5e-3, chance()), lobes.learn(150, 5e-3, chance(1))
    assert last < 0.3 * first
    assert not any(weight.requires_grad for weight in lobes.parameters())


def test_half_difference_angles():
    n, v = torch.tensor([[0.0, 0.0, 1.0]]), unit(torch.tensor([[0.5, 0.0, 1.0]]))
    mirrored = unit(torch.tensor([[-0.5, 0.0, 1.0]]))
    _, nh, vh = rusinkiewicz(n, v, mirrored)[0]
    assert float(nh) == pytest.approx(1, abs=1e-5) and float(vh) == pytest.approx(float(v[0, 2]), abs=1e-5)


def test_normals_face_the_eye():
    normals, eyes = unit(torch.randn(50, 3, generator=chance())), unit(torch.randn(50, 3, generator=chance(1)))
    found = facing(normals, eyes)
    assert float((found * eyes).sum(-1).min()) > 0.03
    front = (normals * eyes).sum(-1) > 0.05
    assert torch.allclose(found[front], normals[front], atol=1e-6)


def test_variation_of_the_light():
    light = torch.zeros(4, 8, 3)
    light[1, 2, 0] = 1.0
    assert float(variation(light)) == 4.0 and float(variation(torch.ones(4, 8, 3))) == 0.0


def relightable(**numbers) -> NeRFactor:
    """A method whose geometry is a ball and whose surface is as it begins."""
    config = replace(NeRFactor.smallest(), grid_resolution=32, **numbers)
    method = build(NeRFactor, tiny.scene().frame, config, torch.device("cpu"), 0)
    method.grid.fill(lambda x: 400.0 * (x.norm(dim=-1) < 0.6), chance())
    method.stage.fill_(1)
    return method.eval()


def test_lights_that_are_given(tmp_path):
    """A sun in the east lights the east of a ball, whether it is a control or a file."""
    method = relightable(light_rows=16)
    points = torch.tensor([[0.6, 0.0, 0.0], [-0.6, 0.0, 0.0]])
    east = method.given(sun_azimuth=90.0, sun_elevation=5.0, sky=0.0)
    marked = np.zeros((16, 32, 3), np.float32)
    marked[7:9, 23:25] = 20.0
    np.save(tmp_path / "east.npy", marked)
    for told in (
        east,
        method.given(light=str(tmp_path / "east.npy")),
        method.given(EnvironmentLight.open(tmp_path / "east.npy")),
    ):
        rgb = told.field(points, -unit(points))[1].detach()
        assert float(rgb[0].min()) > 3 * float(rgb[1].max()), told.settings
    turned = method.given(light=str(tmp_path / "east.npy"), light_turn=180.0)
    assert float(turned.field(points, -unit(points))[1][1].min()) > 0.1
    brighter = method.given(EnvironmentLight.uniform(), red=2.0).field(points, -unit(points))[1]
    plain = method.given(EnvironmentLight.uniform()).field(points, -unit(points))[1]
    assert (brighter[:, 0] > plain[:, 0]).all() and torch.equal(brighter[:, 1], plain[:, 1])


def test_lights_that_cannot_be(tmp_path):
    method = relightable()
    np.save(tmp_path / "three.npy", np.ones((1, 3, 3)))
    np.save(tmp_path / "dark.npy", -np.ones((8, 16, 3)))
    for value, sentence in [
        (str(tmp_path / "three.npy"), "3 x 1 pixels"),
        (str(tmp_path / "dark.npy"), "negative"),
        (str(tmp_path / "gone.hdr"), "does not exist"),
        ("moon", "no choice"),
    ]:
        with pytest.raises(LumigraphError, match=sentence):
            method.given(light=value)
    with pytest.raises(LumigraphError, match="no environment maps"):
        build(
            NeRFactor, tiny.scene().frame, replace(NeRFactor.smallest(), light="known"), torch.device("cpu"), 0
        ).begin(tiny.scene())


def test_networks_of_the_paper_learn(monkeypatch):
    """Every term of the paper's variant, and gradients of all that learns."""
    monkeypatch.setattr("lumigraph.methods.nerfactor.PRIOR_STEPS", 2)
    monkeypatch.setattr("lumigraph.methods.nerfactor.PROPERTY_WIDTH", 16)
    method = relightable(properties="network", visibility="network", reflectance="learnt")
    method._choose_learning()
    method.train().before_step(0, 1.0)
    method.began.fill_(0.0)
    batch = method.batch(tiny.scene(), chance())
    # The hash table is no ball: surfaces are where the grid's is.
    method.surface = lambda rays: (0.6 * unit(rays.at(torch.full((len(rays),), 2.4))), torch.ones(len(rays)))  # type: ignore[method-assign]
    terms = method.loss(batch, 0)
    assert set(terms) >= {"colour", "normals", "visibility", "albedo_smoothness", "code_smoothness", "light_variation"}
    method.config = replace(method.config, shape_share=0.5)  # until then, shape.ini of the release
    method.progress = 0.4
    alone = method.loss(batch, 0)
    assert "colour" not in alone and method.learning_rate(0, 0.4)["properties"] == 1e-2
    for name in ("normals", "visibility"):  # 1 and 0.1
        assert float(alone[name].detach()) == pytest.approx(10 * float(terms[name].detach()))
    sum(terms.values()).backward()
    learns = {name: p for name, p in method.named_parameters() if p.requires_grad}
    assert {name.split(".")[0] for name in learns} == {"properties", "lights_seen", "log_light"}
    assert all(p.grad is not None and p.grad.isfinite().all() for p in learns.values())


def test_sun_has_seven_places():
    light = EnvironmentLight.outdoors(30, 40, 1.0, 0.2, 2.0)
    assert len(light.toward) == 7
    angle = torch.rad2deg((light.toward @ direction(30, 40)).clamp(-1, 1).acos())
    assert float(angle.max()) == pytest.approx(2 * 2 / 3, abs=0.02)
