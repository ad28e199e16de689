"""Figure of one ray: samples, density, transmittance, weights and the accumulated colour, over distance."""

import base64
import math
from html import escape

import torch
from jaxtyping import Float
from torch import Tensor

from ...color.tags import srgb_bytes
from ...figures import to_image
from ...figures.charts import Axis, numbers, svg
from .ray import RayPass, Sight, triple

WIDTH, LEFT, RIGHT = 988, 64, 700  # of the whole, and where the axis of distance begins and ends
SIDE, RIGHT_EDGE = 730, 970  # of the column beside it
TOP, STRIP, PANEL, LANE, GAP = 70, 26, 104, 16, 42  # heights
MAX_DECADES = 5  # of density that are shown at most
PIECES_PER_SAMPLE = 8  # straight pieces that the curve of transmittance has within a sample
STYLE = """<style>
.thin { stroke: currentColor; stroke-width: 1; }
svg path.filled { fill: currentColor; fill-opacity: 0.2; }
.edge { stroke: var(--faint); stroke-width: 0.5; stroke-opacity: 0.7; }
.frame { fill: none; stroke: var(--line); }
.patch { shape-rendering: crispEdges; }
.depth { stroke: var(--ink); stroke-dasharray: 3 4; }
svg text.symbol { font: italic 15px Georgia, "DejaVu Serif", serif; }
</style>"""


def ray_figure(sight: Sight, title: str) -> str:
    """Figure as SVG text; `charts.standalone` makes a file of it."""
    last, x, passes = sight.passes[-1], distances(sight), coloured(sight)
    heights = [STRIP, PANEL, PANEL, *(PANEL for _ in passes), STRIP]
    tops = [TOP + sum(heights[:i]) + GAP * i for i in range(len(heights))]
    colours, density, transmittance, *weights, so_far = tops
    lanes = so_far + STRIP + 20
    axis = lanes + LANE * len(passes) + 4

    parts = [STYLE, f"<text class='label' x='{LEFT}' y='26'>{escape(title)}</text>"]

    parts.append(caption(colours, "c", f"colour of each {called(last, sight)}"))
    glowing = last.density > 0  # what is empty has no colour
    found = zip(*(column[glowing] for column in (last.start, last.end, last.rgb)), strict=True)
    parts += [patch(x, colours, a, b, c) for a, b, c in found]
    parts.append(inset(sight, colours))

    y = density_axis(sight, density + PANEL, density)
    parts.append(caption(density, "σ", "density, per scene unit") + scale(y))
    parts += [skyline(each, x, y, f"{stroke} {'filled' if each is last else ''}") for each, stroke in passes]

    y = Axis(0, 1, transmittance + PANEL, transmittance)
    parts.append(caption(transmittance, "T", "transmittance: light that comes through all in front") + scale(y))
    parts += [curve(falling_light(each, x), x, y, stroke) for each, stroke in passes]
    left = float(last.transmittance[-1])
    parts.append(beside(transmittance, "Tᵢ = exp(−Σ σⱼ δⱼ),  j < i", f"T = {left:.2g} behind the last sample"))

    for top, (each, _) in zip(weights, passes, strict=True):
        y = Axis(0, 1.08 * max(float(each.weight.max()), 1e-3), top + PANEL, top)
        parts.append(caption(top, "w", f"weight of each {called(each, sight)}, in its colour") + scale(y))
        parts += [bar(x, y, i, each) for i in range(len(each))]
    parts.append(beside(weights[-1], "wᵢ = Tᵢ (1 − exp(−σᵢ δᵢ))", f"Σ wᵢ = {sight.opacity:.4f}, the opacity"))

    parts.append(caption(so_far, "C", "colour so far, with the background behind it"))
    bounds = [x.low, *last.start.tolist(), x.high]
    parts += [patch(x, so_far, a, b, c) for a, b, c in zip(bounds[:-1], bounds[1:], last.so_far, strict=True)]
    parts.append(f"<rect class='frame' x='{LEFT}' y='{so_far}' width='{RIGHT - LEFT}' height='{STRIP}'/>")
    parts.append(ends(sight, so_far))

    for i, (each, stroke) in enumerate(passes):
        parts.append(lane(each, x, lanes + LANE * i, stroke))
    parts.append(f"<path class='grid' d='M{LEFT} {axis}H{RIGHT}'/>")
    for value, written in zip(x.ticks(), numbers(x.ticks()), strict=True):
        parts.append(f"<text x='{x(value):.1f}' y='{axis + 18}' text-anchor='middle'>{written}</text>")
    parts.append(f"<text class='label' x='{RIGHT}' y='{axis + 40}' text-anchor='end'>distance, scene units</text>")
    parts.append(expected_depth(sight, x, [(top, top + height) for top, height in zip(tops, heights, strict=True)]))
    return svg("".join(parts), WIDTH, axis + 52)


