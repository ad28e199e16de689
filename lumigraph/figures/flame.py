"""Flame graphs as SVG text (Gregg 2016): each bar is a span of time, below it the spans inside it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from html import escape

from .charts import COLOURS, LETTER_WIDTH, svg

WIDTH, ROW_HEIGHT, GAP = 1200, 20, 1  # of the picture, of a bar, between bars, in pixels
MIN_WIDTH = 0.5  # pixels of a bar that is drawn
PADDING = 4  # pixels between a bar's edge and its name


@dataclass
class Span:
    """A named span of time with the spans inside it. value: in `unit`; kind: number of its colour in charts.css"""

    name: str
    value: float
    kind: int = 0
    inside: list[Span] = field(default_factory=list)


def flame_graph(root: Span, unit: str, legend: tuple[str, ...] = ()) -> str:
    """The spans as bars from left to right, largest first, those inside a span below it. legend: names of the kinds"""
    scale = WIDTH / root.value
    bars = list(placed(root, 0.0, 1))
    depth = max(row for _, _, row in bars)
    drawn = (
        bar(span, scale * left, scale * span.value, row, span.value / root.value, unit) for span, left, row in bars
    )
    names = "".join(
        f"<text class='name c{i % COLOURS}' x='{PADDING + 150 * i}' y='14'>{escape(name)}</text>"
        for i, name in enumerate(legend)
    )
    return svg(names + "".join(drawn), WIDTH, (depth + 1) * ROW_HEIGHT + GAP)


def placed(span: Span, left: float, row: int) -> Iterator[tuple[Span, float, int]]:
    """A span and all inside it, each with the value at its left edge and its row."""
    yield span, left, row
    for one in sorted(span.inside, key=lambda x: -x.value):
        yield from placed(one, left, row + 1)
        left += one.value


def bar(span: Span, left: float, width: float, row: int, share: float, unit: str) -> str:
    """One bar with the name if it fits; name, value and share on hovering."""
    if width < MIN_WIDTH:
        return ""
    letters = int((width - 2 * PADDING) / LETTER_WIDTH)
    name = span.name if len(span.name) <= letters else span.name[: letters - 1] + "…" if letters > 2 else ""
    y = row * ROW_HEIGHT
    return (
        f"<g><title>{escape(span.name)}: {span.value:.3g} {escape(unit)}, {100 * share:.1f} %</title>"
        f"<rect class='bar c{span.kind % COLOURS}' x='{left:.1f}' y='{y}' width='{width - GAP:.1f}' "
        f"height='{ROW_HEIGHT - GAP}' rx='1.5'/>"
        f"<text class='label' x='{left + PADDING:.1f}' y='{y + 14}'>{escape(name)}</text></g>"
    )
