"""Measured depth as a teacher: the loss, the layer that it reads, and the score beside PSNR."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.camera.rays import Rendering
from lumigraph.datasets.images import Layer, LayerSource
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.views import depth_error
from lumigraph.method.depth import DepthNumbers, depth_terms
from lumigraph.methods.instant_ngp import Config
from lumigraph.run import build

pytestmark = budget("methods", 5)
TEACHABLE = [
    name
    for name in methods.available()
    if isinstance(getattr(methods.find(name).Config, "measured", None), DepthNumbers)
]


def term(rendered: float, opacity: float = 1.0, weight: float = 1.0, **layers_: float) -> torch.Tensor:
    """Loss of one ray of that rendered depth. layers_: of the photograph, a depth of 2 if not given"""
    layers = {name: torch.tensor([value]) for name, value in ({"depth": 2.0} | layers_).items()}
    config = replace(Config(), measured=DepthNumbers(weight))
    return depth_terms(config, layers, torch.tensor([rendered]), torch.tensor([opacity])).get(
        "measured", torch.tensor(0.0)
    )


def test_a_large_error_counts_by_its_share_and_a_small_one_hardly():
    assert float(term(2.0)) == 0
    assert float(term(3.0)) == pytest.approx(0.5, rel=0.03)  # a half of the distance
    assert float(term(2.02)) == pytest.approx(0.01 * (2**0.5 - 1), rel=1e-3)  # one deviation
    assert float(term(2.02, depth_deviation=0.2)) == pytest.approx(0.1 * 0.005, rel=0.01)  # a tenth of a deviation


def test_what_was_measured_is_opaque():
    assert float(term(2.0, opacity=0.25, weight=4.0)) == pytest.approx(3.0)
    assert float(term(float("inf"), opacity=0.0)) == pytest.approx(1.0)
    assert float(term(2.5, depth=float("nan"))) == 0 and float(term(2.5, depth=float("inf"))) == 0


def with_depth(scale: float = 1.0):
    """The tiny scene with the distance to its ball, where the pixels show it."""
    scene = tiny.scene()
    planes = []
    for i in range(len(scene)):
        camera = scene.cameras[i]
        rays = camera.rays(camera.pixels())
        b = (rays.directions * rays.origins).sum(-1)
        under = b * b - rays.origins.square().sum(-1) + 0.36
        depth = torch.where(under > 0, -b - under.clamp_min(0).sqrt(), torch.nan).view(tiny.SIZE, tiny.SIZE)
        planes.append(LayerSource(lambda depth=depth: (scale * depth).numpy().astype(np.float32)))
    layer = Layer(scene.images, planes, np.dtype(np.float32), 1, "distance")
    return replace(scene, layers={"depth": layer})


@pytest.mark.parametrize("name", TEACHABLE)
def test_every_taught_method_reads_depth_and_descends_on_it(name):
    kind, scene = methods.find(name), with_depth()
    config = replace(kind.smallest(), measured=DepthNumbers(2.0))
    method = build(kind, scene.frame, config, torch.device("cpu"), 0).train()
    method.begin(scene)
    method.before_step(0, 0.0)
    batch = method.batch(scene, torch.Generator().manual_seed(0))
    terms = method.loss(batch, 0)
    assert float(terms["measured"].detach()) > 0
    terms["measured"].backward()
    assert any(p.grad is not None and p.grad.to_dense().any() for p in method.parameters())


def test_without_depth_a_sentence_says_so():
    method = build(
        methods.find("nerf"),
        tiny.scene().frame,
        replace(methods.find("nerf").smallest(), measured=DepthNumbers(1.0)),
        torch.device("cpu"),
        0,
    )
    with pytest.raises(LumigraphError, match="no depth"):
        method.batch(replace(tiny.scene(), layers={}), torch.Generator())


def test_the_score_of_depth():
    measured = torch.tensor([[2.0, 4.0, float("nan"), 1.0]])
    depth = torch.tensor([[2.2, 4.0, 9.0, float("inf")]])
    seen = Rendering(torch.zeros(1, 4, 3), depth, torch.ones(1, 4))
    assert depth_error(seen, measured) == pytest.approx(100 * (0.1 + 0 + 1) / 3, rel=1e-4)
    assert depth_error(seen, torch.full((1, 4), torch.nan)) is None
