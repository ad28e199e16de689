"""The sample clouds of the package, made anew: training on procedural scenes, and a splat file of each.

    python benchmarks/samples.py [--output lumigraph/samples] [--only still-life]

They show nothing but procedural scenes of this project, and are dedicated to the public domain (CC0 1.0). The steps and
the seed are fixed; other processors round differently, so the bytes differ in the last digits.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch

import lumigraph
from lumigraph.exchange import write_gaussians

SCENES = {  # scene, steps, cap of Gaussians
    "still-life": ("procedural:still-life,size=256,views=60", 1500, 30_000),
    "room": ("procedural:room,size=200,views=100", 2000, 60_000),
}
Y_DOWN = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # as splat files have it, from z up
OPTIONS = {"device": "cpu", "preset": "laptop", "sh_degree": 1, "seed": 0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path(lumigraph.__file__).parent / "samples")
    parser.add_argument("--only", choices=[*SCENES])
    asked = parser.parse_args()
    asked.output.mkdir(parents=True, exist_ok=True)
    for name, (scene, steps, cap) in SCENES.items():
        if asked.only not in (None, name):
            continue
        with tempfile.TemporaryDirectory() as folder:
            run = lumigraph.train(
                scene, "gaussian-splatting", Path(folder) / name, steps=steps, max_gaussians=cap, **OPTIONS
            )
            scores = run.evaluate()
            cloud = run.opened.source_gaussians().transformed(Y_DOWN)
        file = asked.output / f"{name}.sog"
        write_gaussians(file, cloud)
        size = file.stat().st_size
        print(f"{name}: {scores.psnr:.2f} dB held out, {len(cloud):,} Gaussians, {size:,} bytes", flush=True)


if __name__ == "__main__":
    main()
