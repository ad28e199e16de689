"""What training says at its end: how often everything was seen, whether it was still rising, and what would help."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.commands.outcome import (
    advice,
    beside_training,
    more_time,
    next_commands,
    photographed,
    seen,
    show_outcome,
)
from lumigraph.datasets.images import ImageStore
from lumigraph.methods.gaussian_splatting.few_views import FewViewNumbers, FewViews
from lumigraph.metrics.rows import last_psnr
from lumigraph.run import Run, build
from lumigraph.training import fit
from lumigraph.training.verdict import Trend, loss_trend

pytestmark = budget("runs")

FLAT, FALLING = Trend(0.01, 0.01), Trend(0.3, 0.02)


def lines(fall: float, scatter: float, photographs: int = 20, passes: int = 40) -> list[dict]:
    """Lines of ten steps, each from one photograph. The loss falls by such a share over the second half of them; some
    photographs are harder than others by `scatter`, and each has its turn once in every pass."""
    random = np.random.default_rng(0)
    hard = np.exp(random.normal(0, scatter, photographs))
    order = np.concatenate([random.permutation(photographs) for _ in range(passes)])
    steps = len(order)
    loss = hard[order] * (1 - fall) ** (2 * np.arange(steps) / steps) * 0.1
    return [
        {"step": step, "mean_loss": float(loss[step - 10 : step].mean()), "passes": step / photographs}
        for step in range(10, steps + 1, 10)
    ]


def test_a_line_is_measured_exactly():
    trend = loss_trend(lines(0.2, 0.0), by_photograph=False)
    assert trend.fall == pytest.approx(0.2, abs=0.01) and trend.error < 1e-3 and trend.falling


@pytest.mark.parametrize(
    ("fall", "falling"), [(0.15, True), (0.0, False), (0.02, False), (-0.2, False)], ids=["much", "no", "little", "up"]
)
def test_hard_photographs_are_not_taken_for_a_trend_nor_hide_one(fall, falling):
    trend = loss_trend(lines(fall, scatter=0.5), by_photograph=True)
    assert trend.falling is falling and trend.fall == pytest.approx(fall, abs=0.03)


def test_noise_of_rays_is_not_taken_for_a_trend():
    trend = loss_trend(lines(0.06, scatter=1.5, photographs=800, passes=1), by_photograph=False)
    assert trend.error > 0.06 and not trend.falling


def test_photographs_of_another_size_do_not_count():
    rows = lines(0.3, 0.0)
    for row in rows:
        small = row["step"] < 0.7 * rows[-1]["step"]
        row["statistics"] = {"reduction": 2 if small else 1}
        row["psnr"] = 30.0 if small else 26.0
        row["mean_loss"] *= 0.5 if small else 1
    trend = loss_trend(rows, by_photograph=False)
    assert trend.falling and trend.share == pytest.approx(0.3, abs=0.02)
    assert trend.fall == pytest.approx(1 - 0.7**0.6, abs=0.01)  # of 0.3 over a half
    assert last_psnr(rows) == 26.0


def test_too_few_lines_say_nothing():
    assert loss_trend([], False) is None and loss_trend(lines(0.2, 0.0)[:6], False) is None
    assert loss_trend(lines(0.2, 0.5, passes=7), by_photograph=True) is None  # three whole passes
    assert loss_trend([{"step": step, "loss": 1.0} for step in range(99)], False) is None


def test_the_last_psnr_is_the_mean_of_the_last_quarter():
    rows = [{"step": step, "psnr": 10.0 if step <= 60 else 20.0 + step % 2} for step in range(1, 81)]
    assert last_psnr(rows) == 20.5 and last_psnr([{"step": 10, "loss": 1.0}]) is None


def test_a_run_cut_short_was_falling_and_one_that_learns_nothing_has_settled(tmp_path):
    """Of one method on one scene, which is cut short at a tenth of its budget or hardly moves."""
    found = []
    for rate in (0.02, 1e-6):
        run = tiny.new_run(tmp_path / str(rate), learning_rate=rate, rays=1024)
        fit(run.new_method(), tiny.scene(), run, steps=600, pause_at=60, log_every=2, show=False, rehearsal=False)
        found.append(loss_trend(run.metrics(), by_photograph=False).falling)
    assert found == [True, False]


def test_how_often_everything_was_seen_is_counted_over_all_sittings(tmp_path):
    run, scene = tiny.new_run(tmp_path / "rays"), tiny.scene()
    for pause in (10, None):
        fit(run.new_method(), scene, run, steps=30, pause_at=pause, show=False)
    assert run.state.passes == pytest.approx(30 * 256 / (9 * tiny.SIZE**2))
    kind = methods.find("gaussian-splatting")
    method = build(kind, scene.frame, kind.smallest(), torch.device("cpu"), seed=0)
    outcome = fit(method, scene, steps=18, show=False, rehearsal=False)
    assert outcome.state.passes == pytest.approx(2.0)


def test_how_often_in_words():
    assert seen(5.04, "photograph") == "each photograph 5.0 times" and seen(61.7, "pixel") == "each pixel 62 times"
    assert seen(0.05, "pixel") == "one pixel in 20" and seen(0.4, "photograph") == "one photograph in 2.5"


def test_advice_follows_what_was_measured():
    more = "lumigraph resume runs/x --seconds 600"
    assert advice(FALLING, True, more, True) == f"it was still getting better, so more time will help: {more}"
    assert "fewer steps than a draft" in advice(FLAT, False, more, True) and more in advice(None, False, more, True)
    assert advice(FLAT, True, more, True) == "it has settled; more photographs would help more than time"
    assert "photographs" not in advice(FLAT, True, more, False) and more not in advice(FLAT, True, more, False)
    assert "it is unknown" in advice(None, True, more, True)


@pytest.mark.parametrize(
    ("budget", "longer"),
    [
        (Budget(seconds=60.0), "--seconds 180"),
        (Budget(seconds=180.0), "--seconds 600"),
        (Budget(seconds=9000.0), "--seconds 18000"),
        (Budget(20), "--steps 60"),
        (Budget(1234), "--steps 3800"),
        (Budget(500, quality="draft"), "--quality good"),
        (Budget(3000, quality="good"), "--quality best"),
        (Budget(10_000, quality="best"), "--steps 30000"),
    ],
    ids=lambda value: str(value),
)
def test_more_time_is_the_next_budget_of_its_kind(budget, longer):
    assert more_time("runs/my can", budget) == f"lumigraph resume 'runs/my can' {longer}"


def test_next_commands_name_the_run(tmp_path):
    run = tiny.new_run(tmp_path / "a run")
    typed = list(next_commands(run).values())
    assert [words.split()[1] for words in typed] == ["eval", "view", "export"]
    assert all(f"'{run.folder}'" in words for words in typed) and "eval" not in str(next_commands(run, "eval"))
    assert photographed(Run(run.folder), tiny.scene())


def test_memorised_photographs_are_said_with_what_was_applied_and_what_is_next(tmp_path):
    run, method = tiny.new_run(tmp_path / "a"), tiny.method(tiny.scene().frame)
    views = [{"name": name, "psnr": value} for name, value in (("a", 22.0), ("b", 16.0), ("c", 19.0))]
    told = beside_training(25.0, {"psnr": 19.0, "views": views}, run, method)
    assert "6.0 dB worse" in told and "first from near b and c" in told and "no prior for few photographs" in told
    assert "compare: lumigraph train instant-ngp 'in memory'" in told
    assert beside_training(25.0, {"psnr": 24.0}, run, method) == "25.00 dB while training"


def test_priors_for_few_photographs_are_named():
    few = FewViews(FewViewNumbers("yes"))
    few.surface = torch.zeros(2, 3)
    assert few.few_view_priors == ("dropout of Gaussians", "smooth depth", "plane-sweep surfaces at unobserved views")
    assert FewViews(FewViewNumbers("auto")).few_view_priors == ()


def test_the_verdict_compares_held_out_photographs(tmp_path, capsys, monkeypatch):
    """Held-out photographs that show something else are rendered worse, and the advice follows."""
    scene = tiny.scene()
    method = tiny.method(scene.frame, learning_rate=0.02, rays=1024)
    run = Run.create(tmp_path / "a", method, scene, budget=Budget(100).to_json())
    outcome = fit(method, scene, run, steps=100, log_every=2, show=False, rehearsal=False)
    monkeypatch.setattr(type(method), "steps_for", lambda *_: 1)
    show_outcome(run, outcome, method, scene)
    said = capsys.readouterr().out
    assert "held-out photographs" in said and "memorised" not in said
    pictures = [scene.images[i].byte().numpy() for i in range(len(scene))]
    for i in scene.splits["test"].tolist():
        pictures[i] = np.random.default_rng(i).integers(0, 255, pictures[i].shape, np.uint8)
    show_outcome(run, outcome, method, replace(scene, images=ImageStore.from_arrays(pictures)))
    assert "memorised" in capsys.readouterr().out
