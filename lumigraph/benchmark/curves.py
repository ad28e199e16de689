"""A benchmark's first score as curves over time and over photographs, a scene at a time or all members of a collection
together."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from .. import methods
from ..budget import Budget
from ..figures.charts import COLOURS, Series
from ..metrics import scores_of
from .cell import duration
from .results import Row


def together(row: Row) -> str:
    """Key that rows are averaged by: the scene, or the collection that the scene is a member of."""
    return row.get("collection") or row["scene"]


def places(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """The rows of each scene and of each collection's members, by its name."""
    for place in sorted(set(map(together, rows))):
        yield place, [row for row in rows if together(row) == place]


def over_time(rows: Sequence[Row]) -> list[Series]:
    """The first score over seconds of training, from all photographs."""
    return curves([row for row in rows if row["views"] is None], "training_seconds", learnt_for)


def over_views(rows: Sequence[Row]) -> list[Series]:
    """The first score over the number of photographs. Of a collection's members only what all of them have."""
    members = {row["scene"] for row in rows}
    points: dict[tuple[Any, ...], set[str]] = {}
    for row in rows:
        points.setdefault(point_of(row), set()).add(row["scene"])
    return curves([row for row in rows if points[point_of(row)] == members], "train_views", point_of, per=learnt_for)


def point_of(row: Row) -> tuple[str, int, str]:
    return row["method"], row["train_views"], learnt_for(row)


def learnt_for(row: Row) -> str:
    """Budget of a row's cell as text; for a prior's cell, that of the other cells."""
    return duration(Budget.from_json(row["budget"]))


def curves(
    rows: Sequence[Row], x: str, point: Callable[[Row], Any], per: Callable[[Row], Any] = lambda row: ""
) -> list[Series]:
    """The first score over x, a curve for each method. Cells of one point, which differ in their seeds or members
    alone, are their means.

    point: what cells of one point have in common;  per: what else tells curves apart, of one method by their dashes
    """
    groups: dict[tuple[str, Any], dict[Any, list[Row]]] = {}
    for row in rows:
        groups.setdefault((row["method"], per(row)), {}).setdefault(point(row), []).append(row)
    others, drawn = sorted({other for _, other in groups}), colours({method for method, _ in groups})
    series = []
    for (method, other), points in sorted(groups.items()):
        found = sorted(
            (statistics.fmean(row[x] for row in cells), statistics.fmean(scores_of(row)[0].value for row in cells))
            for cells in points.values()
        )
        name = f"{method}, {other}" if len(others) > 1 else method
        x_of, y_of = [at for at, _ in found], [score for _, score in found]
        series.append(Series(name, x_of, y_of, drawn[method], others.index(other)))
    return series


def colours(names: set[str]) -> dict[str, int]:
    """The colour of each method in a chart of these: its own, or the next that is free where another has that."""
    chosen: dict[str, int] = {}
    for name in sorted(names, key=methods.colour):
        own = methods.colour(name) % COLOURS
        free = [own, *(colour for colour in range(COLOURS) if colour not in chosen.values())]
        chosen[name] = free[1] if own in chosen.values() and len(free) > 1 else own
    return chosen
