"""Budgets: what share is over, what a quality asks for, and a finished run that goes on."""

from __future__ import annotations

import dataclasses

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.budget import QUALITIES, REJOIN_PROGRESS, Budget, Effort, lasting
from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.evaluation import held_out_poses
from lumigraph.evaluation.views import evaluate
from lumigraph.method import Method
from lumigraph.run import Run, build
from lumigraph.training import fit

pytestmark = budget("runs", 16)


@pytest.mark.parametrize("said", [{}, {"steps": 3, "seconds": 1.0}, {"steps": 0}, {"seconds": -1.0}])
def test_a_budget_is_steps_or_seconds(said):
    with pytest.raises(LumigraphError):
        Budget.from_json(said)


def test_progress_is_the_share_of_the_budget():
    assert Budget(200).progress(50, 1e9) == 0.25
    assert Budget(seconds=60.0).progress(10**9, 15.0) == 0.25
    assert Budget(seconds=60.0).progress(0, 75.0) == 1.0


@pytest.mark.parametrize(
    "budget",
    [Budget(7), Budget(seconds=2.5), Budget(500, quality="draft"), Budget(seconds=600.0, joined=(60.0, 0.3))],
    ids=["steps", "seconds", "quality", "extended"],
)
def test_a_run_says_its_budget(budget):
    assert Budget.from_json(budget.to_json()) == budget


def test_a_budget_in_words():
    assert str(Budget(seconds=60.0)) == "60 s of training" and str(Budget(3720)) == "3,720 steps"
    assert str(Budget(500, quality="draft")) == "500 steps (quality: draft)"
    told = [lasting(s) for s in (0.5, 90, 600, 3570, 3600, 5400)]
    assert told == ["0.5 s", "90 s", "10 min", "1 h", "1 h", "1 h 30 min"]


def test_a_little_more_is_the_larger_budget_from_the_start():
    assert Budget(30).extended(Budget(35), 30, 1.0) == Budget(35)
    assert Budget(seconds=60.0).extended(Budget(600), 300, 60.0) == Budget(600)


def test_much_more_goes_on_behind_the_coarse_beginning():
    budget = Budget(30).extended(Budget(3000), 30, 1.0)
    assert [budget.progress(step, 1.0) for step in (30, 3000)] == [REJOIN_PROGRESS, 1.0]
    shares = [budget.progress(step, 1.0) for step in range(30, 3001)]
    assert shares == sorted(shares) and budget.progress(1515, 1.0) == pytest.approx((1 + REJOIN_PROGRESS) / 2)


def test_a_run_cut_short_never_falls_back():
    """One that had come to a tenth goes on at a tenth, whatever its new total."""
    budget = Budget(100).extended(Budget(10_000), 10, 1.0)
    assert budget.progress(10, 1.0) == pytest.approx(0.1)
    again = budget.extended(Budget(20_000), 500, 1.0)
    assert again.progress(500, 1.0) == pytest.approx(budget.progress(500, 1.0)) and again.joined[0] == 500


def test_asking_for_the_same_total_changes_nothing():
    budget = Budget(seconds=600.0, joined=(60.0, 0.3))
    assert budget.extended(Budget(seconds=600.0), 100, 90.0) == budget


SCENES = [name for name in methods.available() if methods.find(name).learns_from.kind == "photographs"]


DESCENDING = [name for name in SCENES if methods.find(name).steps_for is Method.steps_for]


@pytest.mark.parametrize("name", sorted({*SCENES} - {*DESCENDING}))
def test_what_takes_each_photograph_once_has_one_effort(name):
    kind, scene = methods.find(name), tiny.scene()
    method = build(kind, scene.frame, kind.smallest(), torch.device("cpu"), seed=0)
    efforts = {method.steps_for(quality, scene) for quality in QUALITIES}
    assert efforts in ({len(scene.splits["train"])}, {1})  # one step for each photograph, or for all together


@pytest.mark.parametrize("name", DESCENDING)
def test_quality_means_something_for_every_method_and_size(name):
    kind, steps = methods.find(name), {}
    for views in (12, 24):
        scene = tiny.scene(views)
        method = build(kind, scene.frame, kind.smallest(), torch.device("cpu"), seed=0)
        assert method.steps_per_pass(scene) > 0
        steps[views] = [method.steps_for(quality, scene) for quality in QUALITIES]
        assert steps[views] == sorted(set(steps[views])) and steps[views][0] >= 100
    larger = kind.efforts["best"].passes * method.steps_per_pass(tiny.scene(24))
    assert larger == pytest.approx(2 * kind.efforts["best"].passes * method.steps_per_pass(tiny.scene(12)))


