"""A benchmark as pictures: the first score over time and over views, and one held-out view as every method shows it."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from .. import files, methods
from ..evaluate import file_name
from ..figures import Row as Line
from ..figures import contact_sheet, save_picture
from ..figures.charts import Series, line_chart, standalone
from ..metrics import scores_of
from ..run import Run
from .cell import SHEET
from .results import Row
from .table import resolution, trained_for


def draw_charts(rows: Sequence[Row], output: Path) -> list[str]:
    """Draw what the rows have at least two points of. Returns the names of the files."""
    measured, drawn = [row for row in rows if not row["failed"]], []
    for scene in sorted({row["scene"] for row in measured}):
        of_scene = [row for row in measured if row["scene"] == scene]
        of_all_views = [row for row in of_scene if row["views"] is None]
        over_time = curves(of_all_views, "training_seconds", budget)
        over_views = curves(of_scene, "train_views", lambda row: row["train_views"], per=trained_for)
        seconds = {row["budget"].get("seconds") for row in of_all_views}
        headline = scores_of(of_scene[0])[0]
        for name, series, label, ticks in (
            ("time", over_time, "seconds of training", () if None in seconds else sorted(seconds)),
            ("views", over_views, "photographs to learn from", sorted({row["train_views"] for row in of_scene})),
        ):
            if not any(len(one.x) > 1 for one in series):
                continue
            chart = line_chart(
                series,
                label,
                ", ".join(part for part in (f"held-out {headline.name}", headline.unit) if part),
                log_x=True,
                marks=True,
                smoothed=False,
                note=", ".join([*(one.name for one in series if len(series) == 1), scene, resolution(of_scene[0])]),
                x_ticks=ticks,
            )
            drawn.append(f"{scene}-{headline.name.lower().replace(' ', '-')}-over-{name}.svg")
            files.write_bytes(output / drawn[-1], standalone(chart), "benchmark")
    return drawn


def curves(
    rows: Sequence[Row], x: str, point: Callable[[Row], Any], per: Callable[[Row], Any] = lambda row: ""
) -> list[Series]:
    """The first score over x, a curve for each method. Cells that differ in their seeds alone are a point: their means.

    point: what cells of one point have in common;  per: what else tells curves apart, of one method by their dashes
    """
    groups: dict[tuple[str, Any], dict[Any, list[Row]]] = {}
    for row in rows:
        groups.setdefault((row["method"], per(row)), {}).setdefault(point(row), []).append(row)
    others = sorted({other for _, other in groups})
    series = []
    for (method, other), points in sorted(groups.items()):
        found = sorted(
            (statistics.fmean(row[x] for row in cells), statistics.fmean(scores_of(row)[0].value for row in cells))
            for cells in points.values()
        )
        name = f"{method}, {other}" if len(others) > 1 else method
        x_of, y_of = [at for at, _ in found], [score for _, score in found]
        series.append(Series(name, x_of, y_of, methods.colour(method), others.index(other)))
    return series


def budget(row: Row) -> tuple[tuple[str, float], ...]:
    return tuple(row["budget"].items())


def draw_views(rows: Sequence[Row], output: Path) -> list[str]:
    """One held-out view of each scene as its photograph and as every method shows it, after its longest training."""
    measured = [row for row in rows if not row["failed"] and "shown" in row]
    best: dict[tuple[str, str, int], dict[str, Row]] = {}
    for row in sorted(measured, key=lambda row: (*row["budget"].values(), -row["seed"])):
        best.setdefault((row["scene"], row["shown"]["name"], row["train_views"]), {})[row["method"]] = row
    methods = sorted({method for cells in best.values() for method in cells})
    photographs: dict[tuple[str, str], Float[Tensor, "height width 3"]] = {}
    lines = []
    for (scene, name, views), cells in sorted(best.items()):
        if (scene, name) not in photographs:  # opening a scene takes a while
            photographs[scene, name] = photograph(next(iter(cells.values())), output)
        truth = photographs[scene, name]
        seen = [rendering(cells[method], output) if method in cells else torch.ones_like(truth) for method in methods]
        scores = [str(scores_of(cells[method]["shown"])[0]) if method in cells else "" for method in methods]
        lines.append(Line([f"{scene}, {views} views", *scores], [truth, *seen]))
    if not lines:
        return []
    save_picture(output / SHEET, contact_sheet("Held-out views", ["photograph", *methods], lines), "benchmark")
    return [SHEET]


def photograph(row: Row, output: Path) -> Float[Tensor, "height width 3"]:
    scene = Run(output / row["run"]).scene()
    return scene.photograph(scene.names.index(row["shown"]["name"])).before(scene.frame.background)


def rendering(row: Row, output: Path) -> Float[Tensor, "height width 3"]:
    """A run's rendering of a view, as the evaluation kept it."""
    path = output / row["run"] / "eval" / f"{file_name(row['shown']['name'])}.png"
    return torch.from_numpy(np.array(Image.open(path).convert("RGB"))).float() / 255
