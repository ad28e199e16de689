"""Charts as SVG text. Colours come from charts.css, also in stand-alone files, and follow light and dark mode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

WIDTH, HEIGHT = 480, 270
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 30, 40  # margins around the plot
SMOOTHING = 0.06  # share of a curve over which its bold line averages
MAX_CURVE_POINTS = 600  # of a curve that are drawn; more cannot be seen
COLOURS, DASHES = 8, 4  # in charts.css
LETTER_WIDTH, LINE_HEIGHT = 7.2, 18  # width of a letter, about, and height of a line of names
DASH_SAMPLE_WIDTH = 30  # width of the piece of line before the name of a dashed one, with the gap behind it
MIN_LABEL_GAP = 24  # between two numbers below the plot, at least
PLAIN_RANGE = 1e-3, 1e6  # numbers from here to there are written out if all of a chart are
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
STYLE = (Path(__file__).parent / "charts.css").read_text("utf-8")


@dataclass(frozen=True)
class Series:
    """Curve of a chart. colour: its number in charts.css, by default its index;  dash: 0 for an unbroken line"""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    colour: int | None = None
    dash: int = 0


def line_chart(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    log: bool = False,
    log_x: bool = False,
    marks: bool = False,
    smoothed: bool = True,
    note: str = "",
    x_ticks: Sequence[float] = (),
    equal: bool = False,
) -> str:
    """Each series twice: faint as measured, bold as averaged. Empty if no series has two points.

    Two points are two marks: a line between them would suggest values that were not measured.

    log, log_x: of the y and the x axis; values without a logarithm, or not finite, are left out
    marks:      a dot at each point, with its numbers on hovering
    smoothed:   if not, the measured curve alone, bold
    note:       a few words below the plot
    x_ticks:    ticks of the x axis in rising order, instead of round numbers
    equal:      both axes have one scale, as on a map
    """
    kept = [thinned(drawable(coloured(s, i), log_x, log)) for i, s in enumerate(series)]
    kept = [s for s in kept if len(s.x) > (0 if marks else 1)]
    if not kept:
        return ""
    pad, from_zero = 0.04 if marks or equal else 0.0, not (log_x or equal)
    x_axis = spanning([x for s in kept for x in s.x], LEFT, WIDTH - RIGHT, log_x, pad=pad, from_zero=from_zero)
    y_axis = spanning(
        [y for s in kept for y in s.y], HEIGHT - BOTTOM, TOP, log, pad=0.06, outliers=0.02 if smoothed else 0.0
    )
    if equal:
        unit = max(abs((a.high - a.low) / (a.end - a.start)) for a in (x_axis, y_axis))
        x_axis, y_axis = (a.widened(unit * abs(a.end - a.start)) for a in (x_axis, y_axis))
    lines = []
    for measured in kept:
        if lined := len(measured.x) > 2:
            if smoothed:
                lines.append(f"<path class='faint {look(measured)}' d='{path(measured, x_axis, y_axis)}'/>")
            bold = smooth(measured) if smoothed else measured
            lines.append(f"<path class='bold {look(measured)}' d='{path(bold, x_axis, y_axis)}'/>")
        if marks or not lined:
            lines.append(dots(measured, x_axis, y_axis))
    rows = legend_rows([s for s in kept if s.name] if len(kept) > 1 else [], y_label)
    above = LINE_HEIGHT * (len(rows) - 1)
    names = (legend_row(row, 16 - above + LINE_HEIGHT * i) for i, row in enumerate(rows))
    parts = [axes(x_axis, y_axis, x_ticks or x_axis.ticks()), *lines, *names]
    parts.append(f"<text class='label' x='{LEFT}' y='{16 - above}'>{escape(y_label)}</text>")
    parts.append(f"<text class='label' x='{WIDTH - RIGHT}' y='{HEIGHT - 4}' text-anchor='end'>{escape(x_label)}</text>")
    if note:
        parts.append(f"<text x='{LEFT}' y='{HEIGHT - 4}'>{escape(note)}</text>")
    return svg("".join(parts), WIDTH, HEIGHT, above)


def standalone(chart: str) -> bytes:
    """A chart as a stand-alone .svg file with its style, one pixel per unit."""
    opening, _, body = chart.partition(">")
    *_, width, height = opening.split("'")[1].split()
    opening = opening.replace("<svg", f"<svg xmlns='http://www.w3.org/2000/svg' width='{width}' height='{height}'", 1)
    return f"{opening}><style>\n{STYLE}</style>{body}\n".encode()


def bar_chart(names: Sequence[str], values: Sequence[float], label: str, colour: int = 0, unit: str = "dB") -> str:
    """One bar for each value, its name on hovering, and a line at their mean."""
    low, high = min(values), max(values)
    width = 2 * WIDTH
    y_axis = Axis(max(0, math.floor(low - 0.25 * (high - low) - 1)), high + 0.08 * (high - low) + 0.2, 200 - 18, TOP)
    step = (width - LEFT - RIGHT) / len(values)
    bar = min(0.8 * step, 40.0)
    bars = "".join(
        f"<rect class='bar c{colour % COLOURS}' x='{LEFT + (i + 0.5) * step - bar / 2:.1f}' y='{y_axis(value):.1f}' "
        f"width='{bar:.1f}' height='{y_axis.start - y_axis(value):.1f}' rx='1.5'>"
        f"<title>{escape(name)}: {value:.2f} {escape(unit)}</title></rect>"
        for i, (name, value) in enumerate(zip(names, values, strict=True))
    )
    mean = y_axis(sum(values) / len(values))
    marked = ticks(y_axis.low, y_axis.high, 4)
    grid = "".join(
        f"<path class='grid' d='M{LEFT} {y_axis(y):.1f}H{width - RIGHT}'/>"
        f"<text x='{LEFT - 8}' y='{y_axis(y) + 4:.1f}' text-anchor='end'>{written}</text>"
        for y, written in zip(marked, numbers(marked), strict=True)
    )
    line = f"<path class='level' d='M{LEFT} {mean:.1f}H{width - RIGHT}'/>"
    return svg(f"{grid}{bars}{line}<text class='label' x='{LEFT}' y='16'>{escape(label)}</text>", width, 200)


@dataclass(frozen=True)
class Axis:
    """Map from values in [low, high] to positions; low and high are powers of ten on a logarithmic axis."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, value: float) -> float:
        share = ((math.log10(value) if self.log else value) - self.low) / ((self.high - self.low) or 1)
        return self.start + min(max(share, 0), 1) * (self.end - self.start)

    def widened(self, span: float) -> Axis:
        """The axis with another span about the same middle."""
        middle = 0.5 * (self.low + self.high)
        return replace(self, low=middle - 0.5 * span, high=middle + 0.5 * span)

    def ticks(self) -> list[float]:
        """Round values along it."""
        return log_ticks(self.low, self.high) if self.log else ticks(self.low, self.high)


