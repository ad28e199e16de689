"""A minute on a processor: captures, budgets of seconds, seeds and methods, with the spread over seeds.

    python benchmarks/one_minute.py DATA OUTPUT                                 all of SCENES that DATA has
    python benchmarks/one_minute.py DATA OUTPUT --scenes fox /photographs/cat   these, and captures of your own
    python benchmarks/one_minute.py DATA OUTPUT --seconds 60 --seeds 0 1 2      one budget
    python benchmarks/one_minute.py DATA OUTPUT --publish                       figures for `tables.py`, and the chart

Each capture is a `lumigraph bench methods` in OUTPUT/CAPTURE, so the same command goes on after Ctrl-C. Run it on an
otherwise idle machine: budgets are seconds. A change of a trainer is a gain if its means differ by more than the
deviation over seeds, on most captures.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from lumigraph.commands.cli import main as command_line
from lumigraph.figures.charts import Series, line_chart, standalone
from lumigraph.files import write_bytes

ROOT = Path(__file__).parent.parent
RESULTS, CHART = ROOT / "benchmarks/results/one-minute-cpu.json", ROOT / "docs/images/one-minute.svg"
SCENES = {"lego": 2, "fern": 8, "fox": 4, "bonsai": 1, "can": 1, "banana": 2}  # captures, and how much they are reduced
VIEWS = 12  # held-out photographs that are compared, at most
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Options:
    data: Annotated[Path, tyro.conf.Positional]  # folder of captures
    output: Annotated[Path, tyro.conf.Positional]
    scenes: tuple[str, ...] = ()  # names in DATA, or paths; all of SCENES that are there by default
    methods: tuple[str, ...] = ("gaussian-splatting", "instant-ngp")
    seconds: tuple[float, ...] = (30, 60, 300)
    seeds: tuple[int, ...] = (0, 1, 2)
    commit: str = ""  # that ran, for --publish
    publish: bool = False


def main(options: Options) -> None:
    names = options.scenes or tuple(name for name in SCENES if (options.data / name).is_dir())
    for name in names:
        place = options.data / name if (options.data / name).is_dir() else Path(name)
        words = ["bench", "methods", "--scenes", str(place), "--output", str(options.output / place.name)]
        words += ["--eval-views", str(VIEWS), "--methods", *options.methods]
        words += ["--seconds", *map(str, options.seconds), "--seeds", *map(str, options.seeds)]
        if name in SCENES:
            words += ["--downscale", str(SCENES[name])]
        if code := command_line(words):
            raise SystemExit(code)
    rows = averaged([row for name in names for row in measured(options.output / Path(name).name)])
    for row in rows:
        print(json.dumps(row))
    if options.publish:
        told = {"scenes": dict.fromkeys(row["scene"] for row in rows), "methods": options.methods}
        told |= {"seconds": [f"{x:g}" for x in options.seconds], "seeds": options.seeds}
        words = " ".join(f"--{name} {' '.join(map(str, values))}" for name, values in told.items())
        about = {"commit": options.commit, "machine": rows[0]["trained_on"], "cells": rows}
        about["commands"] = [f"python benchmarks/one_minute.py DATA OUTPUT {words}"]
        RESULTS.write_text(json.dumps(about, indent=1) + "\n", "utf-8")
        if len(options.seconds) > 1:
            write_bytes(CHART, standalone(chart(rows)), ours=True)


def measured(output: Path) -> list[Row]:
    """Cells of a benchmark that did not fail."""
    rows = json.loads((output / "results.json").read_text("utf-8"))["cells"]
    return [row for row in rows if not row["failed"]]


def averaged(rows: Sequence[Row]) -> list[Row]:
    """Mean and deviation over the seeds of each capture, method and budget."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["method"], row["budget"]["seconds"]), []).append(row)
    found = []
    for (scene, method, seconds), group in groups.items():
        one: Row = {"scene": scene, "method": method, "seconds": seconds, "seeds": len(group)}
        one |= {"resolution": group[0]["protocol"]["resolution"], "trained_on": group[0]["trained_on"]}
        for name in ("psnr", "ssim", "lpips", "steps", "peak_memory"):
            values = [row[name] for row in group if row.get(name) is not None]
            one[name] = statistics.mean(values) if values else None
        one["deviation"] = statistics.stdev(row["psnr"] for row in group) if len(group) > 1 else None
        clouds = [row["cloud"] for row in group if "cloud" in row]
        one |= {name: statistics.mean(cloud[name] for cloud in clouds) for name in (clouds or [{}])[0]}
        found.append(one)
    return found


def chart(rows: Sequence[Row]) -> str:
    """PSNR over seconds: a colour for each capture, a dash for each method."""
    names, kinds = (list(dict.fromkeys(row[key] for row in rows)) for key in ("scene", "method"))
    series = []
    for i, name in enumerate(names):
        for j, method in enumerate(kinds):
            own = sorted(
                (row["seconds"], row["psnr"]) for row in rows if (row["scene"], row["method"]) == (name, method)
            )
            series.append(Series(name if not j else "", [x for x, _ in own], [y for _, y in own], i, j))
    note = ", ".join(f"{'unbroken' if not j else 'dashed'}: {method}" for j, method in enumerate(kinds))
    times = sorted({row["seconds"] for row in rows})
    return line_chart(series, "seconds", "PSNR", log_x=True, marks=True, smoothed=False, note=note, x_ticks=times)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
