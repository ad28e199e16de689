"""The elastic loss of Nerfies, on and off: singular values of the motion's Jacobian at surfaces, as a chart.

    python benchmarks/elastic.py procedural:jelly,sweeps=12,size=80 --steps 800 --output elastic.svg

Trains nerfies twice with its numbers for a plain CPU, from the same seed. Then it takes the three singular values of
the Jacobian at points of the surfaces that photographs of training see, at their moments; 1 is rigid. The chart has
the share of values below each, one curve for each run. Prints quantiles and PSNR of eight held-out views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from lumigraph import methods
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.figures.charts import Series, line_chart, standalone
from lumigraph.files import write_bytes
from lumigraph.geometry import evenly
from lumigraph.methods.nerfies import Nerfies
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

PHOTOGRAPHS, POINTS = 12, 400  # that are looked at; points of each
QUANTILES = 0.01, 0.1, 0.5, 0.9, 0.99


@dataclass(frozen=True)
class Options:
    scene: tyro.conf.Positional[str] = "procedural:jelly,sweeps=12,size=80"
    steps: int = 800
    weight: float = 1e-3  # of the elastic loss, where it is on
    output: Path = Path("elastic.svg")


def main(options: Options) -> None:
    scene, curves = open_scene(options.scene), []
    for weight in (options.weight, 0.0):
        config = Nerfies.cpu_preset()
        config = replace(config, deformation=replace(config.deformation, elastic_weight=weight))
        method = build(methods.find("nerfies"), scene.frame, config, torch.device("cpu"), 0, learning=True)
        go_on_unless(fit(method, scene, steps=options.steps, show=False).signal)
        values, psnr = singular_values(method, scene), evaluate(method, scene, EvaluationOptions(views=8)).psnr
        name = f"weight {weight:g}"
        told = ", ".join(f"{100 * q:g} %: {np.quantile(values, q):.3f}" for q in QUANTILES)
        print(f"{name}: {told}; between 0.9 and 1.1: {np.mean(np.abs(values - 1) < 0.1):.3f}; held out {psnr:.2f} dB")
        share = np.linspace(0.005, 0.995, 199)
        curves.append(Series(name, np.quantile(values, share).tolist(), share.tolist()))
    chart = line_chart(curves, "singular value", "share below", log_x=True, smoothed=False)
    write_bytes(options.output, standalone(chart))


@torch.no_grad()
def singular_values(method: Nerfies, scene: Scene) -> np.ndarray:
    """Singular values of the motion's Jacobian at points of surfaces, three of each point."""
    random, found = np.random.default_rng(0), list[Tensor]()
    motion = method.network.motion
    assert motion is not None
    for i in evenly(scene.splits["train"].tolist(), PHOTOGRAPHS):
        camera = scene.cameras[i]
        seen = method.render(camera)
        solid = np.flatnonzero((seen.opacity.reshape(-1) > 0.9).numpy())
        chosen = torch.from_numpy(random.choice(solid, min(POINTS, len(solid)), replace=False))
        rays = camera.rays(camera.pixels())[chosen]
        points = rays.origins + seen.depth.reshape(-1)[chosen, None] * rays.directions
        code = method.moment_codes(torch.full((len(points),), float(camera.time)))
        found.append(torch.linalg.svdvals(motion.jacobian(points, code)).flatten())
    return torch.cat(found).numpy()


if __name__ == "__main__":
    main(tyro.cli(Options))