def distances(sight: Sight) -> Axis:
    """Axis from the first sample of all passes to the last, with a margin; an unbounded sample is truncated."""
    start, end = (torch.cat([getattr(each, name) for each in sight.passes]) for name in ("start", "end"))
    near, far, last = float(start.min()), float(end.max()), float(start.max())
    if far - last > 2 * (last - near) > 0:
        far = last + 0.1 * (last - near)
    room = 0.04 * (far - near)
    return Axis(max(0.0, near - room), far + room, LEFT, RIGHT)


def density_axis(sight: Sight, bottom: float, top: float) -> Axis:
    """Logarithmic axis, over the last decades below the highest density."""
    found = torch.cat([each.density for each in sight.passes])
    found = found[found > 0]
    if not len(found):
        return Axis(-1, 1, bottom, top, log=True)
    high = math.ceil(math.log10(float(found.max())) + 0.05)
    low = max(high - MAX_DECADES, math.floor(math.log10(float(found.min()))))
    return Axis(min(low, high - 1), high, bottom, top, log=True)


def falling_light(each: RayPass, x: Axis) -> list[tuple[float, float]]:
    """Points of the transmittance's curve, which falls exponentially within each sample and is constant elsewhere."""
    points = [(x.low, 1.0)]
    for i, (a, b, sigma) in enumerate(columns(each, "density")):
        T = float(each.transmittance[i])
        points += [
            (a + s * (b - a), T * math.exp(-sigma * s * (b - a)))
            for s in (k / PIECES_PER_SAMPLE for k in range(PIECES_PER_SAMPLE + 1))
        ]
    return [*points, (x.high, float(each.transmittance[-1]))]


def columns(each: RayPass, name: str) -> list[tuple[float, float, float]]:
    """Begin, end and a quantity of every sample."""
    return list(zip(each.start.tolist(), each.end.tolist(), getattr(each, name).tolist(), strict=True))


def coloured(sight: Sight) -> list[tuple[RayPass, str]]:
    """Passes with their line style: the last always in the first colour, and bold."""
    last = len(sight.passes) - 1
    return [(each, f"{'bold' if i == last else 'thin'} c{last - i}") for i, each in enumerate(sight.passes)]


def called(each: RayPass, sight: Sight) -> str:
    return f"{each.name} sample" if len(sight.passes) > 1 else "sample"


def caption(top: float, symbol: str, words: str) -> str:
    return (
        f"<text class='label symbol' x='{LEFT}' y='{top - 9}'>{symbol}</text>"
        f"<text x='{LEFT + 18}' y='{top - 9}'>{escape(words)}</text>"
    )


def beside(top: float, equation: str, words: str) -> str:
    """Equation and words in the side column, halfway down a panel."""
    return (
        f"<text class='label symbol' x='{SIDE}' y='{top + PANEL / 2}'>{escape(equation)}</text>"
        f"<text x='{SIDE}' y='{top + PANEL / 2 + 20}'>{escape(words)}</text>"
    )


def scale(y: Axis) -> str:
    lines = []
    for value, written in zip(y.ticks(), numbers(y.ticks()), strict=True):
        lines.append(f"<path class='grid' d='M{LEFT} {y(value):.1f}H{RIGHT}'/>")
        lines.append(f"<text x='{LEFT - 10}' y='{y(value) + 4:.1f}' text-anchor='end'>{written}</text>")
    return "".join(lines)


def skyline(each: RayPass, x: Axis, y: Axis, kind: str) -> str:
    """Density as a step curve, constant over each sample, zero elsewhere."""
    d, before = "", None
    for a, b, value in columns(each, "density"):
        if not value:
            continue
        if before is None or a - before > 1e-4 * (x.high - x.low):
            d += f"{'' if before is None else f'V{y.start}'}M{x(a):.2f} {y.start}"
        d, before = d + f"V{y(value):.1f}H{x(b):.2f}", b
    return f"<path class='{kind}' d='{d}V{y.start}'/>" if d else ""


