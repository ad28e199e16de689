"""Many cameras at once: pictures per second of colours and metric depth, and the error of that depth in an exact room.

    python benchmarks/many_cameras.py [--counts 100000 1000000] [--sizes 320 640] [--cameras 1 8 64] [--rounds 3]

A cloud of flat Gaussians lies on the surfaces of the procedural room (`procedural:room,depth`), which a ray tracer
finds exactly; each has the colour and the spacing of its sample. It is written as a splat file in metres, opened by
`lumigraph.open` and rendered by `Model.render`. The depth of held-out cameras is compared with that of the ray tracer,
at pixels that are opaque and more than two pixels from an edge of depth. Nothing is trained.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

import lumigraph
from lumigraph.camera import Camera
from lumigraph.exchange import write_gaussians
from lumigraph.synthetic import SyntheticStage, trace
from lumigraph.synthetic.scenes import stage

SAMPLED_CAMERAS, SAMPLED_SIZE = 60, 160  # that the surfaces are sampled from
OPACITY, THICKNESS = 0.95, 0.1  # of each Gaussian; its thickness in radii
EDGE = 0.03  # share of depth beyond which a neighbouring pixel is across an edge
SPACING_RADIUS = 0.7  # radius in units of the mean spacing of samples


def room_cloud(stage: SyntheticStage, count: int, generator: torch.Generator) -> lumigraph.Gaussians:
    """Flat Gaussians on the surfaces that the training cameras look at, in metres."""
    cameras = stage.cameras["train"]
    means, normals, colours = [], [], []
    chosen = torch.linspace(0, len(cameras) - 1, SAMPLED_CAMERAS).long().tolist()
    for camera in (cameras[i] for i in chosen):
        rays = camera.rays(camera.pixels())
        rays = rays[torch.randperm(len(rays), generator=generator)[: -(-count // SAMPLED_CAMERAS)]]
        seen = trace(stage.world, rays, shaded=False)
        depth, normal, rgb = map(torch.from_numpy, (seen.depth, seen.normal, seen.reflectance))
        means.append(rays.at(depth.float())), normals.append(normal), colours.append(rgb)
    mean, normal, rgb = (torch.cat(x)[:count].float() for x in (means, normals, colours))
    apart = nearest_spacing(mean)
    radius = (SPACING_RADIUS * apart).clamp(1e-4, 0.05)
    scales = torch.stack([radius, radius, THICKNESS * radius], -1) * stage.unit
    harmonics = ((rgb - 0.5) / 0.28209479177387814)[:, None]
    opacity = torch.full((count,), math.log(OPACITY / (1 - OPACITY)))
    return lumigraph.Gaussians(mean * stage.unit, facing(normal), scales.log(), opacity, harmonics)


def nearest_spacing(points: Tensor, neighbours: int = 6) -> Tensor:
    """Distance of the sixth neighbour of each point, less for its number: about the spacing of a surface's samples."""
    from scipy.spatial import cKDTree

    found = cKDTree(points.numpy()).query(points.numpy(), neighbours + 1, workers=-1)[0][:, -1]
    return torch.from_numpy(found).float() * math.sqrt(math.pi / neighbours)


def facing(normals: Tensor) -> Tensor:
    """Quaternion (w, x, y, z) of each normal that turns the third axis to it."""
    x, y, z = normals.unbind(-1)
    turned = torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1)
    return normalize(torch.where((z > -0.999)[:, None], turned, torch.tensor([0.0, 1.0, 0.0, 0.0])), dim=-1)


def depth_error(run: lumigraph.Model, stage: SyntheticStage, cameras: Camera) -> Tensor:
    """Absolute error of depth, metres, at opaque pixels away from edges of depth."""
    errors = []
    batches = [cameras[i] for i in range(len(cameras))]
    for one, seen in zip(batches, run.rendered(run.placed(in_metres(stage, cameras))), strict=True):
        exact = torch.from_numpy(trace(stage.world, one.rays(one.pixels()), shaded=False).depth).float() * stage.unit
        exact = exact.view(seen.depth.shape)
        far = max_pool2d(exact[None], 5, 1, 2)[0] > (1 + EDGE) * -max_pool2d(-exact[None], 5, 1, 2)[0]
        errors.append((seen.depth - exact).abs()[(seen.opacity > 0.9) & ~far])
    return torch.cat(errors)


def in_metres(stage: SyntheticStage, cameras: Camera) -> Camera:
    """Cameras of the world in metres."""
    return cameras.transformed(torch.diag(torch.tensor([stage.unit, stage.unit, stage.unit, 1.0])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", type=int, nargs="+", default=[100_000, 1_000_000])
    parser.add_argument("--sizes", type=int, nargs="+", default=[320, 640])
    parser.add_argument("--cameras", type=int, nargs="+", default=[1, 8, 64])
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    surfaces = stage("room", size=SAMPLED_SIZE, views=SAMPLED_CAMERAS, depth=1)
    for count in asked.counts:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "room.ply"
            write_gaussians(file, room_cloud(surfaces, count, torch.Generator().manual_seed(0)))
            run = lumigraph.open(file, metres=1.0)
        for size in asked.sizes:
            views = stage("room", size=size, views=max(asked.cameras), depth=1)
            wanted = run.placed(in_metres(views, views.cameras["train"]))
            run.render(wanted[:2])  # compiles
            for number in asked.cameras:
                seconds = []
                for _ in range(asked.rounds):
                    begin = time.perf_counter()
                    run.render(wanted[:number])
                    seconds.append(time.perf_counter() - begin)
                best, middle = number / min(seconds), number / sorted(seconds)[len(seconds) // 2]
                about = f"{count:>9,} Gaussians  {size}x{size * 3 // 4}  "
                print(f"{about}{number:>2} cameras  {best:6.2f} pictures/s at best, {middle:6.2f} median", flush=True)
            few = views.cameras["test"][:3]
            off = depth_error(run, views, few)
            low, high = (float(np.quantile(off.numpy(), share)) for share in (0.5, 0.95))
            figures = f"median {low:.4f}, mean {off.mean():.4f}, 95 % {high:.4f}, {len(off):,} pixels"
            print(f"{about}error of depth in {run.depth_unit}: {figures}", flush=True)
    print(f"{torch.get_num_threads()} threads; load before the end {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
