"""Benchmark of shapes: scores of each run at each level of detail, and completions of held-out members.

OUTPUT/shapes.json has all figures, OUTPUT/shapes.md the same as tables.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import torch

from ... import files
from ...camera import ring
from ...datasets.shapes import Shape, Shapes
from ...evaluation.completion import Completed, completions
from ...evaluation.shapes import ShapeScore, compare_shapes, surface_of
from ...geometry import evenly
from ...method import Method
from ...method.capabilities import HasLevels, can, needs
from ...run import Run
from .table import NONE, literal, table

FRAME_SIZE, FRAMES = 400, 3  # pixels a side of the pictures that are timed, and how many of them


@dataclass(frozen=True)
class Held:
    """Scores of a run's own shape at a level of detail; level 0 of methods without levels.

    seconds: of training;  bytes: of the model, or of what the level needs;  frame_seconds: of a picture
    """

    run: str
    method: str
    shape: str
    level: int
    score: ShapeScore
    bytes: int
    seconds: float
    frame_seconds: float


@torch.no_grad()
def measure(
    runs: Sequence[Path], members: int, points: int, cells: int, output: Path, tell: Callable[[str], object]
) -> None:
    """Measure trained runs of shapes, and write the tables. members: most held-out members of a collection"""
    held, completed = list[Held](), dict[str, list[Completed]]()
    together: dict[str, list[tuple[str, Method]]] = {}
    opened: dict[str, Shapes] = {}
    for path in runs:
        run = Run(path)
        source = run.settings.scene.source
        if source not in opened:
            opened[source] = cast(Shapes, run.dataset())
        shapes = opened[source]
        if len(shapes) > 1:
            together.setdefault(source, []).append((run.folder.name, run.method()))
            continue
        tell(f"{run.folder.name}: levels of detail")
        held += levels_of(run, shapes, points, cells)
    for source, named in together.items():
        tell(f"{source}: held-out members")
        chosen = evenly(opened[source].splits["test"].tolist(), members)
        completed[source] = list(completions(named, opened[source], chosen, points, cells))
    found = {"held": [asdict(x) for x in held], "completed": {k: [asdict(x) for x in v] for k, v in completed.items()}}
    files.write_json(output / "shapes.json", found, "benchmark")
    files.write_bytes(output / "shapes.md", page(held, completed).encode(), "benchmark")


def levels_of(run: Run, shapes: Shapes, points: int, cells: int) -> Iterable[Held]:
    """A run's shape at each level of detail."""
    method, true = run.method(), shapes.members[0]
    levels = range(1, needs(method, HasLevels).levels + 1) if can(method, HasLevels) else [0]
    for level in levels:
        told = method.given(level=float(level)) if level else method
        told.eval()
        learnt = Shape(true.name, surface_of(told, true.frame, cells), true.frame)
        score = compare_shapes(true, learnt, told, points)
        stored = needs(method, HasLevels).level_bytes(level) if level else run.model_bytes
        seconds = run.state.seconds
        yield Held(
            run.folder.name, run.method_name, score.name, level, score, stored, seconds, frame_time(told, shapes)
        )


def frame_time(method: Method, shapes: Shapes) -> float:
    """Rendering time of a picture in seconds: the least of some, after a first one that compiles."""
    camera = ring(shapes.frame.bounds, size=FRAME_SIZE)[1].to(method.device)
    taken = []
    for _ in range(FRAMES + 1):
        begin = time.perf_counter()
        method.render(camera)
        taken.append(time.perf_counter() - begin)
    return min(taken[1:])


def page(held: Sequence[Held], completed: dict[str, list[Completed]]) -> str:
    """The tables of a benchmark of shapes as Markdown."""
    parts = ["# Shapes side by side"]
    if held:
        names = ["shape", "run", "level", "IoU", "chamfer-L1", "normal consistency", "bytes", "training s", "s/frame"]
        lines = [
            [
                x.shape,
                x.run,
                str(x.level or NONE),
                *figures([x.score]),
                f"{x.bytes:,}",
                f"{x.seconds:.0f}",
                f"{x.frame_seconds:.3f}",
            ]
            for x in held
        ]
        parts += ["## Shapes that were learnt", table(names, lines)]
    for source, found in completed.items():
        groups: dict[tuple[str, str], list[Completed]] = {}
        for one in found:
            groups.setdefault((one.evidence, one.by), []).append(one)
        names = ["evidence", "by", "shapes", "IoU", "chamfer-L1", "normal consistency", "s/shape"]
        lines = [
            [kind, by, str(len(x)), *figures([y.score for y in x]), f"{statistics.fmean(y.seconds for y in x):.2f}"]
            for (kind, by), x in groups.items()
        ]
        parts += [f"## Held-out members of {literal(Path(source).name)}", table(names, lines)]
    parts.append(
        "IoU and normal consistency are better when larger, chamfer-L1 (tenths of the longest side) when smaller. "
        "Retrieval is the training member that fits the evidence best. A half scan is the points and normals that one "
        f"camera sees; 300 points have no normals; pictures of {FRAME_SIZE} x {FRAME_SIZE} are timed."
    )
    return "\n\n".join(parts) + "\n"


def figures(scores: Sequence[ShapeScore]) -> list[str]:
    """Means of IoU, chamfer-L1 and normal consistency, of the scores that have them."""
    columns = ([getattr(x, name) for x in scores] for name in ("iou", "chamfer", "normals"))
    known = ([x for x in column if x is not None] for column in columns)
    return [f"{statistics.fmean(x):.4f}" if x else NONE for x in known]
