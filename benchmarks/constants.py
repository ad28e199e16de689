"""Held-out PSNR with the constants of `--preset paper`, and with those that it had before they were compared with the
papers and their releases.

    python benchmarks/constants.py [nerf-w rawnerf ...] --steps 200 --output FILE

Scenes are small, networks narrow, and a step evaluates its field equally often before and after. RegNeRF is also
trained without its terms. All constants are options of `lumigraph train METHOD --preset paper`. FILE keeps the figures
of other methods from earlier commands.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.table import Table

from lumigraph import methods
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.files import read_json, write_json
from lumigraph.files.ranges import changed
from lumigraph.opening import open_dataset
from lumigraph.run import build, processor
from lumigraph.system.console import console
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

VIEWS = 4  # held-out photographs
OBJECT = "procedural:still-life,size=64"


@dataclasses.dataclass(frozen=True)
class Change:
    """A scene, with the numbers that make all rows small, those of the row before and those of the row after.

    without: those of a further row, without what the paper adds
    """

    scene: str
    smaller: dict[str, Any]
    before: dict[str, Any]
    after: dict[str, Any] = dataclasses.field(default_factory=dict)
    without: dict[str, Any] = dataclasses.field(default_factory=dict)
    views: int | None = None

    @property
    def rows(self) -> dict[str, dict[str, Any]]:
        rows = {"before": self.before, "after": self.after}
        return rows | ({"without": self.after | self.without} if self.without else {})


CHANGES = {
    "block-nerf": Change(
        "procedural:city,crossings=2,views=30,size=24",
        {"hidden_width": 32, "visibility_width": 16},
        {"coarse_samples": 128, "fine_samples": 128, "rays_per_step": 24, "head_layers": 1, "head_width": 32}
        | {"learning_rate": 1e-3, "final_learning_rate": 1e-5, "warmup_steps": 20},
        {"rays_per_step": 8, "head_width": 16, "warmup_steps": 1},
    ),
    "nerf-w": Change(
        "procedural:tourists,size=24,views=30",
        {"hidden_width": 32, "transient_width": 16},
        {"coarse_samples": 64, "fine_samples": 64, "rays_per_step": 48},
        {"rays_per_step": 6},
    ),
    "rawnerf": Change(
        "procedural:night,size=64,views=40",
        {"samples_per_step": 8192, "occupancy_resolution": 32, "log2_hashmap_size": 15},
        {"huber_delta": 1.0},
    ),
    # The error before was a mean over channels and had half of eq. 6. In units of the sum its weights are these.
    "regnerf": Change(
        OBJECT,
        {"hidden_width": 64, "rays_per_step": 24, "unseen_patches": 1},
        {"depth_weight_start": 15.0, "depth_weight": 0.15, "depth_settling": 0.05, "likelihood_weight": 3e-3}
        | {"annealing": 0.01, "warmup": 0.0025, "density_noise": 0.0, "gradient_clip": 0.0},
        without={"unseen_patches": 0, "likelihood_weight": 0.0},
        views=3,
    ),
    "snerg": Change(
        OBJECT,
        {"samples_per_step": 8192, "occupancy_resolution": 32, "rays_per_step": 1024}
        | {"resolution": 96, "visibility_resolution": 32, "deferred_share": 0.9},
        {"hidden_width": 64, "huber_delta": 0.1, "sparsity_weight": 1e-4},
        {"hidden_width": 128},
    ),
}


@dataclasses.dataclass(frozen=True)
class Options:
    names: tyro.conf.Positional[tuple[str, ...]] = tuple(CHANGES)
    steps: int = 200
    seed: int = 0
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    known = options.output is not None and options.output.exists()
    found: dict[str, Any] = read_json(options.output)["methods"] if known else {}
    table = Table("method", "scene", "constants", "PSNR", "SSIM", "halves")
    for name in options.names:
        change = CHANGES[name]
        data = open_dataset(change.scene, methods.find(name).learns_from, views=change.views)
        found[name] = {"scene": change.scene, "views": change.views, "steps": options.steps, "seed": options.seed}
        for row, numbers in change.rows.items():
            scores = held_out(name, data, change.smaller | numbers, options)
            found[name][row] = {"numbers": numbers} | scores
            table.add_row(name, change.scene, row, *(str(scores[x]) for x in ("psnr", "ssim", "halves")))
            if options.output:
                write_json(options.output, {"processor": processor(torch.device("cpu")), "methods": found}, ours=known)
    console().print(table)


def held_out(name: str, data: Any, numbers: dict[str, Any], options: Options) -> dict[str, Any]:
    """Train one method with the numbers in place of the paper's, and evaluate it on held-out photographs."""
    kind = methods.find(name)
    config = changed(kind.Config(), **numbers)
    method = build(kind, data.frame, config, torch.device("cpu"), options.seed, learning=True)
    go_on_unless(fit(method, data, steps=options.steps, seed=options.seed, show=False).signal)
    scores = evaluate(method, data, EvaluationOptions(views=VIEWS))
    return {"psnr": round(scores.psnr, 2), "ssim": round(scores.ssim, 3), "halves": scores.protocol["halves"]}


if __name__ == "__main__":
    main(tyro.cli(Options))
