"""`lumigraph resume`: training goes on where it stopped."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from .common import budget_of, choose_device, exit_code, needed, option


@dataclass(frozen=True)
class Resume:
    """Go on with a run that was interrupted, exactly as if it had not been; or give it a larger budget."""

    run_folder: Annotated[Positional[Path], needed("RUN")]
    """Folder of the run."""
    seconds: Annotated[float | None, option("S", "as begun")] = None
    """New total of seconds, those already trained included."""
    steps: Annotated[int | None, option("N", "as begun")] = None
    """New total of steps, those already done included."""
    scene: Annotated[str | None, option("SCENE", "where they were")] = None
    """Where what it learns from is now, if it has moved."""
    device: Annotated[str, option("NAME", "the one it began on")] = "same"
    """auto, cpu, cuda, cuda:1."""
    pause_at: Annotated[int | None, option("STEP", "never")] = None
    """Stop at this step as if interrupted."""
    view: bool = False
    """Show the scene in the browser while it is learnt, and afterwards until Ctrl-C."""
    host: Annotated[str, option("ADDRESS", "127.0.0.1, this machine alone")] = "127.0.0.1"
    """Where --view listens; 0.0.0.0 lets other machines look too."""
    port: Annotated[int | None, option("N", "8080, or the next that is free")] = None
    """Port that --view listens at."""

    def run(self) -> int:
        from ..run import Run

        run = Run(self.run_folder)
        with run.held():
            return self._go_on(run)

    def _go_on(self, run: Any) -> int:
        from ..train import Budget, fit
        from .train import tell_outcome
        from .view import keep_showing, watching

        budget = budget_of(self.steps, self.seconds) or run.settings.budget
        state = run.state if run.has_state else None
        if state and Budget(budget.get("steps"), budget.get("seconds")).progress(state.step, state.seconds) >= 1:
            raise LumigraphError(
                f"{run.folder} has spent its budget at step {state.step}, {state.seconds:.0f} s; "
                f"give a larger total by --steps or --seconds"
            )
        device = choose_device(run.settings.device if self.device == "same" else self.device)
        method, data = run.new_method(device), run.dataset(self.scene)
        if budget != run.settings.budget:
            run.set_budget(**budget)
        with watching(self.view, method, data, run, self.host, self.port) as watch:
            outcome = fit(method, data, run, **budget, seed=run.settings.seed, pause_at=self.pause_at, watch=watch)
            tell_outcome(run, outcome)
            keep_showing(watch, outcome.signal)
        return exit_code(outcome.signal)
