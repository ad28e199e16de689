"""Rotation errors of canonical fields on procedural objects in random poses, as grids of their shapes and as runs.

    python benchmarks/canonical.py FOLDER

For each category, `--count` members are turned at random. Their density grids are sampled from the shapes themselves,
and `--runs` of them are trained with `--method` as well and go through what `lumigraph canonicalise` does. The table
says how far off each instance then is: by the network; by alignment to the mean shape that begins with what the network
says; by the same that begins with instances taken for the mean shape; and by the best of these, which is what the
command does. All of it up to one rotation for the whole category, for a canonical frame is as good as any other, and up
to the category's symmetry about the vertical (`SYMMETRY`). FOLDER holds the runs, their canonical
files with a picture before and after, and canonical.json with all figures. The same command goes on where it was
stopped.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from canonical_errors import rotation_errors
from torch import Tensor

from lumigraph.commands.cli import main as command
from lumigraph.derive.canonical import PRESETS, Instance, Solution, canonicalise, found_in, sampled, solve
from lumigraph.derive.canonical.canonicalise import best_alignment, best_rotations, described
from lumigraph.derive.canonical.network import found_rotations
from lumigraph.files import write_json
from lumigraph.geometry import evenly
from lumigraph.run.composition import Canonicalised
from lumigraph.synthetic import signed_distance
from lumigraph.synthetic.members import member_stage

# How often a category looks alike on the way around the vertical. Backs tell where a chair's front is. A car's bonnet
# and boot, and the two sides of a toy's face, differ by less than a cell or two of the grids.
SYMMETRY = {"chairs": 1, "toys": 2, "cars": 2}
SOLID = 200.0  # density inside of shapes, per scene unit


@dataclass(frozen=True)
class Options:
    folder: tyro.conf.Positional[Path]
    categories: tuple[str, ...] = tuple(SYMMETRY)
    count: int = 20  # members to learn from as grids, and as many again that the network never saw; 0 for none
    runs: int = 12  # of them, trained; 0 for none
    method: str = "instant-ngp"
    steps: int = 100  # of training each
    cells: int = 40
    preset: Literal["draft", "standard", "thorough"] = "standard"


def main(options: Options) -> None:
    rows = []
    for category in options.categories:
        if options.count:
            rows += of_shapes(category, options)
        if options.runs:
            rows += of_runs(category, options)
    write_json(options.folder / "canonical.json", rows, "benchmark")
    print(table(rows))


def of_shapes(category: str, options: Options) -> list[dict[str, Any]]:
    """Figures of grids sampled from the shapes: of the network, of the mean shape, of members it never saw."""
    learnt, turns = shapes(category, range(options.count), options.cells)
    begin = time.perf_counter()
    solution = solve(learnt, PRESETS[options.preset])
    seconds = time.perf_counter() - begin
    fresh, fresh_turns = shapes(category, range(options.count, 2 * options.count), options.cells)
    unseen = found_rotations(solution.network, fresh)
    return [
        figures(category, "shapes, network alone", solution.predicted, turns),
        figures(category, "shapes, network alone, unseen", unseen, fresh_turns),
        *by_beginnings(category, "shapes", learnt, solution, turns, options),
        figures(category, "shapes", solution.rotations, turns) | {"seconds": round(seconds, 1)},
    ]


def of_runs(category: str, options: Options) -> list[dict[str, Any]]:
    """Figures of trained fields, from the files that the command writes."""
    folder = options.folder / category
    for member in range(options.runs):
        run = folder / f"{category}-{member}"
        if not (run / "config.json").exists():
            scene = f"procedural:{category},member={member},turned=1"
            command(["train", options.method, scene, "--steps", str(options.steps), "--output", str(run)])
    output = options.folder / f"{category}-canonical"
    begin = time.perf_counter()
    found = found_in(folder, options.cells, torch.device("cpu"))
    solution = canonicalise(found, PRESETS[options.preset], output)
    seconds = time.perf_counter() - begin
    turns = torch.stack([turn_of(f"{category},member={one.name.rpartition('-')[2]},turned=1") for one in found])
    to_scene = torch.stack([one.run.frame.to_source.rotation.T for one in found])
    files = [Canonicalised(output / f"{one.name}.json") for one in found]
    written = torch.stack([file.place.rotation for file in files])
    return [
        figures(category, "runs, network alone", solution.predicted, to_scene @ turns),
        *by_beginnings(category, "runs", [one.instance for one in found], solution, to_scene @ turns, options),
        figures(category, "runs", written, to_scene @ turns) | {"seconds": round(seconds, 1)},
    ]


def by_beginnings(
    category: str, what: str, instances: Sequence[Instance], solution: Solution, turns: Tensor, options: Options
) -> Iterator[dict[str, Any]]:
    """Figures of alignments to the mean shape that begin with what the network says alone, and without it."""
    known = described(instances)
    some = evenly(range(len(instances)), PRESETS[options.preset].templates)
    for beginning, starts in (
        ("from the network", [solution.predicted]),
        ("from instances", [best_rotations(known[i], known) for i in some]),
    ):
        begin = time.perf_counter()
        found = best_alignment(known, starts)
        seconds = time.perf_counter() - begin
        row = figures(category, f"{what}, mean shape {beginning}", found.rotations, turns)
        yield row | {"explained": round(found.explained, 4), "seconds": round(seconds, 1)}


def shapes(category: str, members: Sequence[int], cells: int) -> tuple[list[Instance], Tensor]:
    """Members' density grids, and how each was turned."""
    requests = [f"{category},member={member},turned=1" for member in members]
    return [shape(request, cells) for request in requests], torch.stack([turn_of(request) for request in requests])


def shape(request: str, cells: int) -> Instance:
    stage = member_stage(request)
    return sampled(lambda x: SOLID * (signed_distance(stage.world, x) < 0), stage.bounds, cells, request)


def turn_of(request: str) -> Tensor:
    return torch.tensor(member_stage(request).turn, dtype=torch.float64)


def figures(category: str, what: str, rotations: Tensor, turns: Tensor) -> dict[str, Any]:
    found = {"category": category, "what": what, "instances": len(turns)}
    for name, fold in (("symmetric", SYMMETRY[category]), ("plain", 1)):
        errors = rotation_errors(rotations, turns, fold)
        found |= {f"median_{name}": round(float(errors.median()), 2), f"largest_{name}": round(float(errors.max()), 2)}
        found[f"within_10_{name}"] = int((errors <= 10).sum())
    return found


def table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| category | of what | median error | within 10° | largest | symmetry aside: median | within 10° | seconds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for x in rows:
        near, plain = (f"{x[f'within_10_{name}']} of {x['instances']}" for name in ("symmetric", "plain"))
        lines.append(
            f"| {x['category']} | {x['what']} | {x['median_symmetric']:.1f}° | {near} | {x['largest_symmetric']:.0f}° "
            f"| {x['median_plain']:.1f}° | {plain} | {x.get('seconds', '')} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
