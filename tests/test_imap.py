"""Equations of iMAP (Sucar 2021) and Co-SLAM (Wang 2023), and a short recording that is tracked."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera.rays import Rays, Samples
from lumigraph.commands.cli import main
from lumigraph.components.tracking.frames import DepthFrame
from lumigraph.components.tracking.trajectory import LOST
from lumigraph.errors import LumigraphWarning
from lumigraph.method import Pass
from lumigraph.methods.imap import REGIONS, IMap
from lumigraph.run import Run, build
from lumigraph.volume import composite, weights_of

pytestmark = budget("methods", 8)
SCENE = tiny.scene()


def new(field: str = "hash", **config) -> IMap:
    return build(IMap, SCENE.frame, replace(IMap.smallest(), field=field, **config), torch.device("cpu"), 0)


def one_ray(count: int = 400) -> tuple[Rays, Samples]:
    rays = Rays(torch.tensor([[0.0, 0, -1]]), torch.tensor([[0.0, 0, 1]]), torch.tensor([1e-3]))
    return rays, Samples.rows(torch.linspace(0, 2, count)[None], torch.tensor([2.0]))


def test_half_of_the_light_passes_where_the_distance_is_zero():
    """A plane at distance 1 that faces the ray: transmittance is 1/2 there, so that depth is unbiased."""
    field, (_, samples) = new().network, one_ray(4000)
    inside = torch.sigmoid(-field.sharpness * (1 - samples.t) / field.truncation)
    weights = weights_of(samples, inside * field.sharpness / field.truncation)
    assert float(weights[samples.t < 1].sum()) == pytest.approx(0.5, abs=2e-3)
    assert float((weights * samples.t).sum()) == pytest.approx(1.0, abs=2e-3)


def test_the_distance_is_taught_near_and_free_space_before(monkeypatch):
    """Eqs. 8 and 9 of Co-SLAM: a table that is right has no error; one off by a tenth of the truncation has a square of
    0.01 near the surface alone."""
    method, (_, samples) = new(), one_ray()
    field, depth = method.network, torch.tensor([1.2])
    right = ((1.2 - samples.t) / field.truncation).clamp(-1, 1)
    for off, expected in ((0.0, 0.0), (0.1, 0.01)):
        monkeypatch.setattr(field, "distance_of", lambda _, off=off: torch.where(right < 1, right + off, right))
        seen = Pass("fine", samples, right, right[:, None], torch.zeros(len(samples), 3))
        terms = method.distance_terms(field, seen, depth, torch.Generator().manual_seed(0))
        weights = method.config.terms
        assert float(terms["distance"]) == pytest.approx(weights.distance_weight * expected, abs=1e-4)
        assert float(terms["free"]) == pytest.approx(0, abs=1e-6)


def test_depth_counts_by_its_certainty():
    """Eq. 6 of iMAP: |D - D^| over the deviation of the ray's termination, which composited moments give."""
    samples = Samples.rows(torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([4.0]))
    density = torch.tensor([0.7, 0.3, 30.0])
    t = samples.t[:, None]
    found = composite(samples, density, torch.zeros(3, 3), moments=torch.cat([t, t * t], -1))
    mean, square = found.extra["moments"][0]
    weights = weights_of(samples, density)
    variance = float((weights * (samples.t - mean).square()).sum())
    assert float(square - 2 * mean * mean + mean * mean * found.opacity) == pytest.approx(variance, abs=1e-5)


def frame(index: int = 0) -> DepthFrame:
    return DepthFrame.of(SCENE, index, torch.device("cpu"))


