"""`lumigraph bench methods`: compare methods on the same scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ... import methods
from ...files.ranges import Seconds, Steps
from ..common import option, scene_name
from .cells import Cells, budgets, place_of


@dataclass(frozen=True, kw_only=True)
class BenchMethods(Cells):
    """Train methods on scenes, for several durations and from several seeds, and compare held-out views.

    Every cell is a separate run in OUTPUT/runs, trained by `lumigraph train` and compared by `lumigraph eval` in
    separate processes. OUTPUT/results.md has the table, results.json all figures; charts show PSNR over time. Ctrl-C
    stops; the same command continues.
    """

    seconds: Annotated[tuple[Seconds, ...], option("S", "60")] = ()
    """Training time in seconds; several give a chart."""
    steps: Annotated[tuple[Steps, ...], option("N", "as long as --seconds")] = ()
    """Train for these numbers of steps instead."""

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
