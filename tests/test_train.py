"""The training loop: it learns, resumes to the bit, and stops in good order."""

from __future__ import annotations

import json
import signal
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.views import evaluate
from lumigraph.run import Run
from lumigraph.run.checkpoint import Checkpoints
from lumigraph.training import Clock, finite, fit, rehearse, set_learning_rate

pytestmark = budget("runs", 16)


def final_state(run: Run) -> tuple[dict[str, torch.Tensor], str]:
    """All tensors of a run's checkpoint, and the structure of its optimizers."""
    states = Checkpoints(run.folder, run.method_name)
    tensors: dict[str, torch.Tensor] = {}
    for name in ("weights.safetensors", "optimizer.safetensors"):
        tensors |= {f"{name}/{key}": value for key, value in states._read_tensors(states.latest, name).items()}
    return tensors, json.dumps(states._about(states.latest).optimizers)


def train(run: Run, **options):
    scene, method = tiny.scene(), run.new_method()
    return method, fit(method, scene, run, show=False, seed=run.settings.seed, **options)


def test_a_method_learns_held_out_views():
    scene = tiny.scene()
    method = tiny.method(scene.frame)
    before = evaluate(method, scene).psnr
    outcome = fit(method, scene, steps=200, show=False)
    assert outcome.finished and outcome.state.step == 200 and not method.training
    after = evaluate(method, scene).psnr
    assert before < 15 and after > 21


@pytest.mark.parametrize("momentum", [False, True], ids=["adam", "amsgrad and momentum"])
def test_resuming_equals_never_having_stopped_to_the_bit(tmp_path, momentum):
    straight = tiny.new_run(tmp_path / "straight", momentum=momentum)
    train(straight, steps=200)
    broken = tiny.new_run(tmp_path / "broken", momentum=momentum)
    _, first = train(broken, steps=200, pause_at=100)
    assert not first.finished and broken.state.step == 100
    _, second = train(Run(broken.folder), steps=200)
    assert second.finished and broken.state.step == 200
    (expected, structure), (actual, resumed) = final_state(straight), final_state(broken)
    assert expected.keys() == actual.keys() and len(expected) > 8
    for name in expected:
        assert torch.equal(expected[name], actual[name]), name
    assert structure == resumed


def test_a_step_may_descend_several_times_with_some_of_its_optimizers(monkeypatch):
    """As adversaries do: each descent moves its own parameters, whatever gradients reach the others."""
    scene = tiny.scene()
    method = tiny.method(scene.frame, momentum=True)
    moved = []

    def step(self, batch, number, descend):
        for optimizer in self.kept:
            before = self.logits.detach().clone(), self.colour.detach().clone()
            terms = self.loss(batch, number)
            descend(terms, [optimizer])
            moved.append([not torch.equal(*pair) for pair in zip(before, (self.logits, self.colour), strict=True)])
        return terms

    monkeypatch.setattr(type(method), "step", step)
    fit(method, scene, steps=3, show=False, rehearsal=False)
    assert moved == [[True, False], [False, True]] * 3


def test_the_trainer_gives_groups_what_a_method_declares():
    method = tiny.method()
    groups = [
        {"name": "means", "params": [method.logits], "lr": 1.0},
        {"params": [method.colour], "lr": 1.0, "scale": 0.5},
    ]
    (first, second) = (optimizer := torch.optim.SGD(groups)).param_groups
    for declared, rates in [({}, [1.0, 1.0]), ({"means": 0.3}, [0.3, 1.0]), ({"means": 0.2, "": 0.2}, [0.2, 0.1])]:
        set_learning_rate([optimizer], declared)
        assert [first["lr"], second["lr"]] == pytest.approx(rates)


def test_another_seed_gives_another_result(tmp_path):
    scene = tiny.scene()
    results = []
    for seed in (0, 0, 1):
        method = tiny.method(scene.frame, seed=0)
        fit(method, scene, steps=5, seed=seed, show=False)
        results.append(method.logits.detach().clone())
    assert torch.equal(results[0], results[1]) and not torch.equal(results[0], results[2])


def test_a_config_seed_reaches_the_numbers_that_a_method_draws():
    """PyTorch's CPU generator reads 32 bits of a seed."""
    kind, frame = methods.find("instant-ngp"), tiny.scene().frame
    drawn = []
    for seed in (0, 1, 2, (1 << 32) - 1):
        method = kind(frame, replace(kind.smallest(), seed=seed))
        drawn += [torch.rand(4, generator=method.random(number)) for number in (0, 7, 1_000_000)]
    assert len({tuple(numbers.tolist()) for numbers in drawn}) == len(drawn)


def test_training_leaves_the_global_random_numbers_alone():
    scene = tiny.scene()
    method, before = tiny.method(scene.frame), torch.get_rng_state()
    fit(method, scene, steps=3, show=False)
    assert torch.equal(before, torch.get_rng_state())


def test_rehearsing_changes_nothing():
    scene = tiny.scene()
    method = tiny.method(scene.frame)
    before = {name: value.clone() for name, value in method.state_dict().items()}
    assert rehearse(method, scene, 0) > 0
    assert all(torch.equal(value, before[name]) for name, value in method.state_dict().items())
    assert all(p.grad is None for p in method.parameters())


