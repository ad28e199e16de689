"""3-D photographs beside held-out neighbours: PSNR of the mesh over what it covers, and processor seconds.

    python benchmarks/photo3d.py FERN BANANA [--size 320] [--sheet photo3d.png]

Of each capture, the nine photographs nearest to the one in the middle; every third of them is held out, the other six
make the 3-D photograph. The sheet has each held-out photograph, the mesh from there, and their difference.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch
from textured import rendered

from lumigraph.capture import open_scene
from lumigraph.datasets.scene import Scene
from lumigraph.export.photo3d import photo3d
from lumigraph.figures import Row, contact_sheet
from lumigraph.metrics import psnr

BURST = 9  # photographs, of which every third is held out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--size", type=int, default=320, help="pixels of the longer side of depth maps")
    parser.add_argument("--downscale", type=int)
    parser.add_argument("--sheet", type=Path, default=Path("photo3d.png"))
    given = parser.parse_args()
    rows = []
    for source in given.scenes:
        scene = burst(open_scene(source, given.downscale, whole=True))
        begin = time.process_time()
        found = photo3d(scene, given.size)
        spent, scores, shares = time.process_time() - begin, [], []
        for number in scene.splits["test"].tolist():
            photograph = scene.photograph(number)
            picture, covered = rendered(found.mesh, photograph.camera)
            truth, inside = photograph.rgb, covered == 1
            scores.append(f"{float(psnr(picture[inside], truth[inside])):.1f}")
            shares.append(float(inside.float().mean()))
            rows.append(Row(f"{Path(source).name}, {scores[-1]} dB", [truth, picture, 0.5 + 2 * (picture - truth)]))
        print(
            f"{source}: {', '.join(scores)} dB, {100 * min(shares):.0f} to {100 * max(shares):.0f} % covered, "
            f"{spent:.0f} processor seconds, {100 * found.trusted:.0f} % of the depth trusted",
            flush=True,
        )
    contact_sheet("3-D photographs", ["held out", "mesh", "difference"], rows).save(given.sheet)


def burst(scene: Scene) -> Scene:
    """The photographs around the middle one, every third held out."""
    positions = scene.cameras.position
    middle = (positions - positions.median(0).values).norm(dim=1).argmin()
    nearest = (positions - positions[middle]).norm(dim=1).argsort()[:BURST]
    held_out = torch.arange(len(nearest)) % 3 == 2
    return replace(scene, splits={"train": nearest[~held_out], "test": nearest[held_out]})


if __name__ == "__main__":
    main()
