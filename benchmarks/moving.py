"""Scenes that move, with their truth: pictures of held-out cameras, what moves alone, and where its points go.

    python benchmarks/moving.py --scene procedural:jelly --size 100 --views 60 --seconds 90
    python benchmarks/moving.py --scene procedural:jelly,rig=6 --views 96 --seconds 90 --methods neural-volumes

Trains each method, its seconds counted in those of processors, because a machine may be busy. Compares views of
held-out cameras at training moments, and between them.
`time-input` is the dynamic field of nsff alone, without any warp: hash tables with time as a fourth input.
PCK is the share of surface points of what moves whose place at another moment is predicted to within 5 % of the
longest side of the box around what moves; of a method without motion it is the share of points that stay. Flow error is
the median end-point error of scene flow to the next training moment, beside the median length of the true flow, scene
units. Each method's strip, OUTPUT/SCENE.png, has the held-out cameras at six moments, below the truth.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor

from lumigraph import methods
from lumigraph import synthetic as procedural
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.figures import to_bytes
from lumigraph.files import write_json
from lumigraph.method import Method
from lumigraph.method.capabilities import HasMotion, can
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.synthetic import SyntheticStage
from lumigraph.synthetic.stage import told
from lumigraph.training import fit, loop

POINTS, PAIRS, NEAR = 400, 12, 0.05  # of a pair of moments; pairs; share of what moves's size
STRIP = 6  # moments
TIME_INPUT = "time-input"


@dataclass(frozen=True)
class Options:
    scene: str = "procedural:jelly"
    methods: tuple[str, ...] = ("instant-ngp", TIME_INPUT, "nerfies", "nsff", "deformable-splatting")
    size: int = 100  # pixels a side
    views: int = 60  # photographs of the moving camera
    seed: int = 0  # of the cameras
    seconds: float | None = None  # processor seconds of training each, or
    steps: int | None = None
    compared: int = 12  # views
    output: Path = Path("moving")


def main(options: Options) -> None:
    request = f"{options.scene},size={options.size},views={options.views},seed={options.seed}"
    asked, name = request.removeprefix("procedural:"), options.scene.removeprefix("procedural:").replace(",", "-")
    kind, numbers = told(procedural.scenes.options(asked.partition(",")[0]), asked)
    stage = procedural.scenes.stage(kind, **{k: v for k, v in vars(numbers).items() if k != "jitter_poses"})
    scene = open_scene(request)
    options.output.mkdir(parents=True, exist_ok=True)
    print(f"{request}: the camera moves {degrees_per_frame(stage):.1f} degrees from a photograph to the next")
    rows, strips = {}, [strip(scene, truth(scene))]
    for method_name in options.methods:
        begin = time.process_time()
        method = made(method_name, scene)
        with mock.patch.object(loop, "time", SimpleNamespace(perf_counter=time.process_time)):
            outcome = fit(
                method, scene, steps=options.steps, seconds=options.seconds, show=False, rehearsal=options.steps is None
            )
        found = evaluate(method, scene, EvaluationOptions(views=options.compared)).to_json()
        rows[method_name] = {
            **{kind: {k: v for k, v in part.items() if v is not None} for kind, part in found["by_held_out"].items()},
            **motion_scores(method, stage, scene),
            "steps": outcome.state.step,
            "processor seconds": time.process_time() - begin,
        }
        strips.append(strip(scene, lambda camera, method=method: method.render(camera).rgb))
        print(method_name, rows[method_name], flush=True)
        Image.fromarray(np.concatenate(strips)).save(options.output / f"{name}-{options.seed}.png")
        write_json(options.output / f"{name}-{options.seed}.json", {"scene": request, "methods": rows})


def made(name: str, scene: Scene) -> Method:
    """A method with its numbers for a plain CPU."""
    kind = methods.find("nsff" if name == TIME_INPUT else name)
    config = kind.cpu_preset()
    if name == TIME_INPUT:
        config = replace(config, static_field=False, flow=replace(config.flow, neighbours=0))
    return build(kind, scene.frame, config, torch.device("cpu"), 0, learning=True)


@torch.no_grad()
def motion_scores(method: Method, stage: SyntheticStage, scene: Scene) -> dict[str, float]:
    """PCK over pairs of training moments, and errors of flow to next ones, of points that a training camera sees."""
    random, cameras = np.random.default_rng(0), stage.cameras["train"]
    count = len(cameras)
    pairs = [random.choice(count, 2, replace=False).tolist() for _ in range(PAIRS)]
    times = sorted(set(cameras.time.tolist()))
    steps = [(i, times[times.index(float(cameras.time[i])) + 1]) for i, _ in pairs if cameras.time[i] < times[-1]]
    far = [displacements(method, stage, scene, i, float(cameras.time[j]), random) for i, j in pairs]
    next_ones = [displacements(method, stage, scene, i, end, random) for i, end in steps]
    near = [(found - goal).norm(dim=-1) < NEAR * size for _, found, goal, size in far]
    errors = torch.cat([(found - goal).norm(dim=-1) for _, found, goal, _ in next_ones])
    lengths = torch.cat([(goal - start).norm(dim=-1) for start, _, goal, _ in next_ones])
    return {
        "PCK": float(torch.cat(near).float().mean()),
        "flow_error": float(errors.median()),
        "flow_length": float(lengths.median()),
    }


def displacements(
    method: Method, stage: SyntheticStage, scene: Scene, image: int, end: float, random: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor, float]:
    """Points of what moves that a camera of training sees, where a method has them at another moment, where they are
    then, and the longest side of the box around them; scene units."""
    assert stage.moving is not None
    camera, to_scene = stage.cameras["train"][image], np.linalg.inv(np.array(scene.frame.source_from_scene))
    now, rays = stage.world_of(camera), camera.rays(camera.pixels())
    seen = procedural.trace(now, rays, shaded=False)
    there = np.flatnonzero(np.isin(seen.identity, stage.moving_things))
    there = random.choice(there, min(POINTS, len(there)), replace=False)
    points = rays.origins.double().numpy()[there] + seen.depth[there, None] * rays.directions.double().numpy()[there]
    expected = now.carried(points, seen.identity[there], stage.moving(end))
    start, goal = (torch.from_numpy(x @ to_scene[:3, :3].T + to_scene[:3, 3]).float() for x in (points, expected))
    found = method.follow(start, float(camera.time), end) if can(method, HasMotion) else start
    return start, found, goal, float((start.amax(0) - start.amin(0)).max())


def truth(scene: Scene) -> Callable:
    return lambda camera: scene.photograph(int(camera.image_index)).before(scene.frame.background)


def strip(scene: Scene, picture: Callable) -> np.ndarray:
    """Held-out views at moments evenly spread, side by side."""
    chosen = np.linspace(0, len(scene.splits["test"]) - 1, STRIP).astype(int)
    cameras = [scene.cameras[int(scene.splits["test"][int(i)])] for i in chosen]
    return np.concatenate([to_bytes(picture(camera)).numpy() for camera in cameras], 1)


def degrees_per_frame(stage: SyntheticStage) -> float:
    """Mean angle, about the origin, from one camera of training to the next."""
    positions = torch.nn.functional.normalize(stage.cameras["train"].position, dim=-1)
    return float((positions[1:] * positions[:-1]).sum(-1).clamp(-1, 1).acos().rad2deg().mean())


if __name__ == "__main__":
    main(tyro.cli(Options))
