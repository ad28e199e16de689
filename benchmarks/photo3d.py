"""3-D photographs beside held-out neighbours: PSNR of the mesh over what it covers, and processor seconds.

    python benchmarks/photo3d.py FERN BANANA [--size 320] [--sheet photo3d.png]
    python benchmarks/photo3d.py --page photo.html [--sheet photo3d.png]

With --page: what a page of `lumigraph photo3d` shows from five places, in a headless Chromium.
Of each capture, the nine photographs nearest to the one in the middle; every third of them is held out, the other six
make the 3-D photograph. The sheet has each held-out photograph, the mesh from there, and their difference.
"""

from __future__ import annotations

import argparse
import io
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from textured import rendered
from viewer_drag import browser

from lumigraph.datasets.scene import Scene
from lumigraph.export.options import Photo3DOptions
from lumigraph.export.photo3d import photo3d
from lumigraph.figures import Row, contact_sheet
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene

PLACES = {"middle": (0.5, 0.5), "left": (0.05, 0.5), "right": (0.95, 0.5), "top": (0.5, 0.05), "bottom": (0.5, 0.95)}
WIDTH, HEIGHT = 800, 540  # of a window, pixels
LOADING, SETTLING = 6000, 4000  # milliseconds of waiting: for a page, for its camera
CHROMIUM = Path("/usr/bin/chromium")
BURST = 9  # photographs, of which every third is held out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--page", type=Path, help="a page, to look at from five places")
    parser.add_argument("--size", type=int, default=320, help="pixels of the longer side of depth maps")
    parser.add_argument("--downscale", type=int)
    parser.add_argument("--sheet", type=Path, default=Path("photo3d.png"))
    given = parser.parse_args()
    if given.page:
        contact_sheet(given.page.name, list(PLACES), [Row("pointer", from_five_places(given.page))]).save(given.sheet)
    rows = []
    for source in given.scenes:
        scene = burst(open_scene(source, given.downscale, whole=True))
        begin = time.process_time()
        found = photo3d(scene, Photo3DOptions(given.size))
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
    if rows:
        contact_sheet("3-D photographs", ["held out", "mesh", "difference"], rows).save(given.sheet)


def from_five_places(page: Path) -> list[torch.Tensor]:
    """Pictures of a page while the pointer is in its middle and near its four borders."""
    pictures = []
    with browser(CHROMIUM) as chromium:
        window = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        window.goto(page.resolve().as_uri())
        window.wait_for_timeout(LOADING)
        for x, y in PLACES.values():
            window.mouse.move(x * WIDTH, y * HEIGHT, steps=4)
            window.wait_for_timeout(SETTLING)
            shot = Image.open(io.BytesIO(window.screenshot())).convert("RGB")
            pictures.append(torch.from_numpy(np.asarray(shot, np.float32) / 255))
    return pictures


def burst(scene: Scene) -> Scene:
    """The photographs around the middle one, every third held out."""
    positions = scene.cameras.position
    middle = (positions - positions.median(0).values).norm(dim=1).argmin()
    nearest = (positions - positions[middle]).norm(dim=1).argsort()[:BURST]
    held_out = torch.arange(len(nearest)) % 3 == 2
    return replace(scene, splits={"train": nearest[~held_out], "test": nearest[held_out]})


if __name__ == "__main__":
    main()
