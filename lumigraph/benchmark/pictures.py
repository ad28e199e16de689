"""A benchmark as pictures: the first score over time and over views, and one held-out view as every method shows it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from .. import files
from ..capture.pictures import readable
from ..evaluation import file_name
from ..figures import Row as Line
from ..figures import contact_sheet, save_picture
from ..figures.charts import line_chart, standalone
from ..metrics import scores_of
from ..run import Run
from .cell import SHEET
from .curves import over_time, over_views, places
from .results import Row
from .table import resolution


def draw_charts(rows: Sequence[Row], output: Path) -> list[str]:
    """Draw what the rows have at least two points of. Returns the names of the files."""
    drawn = []
    for place, found in places([row for row in rows if not row["failed"]]):
        seconds = {row["budget"].get("seconds") for row in found if row["views"] is None}
        headline = scores_of(found[0])[0]
        for name, series, label, ticks in (
            ("time", over_time(found), "seconds of training", () if None in seconds else sorted(seconds)),
            ("views", over_views(found), "photographs to learn from", sorted({row["train_views"] for row in found})),
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
                note=", ".join([*(one.name for one in series if len(series) == 1), place, resolution(found[0])]),
                x_ticks=ticks,
            )
            drawn.append(f"{place}-{headline.name.lower().replace(' ', '-')}-over-{name}.svg")
            files.write_bytes(output / drawn[-1], standalone(chart), "benchmark")
    return drawn


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
    with readable(path), Image.open(path) as image:
        return torch.from_numpy(np.array(image.convert("RGB"))).float() / 255
