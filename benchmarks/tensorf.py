"""TensoRF at the paper's size: where the time of a step goes, and that of a picture.

    python benchmarks/tensorf.py SCENE --rays 1024 4096

A VM-192 grid at 128^3 first learns for a while, so that its occupancy grid knows what is empty: what is timed is what
nearly all steps of a training are like. Each part of a step is then timed by itself on one batch, its gradients
included: the march, the lookup of density, compositing, the lookup of appearance with the basis matrix, the network,
the loss with L1, the optimisers.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lumigraph.datasets.scene import Batch, Scene
from lumigraph.files import write_json
from lumigraph.methods.tensorf import Config, TensoRF
from lumigraph.opening import open_scene
from lumigraph.run import build, processor
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit
from lumigraph.volume import composite, weights_of


@dataclasses.dataclass(frozen=True)
class Options:
    scene: tyro.conf.Positional[str]
    rays: Annotated[tuple[int, ...], tyro.conf.arg(help="Rays of a step.")] = (1024, 4096)
    resolution: int = 128  # nodes per axis
    before: int = 600  # steps of 1024 rays that the grid learns first
    repeats: int = 9  # that medians are taken over
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    device, scene = torch.device(options.device), open_scene(options.scene, downscale=None)
    method = learnt(scene, options, device)
    result: dict[str, float | str] = {
        "processor": processor(device),
        "occupied cells, share": method.occupancy.share,
        **frame(method, scene),
    }
    for rays in options.rays:
        result |= {f"{rays} rays: {name}": value for name, value in step(method, scene, rays, options.repeats).items()}
    for name, value in result.items():
        print(f"{name:52} {value if isinstance(value, str) else f'{value:.4g}'}")
    if options.output:
        write_json(options.output, result)


def learnt(scene: Scene, options: Options, device: torch.device) -> TensoRF:
    """A method that has learnt at one resolution."""
    size = options.resolution
    config = Config(initial_resolution=size, final_resolution=size, rays_per_step=1024, samples_per_step=1 << 22)
    method = build(TensoRF, scene.frame, config, device, 0)
    assert isinstance(method, TensoRF)
    go_on_unless(fit(method, scene, steps=options.before, show=False).signal)
    return method


def step(method: TensoRF, scene: Scene, rays: int, repeats: int) -> dict[str, float]:
    """Seconds of a whole step, and of its parts."""
    method.train()
    generator = torch.Generator().manual_seed(0)
    optimizers = method.optimizers()
    method.rays_per_step.fill_(rays)
    found: dict[str, list[float]] = {}

    def timed(name: str, part: Callable[..., Any], *given: Any) -> Any:
        synchronize(method.device)
        begin = time.perf_counter()
        value = part(*given)
        synchronize(method.device)
        found.setdefault(name, []).append(time.perf_counter() - begin)
        return value

    def whole(batch: Batch) -> None:
        terms = method.loss(batch, 0)
        torch.stack(list(terms.values())).sum().backward()
        descend()

    def descend() -> None:
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    for _ in range(repeats + 1):
        batch = method.batch(scene, generator)
        timed("seconds per step", whole, batch)
        parts(method, batch, timed)
        timed("seconds of optimisers", descend)
    numbers = method.figures
    return {
        "samples of a ray": numbers["samples"] / rays,
        "samples of a ray with colour": numbers["coloured_samples"] / rays,
        **{name: statistics.median(seconds[1:]) for name, seconds in found.items()},
    }


def parts(method: TensoRF, batch: Batch, timed: Callable[..., Any]) -> None:
    """The parts of a step one by one, each with its way back."""
    network, rays = method.network, batch.rays

    def march():
        samples = method.occupancy.sample(rays, method.frame.near, method._step())
        ray = samples.ray_index
        return samples, ray, *method._places(rays.origins[ray] + samples.t[:, None] * rays.directions[ray])

    samples, ray, places, _ = timed("seconds of marching", march)

    def density():
        found = network.density(places)
        found.sum().backward()
        return found.detach()

    density_ = timed("seconds of density", density).requires_grad_()
    coloured = (weights_of(samples, density_.detach()) > method.config.weight_threshold).nonzero()[:, 0]
    at, directions = places[coloured], rays.directions[ray[coloured]]

    def appearance():
        found = network.features(at)
        found.sum().backward()
        return found.detach()

    features = timed("seconds of appearance", appearance).requires_grad_()

    def shade():
        found = network.shade(features, directions)
        found.sum().backward()
        return found.detach()

    rgb = timed("seconds of network", shade).requires_grad_()

    def see():
        spread = rgb.new_zeros(len(samples), 3).index_copy(0, coloured, rgb)
        weights_of(samples, density_.detach())
        composite(samples, density_, spread, method.background).rgb.sum().backward()

    timed("seconds of compositing, twice", see)
    timed("seconds of L1", lambda: network.density_grid.sparsity().backward())


def frame(method: TensoRF, scene: Scene) -> dict[str, float]:
    method.eval()
    camera = scene.cameras[0]
    begin = time.perf_counter()
    method.render(camera)
    synchronize(method.device)
    return {"pixels of a picture": float(camera.size.prod()), "seconds of a picture": time.perf_counter() - begin}


def synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


if __name__ == "__main__":
    main(tyro.cli(Options))
