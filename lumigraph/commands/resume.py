"""`lumigraph resume`: continue training."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..budget import Budget
from ..errors import LumigraphError
from ..files.options import RunOption, ViewerOptions
from ..training.options import ResumeOptions
from .common import choose_device, exit_code, typed


@dataclass(frozen=True, kw_only=True)
class Resume(ViewerOptions, ResumeOptions):
    """Continue an interrupted run as if it had not been interrupted, or extend a run with a larger budget.

    A finished run may get a larger budget too. Its schedules then follow the new total: learning rates rise again and
    decay again, and clouds may grow; coarse stages at the beginning of a run are not repeated. A run in blocks goes on
    with the blocks that are not done.
    """

    run_folder: RunOption

    def run(self) -> int:
        from ..run import Run, is_block_run

        if is_block_run(self.run_folder):
            return self._go_on_in_blocks(self.run_folder)
        run = Run(self.run_folder)
        with run.lock():
            return self._go_on(run)

    def _go_on_in_blocks(self, folder: Path) -> int:
        """Train the unfinished blocks by the run's own plan, one after another in this process."""
        from ..large.plan import PLAN_FILE, Plan
        from ..large.planning import begin
        from ..large.training import Workers
        from .train import train_all

        for name in ("seconds", "steps", "quality", "scene", "pause_at", "view", "log"):
            if getattr(self, name):
                raise LumigraphError(
                    f"{folder} is a run in blocks, which goes on as it began, so --{name.replace('_', '-')} is not for "
                    "it; leave it out, or train a new run"
                )
        plan = Plan.read(folder / PLAN_FILE)
        if self.device != "same":
            raise LumigraphError(f"{folder} goes on with the device of its blocks, {plan.device}; leave --device out")
        return train_all(folder, begin(folder, plan), Workers())

    def _go_on(self, run: Any) -> int:
        from ..run.derived import Inferred
        from ..training.loop import fit
        from .outcome import show_outcome
        from .view import end_training, keep_showing, watching

        if run.compressed:
            raise LumigraphError(f"{run.folder} was compressed and cannot be resumed; resume the run it was made of")
        if made := Inferred.of(run.settings, run.folder / "config.json"):
            raise LumigraphError(
                f"{run.folder} was made by a prior and learns nothing itself; go on with the prior: "
                + typed("resume", made.prior)
            )
        if self.quality is None:
            budget = budget_from_now(run, self.budget)
        device = choose_device(run.settings.device if self.device == "same" else self.device)
        method, data = run.new_method(device), run.dataset(self.scene)
        if self.quality is not None:
            budget = budget_from_now(run, Budget(method.steps_for(self.quality, data), quality=self.quality))
        if budget.to_json() != run.settings.budget:
            run.set_budget(**budget.to_json())
        with watching(self, method, data, run) as watch:
            told = {"seed": run.settings.seed, "pause_at": self.pause_at, "loggers": self.log}
            outcome = fit(method, data, run, budget=budget, watch=watch, **told)
            show_outcome(run, outcome, method, data, end_training(watch, method))
            keep_showing(watch if self.stay else None, outcome.signal)
        return exit_code(outcome.signal)


def budget_from_now(run: Any, given: Budget | None) -> Budget:
    """The run's own budget, or another given total. Raises LumigraphError if nothing is left of it."""
    own = run.settings.budget
    budget = given or Budget.from_json(own)
    if not run.has_state:
        return budget
    step, seconds = run.state.step, run.state.seconds
    if budget.progress(step, seconds) >= 1:
        raise LumigraphError(
            f"{run.folder} has spent its budget at step {step}, {seconds:.0f} s; "
            f"give a larger total by --steps, --seconds or --quality"
        )
    return Budget.from_json(own).extended(budget, step, seconds) if own else budget
