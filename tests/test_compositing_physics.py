"""Compositing against fog whose colour is known in closed form: how near it comes, and how fast."""

from __future__ import annotations

import math

import pytest
import torch
from agreement import DEVICES, ENGINES
from media import BLUE, LENGTH, MEDIA, RED, RULES, errors, order, value_and_derivative

from lumigraph import kernels
from lumigraph.camera.rays import Samples
from lumigraph.volume import composite

# Numbers of samples that differ by fours, so that an edge keeps its place within a sample; for float32 so few that
# what rounding does is far below what sampling does.
COUNTS = {"reference": (16, 64, 256), "cpu": (8, 32, 128), "gpu": (8, 32, 128)}
ORDERS = {
    "exponential ramp": {"midpoint": 2, "left end": 1},
    "two slabs, edge within a sample": dict.fromkeys(RULES, 1),
}
named = pytest.mark.parametrize("medium", MEDIA, ids=lambda medium: medium.name)
every_engine = pytest.mark.parametrize("engine", ["reference", *ENGINES])


def measured(medium, engine, rule):
    """Steps, and the errors of colour and derivative at each."""
    dtype = torch.float64 if engine == "reference" else torch.float32
    with kernels.using(engine):
        found = [errors(medium, n, rule, dtype, DEVICES[engine]) for n in COUNTS[engine]]
    return [LENGTH / n for n in COUNTS[engine]], *zip(*found, strict=True)


@every_engine
@named
@pytest.mark.parametrize("rule", RULES)
def test_colours_and_gradients_converge_as_they_should(medium, engine, rule):
    steps, colours, slopes = measured(medium, engine, rule)
    if medium.name not in ORDERS:  # constant over each sample, which is all that compositing assumes
        assert max(*colours, *slopes) < (1e-14 if engine == "reference" else 3e-6)
        return
    expected = ORDERS[medium.name][rule]
    assert order(steps, colours) == pytest.approx(expected, abs=0.1)
    assert order(steps, slopes) == pytest.approx(expected, abs=0.1)
    # And the straight line is where it should be: colours are of size 1, and so is the fog's change along the ray.
    assert all(error < 0.5 * step**expected for error, step in zip(colours + slopes, steps + steps, strict=True))


def test_weights_to_first_order_are_noticed(monkeypatch):
    """The measurement itself: with T_i sigma_i delta_i for a weight, not even a homogeneous slab comes out right."""

    def first_order(tau, values, ray_starts, stop):
        weights = tau * torch.exp(tau - tau.cumsum(0))
        return (weights[:, None] * values).sum(0, keepdim=True), weights.sum(0, keepdim=True), weights

    monkeypatch.setattr(kernels, "composite", first_order)
    homogeneous, *_, ramp = MEDIA
    steps, colours, _ = measured(homogeneous, "reference", "midpoint")
    assert colours[0] > 1e-2 and order(steps, colours) == pytest.approx(1, abs=0.1)
    steps, colours, _ = measured(ramp, "reference", "midpoint")
    assert order(steps, colours) == pytest.approx(1, abs=0.15)


@named
def test_closed_forms_are_the_integrals(medium):
    """The truth itself: sums over a hundred thousand pieces, by no code of the house."""
    edges = torch.linspace(0, LENGTH, 3 * 2**15 + 1, dtype=torch.float64)
    t, step = (edges[1:] + edges[:-1]) / 2, edges.diff()

    def summed(scale):
        tau = scale * medium.density(t) * step
        before = tau.cumsum(0) - 0.5 * tau
        return ((torch.exp(-before) * tau)[:, None] * medium.rgb(t)).sum(0)

    for found, exact in zip(value_and_derivative(summed), value_and_derivative(medium.seen), strict=True):
        assert torch.allclose(found, exact, rtol=0, atol=1e-8)


@every_engine
def test_depth_and_background_of_a_slab(engine):
    """Seen through a slab, a background keeps exp(-sigma L); the expected distance is that of an exponential law."""
    sigma, n = 1.5, 128
    edges = torch.linspace(0, LENGTH, n + 1, device=DEVICES[engine])
    samples = Samples(edges[:-1], edges[1:], torch.tensor([0, n], device=edges.device))
    density, rgb = torch.full_like(edges[1:], sigma), RED.to(edges).expand(n, 3)
    with kernels.using(engine):
        seen = composite(samples, density, rgb, BLUE.to(edges)[None])
    light = math.exp(-sigma * LENGTH)
    assert torch.allclose(seen.rgb[0].cpu().double(), RED + light * (BLUE - RED), atol=1e-5)
    assert float(seen.opacity) == pytest.approx(1 - light, abs=1e-5)
    assert float(seen.depth) == pytest.approx(1 / sigma - LENGTH * light / (1 - light), abs=LENGTH / n / 10)
