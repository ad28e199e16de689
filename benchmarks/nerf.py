"""NeRF as the paper has it: a step, a frame, and what skipping empty space keeps and saves.

    python benchmarks/nerf.py speed SCENE              time of a step of 1024 rays and of a frame of 100 x 100
    python benchmarks/nerf.py skipping RUN             the same pictures with the grid and without

`speed` times the paper's network (64 + 128 samples) beside the same mathematics as one would first write it in PyTorch:
`nn.Linear` and `relu` in float32, all samples at once.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from pathlib import Path
from typing import Annotated, Literal
from unittest import mock

import torch
import tyro
from torch import Tensor, nn

from lumigraph.components.fields import layers
from lumigraph.components.fields.coordinate_network import CoordinateNetwork
from lumigraph.components.sampling.hierarchical_sampler import RayNumbers
from lumigraph.components.sampling.occupancy import OccupancyMask
from lumigraph.datasets.scene import Scene
from lumigraph.errors import LumigraphError
from lumigraph.files import write_json
from lumigraph.methods.nerf import Config, NeRF
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene
from lumigraph.run import Run, build, processor

RAYS, SIDE = 1024, 100  # of a step, and of a frame
CELLS, LOOKS = 128, 4  # of the grid, and at each of its cells


@dataclasses.dataclass(frozen=True)
class Options:
    what: tyro.conf.Positional[Literal["speed", "skipping"]]
    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE_OR_RUN")]
    repeats: int = 5  # steps that the median is taken over
    views: int = 5  # held-out views to compare
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    result = speed(options) if options.what == "speed" else skipping(options)
    for name, value in result.items():
        print(f"{name:32} {value if isinstance(value, str) else f'{value:.4g}'}")
    if options.output:
        write_json(options.output, result)


class PlainLayer(nn.Linear):
    """The layer `components.fields.layers.Dense`, without its optimisations."""

    def forward(self, x: Tensor) -> Tensor:
        y = super().forward(x.float())
        return y.relu() if self.relu else y  # type: ignore[attr-defined]


def plain(network: CoordinateNetwork) -> CoordinateNetwork:
    for module in network.modules():
        if isinstance(module, layers.Dense):
            module.exact, module.__class__ = True, PlainLayer  # type: ignore[assignment]
    return network


def speed(options: Options) -> dict[str, float | str]:
    device, scene = torch.device(options.device), open_scene(options.source, downscale=None)
    result: dict[str, float | str] = {"processor": processor(device), "device": str(device)}
    for name in ("ours", "plain"):
        method = build(NeRF, scene.frame, Config(rays=RayNumbers(rays_per_step=RAYS)), device, 0)
        whole = mock.patch.multiple(layers, CHUNK_CPU=1 << 40, CHUNK_GPU=1 << 40)
        if name == "plain":
            for network in (method.network.coarse, method.network):
                plain(network)
            PlainLayer.type_of_products = lambda self, x: torch.float32  # type: ignore[attr-defined]
            whole.start()
        result[f"{name}: seconds per step"] = step_seconds(method, scene, options.repeats)
        result[f"{name}: seconds per frame"] = frame_seconds(method, scene)
        if name == "plain":
            whole.stop()
    for what in ("step", "frame"):
        result[f"ratio per {what}"] = result[f"plain: seconds per {what}"] / result[f"ours: seconds per {what}"]  # type: ignore[operator]
    return result


def step_seconds(method: NeRF, scene: Scene, repeats: int) -> float:
    """Median over steps after a first one."""
    method.train()
    (optimizer,), generator = method.optimizers(), torch.Generator().manual_seed(0)
    seconds = []
    for step in range(repeats + 1):
        batch = method.batch(scene, generator)
        begin = time.perf_counter()
        terms = method.loss(batch, step)
        optimizer.zero_grad(set_to_none=True)
        torch.stack(list(terms.values())).sum().backward()
        optimizer.step()
        synchronize(method.device)
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds[1:])


def frame_seconds(method: NeRF, scene: Scene) -> float:
    method.eval()
    camera = scene.cameras[0]
    camera = camera.resized(SIDE / float(camera.size.float().prod().sqrt()))
    begin = time.perf_counter()
    method.render(camera)
    synchronize(method.device)
    return time.perf_counter() - begin


def skipping(options: Options) -> dict[str, float | str]:
    run = Run(options.source)
    method = run.method(torch.device(options.device))
    if not isinstance(method, NeRF) or method.sampler.empty.cells:
        raise LumigraphError(
            f"{run.folder} is no run of nerf that learnt without a grid, and what a grid rules out is never learnt; "
            f"train one with --preset laptop --occupancy-resolution 0"
        )
    cameras, grid = run.cameras()["test"], OccupancyMask(CELLS).to(method.device)
    whole = method.sampler.empty
    for seed in range(LOOKS):
        grid.grid.update(method.density, grid.thickness, torch.Generator().manual_seed(seed), decay=1.0)
    chosen = torch.linspace(0, len(cameras) - 1, options.views).long().tolist()
    decibels, seconds = [], {"with the grid": 0.0, "without": 0.0}
    for i in chosen:
        seen = []
        for name, empty in zip(seconds, (grid, whole), strict=True):
            method.sampler.empty = empty
            begin = time.perf_counter()
            seen.append(method.render(cameras[i]).rgb.clamp(0, 1))
            synchronize(method.device)
            seconds[name] += (time.perf_counter() - begin) / len(chosen)
        decibels.append(psnr(*seen))
    return {
        "processor": processor(method.device),
        "views": len(chosen),
        "share of cells that hold something": grid.grid.share,
        "PSNR between, mean": statistics.mean(decibels),
        "PSNR between, worst": min(decibels),
        **{f"{name}: seconds per view": value for name, value in seconds.items()},
        "speed-up": seconds["without"] / seconds["with the grid"],
    }


def synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


if __name__ == "__main__":
    main(tyro.cli(Options))
