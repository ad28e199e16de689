"""A benchmark as Markdown: a short table that averages seeds, and one with a row for each cell and its protocol."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

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
    return table(columns, list(groups.values()))


def full_table(rows: Sequence[Row]) -> str:
    columns: dict[str, Callable[[Row], str]] = {
        "method": lambda row: row["method"],
        "scene": lambda row: row["scene"],
        "views": lambda row: str(row["train_views"]),
        "trained for": trained_for,
        "seed": lambda row: str(row["seed"]),
        "PSNR": lambda row: f"{row['psnr']:.2f}",
        "SSIM": lambda row: f"{row['ssim']:.4f}",
        "LPIPS": lambda row: NONE if row["lpips"] is None else f"{row['lpips']:.4f}",
        "steps": lambda row: str(row["steps"]),
        "training s": lambda row: f"{row['training_seconds']:.1f}",
        "compiling s": lambda row: f"{row['compile_seconds']:.1f}",
        "memory": lambda row: size(row["peak_memory"]),
        "model": lambda row: size(row["model_bytes"]),
        "s/view": lambda row: f"{row['seconds_per_view']:.3g}",
        "published PSNR": published,
        "protocol": protocol,
        "trained on": lambda row: row["trained_on"],
    }
    return table(columns, in_order(rows))


def table(columns: dict[str, Callable[[Any], str]], entries: Sequence[Any]) -> str:
    """Markdown with a line for each entry. Columns that say nothing anywhere are left out."""
    lines = [[say(entry, name, value) for name, value in columns.items()] for entry in entries]
    kept = [i for i in range(len(columns)) if any(line[i] != NONE for line in lines)]
    shown = [[line[i] for i in kept] for line in [list(columns), ["---"] * len(columns), *lines]]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in shown) if lines else ""


def say(entry: Any, name: str, value: Callable[[Any], str]) -> str:
    """A cell's text. One that failed has no figures, and says why where its protocol would stand."""
    if isinstance(entry, dict) and entry["failed"]:
        known = {"views": str(entry["views"] or "all"), "protocol": f"failed: {entry['failed']}"}
        return known.get(name) or (value(entry) if name in ("method", "scene", "trained for", "seed") else NONE)
    return value(entry)


def in_order(rows: Sequence[Row]) -> list[Row]:
    def key(row: Row) -> tuple[Any, ...]:
        return row["scene"], row["method"], row.get("train_views", 0), *sorted(row["budget"].items()), row["seed"]

    return sorted(rows, key=key)


def trained_for(row: Row) -> str:
    return f"{row['budget']['seconds']:g} s" if "seconds" in row["budget"] else f"{row['budget']['steps']} steps"


def resolution(row: Row) -> str:
    sizes = row["protocol"]["resolution"]
    return sizes if isinstance(sizes, str) else f"{len(sizes)} sizes"


def published(row: Row) -> str:
    figure = row["published"]
    return f"{figure['psnr']:.2f} at {figure['resolution']}, {figure['source']}" if figure else NONE


def protocol(row: Row) -> str:
    """How the cell was compared, in a few words."""
    how = row["protocol"]
    whole = how["views"] == how["of"]
    parts = [resolution(row), f"{how['views']} of {how['split']}" if whole else some(how)]
    if how["background"] is not None:
        known = {(1.0, 1.0, 1.0): "white", (0.0, 0.0, 0.0): "black"}
        colour = tuple(how["background"])
        parts.append(f"{known.get(colour, colour)} background")
    if how["masked"]:
        parts.append("masked")
    return ", ".join(parts)


def some(how: dict[str, Any]) -> str:
    return f"{how['views']} of {how['of']} of {how['split']}, evenly spread"


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
