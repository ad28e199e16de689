"""A benchmark as Markdown and curves: a table that averages seeds, one with a row for each cell, scores over time."""

import re
import statistics
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from ... import methods
from ...budget import Budget
from ...evaluation.halves import LEFT_HALVES
from ...evaluation.views import CAPTURED_POSES
from ...figures.charts import COLOURS, Series
from ...metrics import named, scores_of
from ...run.records import compared_kind
from .cell import MEMBERS, Row, duration
from .published import FEW_VIEWS

NONE = "–"


def markdown(rows: Sequence[Row], pictures: Sequence[str] = ()) -> str:
    """Page of a benchmark. pictures: names of files beside it"""
    measured = [row for row in rows if not row["failed"]]
    charts = "\n".join(f"![{name}]({name})" for name in pictures)
    parts = ["# Methods side by side", few_photographs(measured), short_table(measured), charts]
    parts += [
        "## Every cell",
        full_table(rows),
        "PSNR in dB and SSIM are means over held-out views, larger is better; LPIPS (AlexNet), smaller is better. "
        "Of shapes, IoU and normal consistency are better when larger, chamfer-L1 (tenths of the longest side) when "
        "smaller. Where a method of a scene finds codes of photographs on their left halves, all methods of that scene "
        "are compared on right halves; poses that were refined are found on left halves of held-out photographs. "
        "Training is without compiling, which happens on first use. Memory is the training process's peak, "
        "on a GPU that of its tensors. Published figures follow their own protocols and are no figures of ours.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def few_photographs(rows: Sequence[Row]) -> str:
    """For each scene or collection a line per method and a column per number of photographs, with published figures
    below; empty if all cells were trained on all photographs."""
    parts = []
    for place, found in places(rows):
        if all(row["views"] is None for row in found):
            continue
        numbers = sorted({row["train_views"] for row in found})
        lines = []
        for one in over_views(found):
            known = dict(zip(one.x, one.y, strict=True))
            lines.append([one.name, *(f"{known[n]:.2f}" if n in known else NONE for n in numbers)])
        scenes = len({row["scene"] for row in found})
        members = "one held-out member" if scenes == 1 else f"{scenes} held-out members"
        of_what = f"{members} of {place.removesuffix(MEMBERS)}" if place.endswith(MEMBERS) else place
        names = ["photographs", *map(str, numbers)]
        parts += [f"{scores_of(found[0])[0].name} of {of_what}, {resolution(found[0])}:", table(names, lines)]
    if not parts:
        return ""
    told = few_view_results()
    return "\n\n".join(["## How many photographs", *parts, "Published results, each by its own protocol:", told])


def short_table(rows: Sequence[Row]) -> str:
    """One line for cells that differ only in seeds, or in members of one collection."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in in_order(rows):
        groups.setdefault((together(row), row["method"], row["train_views"], trained_for(row)), []).append(row)
    columns: dict[str, Callable[[list[Row]], str]] = {
        "method": lambda group: group[0]["method"],
        "scene": lambda group: ", ".join(part for part in (together(group[0]), resolution(group[0])) if part),
        "views": lambda group: str(group[0]["train_views"]),
        "trained for": lambda group: trained_for(group[0]),
        **{name: partial(mean_score, name) for name in score_names(rows)},
        **{name: partial(shared, value) for name, value in PROTOCOL.items()},
        "s/view": lambda group: spread([row.get("seconds_per_view") for row in group[:1]], ".2g"),
        "memory": lambda group: size(max(row["peak_memory"] for row in group)),
        "model": lambda group: size(max(row["model_bytes"] for row in group)),
        "published PSNR": lambda group: published(group[0]),
    }
    return table([*columns], [[value(group) for value in columns.values()] for group in groups.values()])


CELL: dict[str, Callable[[Row], str]] = {
    "method": lambda row: row["method"],
    "scene": lambda row: row["scene"],
    "views": lambda row: str(row.get("train_views") or row["views"] or "all"),
    "trained for": lambda row: trained_for(row),
    "seed": lambda row: str(row["seed"]),
}
FIGURES: dict[str, Callable[[Row], str]] = {
    "steps": lambda row: str(row["steps"]),
    "training s": lambda row: f"{row['training_seconds']:.1f}",
    "compiling s": lambda row: f"{row['compile_seconds']:.1f}",
    "memory": lambda row: size(row["peak_memory"]),
    "model": lambda row: size(row["model_bytes"]),
    "s/view": lambda row: spread([row.get("seconds_per_view")], ".3g"),
    "trained on": lambda row: row["trained_on"],
    "published PSNR": lambda row: published(row),
}


def halves(row: Row) -> str:
    """Compared pixels of photographs."""
    if "views" not in row["protocol"]:
        return NONE
    how = row["protocol"].get("halves")
    return "whole" if not how else "right, codes from left" if how == LEFT_HALVES else "right"


def poses(row: Row) -> str:
    """Origin of the cameras of the compared photographs."""
    how = row["protocol"].get("poses")
    return NONE if not how else "as captured" if how == CAPTURED_POSES else "refined"


PROTOCOL: dict[str, Callable[[Row], str]] = {"halves": halves, "poses": poses}


def shared(value: Callable[[Row], str], group: list[Row]) -> str:
    """Common value of rows; all values if they differ."""
    return " / ".join(dict.fromkeys(map(value, group)))


def full_table(rows: Sequence[Row]) -> str:
    """One line for each cell. A failed one has the reason in the column of its protocol."""
    names = score_names([row for row in rows if not row["failed"]])
    columns: dict[str, Callable[[Row], str]] = {name: partial(score_in, name) for name in names} | FIGURES | PROTOCOL
    lines = []
    for row in in_order(rows):
        figures = [NONE if row["failed"] else value(row) for value in columns.values()]
        how = f"failed: {row['failed']}" if row["failed"] else protocol(row)
        lines.append([*(value(row) for value in CELL.values()), *figures, how])
    return table([*CELL, *columns, "protocol"], lines)


def table(names: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table, without empty columns."""
    kept = [i for i in range(len(names)) if any(line[i] != NONE for line in lines)]
    shown = [[literal(line[i]) for i in kept] for line in (names, ["---"] * len(names), *lines)]
    return "\n".join(f"| {' | '.join(line)} |" for line in shown) if lines else ""


def literal(text: str) -> str:
    """Text escaped for Markdown."""
    return re.sub(r"([\\`*\[\]<>|])", r"\\\1", text)


def in_order(rows: Sequence[Row]) -> list[Row]:
    def key(row: Row) -> tuple[Any, ...]:
        return row["scene"], row["method"], row.get("train_views", 0), *sorted(row["budget"].items()), row["seed"]

    return sorted(rows, key=key)


def trained_for(row: Row) -> str:
    """Budget of a cell as text, or the name of its prior."""
    return f"by {row['prior']}" if row.get("prior") else learnt_for(row)


def few_view_results() -> str:
    """Table of published results from few photographs."""
    lines = [[x.method, x.value, str(x.views), f"{x.data}, {x.protocol}", x.measured_by, x.source] for x in FEW_VIEWS]
    return table(["method", "PSNR", "photographs", "protocol", "measured by", "source"], lines)


def resolution(row: Row) -> str:
    sizes = row["protocol"].get("resolution", "")
    return sizes if isinstance(sizes, str) else f"{len(sizes)} sizes"


def published(row: Row) -> str:
    figure = row["published"]
    return f"{figure['psnr']:.2f} at {figure['resolution']}, {figure['source']}" if figure else NONE


def protocol(row: Row) -> str:
    """Protocol of the cell's evaluation, in a few words."""
    how = row["protocol"]
    count = how[compared_kind(how)]
    some = f"{count} of {how['of']} of {how['split']}, evenly spread"
    parts = [resolution(row), f"{count} of {how['split']}" if count == how["of"] else some]
    if how.get("background") is not None:
        known = {(1.0, 1.0, 1.0): "white", (0.0, 0.0, 0.0): "black"}
        colour = tuple(how["background"])
        parts.append(f"{known.get(colour, colour)} background")
    if how.get("masked"):
        parts.append("masked")
    return ", ".join(part for part in parts if part)


def score_names(rows: Sequence[Row]) -> list[str]:
    """The names of all scores that some row has, the headline of the first row first."""
    return list(dict.fromkeys(score.name for row in in_order(rows) for score in scores_of(row)))


def score_in(name: str, row: Row) -> str:
    score = named(scores_of(row), name)
    return f"{score.value:.{score.digits}f}" if score else NONE


def mean_score(name: str, group: list[Row]) -> str:
    """The mean and deviation of a score, in at most three digits after the point."""
    found = [score for row in group if (score := named(scores_of(row), name))]
    return spread([score.value for score in found], f".{min(found[0].digits, 3)}f") if found else NONE


def spread(values: Sequence[float | None], form: str) -> str:
    """The mean of some numbers, and their deviation if there are several."""
    known = [value for value in values if value is not None]
    if not known:
        return NONE
    mean = f"{statistics.fmean(known):{form}}"
    return f"{mean} ± {statistics.stdev(known):{form}}" if len(known) > 1 else mean


def size(bytes_: int) -> str:
    """A size in MB or GB as text; empty if unknown."""
    return NONE if not bytes_ else f"{bytes_ / 1e9:.2f} GB" if bytes_ >= 1e9 else f"{bytes_ / 1e6:.3g} MB"


def together(row: Row) -> str:
    """Key of averaging rows: the scene, or its collection."""
    return row.get("collection") or row["scene"]


def places(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """The rows of each scene and of each collection's members, by its name."""
    for place in sorted(set(map(together, rows))):
        yield place, [row for row in rows if together(row) == place]


def over_time(rows: Sequence[Row]) -> list[Series]:
    """The first score over seconds of training, from all photographs."""
    return curves([row for row in rows if row["views"] is None], "training_seconds", learnt_for)


def over_views(rows: Sequence[Row]) -> list[Series]:
    """The first score over the number of photographs. For a collection only numbers common to all members."""
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
    """The first score over x, a curve for each method. Points are means over seeds and members.

    point: key of a point;  per: key of a curve beside the method, shown by dashes
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
    """Colour of each method in a chart: its own, or the next free one if taken."""
    chosen: dict[str, int] = {}
    for name in sorted(names, key=methods.colour):
        own = methods.colour(name) % COLOURS
        free = [own, *(colour for colour in range(COLOURS) if colour not in chosen.values())]
        chosen[name] = free[1] if own in chosen.values() and len(free) > 1 else own
    return chosen
