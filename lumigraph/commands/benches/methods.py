"""`lumigraph bench methods`: methods side by side on the same scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ... import methods
from ...ranges import Seconds, Steps
from ..common import option, scene_name
from .cells import Cells, budgets, place_of


@dataclass(frozen=True, kw_only=True)
class BenchMethods(Cells):
    """Train methods on scenes, for several durations and from several seeds, and compare held-out views.

    Every cell is a run of its own in OUTPUT/runs, trained by `lumigraph train` and compared by `lumigraph eval` in
    processes of their own. OUTPUT/results.md has the table, results.json all figures; charts show PSNR over time.
    Ctrl-C stops; the same command goes on.
    """

    seconds: Annotated[tuple[Seconds, ...], option("S", "60")] = ()
    """Train for so long; several make a chart."""
    steps: Annotated[tuple[Steps, ...], option("N", "as long as --seconds")] = ()
    """Train for so many steps instead."""

    def run(self) -> int:
        from ...benchmark.cell import Cell

        times, settings = budgets(self.seconds, self.steps), self.checked()
        cells = [
            Cell(methods.check(name), scene_name(place), place, budget, seed)
            for place in map(place_of, self.scenes)
            for budget in times
            for seed in self.seeds
            for name in self.methods
        ]
        return self.conduct(cells, settings)