def curve(points: list[tuple[float, float]], x: Axis, y: Axis, kind: str) -> str:
    return f"<path class='{kind}' d='M{'L'.join(f'{x(a):.2f} {y(b):.2f}' for a, b in points)}'/>"


def bar(x: Axis, y: Axis, i: int, each: RayPass) -> str:
    """A weight, with its numbers on hovering."""
    a, b, weight = columns(each, "weight")[i]
    return (
        f"<rect class='edge' x='{x(a):.2f}' y='{y(weight):.1f}' width='{x(b) - x(a):.2f}' "
        f"height='{y.start - y(weight):.1f}' fill='{hex_of(each.rgb[i])}'><title>{a:.4g} to {b:.4g}: "
        f"density {float(each.density[i]):.4g}, weight {weight:.4f}</title></rect>"
    )


def patch(x: Axis, top: float, begin: Tensor | float, end: Tensor | float, rgb: Float[Tensor, " 3"]) -> str:
    a, b = x(float(begin)), x(float(end))
    return f"<rect class='patch' x='{a:.2f}' y='{top}' width='{b - a:.2f}' height='{STRIP}' fill='{hex_of(rgb)}'/>"


def lane(each: RayPass, x: Axis, top: float, kind: str) -> str:
    """A tick in the middle of each sample."""
    ticks = "".join(f"M{x((a + b) / 2):.2f} {top}v10" for a, b, _ in columns(each, "weight"))
    colour = kind.split()[-1]
    return (
        f"<text class='name {colour}' x='{LEFT - 10}' y='{top + 9}' text-anchor='end'>{escape(each.name)}</text>"
        f"<path class='thin {colour}' d='{ticks}'/>"
    )


def expected_depth(sight: Sight, x: Axis, spans: list[tuple[float, float]]) -> str:
    if not math.isfinite(sight.depth):
        return ""
    at = x(sight.depth)
    label = min(max(at, LEFT + 260), RIGHT - 70)
    return (
        f"<path class='depth' d='{''.join(f'M{at:.1f} {top - 4}V{bottom + 4}' for top, bottom in spans)}'/>"
        f"<text class='label' x='{label:.1f}' y='{spans[0][0] - 9}' text-anchor='middle'>"
        f"expected depth {sight.depth:.4g}</text>"
    )


def inset(sight: Sight, top: float) -> str:
    """The whole picture, small, with the pixel marked."""
    (width, height), (column, row) = sight.size, sight.pixel
    shrunk = (RIGHT_EDGE - SIDE) / max(width, height)
    at_x, at_y = SIDE + (column + 0.5) * shrunk, top + (row + 0.5) * shrunk
    ring = f"cx='{at_x:.1f}' cy='{at_y:.1f}' r='7' fill='none'"
    return (
        f"<text x='{SIDE}' y='{top - 9}'>rendering, {width} × {height}</text>"
        f"<image x='{SIDE}' y='{top}' width='{width * shrunk:.1f}' height='{height * shrunk:.1f}' "
        f"preserveAspectRatio='none' href='{png(sight.picture)}'/>"
        f"<circle {ring} stroke='#000' stroke-width='4'/><circle {ring} stroke='#fff' stroke-width='2'/>"
        f"<circle cx='{at_x:.1f}' cy='{at_y:.1f}' r='1.2' fill='#fff'/>"
    )


def ends(sight: Sight, top: float) -> str:
    """Ends of the strip: its final colour, and the photograph's colour."""
    parts = [f"<text class='label symbol' x='{SIDE}' y='{top + STRIP + 42}'>C = Σ wᵢ cᵢ + T background</text>"]
    for i, (name, rgb) in enumerate((("pixel", sight.rgb), ("photograph", sight.photograph))):
        if rgb is not None:
            left = SIDE + 122 * i
            parts.append(
                f"<text x='{left}' y='{top - 9}'>{name}</text>"
                f"<rect class='edge' x='{left}' y='{top}' width='110' height='{STRIP}' fill='{hex_of(rgb)}'/>"
                f"<text x='{left}' y='{top + STRIP + 18}'>{triple(rgb)}</text>"
            )
    return "".join(parts)


def hex_of(rgb: Float[Tensor, " 3"]) -> str:
    return "#" + bytes((rgb.clamp(0, 1) * 255).round().to(torch.uint8).tolist()).hex()


def png(picture: Float[Tensor, "height width 3"]) -> str:
    return f"data:image/png;base64,{base64.b64encode(srgb_bytes(to_image(picture), optimize=True)).decode()}"