def spanning(
    values: Sequence[float],
    start: float,
    end: float,
    log: bool = False,
    pad: float = 0.0,
    outliers: float = 0.0,
    from_zero: bool = False,
) -> Axis:
    """An axis that spans all values, except for a share of outliers among the lowest.

    pad:       margin beyond them, as a share of their span
    from_zero: begin at zero also if all values are larger
    """
    heights = sorted(math.log10(value) if log else value for value in values)
    low, high = heights[int(outliers * len(heights))], heights[-1]
    room = (pad * (high - low) or 0.5) if pad else 0.0
    return Axis(min(0.0, low) if from_zero else low - room, high + room, start, end, log)


def axes(x_axis: Axis, y_axis: Axis, x_ticks: Sequence[float]) -> str:
    y_ticks, parts, taken = y_axis.ticks(), [], -math.inf
    written = numbers([*y_ticks, *x_ticks])
    for y, name in zip(y_ticks, written, strict=False):
        parts.append(f"<path class='grid' d='M{x_axis.start} {y_axis(y):.1f}H{x_axis.end}'/>")
        parts.append(f"<text x='{LEFT - 8}' y='{y_axis(y) + 4:.1f}' text-anchor='end'>{name}</text>")
    for x, name in zip(x_ticks, written[len(y_ticks) :], strict=True):
        if x_axis(x) - taken >= MIN_LABEL_GAP:
            taken = x_axis(x)
            parts.append(f"<text x='{taken:.1f}' y='{HEIGHT - BOTTOM + 18}' text-anchor='middle'>{name}</text>")
    return "".join(parts)


def coloured(series: Series, place: int) -> Series:
    """The series with a default colour by index."""
    return replace(series, colour=(place if series.colour is None else series.colour) % COLOURS)


def look(series: Series) -> str:
    """CSS classes of its line, as in charts.css."""
    return f"c{series.colour}" + (f" dash{series.dash % DASHES}" if series.dash else "")


def letters(series: Series) -> float:
    """Width of a series' name in a legend, in letters, including the line sample of a dashed one."""
    return len(series.name) + (DASH_SAMPLE_WIDTH / LETTER_WIDTH if series.dash else 0)