def test_active_sampling_draws_where_the_loss_is():
    method, chance = new(), torch.Generator().manual_seed(0)
    method.config = replace(method.config, mapping=replace(method.config.mapping, pixels_per_frame=4000))
    method.losses.zero_()
    method.losses[0, 9] = 3.0  # second row, second column
    method.losses[0, 54] = 1.0  # seventh row, seventh column
    pixels, side = method.pixels(frame(), chance), tiny.SIZE // REGIONS
    row, column = pixels // tiny.SIZE // side, pixels % tiny.SIZE // side
    share = ((row == 1) & (column == 1)).float().mean(), ((row == 6) & (column == 6)).float().mean()
    assert float(share[0]) == pytest.approx(0.75, abs=0.03) and float(share[1]) == pytest.approx(0.25, abs=0.03)
    error = torch.full((len(pixels),), 0.5)
    method.remember([(frame(), pixels)], error)
    assert method.losses[0, [9, 54]].tolist() == [0.5, 0.5]


def test_the_window_holds_the_current_frame_and_the_latest_keyframe():
    method, chance = new(), torch.Generator().manual_seed(0)
    window = method.window([1, 2, 5, 7, 9, 11], frame(5), chance)
    assert len(window) == 4 and len(set(window)) == 4 and {2, 5} <= set(window)


def test_the_network_is_the_papers(monkeypatch):
    method = build(IMap, SCENE.frame, IMap.Config(), torch.device("cpu"), 0)
    network = method.network
    assert [tuple(x.weight.shape) for x in network.layers] == [(256, 93), (256, 256), (256, 256), (256, 256)]
    assert float(network.frequencies.std()) == pytest.approx(25, rel=0.1) and network.frequencies.requires_grad


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A short recording of the room, tracked in one sitting, and in two."""
    folder = tmp_path_factory.mktemp("room")
    options = "--frames 8 --downscale 1 --mapping-iterations 6 --first-iterations 60 --pixels-per-frame 64"
    source = "procedural:room,depth,views=300,size=48"
    for name in ("straight", "broken"):
        command = f"track imap {source} --output {folder / name} {options}".split()
        assert main([*command, *(["--pause-at", "4"] if name == "broken" else [])]) in (0, 130)
    assert main(["resume", str(folder / "broken")]) == 0
    return folder


def test_a_recording_is_tracked(room):
    said = json.loads((room / "straight" / "tracking.json").read_text())
    run = Run(room / "straight")
    rows = [line.split() for line in (room / "straight" / "trajectory.txt").read_text().splitlines()[1:]]
    assert said["frames"] == said["known"] == len(rows) and not said["lost"]
    truth = np.loadtxt(room / "straight" / "truth.txt")[:, 1:4]
    found = np.array(rows, float)[:, 1:4]
    apart = np.linalg.norm(np.diff(truth, axis=0), axis=-1).sum()
    assert np.linalg.norm(found - truth, axis=-1).max() < 0.25 * apart
    scene, method = run.scene(), run.method()
    camera = method.refined(scene.cameras)
    assert not torch.allclose(camera.pose, scene.cameras.pose)  # the scene knows the first pose alone
    assert (room / "straight" / "drift.svg").read_text().startswith("<svg")


def test_a_run_that_was_stopped_ends_with_the_same_trajectory(room):
    one, other = (np.loadtxt(room / name / "trajectory.txt") for name in ("straight", "broken"))
    np.testing.assert_allclose(one, other, atol=1e-6)


def test_a_lost_frame_is_told_and_left_out(room, capsys, recwarn):
    """A frame that the map explains nothing of keeps the last known pose, and has none in the file."""
    from lumigraph.commands.outcome import show_tracking
    from lumigraph.training.loop import Outcome

    run = Run(room / "straight")
    method, scene = run.method(), run.scene()
    method.tracker.trajectory.state[3] = LOST
    show_tracking(run, Outcome(run.state, True), method, scene)
    told = capsys.readouterr()
    said = f"followed 7 of 8 frames (88 %) and lost the camera at {scene.names[3]}, where too few of its features"
    assert "frames followed" in told.out and said in str(recwarn.pop(LumigraphWarning).message)
    about = json.loads((run.folder / "tracking.json").read_text())
    assert about["share"] == 7 / 8 and said in about["warnings"][0]
    assert len((run.folder / "trajectory.txt").read_text().splitlines()) == len(scene)
