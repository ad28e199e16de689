"""How long a step of Gaussian splatting takes, and a frame; each part by itself.

    python benchmarks/splatting.py --scene PHOTOS --downscale 4 --splats FILE

Steps: the cloud begins at the scene's sparse points and grows while it learns; medians are taken around given sizes.
Frames: a splat file seen by a ring of cameras, 800 x 800 pixels.
On a GPU: a random cloud at 1920 x 1080, forward and backward, beside the package gsplat where that is installed.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
import tyro
from rich.table import Table

from lumigraph import kernels, methods
from lumigraph.components.clouds import cloud_method
from lumigraph.files import write_json
from lumigraph.files.ranges import changed
from lumigraph.gaussians import Gaussians, splatting
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.run.files import SplatFile
from lumigraph.system.console import console

PARTS = ("batch", "forward and loss", "backward", "optimiser", "after")


@dataclasses.dataclass(frozen=True)
class Options:
    scene: Path | None = None  # photographs with poses and sparse points
    downscale: int | None = None
    sizes: tuple[int, ...] = (13_000, 20_000, 30_000)  # Gaussians around which steps are timed
    splats: Path | None = None  # a splat file
    gaussians: int = 1_000_000  # of the random cloud on a GPU
    repeats: int = 40
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    result: dict = {"threads": torch.get_num_threads(), "torch": torch.__version__, "device": str(device)}
    if options.scene:
        result["steps"] = steps(options, device)
    if options.splats:
        result["frames"] = frames(options, device)
    if device.type == "cuda":
        result["gpu"] = beside_gsplat(options, device)
        console().print(result["gpu"])
    if options.output:
        write_json(options.output, result)


def steps(options: Options, device: torch.device) -> list[dict]:
    """Milliseconds of each part of a training step, at several sizes of the cloud."""
    scene, kind = open_scene(str(options.scene), downscale=options.downscale), methods.find("gaussian-splatting")
    cloud_method.SH_DEGREE_INTERVAL = 1  # all bands are in use
    config = changed(kind.preset(device), half_resolution_until=0.0, max_gaussians=2 * max(options.sizes))
    method = build(kind, scene.frame, config, device, 0)
    optimizers, generator = method.optimizers(), torch.Generator().manual_seed(0)
    method.begin(scene)
    width, height = scene.cameras.size[0].tolist()
    table = Table("Gaussians", *PARTS, "all", title=f"A step at {width} x {height}: median milliseconds")
    rows, step = [], 0

    def one() -> list[float]:
        nonlocal step
        method.progress = min(0.4, step / 10_000)
        method.before_step(step, method.progress)
        marks = [clock(device)]
        batch = method.batch(scene, generator)
        marks.append(clock(device))
        loss = torch.stack(list(method.loss(batch, step).values())).sum()
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=True)
        marks.append(clock(device))
        loss.backward()
        marks.append(clock(device))
        for optimizer in optimizers:
            optimizer.step()
        marks.append(clock(device))
        method.after_step(step)
        marks.append(clock(device))
        step += 1
        return [1e3 * (b - a) for a, b in zip(marks, marks[1:], strict=False)]

    for _ in range(5):
        one()
    for size in options.sizes:
        while len(method.cloud) < 0.97 * size and step < 5000:
            one()
        times = [one() for _ in range(options.repeats)]
        medians = [statistics.median(column) for column in zip(*times, strict=True)]
        whole = statistics.median(sum(row) for row in times)
        rows.append({"gaussians": len(method.cloud), **dict(zip(PARTS, medians, strict=True)), "all": whole})
        table.add_row(f"{len(method.cloud):,}", *(f"{x:.1f}" for x in [*medians, whole]))
    console().print(table)
    return rows


def frames(options: Options, device: torch.device) -> list[dict]:
    """Milliseconds of each part of a frame, without gradients: median over the cameras around a file."""
    file = SplatFile(options.splats)
    cloud, cameras = file.method(device).gaussians(), file.cameras()["train"]
    names = ("project", "tile", "rasterise", "all")
    times: dict[str, list[float]] = {name: [] for name in names}
    with torch.no_grad():
        for i in range(-3, len(cameras)):
            view = splatting.view_of(cameras[i % len(cameras)], file.frame.near).to(device)
            marks = [clock(device)]
            scales, opacities = cloud.log_scales.exp(), cloud.opacities.sigmoid()
            inputs = cloud.means, cloud.quaternions, scales, opacities, cloud.harmonics
            centres, conics, depths, colours, opacities = kernels.project(*inputs, view, cloud.degree + 1)
            marks.append(clock(device))
            tiles = kernels.tile(centres, conics, opacities, depths, view.size)
            marks.append(clock(device))
            kernels.rasterize(centres, conics, opacities, colours, depths, tiles)
            marks.append(clock(device))
            if i >= 0:
                spans = [b - a for a, b in zip(marks, marks[1:], strict=False)]
                for name, seconds in zip(names, [*spans, sum(spans)], strict=True):
                    times[name].append(1e3 * seconds)
    table = Table("Gaussians", *names, title=f"A frame of {file.path.name} at 800 x 800: median milliseconds")
    medians = {name: statistics.median(x) for name, x in times.items()}
    table.add_row(f"{len(cloud):,}", *(f"{x:.1f}" for x in medians.values()))
    console().print(table)
    return [{"gaussians": len(cloud), **medians}]


def beside_gsplat(options: Options, device: torch.device) -> dict:
    """Milliseconds forward and backward at 1920 x 1080, of ours and of gsplat's rasterization."""
    count, generator = options.gaussians, torch.Generator().manual_seed(0)
    means = 2 * torch.rand(count, 3, generator=generator) - 1
    quaternions, scales = torch.randn(count, 4, generator=generator), 0.5 * torch.randn(count, 3, generator=generator)
    opacities, harmonics = torch.randn(count, generator=generator), 0.3 * torch.randn(count, 16, 3, generator=generator)
    cloud = Gaussians(means, quaternions, scales - 5.5, opacities, harmonics).to(device)
    leaves = [
        x.requires_grad_() for x in (cloud.means, cloud.quaternions, cloud.log_scales, cloud.opacities, harmonics)
    ]
    leaves[-1] = cloud.harmonics.requires_grad_()
    rotation, eye = torch.eye(3, device=device), torch.tensor([0.0, 0.0, -3.0], device=device)
    size, focal = (1920, 1080), torch.tensor([1200.0, 1200.0], device=device)
    centre = torch.tensor([960.0, 540.0], device=device)
    limits = torch.tensor([-1.0, 1.0, -0.6, 0.6], device=device)
    view = kernels.View(rotation, eye, focal, centre, torch.zeros(8, device=device), limits, size, 0.01)

    def ours() -> torch.Tensor:
        return splatting.splat(cloud, view).rgb

    found = {"ours": forward_and_backward(ours, leaves, device, options.repeats)}
    try:
        from gsplat import rasterization
    except ImportError:
        return found
    pose = torch.eye(4, device=device)
    pose[2, 3] = 3.0
    K = torch.tensor([[1200.0, 0, 960], [0, 1200, 540], [0, 0, 1]], device=device)

    def theirs() -> torch.Tensor:
        scales, opacity = cloud.log_scales.exp(), cloud.opacities.sigmoid()
        given = cloud.means, cloud.quaternions, scales, opacity, cloud.harmonics
        return rasterization(*given, pose[None], K[None], *size, sh_degree=3, packed=False)[0][0]

    return found | {"gsplat": forward_and_backward(theirs, leaves, device, options.repeats)}


def forward_and_backward(picture: Callable[[], torch.Tensor], leaves, device, repeats: int) -> dict[str, float]:
    forward, backward = [], []
    for _ in range(repeats + 3):
        a = clock(device)
        rgb = picture()
        b = clock(device)
        torch.autograd.grad(rgb.sum(), leaves)
        forward.append(1e3 * (b - a))
        backward.append(1e3 * (clock(device) - b))
    return {"forward ms": statistics.median(forward[3:]), "backward ms": statistics.median(backward[3:])}


def clock(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
