"""How well methods find poses that were jittered, and what that is worth: exact poses, jittered ones, refined ones.

    python benchmarks/pose_refinement.py --scenes still-life courtyard --seeds 0 1 --output poses.json

For each scene it says first where poses are that points which photographs share tell, before any scene is learnt. Then
each method is trained four times: on `procedural:SCENE`, on `procedural:SCENE,jitter_poses=2` as if its poses were
right, on the same with `refine_cameras`, and with `match_photographs` too. Errors of rotation and position are medians
over training photographs, after alignment; PSNR is of held-out views, whose poses are refined too where training ones
were (Lin 2021, section 5.1). Steps rather than seconds, so that a busy machine changes nothing.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.table import Table

from lumigraph import methods
from lumigraph.components.training.pose_refinement import PoseRefinement
from lumigraph.datasets.alignment import moves
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.views import evaluate
from lumigraph.figures import save_picture
from lumigraph.files import write_json
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.system.console import console
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

STEPS = {"nerf": 4000, "mip-nerf": 4000, "instant-ngp": 2500, "gaussian-splatting": 3000}
POSES = ("exact", "jittered", "refined", "matched")


@dataclass(frozen=True)
class Options:
    methods: tuple[str, ...] = ("nerf", "instant-ngp", "gaussian-splatting")
    scenes: tuple[str, ...] = ("still-life", "courtyard")  # of `procedural:`
    seeds: tuple[int, ...] = (0,)
    poses: tuple[str, ...] = POSES
    jitter: int = 2  # degrees, and percent of the extent
    size: int = 200  # of the pictures, pixels
    views: int = 30
    steps: dict[str, int] = field(default_factory=lambda: dict(STEPS))  # of training, by method
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    sheets: Path | None = None  # folder for contact sheets
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    rows = []
    for scene in options.scenes:
        for seed in options.seeds:
            rows.append(found(scene, seed, options))
            for name in options.methods:
                rows += [trained(name, scene, seed, poses, options) for poses in options.poses]
                show(rows)
                if options.output:
                    write_json(options.output, rows)


def trained(name: str, scene: str, seed: int, poses: str, options: Options) -> dict[str, Any]:
    """Train a method on a scene's exact or jittered poses, or refine the latter, and compare with what is known."""
    jitter = "" if poses == "exact" else f",jitter_poses={options.jitter}"
    data = opened(scene, seed, jitter, options)
    device, kind = torch.device(options.device), methods.find(name)
    config = replace(kind.preset(device), seed=seed, refine_cameras=poses in ("refined", "matched"))
    config = replace(config, match_photographs=poses == "matched")
    method = build(kind, data.frame, config, device, seed)
    outcome = fit(method, data, steps=options.steps[name], seed=seed)
    go_on_unless(outcome.signal)
    evaluation = evaluate(method, data)
    if options.sheets:
        title = f"{name} · {scene} · {poses} poses · {evaluation.psnr:.2f} dB"
        save_picture(options.sheets / f"{name}-{scene}-{seed}-{poses}.png", evaluation.contact_sheet(title))
    row = {"method": name, "scene": scene, "seed": seed, "poses": poses, "steps": outcome.state.step}
    row |= {"seconds": outcome.state.seconds, "protocol": evaluation.protocol["poses"]}
    return row | {score.name: score.value for score in evaluation.scores}


def found(scene: str, seed: int, options: Options) -> dict[str, Any]:
    """Where poses are that points which photographs share tell, before any method learns."""
    data = opened(scene, seed, f",jitter_poses={options.jitter}", options)
    begin, poses = time.perf_counter(), PoseRefinement(data.frame.image_count)
    poses.find(data)
    seconds, learnt = time.perf_counter() - begin, data.splits["train"]
    to_scene = data.frame.to_source.inverse
    truth = replace(data.cameras, pose=data.about["true_pose"]).transformed(to_scene.matrix)[learnt]
    turned, shifted = moves(poses.refined(data.cameras[learnt]), truth, data.frame).median
    row = {"method": "none", "scene": scene, "seed": seed, "poses": "found", "steps": 0, "seconds": seconds}
    return row | {"rotation error": turned, "position error": shifted}


def opened(scene: str, seed: int, jitter: str, options: Options) -> Scene:
    data = open_scene(f"procedural:{scene},size={options.size},views={options.views},seed={seed}{jitter}")
    assert isinstance(data, Scene)
    return data


def show(rows: list[dict[str, Any]]) -> None:
    table = Table("method", "scene", "seed", "poses", "PSNR, dB", "rotation error, °", "position error, %", "s")
    for row in rows:
        errors = (f"{row[name]:.3f}" if name in row else "" for name in ("rotation error", "position error"))
        cells = (
            row["method"],
            row["scene"],
            str(row["seed"]),
            row["poses"],
            f"{row['PSNR']:.2f}" if "PSNR" in row else "",
            *errors,
        )
        table.add_row(*cells, f"{row['seconds']:.0f}")
    console(width=120).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
