"""Splats that begin at fused depth maps of multi-view stereo, beside those that begin at points of plane sweeps.

    python benchmarks/dense_start.py FERN FOX CAN LUND [--seconds 60] [--downscale 4]

Both train for the same processor seconds (of all threads), the search for points among them, from the same photographs
and seed. Written: Gaussians at the start, seconds that the points took, and held-out PSNR.
"""

from __future__ import annotations

import argparse
import functools
import time
import warnings

import torch

from lumigraph import methods
from lumigraph.components.clouds import cloud_method
from lumigraph.components.training.dense_points import Points, seen_points
from lumigraph.datasets.scene import Scene
from lumigraph.depth_maps.depth_map import SurfacePoints, free
from lumigraph.depth_maps.multi_view import multi_view_depth
from lumigraph.evaluation.views import evaluate
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

PACE_STEPS = 30  # steps whose pace says how many fit
VIEWS = 48  # photographs whose depth is found, as many as plane sweeps take


def fused_points(scene: Scene, size: int) -> Points:
    """Points of all depth maps; each is as large as a pixel of its map there."""
    maps = multi_view_depth(scene, size, views=VIEWS)
    found = SurfacePoints.cat([seen.points() for seen in maps])
    sizes = torch.cat([seen.depth[seen.solid] / seen.camera.lens.focal.mean() for seen in maps])
    sure = ~free(found.points, maps)
    return Points(found.points[sure], found.colours[sure], sizes[sure], found.origins[sure])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--downscale", type=int)
    parser.add_argument("--size", type=int, default=320, help="pixels of the longer side of depth maps")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| scene | start | Gaussians | seconds for points | steps | held-out PSNR |\n|---|---|---|---|---|---|")
    for source in given.scenes:
        scene = open_scene(source, given.downscale)
        starts = {"plane sweeps": seen_points, "fused depth": functools.partial(fused_points, size=given.size)}
        for name, start in starts.items():
            begin = time.process_time()
            points = start(scene)
            spent = time.process_time() - begin
            cloud_method.seen_points = lambda *_, points=points: points
            score, count, steps = trained(scene, given.seconds - spent)
            print(f"| {source} | {name} | {count} | {spent:.1f} | {steps} | {score:.2f} |", flush=True)


def trained(scene: Scene, seconds: float) -> tuple[float, int, int]:
    """Held-out PSNR of splats after so many processor seconds, Gaussians at the start, and steps."""
    kind, device = methods.find("gaussian-splatting"), torch.device("cpu")

    def new():
        return build(kind, scene.frame, kind.preset(device), device, 0)

    for count in (2, PACE_STEPS):  # the first ones compile
        begin, method = time.process_time(), new()
        go_on_unless(fit(method, scene, steps=count, show=False, rehearsal=False).signal)
    pace = (time.process_time() - begin) / PACE_STEPS
    method = new()
    method.begin(scene)
    count, steps, method = len(method.gaussians()), max(PACE_STEPS, int(seconds / pace)), new()
    go_on_unless(fit(method, scene, steps=steps, show=False, rehearsal=False).signal)
    return evaluate(method, scene).psnr, count, steps


if __name__ == "__main__":
    main()
