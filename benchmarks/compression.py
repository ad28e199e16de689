"""dB against bytes: runs on every rung of the ladder that `lumigraph compress` stands them on.

    python benchmarks/compression.py RUN ... --seconds 10 --views 20 --output FOLDER

Each run is pressed harder and harder, tuned for equally long on each rung, and compared with its held-out photographs.
FOLDER/compression.svg is the chart, compression.json the figures behind it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.table import Table

from lumigraph.derive.compression import LADDER
from lumigraph.derive.compression.compress import STAGES, Ladder, important, truth_of
from lumigraph.derive.options import CompressOptions
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.figures.charts import Series, line_chart, standalone
from lumigraph.files import scene_name, write_bytes, write_json
from lumigraph.methods import colour
from lumigraph.run import Run
from lumigraph.system.console import console
from lumigraph.system.progress import NumberedStages


@dataclass(frozen=True)
class Options:
    runs: tyro.conf.Positional[tuple[Path, ...]]
    output: Path
    seconds: float = 10.0  # of tuning, on each rung
    steps: int | None = None  # of tuning instead
    views: int = 20  # held-out views to compare
    every: int = 1  # rung: 2 leaves out every second one
    device: str = "cpu"


def main(options: Options) -> None:
    rows = [row for folder in options.runs for row in rungs(Run(folder), options)]
    show(rows)
    write_json(options.output / "compression.json", rows, "benchmark")
    write_bytes(options.output / "compression.svg", standalone(chart(rows)), "benchmark")


def rungs(run: Run, options: Options) -> list[dict]:
    """A row for the run as it is, and one for each rung."""
    before = run.method(options.device)
    truth = truth_of(run, before, None, 1)
    timed = None if options.steps else options.seconds
    ladder = Ladder(
        run,
        truth,
        CompressOptions(max_loss=0.0, steps=options.steps, seconds=timed),
        options.device,
        important(before, truth),
        NumberedStages(STAGES, "", show=False),
    )
    psnr = evaluate(before, truth.scene, EvaluationOptions("test", options.views)).psnr
    rows = [
        {
            "method": run.method_name,
            "scene": scene_name(run.settings.scene.source),
            "rung": None,
            "bytes": run.model_bytes,
            "psnr": psnr,
        }
    ]
    for number in range(0, len(LADDER), options.every):
        begin, model = time.perf_counter(), ladder.at(number)
        ladder.tune(model, 1.0)
        size, seconds = len(model.packed()), time.perf_counter() - begin
        psnr = evaluate(model.method, truth.scene, EvaluationOptions("test", options.views)).psnr
        rows.append({**rows[0], "rung": number, "bytes": size, "psnr": psnr, "seconds": seconds})
    return rows


def show(rows: list[dict]) -> None:
    table = Table("method", "scene", "rung", "model", "times smaller", "PSNR", "loss")
    for row in rows:
        if row["rung"] is None:
            whole = row
        smaller, loss = whole["bytes"] / row["bytes"], whole["psnr"] - row["psnr"]
        rung = "–" if row["rung"] is None else str(row["rung"])
        size = f"{row['bytes'] / 1e6:.2f} MB"
        table.add_row(row["method"], row["scene"], rung, size, f"{smaller:.1f}", f"{row['psnr']:.2f}", f"{loss:.2f}")
    console(width=120).print(table)


def chart(rows: list[dict]) -> str:
    """A curve for each run, from the run as it is down the ladder."""
    names = list(dict.fromkeys((row["method"], row["scene"]) for row in rows))
    scenes = {scene for _, scene in names}
    series = []
    for method, scene in names:
        own = sorted(
            (row["bytes"] / 1e6, row["psnr"]) for row in rows if (row["method"], row["scene"]) == (method, scene)
        )
        name = method if len(scenes) == 1 else f"{method}, {scene}"
        series.append(Series(name, [x for x, _ in own], [y for _, y in own], colour(method)))
    note = ", ".join(sorted(scenes))
    return line_chart(series, "MB of the model", "held-out PSNR, dB", log_x=True, marks=True, smoothed=False, note=note)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
