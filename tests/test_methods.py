"""What every method promises to the trainer, the run and the viewer, whatever it is."""

from __future__ import annotations

import dataclasses

import pytest
import tiny
import torch

from lumigraph import methods
from lumigraph.rays import Rendering
from lumigraph.run import Run, build
from lumigraph.train import fit

NAMES = methods.available()  # tiny adds the tests' own
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"))]


def preset(kind, device: str = "cpu"):
    """What a user would get, learning from fewer rays at a time."""
    config = kind.preset(torch.device(device))
    return dataclasses.replace(config, rays_per_step=256) if hasattr(config, "rays_per_step") else config


def begin(name: str, folder, device: str = "cpu") -> Run:
    scene, kind = tiny.scene(), methods.find(name)
    return Run.create(folder, build(kind, scene.frame, preset(kind, device), torch.device(device), 0), scene)


def train(run: Run, device: str = "cpu", **options):
    method = run.new_method(device)
    fit(method, tiny.scene(), run, show=False, **options)
    return method


@pytest.mark.parametrize("name", NAMES)
def test_a_method_says_what_it_is(name):
    kind = methods.find(name)
    assert len(methods.summary(name)) > 20
    assert dataclasses.is_dataclass(kind.Config) and kind.Config.__dataclass_params__.frozen  # type: ignore[attr-defined]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", NAMES)
def test_resuming_equals_never_having_stopped(name, device, tmp_path):
    straight, broken = begin(name, tmp_path / "straight", device), begin(name, tmp_path / "broken", device)
    train(straight, device, steps=40)
    train(broken, device, steps=40, pause_at=20)
    train(Run(broken.folder), device, steps=40)
    expected, actual = straight.method(device).state_dict(), broken.method(device).state_dict()
    assert expected.keys() == actual.keys()
    for key in expected:
        assert torch.equal(expected[key], actual[key]), key


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", NAMES)
def test_what_is_saved_renders_the_same(name, device, tmp_path):
    run = begin(name, tmp_path / "run", device)
    method = train(run, device, steps=10)
    camera = tiny.scene().cameras[0]
    seen, again = method.render(camera).cpu(), run.method(device).render(camera).cpu()
    assert isinstance(seen, Rendering) and seen.rgb.shape == (24, 24, 3) and seen.depth.shape == (24, 24)
    assert seen.rgb.isfinite().all() and not seen.rgb.requires_grad
    assert (seen.depth > 0).all() and (seen.opacity >= -1e-6).all() and (seen.opacity <= 1 + 1e-5).all()
    for name_of in ("rgb", "depth", "opacity"):
        assert torch.equal(getattr(seen, name_of), getattr(again, name_of)), name_of


@pytest.mark.parametrize("name", NAMES)
def test_looking_changes_nothing(name, tmp_path):
    """Renderings between steps, as previews are, leave training as it was."""
    scene, kind, states = tiny.scene(), methods.find(name), []
    for looks in (False, True):
        method = build(kind, scene.frame, preset(kind), torch.device("cpu"), 0)
        if looks:
            step = type(method).after_step

            def after(self, number, step=step):
                step(self, number)
                self.eval()
                self.render(scene.cameras[3])
                self.train()

            method.after_step = after.__get__(method)
        fit(method, scene, steps=6, show=False)
        states.append(method.state_dict())
    for key in states[0]:
        assert torch.equal(states[0][key], states[1][key]), key


@pytest.mark.parametrize("name", NAMES)
def test_its_config_and_frame_survive_the_folder(name, tmp_path):
    run = begin(name, tmp_path / "run")
    fresh = Run(run.folder).new_method()
    kind = methods.find(name)
    assert fresh.config == preset(kind) and fresh.frame == tiny.scene().frame
    assert methods.name_of(fresh) == name
