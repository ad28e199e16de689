"""Instances of clouds: identity codes by the rasteriser, neighbours that agree, codes that follow the cloud, edits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from balls import BLUE, RED, WHITE, Splatted, eye
from budgets import budget

from lumigraph.components.instances import edit_of
from lumigraph.datasets.images import Layer, LayerSource
from lumigraph.datasets.scene import Photograph, Scene
from lumigraph.files.ranges import changed
from lumigraph.gaussians import joined
from lumigraph.gaussians.splatting import splat, view_of
from lumigraph.methods.gaussian_splatting import GaussianSplatting
from lumigraph.methods.gaussian_splatting.instances import Identities, InstanceNumbers
from lumigraph.run import build
from lumigraph.selection.distilled import CloudWeigher

pytestmark = budget("methods", 5)

NUMBERS = InstanceNumbers("yes", instances=2, identity_code=4, identity_lr=0.1, classifier_lr=0.1)
EYES = (-3.0, 0.3, 0.8), (0.2, -3.0, 0.5), (3.0, 0.2, 0.3), (-0.3, 3.0, 0.9)


def method_of(cloud, numbers=NUMBERS):
    config = changed(replace(GaussianSplatting.smallest(), groups=numbers), sh_degree=0)
    method = build(GaussianSplatting, WHITE, config, torch.device("cpu"), 0)
    method.begin_with(cloud, eye(EYES[0]))
    return method


def two_balls():
    return joined([Splatted(RED, 0.3, (0.0, -0.4, 0.0)).cloud, Splatted(BLUE, 0.3, (0.0, 0.4, 0.0)).cloud])


def step_at(method, camera):
    """A training step on a photograph whose labels are 0 on the red ball, 1 on the blue one."""
    cloud = method.cloud.gaussians()
    picture = splat(cloud, view_of(camera, 0.01), 1)
    seen, red = picture.opacity > 0.5, picture.rgb[..., 0] > picture.rgb[..., 2]
    labels = torch.where(seen, torch.where(red, 0, 1), -1)
    photograph = Photograph(camera, picture.rgb, seen.float(), extra={"labels": labels})
    step = method.step_on(photograph, 0)
    step.picture = picture
    return step


@pytest.fixture(scope="module")
def learnt():
    method = method_of(two_balls())
    optimizers = method.identities.optimizers()
    for turn in range(60):
        step = step_at(method, eye(EYES[turn % 4]))
        method.identities.regularize(step)
        for optimizer in optimizers:
            optimizer.zero_grad()
        sum(step.terms.values()).backward()
        for optimizer in optimizers:
            optimizer.step()
    return method.eval()


def test_masks_teach_each_gaussian_its_instance(learnt):
    labels = learnt.identities.labels(learnt.cloud.gaussians())
    truth = torch.arange(3000) // 1500
    weigher, ones = CloudWeigher(learnt.cloud.gaussians(), 0.01), torch.ones(33, 33, 1)
    seen = sum(weigher.sums(eye(place), ones)[:, 0] for place in EYES) > 0.05
    assert (labels == truth)[seen].float().mean() > 0.97 and (labels == truth).float().mean() > 0.9


def test_a_photograph_without_labels_learns_from_one_that_has_some(monkeypatch):
    """Its own unknown labels teach nothing; those of the only labelled photograph do, from its camera."""
    method, scene = method_of(two_balls()), tiny.scene()
    step = step_at(method, eye(EYES[0]))
    step.rgb = step.picture.rgb
    other = step_at(method, eye(EYES[2])).photograph
    step.photograph.extra["labels"] = torch.full_like(other.extra["labels"], -1)
    step.photograph = replace(step.photograph, alpha=None)
    planes = [None] * len(scene.names)
    planes[5] = LayerSource(lambda: np.zeros(0))
    layer = Layer(scene.images, planes, np.dtype(np.uint8), 1, "index")
    method.identities.layers(replace(scene, layers={"labels": layer}))
    asked = []
    monkeypatch.setattr(Scene, "photograph", lambda self, index, layers: asked.append(index) or other)
    method.identities.regularize(step)
    assert asked == [5] and method.identities.seen.all() and step.terms["identity"] > 0
    step.terms["identity"].backward()
    assert method.identities.codes.grad.abs().sum() > 0 and method.cloud.means.grad is None


def test_identities_change_nothing_else():
    """Gradients reach codes and classifier alone."""
    method = method_of(two_balls())
    step = step_at(method, eye(EYES[0]))
    method.identities.regularize(step)
    sum(step.terms.values()).backward()
    assert method.identities.codes.grad.abs().sum() > 0 and method.identities.classifier.weight.grad.abs().sum() > 0
    assert all(p.grad is None or not p.grad.any() for p in method.cloud.parameters())


def test_neighbours_agree_when_their_codes_do():
    identities = Identities(NUMBERS, 200)
    identities._set(torch.ones(200, 4), torch.randn(200, 3, generator=torch.Generator().manual_seed(0)))
    chance = torch.Generator().manual_seed(1)
    assert float(identities.disagreement(chance).detach()) == pytest.approx(0, abs=1e-6)
    identities._set(torch.randn(200, 4, generator=chance) * 5, identities.places)
    assert float(identities.disagreement(chance).detach()) > 0.1


def test_codes_follow_a_cloud_that_changes():
    """Before codes are learnt too, where a cloud grows and is pruned after one step."""
    method = method_of(two_balls())
    method.cloud.optimizers()
    codes = method.identities.codes.detach().clone()
    order = torch.tensor([5, 5, 2000])
    method.cloud.rebuild(order, order == 2000)
    method.prune(torch.tensor([True, False, True]))
    assert torch.equal(method.identities.codes.detach(), codes[order[[0, 2]]])


def test_codes_of_an_older_run_are_those_of_the_nearest():
    method = method_of(two_balls())
    codes, order = method.identities.codes.detach().clone(), torch.tensor([5, 5, 2000])
    method.cloud.replace(method.cloud.gaussians()[order])
    method.identities.before_raster(method.step_on(Photograph(eye(EYES[0]), torch.zeros(1, 1, 3)), 0))
    assert torch.equal(method.identities.codes.detach(), codes[order])


def test_an_instance_is_removed_moved_copied_and_alone(learnt):
    camera = eye(EYES[0])
    whole = learnt.render(camera)
    assert [x.name for x in learnt.controls][-5:] == ["edit", "shift_x", "shift_y", "shift_z", "turn"]
    gone = learnt.given(edit="remove 0")
    assert len(gone.gaussians()) < 1600 and gone.render(camera).opacity.sum() < 0.7 * whole.opacity.sum()
    alone = learnt.given(edit="alone 0").render(camera)
    assert (alone.rgb[alone.opacity > 0.9][:, 0] > 0.7).float().mean() > 0.95
    assert len(learnt.given(edit="copy 0", shift_z=0.5).gaussians()) > 4300
    moved = learnt.given(edit="move 0", shift_z=0.5).gaussians()
    assert len(moved) == 3000 and moved.means[:, 2].max() > 0.7
    assert edit_of(learnt.given(edit="move 0")) is None
    assert torch.equal(learnt.given(edit="move 0").render(camera).rgb, whole.rgb)


def test_alpha_is_a_mask_where_there_are_no_labels():
    assert tiny.scene().images.has_alpha
    method = method_of(two_balls())
    step = step_at(method, eye(EYES[0]))
    step.photograph.extra.clear()
    method.identities.regularize(step)
    assert method.identities.seen.tolist() == [True, False]
