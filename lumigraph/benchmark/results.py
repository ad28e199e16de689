"""Results of a cell as one row, and all rows of a benchmark in a file."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from .. import files
from ..budget import Budget
from ..files.ranges import Lasted, Tally, typed
from ..metrics import Score
from ..run import Run
from ..run.measured import Protocol, ViewScores
from .cell import Cell, Settings, train_command
from .published import Published, published

Row = dict[str, Any]
MEASURED = (
    "scores",
    "psnr",
    "ssim",
    "lpips",
    "steps",
    "training_seconds",
    "compile_seconds",
    "peak_memory",
    "seconds_per_view",
    "protocol",
    "trained_on",
    "evaluated_on",
    "versions",
)


@dataclass(frozen=True)
class Begun:
    """Validated fields of every cell in results.json. run: its folder, within the output's"""

    method: str
    scene: str
    budget: dict[str, Any]
    seed: int
    run: Annotated[str, msgspec.Meta(pattern=r"\Aruns/[^/\\\x00]+\Z")]
    views: Tally | None = None
    failed: str | None = None
    collection: str = ""
    prior: str | None = None


@dataclass(frozen=True)
class Measured:
    """Validated fields of cells that did not fail."""

    protocol: Protocol
    train_views: Tally
    model_bytes: Tally
    peak_memory: Tally
    steps: Tally
    training_seconds: Lasted
    compile_seconds: Lasted
    trained_on: str
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    scores: list[Score] = field(default_factory=list)
    seconds_per_view: Lasted | None = None
    shown: ViewScores | None = None
    published: Published | None = None


@dataclass(frozen=True)
class Results:
    """And of all of them."""

    cells: list[Row] = field(default_factory=list)


def row_of(cell: Cell, output: Path, settings: Settings, failure: str | None) -> Row:
    """A cell's figures out of its run's folder, under the names that eval.json has for them; or why there are none."""
    folder = output / "runs" / cell.name
    row: Row = {
        "method": cell.method,
        "scene": cell.scene,
        "views": cell.views,
        "budget": {name: value for name, value in asdict(cell.budget).items() if value is not None},
        "seed": cell.seed,
        "command": shlex.join(["lumigraph", *train_command(public(cell), settings)]),
        "run": f"runs/{cell.name}",
        "failed": failure,
        "collection": cell.collection,
        "prior": cell.prior and Path(cell.prior).name,
    }
    if failure:
        return row
    run = Run(folder)
    result = run.evaluation() or {}
    figure = published(cell.method, cell.scene) if cell.views is None and settings.scales == 1 else None
    row |= {name: result[name] for name in MEASURED if name in result}
    row |= {
        "train_views": run.settings.splits.get("train", 0) // settings.scales,
        "model_bytes": run.model_bytes,
        "published": figure and asdict(figure),
    }
    if (views := result.get("views")) and "members" not in result["protocol"]:
        row["shown"] = views[len(views) // 2 // settings.scales]  # at full size
    if "by_resolution" in result:
        row["by_resolution"] = result["by_resolution"]
    return row


def public(cell: Cell) -> Cell:
    """A cell without the places where its scene and its prior lie on this machine."""
    source = cell.scene if Path(cell.source).exists() else cell.source
    return replace(cell, source=source, prior=cell.prior and Path(cell.prior).name)


def read_rows(output: Path) -> dict[str, Row]:
    """The rows so far by their runs, earlier commands' among them."""
    path = output / "results.json"
    if not path.exists():
        return {}
    rows = files.read_json(path, Results).cells
    for row in typed(list[Begun], rows, path):
        Budget.from_json(row.budget, f"{path}: {row.run}")
    typed(list[Measured], [row for row in rows if not row.get("failed")], path)
    return {row["run"]: row for row in rows}
