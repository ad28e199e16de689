"""How near compositing comes to closed forms, and the order in which it converges.

    python benchmarks/compositing.py

Each medium of benchmarks/media.py, asked at the middle of each sample and at its left end, by the reference in float64
and by the engine of this machine's CPU in float32. Errors are the largest of a channel: of the colour, and of its
derivative when the whole density is scaled. The order is the slope of log error over log step; where compositing is
exact there is none, for only rounding is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from media import LENGTH, MEDIA, RULES, errors, order

from lumigraph import kernels
from lumigraph.files import write_json

ENGINES = {"reference": torch.float64, "cpu": torch.float32}
ROUNDING = {"reference": 1e-13, "cpu": 1e-5}  # an error below this at the fewest samples is no error of sampling


@dataclass(frozen=True)
class Options:
    samples: tuple[int, ...] = (16, 64, 256)
    output: Path = Path(__file__).parent / "results" / "compositing.json"


def main(options: Options) -> None:
    rows = [
        row
        for engine in ENGINES
        for medium in MEDIA
        for rule in RULES
        for row in measured(engine, medium, rule, options.samples)
    ]
    for engine, dtype in ENGINES.items():
        print(f"\n{engine}, {str(dtype).removeprefix('torch.')}\n")
        print(table([row for row in rows if row["engine"] == engine], options.samples))
    write_json(options.output, {"samples": options.samples, "length": LENGTH, "rows": rows})


def measured(engine: str, medium, rule: str, samples: tuple[int, ...]) -> list[dict]:
    """One row for the colour, one for its derivative."""
    with kernels.using(engine):
        both = zip(*(errors(medium, n, rule, ENGINES[engine]) for n in samples), strict=True)
    about = {"engine": engine, "medium": medium.name, "asked at": rule}
    return [
        {
            **about,
            "of": name,
            "errors": found,
            "order": order([LENGTH / n for n in samples], found) if found[0] > ROUNDING[engine] else None,
        }
        for name, found in zip(("colour", "gradient"), both, strict=True)
    ]


def table(rows: list[dict], samples: tuple[int, ...]) -> str:
    lines = ["| medium | asked at | of | " + " | ".join(f"n = {n}" for n in samples) + " | order |"]
    lines.append("|---" * (len(samples) + 4) + "|")
    for row in rows:
        found = " | ".join(f"{error:.1e}" for error in row["errors"])
        power = "exact" if row["order"] is None else f"{row['order']:.2f}"
        lines.append(f"| {row['medium']} | {row['asked at']} | {row['of']} | {found} | {power} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
