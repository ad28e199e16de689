"""What training says at its end: how often everything was seen, whether it was still rising, and what would help."""

from __future__ import annotations

import numpy as np
import pytest
import tiny
import torch

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.commands.eval import beside_training
from lumigraph.commands.outcome import advice, more_time, next_commands, photographed, seen
from lumigraph.run import Run, build
from lumigraph.train import fit
from lumigraph.verdict import Trend, psnr_trend

FLAT = Trend(25.0, 0.05, 0.01)
RISING = Trend(25.0, 1.5, 0.2)


def rows(psnr):
    return [{"step": 10 * (i + 1), "psnr": float(x)} for i, x in enumerate(psnr)]


def noisy(rise: float, deviation: float, count: int = 300) -> list[dict]:
    """Lines whose PSNR rises by so much over their last third, scattered as photographs of one capture are."""
    noise = np.random.default_rng(0).normal(0, deviation, count)
    return rows(20 + 3 * rise * np.arange(count) / (count - 1) + noise)


def test_a_line_is_measured_exactly():
    trend = psnr_trend(noisy(1.5, 0.0, 301))
    assert trend.rise == pytest.approx(1.5, rel=0.02) and trend.error < 1e-9 and trend.rising
    assert trend.last == pytest.approx(20 + 4.5 * 5 / 6, rel=0.01)


@pytest.mark.parametrize(
    ("rise", "deviation", "rising"), [(2.0, 1.5, True), (0.0, 1.5, False), (0.1, 0.0, False), (-2.0, 1.5, False)]
)
def test_noise_is_not_taken_for_a_trend_nor_a_trend_for_noise(rise, deviation, rising):
    trend = psnr_trend(noisy(rise, deviation))
    assert trend.rising is rising and trend.rise == pytest.approx(rise, abs=3 * trend.error + 0.02)


def test_too_few_lines_say_nothing():
    assert psnr_trend([]) is None and psnr_trend(rows([20.0] * 20)) is None
    assert psnr_trend([{"step": step, "loss": 1.0} for step in range(99)]) is None


def test_a_run_cut_short_rises_and_one_that_had_its_time_has_settled(tmp_path):
    """Of one method on one scene: a few steps at a low rate, and many that end where nothing is left to learn."""
    found = []
    for steps, rate in ((60, 0.004), (400, 0.1)):
        run = tiny.new_run(tmp_path / str(steps), learning_rate=rate)
        fit(run.new_method(), tiny.scene(), run, steps=steps, log_every=1, show=False)
        found.append(psnr_trend(run.metrics()))
    assert [trend.rising for trend in found] == [True, False] and found[1].last > found[0].last + 5


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
    assert advice(RISING, True, more, True) == f"it was still getting better, so more time will help: {more}"
    assert "fewer steps than a draft" in advice(FLAT, False, more, True) and more in advice(None, False, more, True)
    assert advice(FLAT, True, more, True) == "it has settled; more photographs would help more than time"
    assert "photographs" not in advice(FLAT, True, more, False) and more not in advice(FLAT, True, more, False)
    assert "cannot be told" in advice(None, True, more, True)


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


def test_what_is_known_by_heart_is_said():
    assert "by heart" in beside_training(FLAT, 19.0) and "by heart" not in beside_training(FLAT, 24.0)
    assert beside_training(FLAT, 24.0) == "25.00 dB while training"