def test_an_effort_grows_with_the_capture_from_a_least_on():
    effort = Effort(passes=10, at_least=500)
    assert [effort.steps(photographs) for photographs in (7, 50, 51, 400)] == [500, 500, 510, 4000]


def test_a_run_remembers_its_quality_and_goes_on_to_the_next(tmp_path, monkeypatch, capsys):
    efforts = {"draft": Effort(0, 10), "good": Effort(1, 20), "best": Effort(5, 40)}
    monkeypatch.setattr(methods.find("voxel-grid"), "efforts", efforts)
    photographs, run = tiny.write_blender(tmp_path / "ball"), tmp_path / "run"
    words = ["train", "voxel-grid", str(photographs), "--output", str(run), "--quality", "draft", "--device", "cpu"]
    assert main(words) == 0 and Run(run).state.step == 10
    assert Run(run).settings.budget == {"steps": 10, "quality": "draft"}
    assert f"lumigraph resume {run} --quality good" in capsys.readouterr().out
    assert main(["info", str(run)]) == 0 and "10 steps (quality: draft)" in capsys.readouterr().out
    assert main(["resume", str(run), "--quality", "draft"]) == 2 and "has spent its budget" in capsys.readouterr().err
    assert main(["resume", str(run), "--quality", "good"]) == 0 and Run(run).state.step == 20
    assert main(["resume", str(run), "--quality", "best", "--steps", "50"]) == 2
    assert "give one of them" in capsys.readouterr().err


@pytest.mark.parametrize("total", ["--steps=200", "--seconds=9999"])
def test_a_finished_run_goes_on_and_may_be_stopped_meanwhile(tmp_path, total):
    photographs, run = tiny.write_blender(tmp_path / "ball"), tmp_path / "run"
    assert main(["train", "voxel-grid", str(photographs), "--output", str(run), "--steps", "20"]) == 0
    assert main(["resume", str(run), total, "--pause-at", "30"]) == 0 and Run(run).state.step == 30
    said = Run(run).settings.budget
    assert said["joined"][1] == pytest.approx(REJOIN_PROGRESS)
    assert main(["resume", str(run), "--pause-at", "35"]) == 0 and Run(run).settings.budget == said
    state = Run(run).state
    assert state.step == 35 and REJOIN_PROGRESS < Budget.from_json(said).progress(state.step, state.seconds) < 0.5


def test_extending_is_exact_too(tmp_path):
    """Stopping after the extension and going on gives what an extension in one go gives, to the bit."""
    budget = Budget(20).extended(Budget(200), 20, 1.0)
    results = []
    for pauses in ([None], [50, None]):
        run = tiny.new_run(tmp_path / str(len(pauses)))
        fit(run.new_method(), tiny.scene(), run, steps=20, show=False)
        for pause in pauses:
            method = run.new_method()
            fit(method, tiny.scene(), run, budget=budget, pause_at=pause, show=False)
        results.append(method.logits.detach())
    assert torch.equal(*results)


@pytest.mark.parametrize("name", ["gaussian-splatting", "instant-ngp", "voxel-grid"])
def test_what_was_learnt_survives_an_extension(name, tmp_path, monkeypatch):
    """The held-out error after it is no larger than before, however much longer the new budget is."""
    monkeypatch.setattr(held_out_poses, "STEPS", 5)  # for each photograph, of methods that refine poses; 200 otherwise
    scene, kind = tiny.scene(), methods.find(name)
    config = dataclasses.replace(kind.smallest(), learning_rate=5e-2) if name == "voxel-grid" else kind.smallest()
    method = build(kind, scene.frame, config, torch.device("cpu"), seed=0)
    run = Run.create(tmp_path / "run", method, scene, budget={"steps": 60})
    fit(method, scene, run, steps=60, show=False)
    before = evaluate(method, scene).psnr
    goes_on = run.new_method()
    budget = Budget(60).extended(Budget(240), 60, 1.0)
    fit(goes_on, scene, run, budget=budget, show=False)
    assert evaluate(goes_on, scene).psnr > before
