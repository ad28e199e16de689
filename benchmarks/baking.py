"""What baking costs and what learning on gives back: PSNR before, right after, and in the end; sizes; seconds per view.

    python benchmarks/baking.py plenoctrees SCENE --output FOLDER
    python benchmarks/baking.py snerg SCENE --output FOLDER

Trains a run of `--steps` steps in FOLDER/run, and stops twice on the way: with the field as it was learnt, and one step
later, when it is baked. FOLDER/baking.json holds the figures, FOLDER/baking.png one view at each stop. The same command
goes on where it was interrupted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.camera.rays import Rendering
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.files import is_file, write_json
from lumigraph.lab.benchmark.table import size, table
from lumigraph.opening import open_scene
from lumigraph.run import Run
from lumigraph.run.folder import build
from lumigraph.training import fit

FIELD = {"plenoctrees": "teacher_share", "snerg": "deferred_share"}  # share of the budget in which a field learns


@dataclass(frozen=True)
class Options:
    method: tyro.conf.Positional[Literal["plenoctrees", "snerg"]]
    scene: tyro.conf.Positional[str]
    output: Path
    steps: int = 6000  # of all stages
    views: int = 25  # held-out views to compare
    octree_depth: int | None = None  # of plenoctrees, where it shall not be the preset's
    downscale: int | None = None
    device: str = "cpu"


def main(options: Options) -> None:
    device = torch.device(options.device)
    scene = open_scene(options.scene, downscale=options.downscale)
    kind = methods.find(options.method)
    config = kind.preset(device)
    if options.octree_depth is not None:
        config = replace(config, octree_depth=options.octree_depth)
    folder, budget = options.output / "run", Budget(options.steps, None)
    if not is_file(folder / "config.json"):
        method = build(kind, scene.frame, config, device, 0, learning=True)
        Run.create(folder, method, scene, seed=0, options={"downscale": options.downscale}, budget=budget.to_json())
    run = Run(folder)
    share = getattr(config, FIELD[options.method])
    last = next(step for step in range(options.steps) if budget.progress(step, 0.0) >= share)
    rows, pictures = [], []
    for name, stop in {"field": last, "baked": last + 1, "learnt on": options.steps}.items():
        method = run.new_method(device)
        outcome = fit(method, scene, run, budget=budget, pause_at=stop)
        if outcome.signal:
            return
        row, picture = figures(method, scene, options.views)
        rows.append({"stage": name, "seconds": outcome.state.seconds, **row, "model_bytes": run.model_bytes})
        pictures.append(picture)
        print(rows[-1], flush=True)
    write_json(options.output / "baking.json", rows, "benchmark")
    chosen = scene.splits["test"][0]
    photograph = scene.photograph(int(chosen)).before(scene.frame.background)
    names = ["photograph", *(f"{row['stage']}, {row['psnr']:.2f} dB" for row in rows)]
    save_picture(
        options.output / "baking.png",
        contact_sheet(options.method, names, [Row(scene.names[int(chosen)], [photograph, *pictures])]),
        "benchmark",
    )
    cells = [
        [r["stage"], f"{r['seconds']:.0f}", f"{r['psnr']:.2f}", f"{r['seconds_per_view']:.3f}", size(r["model_bytes"])]
        for r in rows
    ]
    print(table(["stage", "seconds", "PSNR", "s/view", "model"], cells))


def figures(method: Any, scene: Scene, views: int) -> tuple[dict[str, float], torch.Tensor]:
    """Mean PSNR in dB over held-out views, median seconds of a view; and the first of them as rendered."""
    seen: list[torch.Tensor] = []

    def keep(name: str, rendering: Rendering) -> None:
        seen.append(rendering.rgb.clamp(0, 1))

    found = evaluate(method, scene, EvaluationOptions("test", views), keep)
    middle = sorted(view.seconds for view in found.views)[len(found.views) // 2]
    return {"psnr": found.psnr, "seconds_per_view": middle}, seen[0]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
