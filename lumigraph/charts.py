"""Charts as SVG text. Colours come from the page's style sheet, so that they follow its light and dark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 480, 270
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 30, 40  # margins around the plot
SMOOTHING = 0.06  # share of a curve over which its bold line averages
POINTS = 600  # of a curve that are drawn; more cannot be seen


@dataclass(frozen=True)
class Series:
    name: str
    x: Sequence[float]
    y: Sequence[float]


def line_chart(series: Sequence[Series], x_label: str, y_label: str, log: bool = False) -> str:
    """Each series twice: faint as measured, bold as averaged. log: of the y axis; values at or below 0 are left out."""
    kept = [positive(s) for s in series] if log else list(series)
    kept = [thinned(s) for s in kept if len(s.x) > 1]
    if not kept:
        return ""
    means = [smooth(s) for s in kept]
    x_axis = Axis(0, max(max(s.x) for s in kept), LEFT, WIDTH - RIGHT)
    heights = sorted(math.log10(y) if log else y for s in kept for y in s.y)
    low, high = heights[len(heights) // 50], heights[-1]
    pad = 0.06 * (high - low) or 0.5
    y_axis = Axis(low - pad, high + pad, HEIGHT - BOTTOM, TOP)
    lines = []
    for i, (measured, mean) in enumerate(zip(kept, means, strict=True)):
        lines.append(f"<path class='measured c{i % 4}' d='{path(measured, x_axis, y_axis, log)}'/>")
        lines.append(f"<path class='mean c{i % 4}' d='{path(mean, x_axis, y_axis, log)}'/>")
    names = legend([s.name for s in kept]) if len(kept) > 1 else ""
    y_ticks = log_ticks(y_axis) if log else [(y, number(y)) for y in ticks(y_axis.low, y_axis.high)]
    return svg(axes(x_axis, y_axis, y_ticks, x_label, y_label) + "".join(lines) + names)


def bar_chart(names: Sequence[str], values: Sequence[float], label: str) -> str:
    """One bar for each value, its name on hovering, and a line at their mean."""
    low, high = min(values), max(values)
    width = 2 * WIDTH
    y_axis = Axis(max(0, math.floor(low - 0.25 * (high - low) - 1)), high + 0.08 * (high - low) + 0.2, 200 - 18, TOP)
    step = (width - LEFT - RIGHT) / len(values)
    bar = min(0.8 * step, 40.0)
    bars = "".join(
        f"<rect class='bar' x='{LEFT + (i + 0.5) * step - bar / 2:.1f}' y='{y_axis(value):.1f}' width='{bar:.1f}' "
        f"height='{y_axis.start - y_axis(value):.1f}' rx='1.5'><title>{escape(name)}: {value:.2f} dB</title></rect>"
        for i, (name, value) in enumerate(zip(names, values, strict=True))
    )
    mean = y_axis(sum(values) / len(values))
    grid = "".join(
        f"<path class='grid' d='M{LEFT} {y_axis(y):.1f}H{width - RIGHT}'/>"
        f"<text x='{LEFT - 8}' y='{y_axis(y) + 4:.1f}' text-anchor='end'>{number(y)}</text>"
        for y in ticks(y_axis.low, y_axis.high, 4)
    )
    line = f"<path class='level' d='M{LEFT} {mean:.1f}H{width - RIGHT}'/>"
    return svg(f"{grid}{bars}{line}<text class='label' x='{LEFT}' y='16'>{escape(label)}</text>", width, 200)


@dataclass(frozen=True)
class Axis:
    """Values from low to high lie between two positions."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        share = (value - self.low) / ((self.high - self.low) or 1)
        return self.start + min(max(share, 0), 1) * (self.end - self.start)


def axes(x_axis: Axis, y_axis: Axis, y_ticks: Sequence[tuple[float, str]], x_label: str, y_label: str) -> str:
    parts = []
    for y, text in y_ticks:
        parts.append(f"<path class='grid' d='M{x_axis.start} {y_axis(y):.1f}H{x_axis.end}'/>")
        parts.append(f"<text x='{LEFT - 8}' y='{y_axis(y) + 4:.1f}' text-anchor='end'>{text}</text>")
    for x in ticks(x_axis.low, x_axis.high):
        parts.append(f"<text x='{x_axis(x):.1f}' y='{HEIGHT - BOTTOM + 18}' text-anchor='middle'>{number(x)}</text>")
    parts.append(f"<text class='label' x='{WIDTH - RIGHT}' y='{HEIGHT - 4}' text-anchor='end'>{escape(x_label)}</text>")
    parts.append(f"<text class='label' x='{LEFT}' y='16'>{escape(y_label)}</text>")
    return "".join(parts)


def legend(names: Sequence[str]) -> str:
    parts, x = [], float(WIDTH - RIGHT)
    for i, name in reversed(list(enumerate(names))):
        parts.append(f"<text class='c{i % 4}' x='{x:.0f}' y='16' text-anchor='end'>{escape(name)}</text>")
        x -= 7.2 * len(name) + 14
    return "".join(parts)


def path(series: Series, x_axis: Axis, y_axis: Axis, log: bool) -> str:
    points = (
        f"{x_axis(x):.1f} {y_axis(math.log10(y) if log else y):.1f}" for x, y in zip(series.x, series.y, strict=True)
    )
    return "M" + "L".join(points)


def svg(body: str, width: int = WIDTH, height: int = HEIGHT) -> str:
    return f"<svg viewBox='0 0 {width} {height}' role='img'>{body}</svg>"


def ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers between two values: multiples of 1, 2 or 5 times a power of ten."""
    span = (high - low) or 1.0
    power = 10 ** math.floor(math.log10(span / about))
    step = next((f * power for f in (1, 2, 5, 10) if span / (f * power) <= about), 10 * power)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(axis: Axis) -> list[tuple[float, str]]:
    """Positions (as logarithms) and names: powers of ten, with twos and fives between if there are few."""
    span = range(math.floor(axis.low), math.ceil(axis.high) + 1)
    factors = (1,) if axis.high - axis.low > 2 else (1, 2, 5)
    marks = [(math.log10(f) + power, f"{f * 10.0**power:g}") for power in span for f in factors]
    return [(y, name) for y, name in marks if axis.low <= y <= axis.high]


def number(value: float) -> str:
    for size, prefix in ((1e6, " M"), (1e4, " k")):
        if abs(value) >= size:
            return f"{value / (1e3 if prefix == ' k' else size):g}{prefix}"
    return f"{value:.6g}"


def positive(series: Series) -> Series:
    kept = [(x, y) for x, y in zip(series.x, series.y, strict=True) if y > 0]
    return Series(series.name, [x for x, _ in kept], [y for _, y in kept])


def thinned(series: Series) -> Series:
    every = -(-len(series.x) // POINTS)
    return Series(series.name, series.x[::every], series.y[::every])


def smooth(series: Series) -> Series:
    """A moving mean that follows from behind, shorter where there is little behind."""
    reach = max(1, round(SMOOTHING * len(series.y)))
    means = []
    for i in range(len(series.y)):
        window = series.y[max(0, i - min(reach, i // 2)) : i + 1]
        means.append(sum(window) / len(window))
    return Series(series.name, series.x, means)
