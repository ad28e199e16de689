"""The network of NeRF and its wide layers: the paper's shapes, bfloat16 and float32, in chunks and whole."""

from __future__ import annotations

import pytest
import torch
from budgets import budget
from torch.nn import functional as F

from lumigraph.components.fields import layers
from lumigraph.components.fields.coordinate_network import CoordinateNetwork
from lumigraph.components.fields.layers import Dense, in_chunks
from lumigraph.datasets.scene import Frame
from lumigraph.methods.mip_nerf import Config as MipConfig
from lumigraph.methods.mip_nerf import MipNeRF
from lumigraph.methods.nerf import Config, NeRF

pytestmark = budget("methods")

EXACT = {"exact": True}


def parameters(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_the_network_is_the_papers():
    """Mildenhall 2020, figure 7: 60 and 24 numbers in, eight layers, the input again after the fifth."""
    nerf = NeRF(Frame(), Config())
    assert parameters(nerf.network.network) == parameters(nerf.network.coarse.network) == 593_924
    shapes = [tuple(p.shape) for p in nerf.network.network.parameters() if p.ndim == 2]
    wide = [(256, 256)] * 4
    assert shapes == [(256, 60), *wide, (256, 316), *wide[:2], (1, 256), (256, 256), (128, 280), (3, 128)]


def test_mip_nerf_has_one_network_of_612_thousand():
    """Barron 2021, table 1: 612 K, about half of NeRF's."""
    assert parameters(MipNeRF(Frame(), MipConfig())) == 612_740


def test_it_computes_what_the_figure_draws(generator):
    network = CoordinateNetwork(60, 24, **EXACT).double()
    network.feature.type_of_products = lambda x: torch.float64  # type: ignore[method-assign]
    for layer in network.modules():
        if isinstance(layer, Dense):
            layer.type_of_products = lambda x: torch.float64  # type: ignore[method-assign]
            torch.nn.init.normal_(layer.bias)
    x, d = torch.randn(9, 60, generator=generator).double(), torch.randn(9, 24, generator=generator).double()
    weights = [p.detach() for p in network.parameters()]
    layers = list(zip(weights[::2], weights[1::2], strict=True))
    h = x
    for i, (w, b) in enumerate(layers[:8]):
        h = F.relu((torch.cat([x, h], 1) if i == 5 else h) @ w.t() + b)
    density = h @ layers[8][0].t() + layers[8][1]
    feature = h @ layers[9][0].t() + layers[9][1]
    hidden = F.relu(torch.cat([feature, d], 1) @ layers[10][0].t() + layers[10][1])
    rgb = hidden @ layers[11][0].t() + layers[11][1]
    seen = network(x, d)
    torch.testing.assert_close(seen[0], density[:, 0].float())
    torch.testing.assert_close(seen[1], rgb.float())
    torch.testing.assert_close(network.density(x), seen[0])


def test_direction_changes_colour_and_not_density(generator):
    network = CoordinateNetwork(6, 4, 3, 16, 2)
    x = torch.randn(5, 6, generator=generator)
    (a, red), (b, blue) = (network(x, torch.randn(5, 4, generator=generator)) for _ in range(2))
    assert torch.equal(a, b) and not torch.allclose(red, blue)


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize(("kind", "tolerance"), [(torch.float32, 1e-6), (torch.bfloat16, 1e-1)])
@pytest.mark.parametrize("samples", [0, 1, 33, 200])
def test_a_layer_and_its_gradients(samples, kind, tolerance, relu, generator, monkeypatch):
    monkeypatch.setattr(layers, "product_type", lambda device: kind)
    layer = Dense(20, 24, relu)
    torch.nn.init.kaiming_uniform_(layer.weight, 5**0.5, generator=generator)
    torch.nn.init.normal_(layer.bias, generator=generator)
    x, g = (torch.randn(samples, n, generator=generator) for n in (20, 24))
    x, g = (a.to(kind).float().requires_grad_(i == 0) for i, a in enumerate((x, g)))

    def answers(f):
        inputs = x, layer.weight, layer.bias
        y = f(*inputs)
        return [y, *torch.autograd.grad(y, inputs, g.to(y.dtype))]

    expected = answers(lambda x, w, b: F.linear(x, w, b).relu() if relu else F.linear(x, w, b))
    for actual, wanted in zip(answers(lambda x, w, b: layer(x)), expected, strict=True):
        assert actual.shape == wanted.shape
        assert float((actual.float() - wanted).norm()) <= tolerance * float(wanted.norm())


def test_gradients_of_weights_are_summed_in_float32(monkeypatch):
    """Very many equal chunks: in bfloat16 the sum would stop growing at 256 times one of them."""
    monkeypatch.setattr(layers, "product_type", lambda device: torch.bfloat16)
    monkeypatch.setattr(layers, "CHUNK_CPU", 1)
    layer = Dense(1, 1)
    (y,) = in_chunks(lambda x: (layer(x),), torch.ones(1000, 1))
    y.float().sum().backward()
    assert layer.weight.grad is not None and float(layer.weight.grad) == 1000


@pytest.mark.parametrize("samples", [0, 1, 7, 8, 30])
def test_chunks_change_nothing(samples, generator, monkeypatch):
    monkeypatch.setattr(layers, "CHUNK_CPU", 8)
    network = CoordinateNetwork(6, 4, 3, 16, 2, **EXACT)
    x, d = torch.randn(samples, 6, generator=generator), torch.randn(samples, 4, generator=generator)
    for a, b in zip(in_chunks(network, x, d), network(x, d), strict=True):
        torch.testing.assert_close(a, b)


def test_only_where_it_is_worth_asking(generator, monkeypatch):
    monkeypatch.setattr(layers, "ROUND", 4)
    network = CoordinateNetwork(6, 4, 3, 16, 2, **EXACT)
    x, d = torch.randn(30, 6, generator=generator), torch.randn(30, 4, generator=generator)
    where = torch.rand(30, generator=generator) < 0.3
    asked: list[int] = []
    density, rgb = in_chunks(lambda x, d: asked.append(len(x)) or network(x, d), x, d, where=where)
    whole = network(x, d)
    assert where.sum() <= sum(asked) < where.sum() + 4
    torch.testing.assert_close(density, whole[0] * where)
    torch.testing.assert_close(rgb, whole[1] * where[:, None])
    rgb.sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())
    nothing = in_chunks(network, x, d, where=torch.zeros(30, dtype=torch.bool))
    assert float(nothing[1].detach().abs().max()) == 0