def test_seconds_are_kept_and_compiling_and_saving_do_not_count(tmp_path, monkeypatch):
    run = tiny.new_run(tmp_path / "run")
    _, outcome = train(run, seconds=0.5, save_every=0.1)
    assert outcome.finished and 0.5 <= outcome.state.seconds < 0.9
    assert run.state == outcome.state and outcome.saving_seconds > 0
    _, again = train(Run(run.folder), seconds=0.8)
    assert again.state.seconds >= 0.8 and again.state.step > outcome.state.step


def test_a_clock_stands_still_in_pauses(monkeypatch):
    now = [10.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    clock = Clock(seconds=5.0)
    now[0] += 2
    with clock.paused():
        now[0] += 100
    now[0] += 1
    assert clock.seconds == pytest.approx(8) and clock.pauses == pytest.approx(100)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_the_step_and_saves(tmp_path, monkeypatch, number):
    run = tiny.new_run(tmp_path / "run")
    method, scene = run.new_method(), tiny.scene()
    monkeypatch.setattr(type(method), "after_step", lambda self, step: step == 12 and signal.raise_signal(number))
    handler = signal.getsignal(number)
    outcome = fit(method, scene, run, steps=50, show=False)
    assert outcome.signal == number and not outcome.finished
    assert outcome.state.step == run.state.step == 13
    assert signal.getsignal(number) is handler


def test_a_second_interrupt_breaks_off(tmp_path, monkeypatch):
    method, scene = tiny.method(), tiny.scene()

    def insist(self, step, progress):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(type(method), "before_step", insist)
    with pytest.raises(KeyboardInterrupt):
        fit(method, scene, steps=50, show=False, rehearsal=False)


def finite_weights(run: Run) -> bool:
    return all(x.isfinite().all() for x in run.method().state_dict().values())


def spoil_loss(kind, at: int, spoil):
    """Let a method's loss have another term from a step on."""
    sound = kind.loss
    return lambda self, batch, step: sound(self, batch, step) | ({"edge": spoil(self)} if step >= at else {})


def test_a_loss_that_is_not_finite_stops_with_step_and_term(tmp_path, monkeypatch):
    run = tiny.new_run(tmp_path / "run")
    method = run.new_method()
    spoilt = spoil_loss(type(method), 23, lambda self: self.logits.sum() * float("nan"))
    monkeypatch.setattr(type(method), "loss", spoilt)
    with pytest.raises(LumigraphError, match=r"step 23 because the loss term 'edge' is nan; the state after step 23"):
        fit(method, tiny.scene(), run, steps=50, show=False)
    assert run.state.step == 23 and finite_weights(run)


def test_a_gradient_that_is_not_finite_stops_with_step_and_term(tmp_path, monkeypatch):
    run = tiny.new_run(tmp_path / "run")
    method = run.new_method()
    # The root's value at zero is harmless, its slope is not.
    spoilt = spoil_loss(type(method), 7, lambda self: (0 * self.colour.sum()).sqrt())
    monkeypatch.setattr(type(method), "loss", spoilt)
    with pytest.raises(LumigraphError, match=r"step 7 because the gradient of the loss term 'edge' in 'colour' is not"):
        fit(method, tiny.scene(), run, steps=50, show=False)
    assert run.state.step == 7 and finite_weights(run)


@pytest.mark.parametrize(("save_every", "kept"), [(1e-9, 30), (60.0, 20)])
def test_a_spoilt_state_never_replaces_a_good_one(tmp_path, monkeypatch, save_every, kept):
    run = tiny.new_run(tmp_path / "run")
    train(run, steps=40, pause_at=20)

    def spoil(self, step):
        if step == 30:
            self.logits.data.view(-1)[5] = float("inf")

    monkeypatch.setattr(type(run.new_method()), "after_step", spoil)
    with pytest.raises(LumigraphError, match=rf"stopped at step 31 .* the state after step {kept} is kept"):
        train(Run(run.folder), steps=40, save_every=save_every)
    assert run.state.step == kept and finite_weights(run)


def test_lines_and_previews_tell_the_steps_once(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    train(run, steps=40, pause_at=20)
    run.log({"step": 30, "seconds": 9.0})  # as if it had gone on and been killed before saving
    train(Run(run.folder), steps=40)
    rows = run.metrics()
    assert [row["step"] for row in rows] == [10, 20, 30, 40]
    assert {"seconds", "loss", "terms", "psnr", "statistics", "learning_rate", "mean_loss", "passes"} <= rows[-1].keys()
    assert set(rows[-1]["terms"]) == {"colour", "thin"}
    assert [row["seconds"] for row in rows] == sorted(row["seconds"] for row in rows)
    assert rows[-1]["learning_rate"][0] == pytest.approx(0.1 * 0.1 ** (39 / 40))
    assert max(run.previews()) == 40 and len(run.previews()) >= 4


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1.0, -2.0], True),
        ([], True),
        ([0.0, float("nan")], False),
        ([float("inf"), float("-inf")], False),
        ([1.0, float("-inf"), 3.0], False),
    ],
)
def test_finite_notices_every_fault(values, expected):
    assert finite([torch.ones(3), torch.tensor(values), torch.arange(3)]) is expected
    assert finite([torch.full((8,), 60_000.0, dtype=torch.float16)])  # whose sum float16 cannot hold
