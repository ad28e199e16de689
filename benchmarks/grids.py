"""Dense, sparse, factorised and hashed grids side by side: memory, lookups, PSNR after equal time and at equal size.

    python benchmarks/grids.py SCENE --output FOLDER

Each method is trained for equally long and compared, as `lumigraph bench methods` does; then its run is pressed down
the ladder of `lumigraph compress`. FOLDER/grids.md is the table, grids.svg the chart of dB against bytes, and what
each run came to lies beside it in FOLDER/runs. The same command goes on where it was stopped. About eleven minutes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from compression import Options as Pressed
from compression import chart, rungs

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.commands.bench import place_of
from lumigraph.figures.charts import standalone
from lumigraph.files import read_json, scene_name, write_bytes, write_json
from lumigraph.lab.benchmark.cell import Cell, CellSettings, read_rows
from lumigraph.lab.benchmark.conduct import conduct
from lumigraph.lab.benchmark.table import size, table
from lumigraph.methods.dvgo import FEATURE_CHANNELS
from lumigraph.run import Run

KINDS = {"dvgo": "dense", "plenoxels": "sparse", "tensorf": "factorised", "instant-ngp": "hashed"}


@dataclass(frozen=True)
class Options:
    scene: tyro.conf.Positional[str]
    output: Path
    methods: tuple[str, ...] = tuple(KINDS)
    seconds: float = 60.0  # of training, each
    tuning: float = 6.0  # seconds on each rung
    every: int = 3  # rung of the ladder: 0, 3 and 6
    views: int = 10  # held-out views to compare
    megabytes: tuple[float, ...] = (1.0, 2.0)  # at which sizes are compared
    downscale: int | None = None


def main(options: Options) -> int:
    source, settings = place_of(options.scene), CellSettings(downscale=options.downscale, eval_views=options.views)
    there = [name for name in options.methods if name in methods.available()]
    cells = [Cell(name, scene_name(source), source, Budget(None, options.seconds)) for name in there]
    if code := conduct(cells, settings, options.output):
        return code
    known = read_rows(options.output)
    rows = [known[f"runs/{cell.name}"] for cell in cells]
    lines = [line for row in rows if not row["failed"] for line in pressed(row, options)]
    write_bytes(options.output / "grids.svg", standalone(chart(lines)), "benchmark")
    text = grids_table([row for row in rows if not row["failed"]], lines, options)
    write_bytes(options.output / "grids.md", text.encode(), "benchmark")
    print(text)
    return 0


def pressed(row: dict[str, Any], options: Options) -> list[dict[str, Any]]:
    """The run of a cell down the ladder; kept beside it, so that it is done once."""
    folder = options.output / row["run"]
    kept = folder.with_name(f"{folder.name}-ladder.json")
    if kept.exists():
        return read_json(kept)
    how = Pressed((folder,), options.output, seconds=options.tuning, views=options.views, every=options.every)
    found = rungs(Run(folder), how)
    write_json(kept, found, "benchmark")
    return found


def grids_table(rows: Sequence[dict[str, Any]], lines: Sequence[dict[str, Any]], options: Options) -> str:
    """The table of docs/grids.md."""
    names = ["method", "grid", "places per sample", "numbers per sample", "model", "memory while training", "s/view"]
    names += [f"PSNR after {options.seconds:g} s", *(f"PSNR at {x:g} MB" for x in options.megabytes)]
    found = []
    for row in rows:
        name, own = row["method"], [line for line in lines if line["method"] == row["method"]]
        places, numbers = lookups(name, Run(options.output / row["run"]).new_method().config)
        cells = [name, KINDS.get(name, "–"), str(places), str(numbers), size(row["model_bytes"])]
        cells += [size(row["peak_memory"]), f"{row['seconds_per_view']:.2g}", f"{own[0]['psnr']:.2f}"]
        found.append(cells + [at_size(own, 1e6 * x) for x in options.megabytes])
    return table(names, found) + "\n"


def lookups(name: str, config: Any) -> tuple[int, int]:
    """Places that a coloured sample is interpolated from, and numbers that are read there."""
    if name == "instant-ngp":
        return 8 * config.levels, 8 * config.levels * config.features_per_level
    if name == "tensorf":  # three planes of four nodes and three lines of two, or the lines alone; twice, for colour
        places = 3 * (4 + 2) if config.factors == "vm" else 3 * 2
        return 2 * places, places * (config.density_components + config.appearance_components)
    if name == "plenoxels":  # a corner's row, density, and nine harmonics of three colours
        return 8, 8 * (1 + 1 + 27)
    return 2 * 8, 8 * (1 + FEATURE_CHANNELS)  # density, and features where they are seen


def at_size(lines: Sequence[dict[str, Any]], wanted: float) -> str:
    """PSNR at a size, between the rungs beside it; in brackets that of the smallest or largest there is."""
    points = sorted((math.log(line["bytes"]), line["psnr"]) for line in lines)
    at = math.log(wanted)
    if at <= points[0][0] or at >= points[-1][0]:
        return f"({points[0 if at <= points[0][0] else -1][1]:.2f})"
    (x0, y0), (x1, y1) = next((a, b) for a, b in zip(points, points[1:], strict=False) if b[0] >= at)
    return f"{y0 + (y1 - y0) * (at - x0) / (x1 - x0):.2f}"


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
