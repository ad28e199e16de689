"""Each `--preset paper` trained for some hundred steps at reduced size: whether its loss falls.

    python benchmarks/paper_presets.py nerf-w block-nerf --steps 200 --output FILE

Networks, tables, grids and the samples of a ray are the preset's. Smaller are the photographs, the steps, the grid of
empty space, and the rays of a step: about as many as take `evaluations` of the field. A run stops after 85 % of its
steps, ahead of stages that bake a field. It shows means over each fifth of these steps, of the loss and of the PSNR of
the rays it learnt from.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.table import Table

from lumigraph import methods
from lumigraph.components.sampling.hierarchical_sampler import RayNumbers
from lumigraph.files import write_json
from lumigraph.files.ranges import changed, holds
from lumigraph.opening import open_dataset
from lumigraph.run import build, processor
from lumigraph.system.console import console
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

STOP, PARTS = 0.85, 5
OBJECT = "procedural:still-life,size=64,views=40"
SCENES = {  # by method, where that is no object
    "block-nerf": "procedural:city,crossings=2,views=40,size=64",
    "fourier-features": str(Path(__file__).parent.parent / "docs" / "images" / "block-nerf.jpg"),
    "hyp-nerf": "procedural:toys,count=10,size=32,views=10",
    "nerf-w": "procedural:tourists,size=64,views=40",
    "pixelnerf": "procedural:toys,count=10,size=32,views=10",
    "rawnerf": "procedural:night,size=64,views=40",
    "regnerf": "procedural:courtyard,size=64,views=3",
    "srn": "procedural:chairs,count=10,size=32,views=10",
}


@dataclasses.dataclass(frozen=True)
class Options:
    names: tyro.conf.Positional[tuple[str, ...]] = ()  # methods; all by default
    steps: int = 200
    evaluations: int = 8192  # of the field in a step, about
    seed: int = 0
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    output: Path | None = None  # also write the figures there, as JSON


@dataclasses.dataclass
class Notes:
    """Lines of metrics.jsonl, by the trainer's protocol of a watch."""

    rows: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    asked = False

    def give_way(self, stopping: Callable[[], object]) -> None:
        pass

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        self.rows += [row] if row else []


def main(options: Options) -> None:
    result = {}
    table = Table("method", "steps", "s a step", "loss", "PSNR of training rays")
    for name in options.names or methods.available():
        signal, found = trained(name, options)
        result[name] = found
        curves = (" ".join(f"{x:.4g}" for x in found[curve]) for curve in ("loss", "psnr"))
        table.add_row(name, str(found["steps"]), f"{found['seconds_per_step']:.2f}", *curves)
        if options.output:
            write_json(options.output, {"processor": processor(torch.device(options.device)), "methods": result})
        go_on_unless(signal)
    console().print(table)


def trained(name: str, options: Options) -> tuple[int | None, dict[str, Any]]:
    """Train one method: the signal that ended it, if one did; the scene, numbers that differ, and the two curves."""
    kind, device, notes = methods.find(name), torch.device(options.device), Notes()
    source = SCENES.get(name, OBJECT)
    data = open_dataset(source, kind.learns_from)
    numbers = smaller_batch(kind.Config(), options.evaluations)
    method = build(kind, data.frame, changed(kind.Config(), **numbers), device, options.seed, learning=True)
    budget = {"steps": options.steps, "pause_at": int(STOP * options.steps)}
    outcome = fit(method, data, **budget, seed=options.seed, show=False, log_every=1, watch=notes)
    curves = {key: parts([row[key] for row in notes.rows if key in row]) for key in ("loss", "psnr")}
    seconds = outcome.state.seconds / outcome.state.step
    found = {"scene": Path(source).name, "numbers": numbers, "steps": outcome.state.step, "seconds_per_step": seconds}
    return outcome.signal, found | curves


def smaller_batch(config: Any, evaluations: int) -> dict[str, int]:
    """The numbers of a Config that make a step as small as some evaluations of the field."""
    if isinstance(rays := getattr(config, "rays", None), RayNumbers):
        few = {"rays_per_step": max(8, evaluations // (rays.coarse_samples + rays.fine_samples))}
    elif holds(config, "first_march_steps"):
        few = {"rays_per_step": max(8, evaluations // config.march_steps)}
    elif holds(config, "members_per_step"):
        few = {"members_per_step": 1, "rays_per_member": evaluations // 128}
    else:
        few = {"samples_per_step": evaluations, "pixels_per_step": evaluations, "occupancy_resolution": 32}
    few |= {"unseen_patches": 1, "sparsity_points": evaluations}
    return {key: value for key, value in few.items() if holds(config, key)}


def parts(values: list[float]) -> list[float]:
    """Means over equal parts of the values; none of too few."""
    length = len(values) // PARTS
    return [statistics.mean(values[i * length : (i + 1) * length]) for i in range(PARTS)] if length else []


if __name__ == "__main__":
    main(tyro.cli(Options))
