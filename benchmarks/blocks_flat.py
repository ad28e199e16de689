"""What a block takes as the scene around it grows: seconds and memory, from what several runs in blocks have measured.

python benchmarks/blocks_flat.py RUN_OF_4 RUN_OF_8 RUN_OF_16 --chart docs/images/blocks-flat.svg
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import tyro
from rich.table import Table

from lumigraph import files
from lumigraph.figures.charts import Series, line_chart, standalone
from lumigraph.large.plan import DONE_FILE, PLAN_FILE, Done, Plan
from lumigraph.large.planning import place_of
from lumigraph.system.console import console


@dataclass(frozen=True)
class Options:
    runs: tyro.conf.Positional[tuple[Path, ...]]
    chart: Path | None = None


def done_of(run: Path) -> list[Done]:
    plan = Plan.read(run / PLAN_FILE)
    return [files.read_json(place_of(run, block) / DONE_FILE, Done) for block in plan.blocks]


def main(options: Options) -> None:
    table = Table("blocks", "photographs of one", "opening, s", "training, s", "ms a step", "MB, mean", "MB, most")
    found = {len(done): done for done in map(done_of, options.runs)}
    for count, done in sorted(found.items()):
        photographs, opening, training = (
            mean(getattr(x, name) for x in done) for name in ("photographs", "opening_seconds", "seconds")
        )
        step = 1e3 * sum(x.seconds for x in done) / sum(x.steps for x in done)
        memory = [x.peak_memory / 1e6 for x in done]
        row = f"{photographs:.0f}", f"{opening:.2f}", f"{training:.1f}", f"{step:.0f}"
        table.add_row(str(count), *row, f"{mean(memory):.0f}", f"{max(memory):.0f}")
    console().print(table)
    if options.chart:
        counts = sorted(found)
        series = [
            Series(told, counts, [mean(map(of, found[n])) / mean(map(of, found[counts[0]])) for n in counts])
            for told, of in (
                ("seconds of a block", lambda x: x.seconds),
                ("memory of a worker", lambda x: x.peak_memory),
            )
        ]
        label = f"times what it is at {counts[0]}"
        flat = Series("as the city grows", counts, [n / counts[0] for n in counts], dash=1)
        chart = line_chart([*series, flat], "blocks", label, marks=True, smoothed=False, x_ticks=counts)
        files.write_bytes(options.chart, standalone(chart))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
