"""A benchmark as Markdown: a short table that averages seeds, and one with a row for each cell and its protocol."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

from .cell import budget_of, duration
from .results import Row

NONE = "–"


def markdown(rows: Sequence[Row], pictures: Sequence[str] = ()) -> str:
    """The whole page. pictures: names of files beside it."""
    measured = [row for row in rows if not row["failed"]]
    parts = ["# Methods side by side", short_table(measured), "\n".join(f"![{name}]({name})" for name in pictures)]
    parts += ["## Every cell", full_table(rows)]
    parts += [
        "PSNR in dB and SSIM are means over held-out views, larger is better; LPIPS (AlexNet), smaller is better. "
        "Training is without compiling, which happens on first use. Memory is the training process's peak, on a GPU "
        "that of its tensors. Published figures follow their own protocols and are no figures of ours."
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def short_table(rows: Sequence[Row]) -> str:
    """One line for cells that differ in their seeds alone."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in in_order(rows):
        groups.setdefault((row["scene"], row["method"], row["train_views"], trained_for(row)), []).append(row)
    columns: dict[str, Callable[[list[Row]], str]] = {
        "method": lambda group: group[0]["method"],
        "scene": lambda group: f"{group[0]['scene']}, {resolution(group[0])}",
        "views": lambda group: str(group[0]["train_views"]),
        "trained for": lambda group: trained_for(group[0]),
        "PSNR": lambda group: spread([row["psnr"] for row in group], ".2f"),
        "SSIM": lambda group: spread([row["ssim"] for row in group], ".3f"),
        "LPIPS": lambda group: spread([row["lpips"] for row in group], ".3f"),
        "s/view": lambda group: f"{statistics.fmean(row['seconds_per_view'] for row in group):.2g}",
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
    "PSNR": lambda row: f"{row['psnr']:.2f}",
    "SSIM": lambda row: f"{row['ssim']:.4f}",
    "LPIPS": lambda row: spread([row["lpips"]], ".4f"),
    "steps": lambda row: str(row["steps"]),
    "training s": lambda row: f"{row['training_seconds']:.1f}",
    "compiling s": lambda row: f"{row['compile_seconds']:.1f}",
    "memory": lambda row: size(row["peak_memory"]),
    "model": lambda row: size(row["model_bytes"]),
    "s/view": lambda row: f"{row['seconds_per_view']:.3g}",
    "trained on": lambda row: row["trained_on"],
    "published PSNR": lambda row: published(row),
}


def full_table(rows: Sequence[Row]) -> str:
    """One line for each cell. One that failed says why where its protocol would stand."""
    lines = []
    for row in in_order(rows):
        figures = [NONE if row["failed"] else value(row) for value in FIGURES.values()]
        how = f"failed: {row['failed']}" if row["failed"] else protocol(row)
        lines.append([*(value(row) for value in CELL.values()), *figures, how])
    return table([*CELL, *FIGURES, "protocol"], lines)


def table(names: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Markdown. Columns that say nothing anywhere are left out."""
    kept = [i for i in range(len(names)) if any(line[i] != NONE for line in lines)]
    shown = [[line[i].replace("|", "/") for i in kept] for line in (names, ["---"] * len(names), *lines)]
    return "\n".join(f"| {' | '.join(line)} |" for line in shown) if lines else ""


def in_order(rows: Sequence[Row]) -> list[Row]:
    def key(row: Row) -> tuple[Any, ...]:
        return row["scene"], row["method"], row.get("train_views", 0), *sorted(row["budget"].items()), row["seed"]

    return sorted(rows, key=key)


def trained_for(row: Row) -> str:
    return duration(budget_of(row["budget"]))


def resolution(row: Row) -> str:
    sizes = row["protocol"]["resolution"]
    return sizes if isinstance(sizes, str) else f"{len(sizes)} sizes"


def published(row: Row) -> str:
    figure = row["published"]
    return f"{figure['psnr']:.2f} at {figure['resolution']}, {figure['source']}" if figure else NONE


def protocol(row: Row) -> str:
    """How the cell was compared, in a few words."""
    how = row["protocol"]
    some = f"{how['views']} of {how['of']} of {how['split']}, evenly spread"
    parts = [resolution(row), f"{how['views']} of {how['split']}" if how["views"] == how["of"] else some]
    if how["background"] is not None:
        known = {(1.0, 1.0, 1.0): "white", (0.0, 0.0, 0.0): "black"}
        colour = tuple(how["background"])
        parts.append(f"{known.get(colour, colour)} background")
    if how["masked"]:
        parts.append("masked")
    return ", ".join(parts)


def spread(values: Sequence[float | None], form: str) -> str:
    """Their mean, and their deviation if there are several."""
    known = [value for value in values if value is not None]
    if not known:
        return NONE
    mean = f"{statistics.fmean(known):{form}}"
    return f"{mean} ± {statistics.stdev(known):{form}}" if len(known) > 1 else mean


def size(bytes_: int) -> str:
    """In MB or GB; nothing if unknown."""
    return NONE if not bytes_ else f"{bytes_ / 1e9:.2f} GB" if bytes_ >= 1e9 else f"{bytes_ / 1e6:.3g} MB"
