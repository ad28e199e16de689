"""A run follows its budget: however few steps it has, its cloud grows, its harmonics rise, and its end is calm."""

from __future__ import annotations

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.components.clouds.adaptive import AdaptiveDensity
from lumigraph.components.clouds.cloud import SCALES_LR
from lumigraph.components.clouds.interval_schedule import IntervalSchedule, short_schedule_lr_scale
from lumigraph.files.ranges import changed
from lumigraph.methods.gaussian_splatting.mcmc import MarkovChain
from lumigraph.run import build
from lumigraph.training import fit
from lumigraph.training import loop as train

pytestmark = budget("methods", 5)

PAPER = 30_000  # steps


@pytest.fixture
def events(monkeypatch):
    """What happens to the cloud, as (what, progress), in the order in which it does."""
    happened, now = [], [0.0]
    kind = methods.find("gaussian-splatting")
    before_step = kind.before_step

    def noted(name, inner):
        def act(self, *given):
            happened.append((name, now[0]))
            return inner(self, *given)

        return act

    def before(self, step, progress):
        now[0] = progress
        before_step(self, step, progress)

    monkeypatch.setattr(kind, "before_step", before)
    monkeypatch.setattr(AdaptiveDensity, "refine", noted("refine", AdaptiveDensity.refine))
    monkeypatch.setattr(AdaptiveDensity, "reset_opacity", noted("reset", AdaptiveDensity.reset_opacity))
    monkeypatch.setattr(MarkovChain, "refine", noted("refine", MarkovChain.refine))
    return happened


def new(**config):
    """A method with the numbers that it has on a CPU, but a cloud that is quick to learn."""
    kind, scene = methods.find("gaussian-splatting"), tiny.scene()
    numbers = {"initial_gaussians": 100, "max_gaussians": 1000, **config}
    return build(kind, scene.frame, changed(kind.preset(torch.device("cpu")), **numbers), torch.device("cpu"), 0)


@pytest.mark.filterwarnings("ignore:The cloud stops growing")
@pytest.mark.parametrize("strategy", ["adaptive", "mcmc"])
def test_a_minute_on_a_slow_machine_grows(strategy, events, monkeypatch):
    """120 steps of half a second each, of which training knows only the seconds."""
    taken = []
    step = methods.find("gaussian-splatting").after_step
    monkeypatch.setattr(train.Clock, "seconds", property(lambda self: 0.5 * len(taken)))
    monkeypatch.setattr(methods.find("gaussian-splatting"), "after_step", lambda *x: (taken.append(x[1]), step(*x)))
    method = new(strategy=strategy)
    fit(method, tiny.scene(), seconds=60.0, show=False, rehearsal=False)
    refined = [progress for what, progress in events if what == "refine"]
    assert len(taken) == 120 and len(refined) >= 3
    assert refined[0] <= 0.2 and 0.35 < refined[-1] < 0.95  # early enough to matter, late enough to settle
    assert "reset" not in dict(events)  # there is no time to recover
    assert len(method.cloud) > 200
    assert method.cloud.harmonics[:, 9:].abs().max() > 0  # the last degree has learnt


def test_resets_leave_time_to_recover(events):
    """Twelve intervals: after the ninth there are too few left, and the cloud is refined no more after the sixth."""
    fit(new(opacity_reset_interval=5, half_resolution_until=0.3), tiny.scene(), steps=60, show=False, rehearsal=False)
    resets = [round(60 * progress) for what, progress in events if what == "reset"]
    assert resets and max(resets) <= 45


def test_only_large_photographs_are_reduced():
    """Half of lego's 400 x 400 pixels would hardly be quicker. Poses are refined from coarse to fine at any size."""
    plain, refining = new(), new(refine_cameras=True)
    for size, at_first, later in [((400, 400), 1, 1), ((533, 800), 2, 2), ((720, 1280), 4, 2)]:
        plain.progress = 0.1
        assert plain.reduction(*size) == at_first
        plain.progress = 0.5
        assert plain.reduction(*size) == later
    refining.progress = 0.1
    assert refining.reduction(400, 400) == 4


@pytest.mark.parametrize("budget, interval", [(PAPER, 100), (1000, 100), (600, 60), (60, 6)])
def test_intervals_are_the_papers_or_a_share_of_the_budget(budget, interval):
    schedule = IntervalSchedule(100, 1 / 10)
    due = [step for step in range(1000) if schedule.due(step, min(1.0, (step + 1e-3) / budget))]
    assert due == [*range(interval, min(budget + 1, 1000), interval)]


def test_the_papers_steps_hold_for_the_papers_budget():
    """The cloud changes every 100 of 30 000 steps, from step 500 on, harmonics rise every 1000. Nothing hurries."""
    method = new()
    method.config = type(method.config)()
    raised, due = [], []
    for step in range(4001):
        method.before_step(step, step / PAPER)
        if step % 1000 == 0:
            raised.append(method.bands)
        if method.density_control.due(step, step / PAPER):
            due.append(step)
    assert method.learning_rates(4000, 4000 / PAPER)["scales"] == SCALES_LR
    assert raised == [1, 2, 3, 4, 4] and due == [*range(500, 4001, 100)]


def test_counting_goes_on_where_a_run_was_stopped():
    one, other = IntervalSchedule(10, 1.0), IntervalSchedule(10, 1.0)
    assert not one.due(9, 0.0)
    other.load_state_dict(one.state_dict())
    assert other.due(10, 0.0) and not other.due(11, 0.0)


def test_a_run_of_few_steps_hurries():
    assert short_schedule_lr_scale(0, 0.0, 2400, 4.0) == 1.0  # nothing is known yet
    for steps, times in [(30_000, 1.0), (2400, 1.0), (600, 2.0), (150, 4.0), (15, 4.0)]:
        assert short_schedule_lr_scale(10, 10 / steps, 2400, 4.0) == pytest.approx(times)
