"""A ring's stereo panorama beside the exact one: PSNR of each eye, and disparity between the eyes, by stereo on both.

    python benchmarks/jump.py [--size 512] [--scene procedural:ring,size=240,views=12] [--output jump.png]

Rows are those up to 48 degrees up and down. The disparity of an eye's pixel is where the other eye sees the same
place, from the exact distance; "drawn" takes the stitched distance, "matched" semi-global matching on the two stitched
panoramas, as two eyes would fuse them, where it is sure. The picture has both eyes stitched, exact, and their
difference.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

from lumigraph.camera import Camera
from lumigraph.camera.lens import OmnidirectionalStereo
from lumigraph.depth_maps.stereo import as_bytes, semi_global
from lumigraph.export import jump
from lumigraph.export.options import JumpOptions
from lumigraph.figures import Row, contact_sheet
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene
from lumigraph.synthetic import render, scenes

LATITUDE = 48.0  # degrees
BORDER = 0.125  # of the width, to both sides, that is repeated for matching
MAX_DISPARITY = 24  # pixels
INFINITELY_FAR = 1e4  # times the distance of the eyes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scene", default="procedural:ring,size=240,views=12")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--output", type=Path, default=Path("jump.png"))
    given = parser.parse_args()
    name, *numbers = given.scene.removeprefix("procedural:").split(",")
    world = scenes.stage(name, **{key: int(value) for key, value in (one.split("=") for one in numbers)}).world
    scene = open_scene(given.scene)
    found, _ = jump.stereo_panorama(scene, JumpOptions(given.size))
    size, rows = (given.size, given.size // 2), within(given.size // 2)
    forward, up, to_world = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1]), scene.frame.to_source
    axes = [to_world.directions(axis.double()) for axis in (torch.linalg.cross(-up, forward), -up, forward)]
    pose = torch.stack([*axes, to_world.points(found.rig.middle.double())], 1)[None].float()
    exact, pictures = [], [found.left, found.right]
    for side in (-1, 1):
        offset = torch.tensor([[side * found.eyes / 2 * to_world.scale]])
        lens = OmnidirectionalStereo(torch.tensor([size]).float(), offset=offset)
        exact.append(render(world, Camera(pose, lens, torch.tensor([size]))))
    for eye, seen, truth in zip(("left", "right"), pictures, exact, strict=True):
        print(f"{eye}: {float(psnr(seen[rows], truth.rgb.view(seen.shape)[rows])):.1f} dB")
    truth = disparity(exact[0].depth.view(size[1], size[0]) / to_world.scale, found.eyes, size[0])
    drawn = disparity(found.depth[0], found.eyes, size[0])
    report("drawn", drawn[rows], truth[rows])
    matched = matched_disparity(*pictures)
    report("matched", matched[rows], truth[rows])
    shown = [x.rgb.view(found.left.shape) for x in exact]
    report("matched on the exact pair", matched_disparity(*shown)[rows], truth[rows])
    differences = [0.5 + 2 * (a - b) for a, b in zip(pictures, shown, strict=True)]
    sheet = [Row(eye, [a, b, c]) for eye, a, b, c in zip(("left", "right"), pictures, shown, differences, strict=True)]
    contact_sheet("Jump", ["stitched", "exact", "difference"], sheet).save(given.output)


def within(height: int) -> Tensor:
    """Rows that are compared."""
    return ((torch.arange(height) + 0.5 - height / 2) / height * 180).abs() < LATITUDE


def disparity(depth: Tensor, eyes: float, width: int) -> Tensor:
    """Columns by which the right eye sees a place farther left than the left eye, from the distance along its ray.

    Both rays touch the circle of radius r; a place at the horizontal distance D from its middle is asin(r / D) aside of
    the direction of each eye's ray. Rows give the elevation.
    """
    height = len(depth)
    elevation = (height / 2 - torch.arange(height) - 0.5) / height * math.pi
    level = depth.clamp(max=INFINITELY_FAR * eyes) * elevation.cos()[:, None]
    return 2 * torch.atan2(torch.tensor(eyes / 2), level) / (2 * math.pi) * width


def matched_disparity(left: Tensor, right: Tensor) -> Tensor:
    """Disparity by semi-global matching, around the seam; NaN where it is not sure."""
    border = int(BORDER * left.shape[1])
    around = [as_bytes(torch.cat([x[:, -border:], x, x[:, :border]], 1)) for x in (left, right)]
    found = semi_global(*around, 0, MAX_DISPARITY)
    return torch.where(found.sure, found.values, torch.nan)[:, border:-border]


def report(name: str, found: Tensor, truth: Tensor) -> None:
    known = found.isfinite()
    off = (found - truth)[known].abs()
    share = (off / truth[known]).median()
    print(
        f"{name}: {100 * float(known.float().mean()):.0f} % of the pixels, off by {float(off.mean()):.3f} pixels on "
        f"average and {float(off.median()):.3f} in the middle, of up to {float(truth.max()):.1f}; "
        f"{100 * float(share):.1f} % in the middle"
    )


if __name__ == "__main__":
    main()