def legend_rows(series: Sequence[Series], label: str) -> list[list[Series]]:
    """Names in rows: the first row is right of the label, and empty unless all fit there."""
    room = (WIDTH - RIGHT - LEFT) / LETTER_WIDTH
    rows: list[list[Series]] = [[]]
    if len(label) + sum(letters(s) + 2 for s in series) > room:
        rows.append([])
    for s in series:
        if rows[-1] and sum(letters(other) + 2 for other in rows[-1]) + letters(s) > room:
            rows.append([])
        rows[-1].append(s)
    return rows


def legend_row(row: Sequence[Series], y: float) -> str:
    parts, x = [], float(WIDTH - RIGHT)
    for s in reversed(row):
        parts.append(f"<text class='name c{s.colour}' x='{x:.0f}' y='{y}' text-anchor='end'>{escape(s.name)}</text>")
        x -= LETTER_WIDTH * letters(s)
        if s.dash:
            parts.append(f"<path class='sample {look(s)}' d='M{x:.0f} {y - 4}h{DASH_SAMPLE_WIDTH - 6}'/>")
        x -= 14
    return "".join(parts)


def path(series: Series, x_axis: Axis, y_axis: Axis) -> str:
    return "M" + "L".join(f"{x_axis(x):.1f} {y_axis(y):.1f}" for x, y in zip(series.x, series.y, strict=True))


def dots(series: Series, x_axis: Axis, y_axis: Axis) -> str:
    return "".join(
        f"<circle class='dot c{series.colour}' cx='{x_axis(x):.1f}' cy='{y_axis(y):.1f}' r='3.2'>"
        f"<title>{escape(series.name)}: {x:.4g}, {y:.4g}</title></circle>"
        for x, y in zip(series.x, series.y, strict=True)
    )


def svg(body: str, width: int = WIDTH, height: int = HEIGHT, above: int = 0) -> str:
    """SVG of a body. above: margin over the picture's origin, added to its height"""
    return f"<svg viewBox='0 {-above} {width} {height + above}' role='img'>{body}</svg>"


def ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers between two values: multiples of 1, 2 or 5 times a power of ten."""
    span = (high - low) or 1.0
    power = 10 ** math.floor(math.log10(span / about))
    step = next((f * power for f in (1, 2, 5, 10) if span / (f * power) <= about), 10 * power)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float, about: int = 8) -> list[float]:
    """Round numbers between two powers of ten: powers of ten, thinned out if many, with twos and fives if few."""
    every = max(1, math.ceil((high - low) / about))
    factors = (1,) if high - low > 2 else (1, 2, 5)
    powers = range(math.floor(low), math.ceil(high) + 1)
    marks = [f * 10.0**power for power in powers if power % every == 0 for f in factors]
    marks = [mark for mark in marks if low - 1e-9 <= math.log10(mark) <= high + 1e-9]
    return marks if len(marks) > 1 else [x for x in ticks(10**low, 10**high) if x > 0]


def numbers(values: Sequence[float]) -> list[str]:
    """Axis labels of values, all in full, or all by powers of ten if one is too small or large."""
    low, high = PLAIN_RANGE
    if all(not value or low <= abs(value) < high for value in values):
        return [f"{value:.6g}" for value in values]
    return [by_powers(value) for value in values]


def by_powers(value: float) -> str:
    """3e-05 as 3×10⁻⁵, and 1e-05 as 10⁻⁵."""
    if not value:
        return "0"
    digits, _, exponent = f"{value:.5e}".partition("e")
    power = "10" + str(int(exponent)).translate(SUPERSCRIPTS)
    factor = f"{float(digits):g}"
    return power if factor == "1" else f"{factor}×{power}"


def drawable(series: Series, log_x: bool, log: bool) -> Series:
    """The points that have a position on both axes."""
    kept = [
        (x, y)
        for x, y in zip(series.x, series.y, strict=True)
        if math.isfinite(x) and math.isfinite(y) and (x > 0 or not log_x) and (y > 0 or not log)
    ]
    return replace(series, x=[x for x, _ in kept], y=[y for _, y in kept])


def thinned(series: Series) -> Series:
    every = -(-len(series.x) // MAX_CURVE_POINTS)
    return replace(series, x=series.x[::every], y=series.y[::every])


def smooth(series: Series) -> Series:
    """Trailing moving average, shorter at the beginning."""
    reach = max(1, round(SMOOTHING * len(series.y)))
    means = []
    for i in range(len(series.y)):
        window = series.y[max(0, i - min(reach, i // 2)) : i + 1]
        means.append(sum(window) / len(window))
    return replace(series, y=means)
