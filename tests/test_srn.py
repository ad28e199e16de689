"""SRN: networks that codes make, the marcher's steps, the terms of its loss, codes of unseen scenes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import tiny_collection
import torch
from budgets import budget
from torch.nn.functional import layer_norm

from lumigraph import methods
from lumigraph.errors import LumigraphError
from lumigraph.methods import srn as module
from lumigraph.methods.srn import SRN
from lumigraph.methods.srn.networks import RayMarcher, SceneHyperNetwork, scene_features
from lumigraph.run import build

pytestmark = budget("methods", 6)


def srn(frame=None, **changes) -> SRN:
    kind = methods.find("srn")
    frame = frame or tiny_collection.collection().frame
    return build(kind, frame, replace(kind.smallest(), **changes), torch.device("cpu"), 0)


def test_each_code_makes_layers_of_its_own():
    """Of two members at once as of each alone, and as eq. 1 has it: layers, normalised, with ReLU."""
    network = SceneHyperNetwork(4, (3, 8, 6), 2)
    codes, points = torch.randn(2, 4), torch.randn(2, 5, 3)
    both = scene_features(network(codes), points)
    for member in range(2):
        x = points[member]
        for weights, biases in network(codes[member : member + 1]):
            x = layer_norm(x @ weights[0].t() + biases[0], weights.shape[1:2]).relu()
        torch.testing.assert_close(both[member], x)
    assert not torch.allclose(both[0], scene_features(network(codes[1:]), points[:1])[0], atol=1e-2)


def test_the_published_hypernetwork_is_as_large():
    """16 777 216 + 65 536 numbers and biases for each of three layers of 256, and 768 + 256 for the first one."""
    network = SceneHyperNetwork(256, (3, 256, 256, 256, 256), 2)
    last = [layer[-1] for layer in network.layers]
    assert [x.weight.shape[0] for x in last] == [1024, 65_792, 65_792, 65_792]
    assert all(x.weight.shape[1] == 256 for x in last)


def test_the_marcher_adds_its_steps():
    """With weights of zero each step is as long as the bias; with others the scene decides (algorithm 1)."""
    network, marcher = SceneHyperNetwork(4, (3, 8), 1), RayMarcher(8, 4, 5)
    layers = network(torch.randn(1, 4))
    origins, directions = torch.zeros(1, 3, 3), torch.nn.functional.normalize(torch.randn(1, 3, 3), dim=-1)
    start = torch.tensor([[0.1, 0.2, 0.3]])
    moved = marcher(layers, origins, directions, start)
    with torch.no_grad():
        marcher.length.weight.zero_()
        marcher.length.bias.fill_(0.25)
    torch.testing.assert_close(marcher(layers, origins, directions, start), start + 5 * 0.25)
    assert (moved - start).std() > 0


def test_gradients_of_the_marchers_state_are_bounded():
    """By 10 in each number, at each step, as published: else ten steps of an LSTM explode."""
    marcher = RayMarcher(8, 4, 1)
    layers = SceneHyperNetwork(4, (3, 8), 1)(torch.randn(1, 4))
    distance = marcher(layers, torch.zeros(1, 2, 3), torch.ones(1, 2, 3), torch.zeros(1, 2))
    (1e6 * distance.sum()).backward()
    gradient = marcher.cell.bias_ih.grad
    assert 0.01 < gradient.abs().max() <= 2 * 10  # of two rays; a gate passes at most all of it on


def test_places_behind_the_camera_are_penalised(monkeypatch):
    """By the square of their distance (eq. 6); others are not."""
    monkeypatch.setattr(module, "START_DEVIATION", 0.0)
    monkeypatch.setattr(module, "START_DISTANCE", 0.1)
    method = srn(start="camera", march_steps=4)
    lesson = method.batch(tiny_collection.collection(), torch.Generator().manual_seed(0))
    for bias, expected in ((0.5, 0.0), (-0.5, 10.0 * 1.9**2)):
        with torch.no_grad():
            method.marcher.length.weight.zero_()
            method.marcher.length.bias.fill_(bias)
        assert float(method.loss(lesson, 0)["depth"].detach()) == pytest.approx(expected, rel=1e-4)


def test_colours_are_compared_between_minus_one_and_one_and_codes_stay_small():
    method = srn()
    lesson = method.batch(tiny_collection.collection(), torch.Generator().manual_seed(0))
    with torch.no_grad():
        method.codes.rows.fill_(0.5)
    terms = method.loss(lesson, 0)
    assert float(terms["colour"]) == pytest.approx(800 * method.figures["mse"], rel=1e-5)
    assert float(terms["code"]) == pytest.approx(0.25)


def test_photographs_without_alpha_have_no_opacity():
    frame = replace(tiny_collection.collection().frame, has_alpha=False)
    method = srn(frame)
    assert method.pixel_generator[-1].out_features == 3
    assert bool((method.eval().render(tiny.scene().cameras[0]).opacity == 1).all())


@pytest.fixture(scope="module")
def taught() -> SRN:
    """Sixty steps on three balls."""
    method, data = srn(code_steps=40), tiny_collection.collection()
    method.begin(data)
    (optimizer,) = method.optimizers()
    generator = torch.Generator().manual_seed(0)
    for step in range(60):
        method.before_step(step, step / 60)
        optimizer.zero_grad()
        torch.stack([*method.loss(method.batch(data, generator), step).values()]).sum().backward()
        optimizer.step()
    return method.eval()


def test_the_code_of_an_unseen_scene_explains_its_photographs(taught):
    """Better than the best learnt code, with the networks as they are."""
    unseen = tiny_collection.tinted("amber")
    before = {name: value.clone() for name, value in taught.state_dict().items()}
    told = taught.given(unseen)
    assert told.control("instance") == "found" and taught.control("instance") == "average"
    assert all(torch.equal(value, before[name]) for name, value in taught.state_dict().items())

    def error(method) -> float:
        picture = unseen.photograph(1)
        shown = method.render(picture.camera).rgb
        return float((shown - picture.before(unseen.frame.background)).square().mean())

    assert error(told) < min(error(taught.given(instance=name)) for name in ("average", *taught.codes.names))
    drawn = taught.draw_object(1)
    assert not torch.equal(drawn.code, told.code) and torch.equal(taught.draw_object(1).code, drawn.code)


def test_more_members_than_codes_are_refused():
    with pytest.raises(LumigraphError, match="members"):
        srn(members=2).begin(tiny_collection.collection())
