"""Measured depth as a teacher: PSNR and error of depth with and without --depth-weight, by method and number of views.

    python benchmarks/teaching.py SCAN [--views 6 20] [--steps 150] [--weight 0.1] [--downscale 8] [--methods ...]

SCAN is a capture of a depth camera. Every method trains from its preset for a CPU, from the same photographs and seed.
Both scores are of held-out photographs: PSNR, and the mean error of rendered depth in percent of the measured distance.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import replace

import torch

from lumigraph import methods
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.method.depth import DepthNumbers
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

METHODS = ("instant-ngp", "dvgo", "plenoxels", "tensorf", "nerf", "gaussian-splatting", "planar-splatting")
TEST_VIEWS = 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scan")
    parser.add_argument("--views", type=int, nargs="+", default=[6, 20])
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--weight", type=float, default=0.1)
    parser.add_argument("--downscale", type=int)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    heads = ("method", "views", "dB", "dB with depth", "depth error", "with depth", "processor seconds")
    print("|", " | ".join(heads), "|\n" + "|---" * len(heads) + "|", flush=True)
    for views in given.views:
        scene = open_scene(given.scan, downscale=given.downscale, views=views)
        for name in given.methods:
            kind, scores, begin = methods.find(name), [], time.process_time()
            for weight in (0.0, given.weight):
                config = replace(kind.cpu_preset(), measured=DepthNumbers(weight))
                method = build(kind, scene.frame, config, torch.device("cpu"), 0, learning=True)
                go_on_unless(fit(method, scene, steps=given.steps, show=False).signal)
                scores.append(evaluate(method, scene, EvaluationOptions(views=TEST_VIEWS)))
            (psnr, psnr_with), (depth, depth_with) = ([getattr(s, x) for s in scores] for x in ("psnr", "depth_error"))
            cells = [name, views, f"{psnr:.2f}", f"{psnr_with:.2f}", f"{depth:.1f} %", f"{depth_with:.1f} %"]
            print("|", " | ".join(map(str, [*cells, f"{time.process_time() - begin:.0f}"])), "|", flush=True)


if __name__ == "__main__":
    main()
