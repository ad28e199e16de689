"""How near compositing comes to closed forms, and the order in which it converges.

    python benchmarks/compositing.py
    python benchmarks/compositing.py --pictures docs/images

Each medium of benchmarks/media.py, asked at the middle of each sample and at its left end, by the reference in float64
and by the engine of this machine's CPU in float32. Errors are the largest of a channel: of the colour, and of its
derivative when the whole density is scaled. The order is the slope of log error over log step; where compositing is
exact there is none, for only rounding is left. In float32 rounding shows from errors of 1e-6 on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from media import LENGTH, MEDIA, RULES, Medium, errors, exponential_ramp, order

from lumigraph import kernels
from lumigraph.camera.rays import Samples
from lumigraph.figures.charts import Series, line_chart, standalone
from lumigraph.files import write_bytes, write_json
from lumigraph.volume import weights_of

ENGINES = {"reference": torch.float64, "cpu": torch.float32}
ROUNDING = {"reference": 1e-13, "cpu": 1e-5}  # an error below this at the fewest samples is no error of sampling


@dataclass(frozen=True)
class Options:
    samples: tuple[int, ...] = (16, 64, 256)
    output: Path = Path(__file__).parent / "results" / "compositing.json"
    pictures: Path | None = None  # a folder for the two charts of docs/volume_rendering.md


def main(options: Options) -> None:
    rows = [measured(engine, m, rule, options.samples) for engine in ENGINES for m in MEDIA for rule in RULES]
    for engine, dtype in ENGINES.items():
        print(f"\n{engine}, {str(dtype).removeprefix('torch.')}\n")
        print(table([row for row in rows if row["engine"] == engine], options.samples))
    write_json(options.output, {"samples": options.samples, "length": LENGTH, "rows": rows})
    if options.pictures:
        write_bytes(options.pictures / "convergence.svg", standalone(convergence()))
        write_bytes(options.pictures / "ramp.svg", standalone(pieces(exponential_ramp())))


def measured(engine: str, medium: Medium, rule: str, samples: tuple[int, ...]) -> dict[str, Any]:
    with kernels.using(engine):
        colour, gradient = zip(*(errors(medium, n, rule, ENGINES[engine]) for n in samples), strict=True)
    row: dict[str, Any] = {"engine": engine, "medium": medium.name, "asked at": rule}
    for name, found in (("colour", colour), ("gradient", gradient)):
        exact = found[0] < ROUNDING[engine]
        row[name] = {"errors": found, "order": None if exact else order([LENGTH / n for n in samples], found)}
    return row


def table(rows: list[dict[str, Any]], samples: tuple[int, ...]) -> str:
    each = " | ".join([f"n = {samples[0]}", *map(str, samples[1:]), "order"])
    lines = [f"| medium | asked at | colour, {each} | gradient, {each} |", "|---" * (2 * len(samples) + 4) + "|"]
    for row in rows:
        cells = [row["medium"], row["asked at"]]
        for found in (row["colour"], row["gradient"]):
            cells += [f"{error:.1e}" for error in found["errors"]]
            cells.append("exact" if found["order"] is None else f"{found['order']:.2f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def convergence() -> str:
    """Error of the colour against the number of samples."""
    counts = [2**k for k in range(2, 11)]
    *_, within, ramp = MEDIA
    curves = [("ramp, midpoint", ramp, "midpoint"), ("ramp, left end", ramp, "left end")]
    curves.append(("edge in a sample", within, "midpoint"))
    with kernels.using("reference"):
        series = [Series(name, counts, [errors(medium, n, rule)[0] for n in counts]) for name, medium, rule in curves]
    return line_chart(series, "samples", "error", log=True, log_x=True, marks=True, smoothed=False)


def pieces(medium: Medium, n: int = 8) -> str:
    """How much each stretch of a ray adds to what the eye sees: the integrand T sigma, and w / delta of n samples."""
    fine = torch.linspace(0, LENGTH, 401, dtype=torch.float64)
    sigma = medium.density(fine)
    T = torch.exp(-torch.cumulative_trapezoid(sigma, fine, dim=0))
    T = torch.nn.functional.pad(T, (1, 0), value=1.0)
    edges = torch.linspace(0, LENGTH, n + 1, dtype=torch.float64)
    samples = Samples(edges[:-1], edges[1:], torch.tensor([0, n]))
    with kernels.using("reference"):
        height = weights_of(samples, medium.density(samples.t)) / samples.length
    series = [
        Series("T", fine.tolist(), T.tolist()),
        Series("T σ", fine.tolist(), (T * sigma).tolist()),
        Series(f"w / δ, {n} samples", edges.repeat_interleave(2)[1:-1].tolist(), height.repeat_interleave(2).tolist()),
    ]
    return line_chart(series, "distance t", medium.name, smoothed=False)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
