"""A run that moves as .4dgs and as a page: pictures before and after, bytes, and frames per second.

    python benchmarks/moving_exports.py RUN

Compares the run's renderings at five moments, which are no ends of spans, with those of its .4dgs, read back by us and
by PyPI's `fourdgs`. The size of one .spz for each of 90 frames (3 s at 30 frames/s) is estimated by five of them.
Frames per second are of 400 x 400 pixels, in processor seconds.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import fourdgs as reference
import numpy as np
import torch
import tyro

from lumigraph.camera import Camera
from lumigraph.exchange import fourdgs, write_gaussians
from lumigraph.exchange.codes import cloud
from lumigraph.export.page import moving_page
from lumigraph.gaussians import Gaussians
from lumigraph.gaussians.cloud import BAND_0
from lumigraph.gaussians.splatting import render
from lumigraph.large import open_any
from lumigraph.metrics import psnr
from lumigraph.paths.opening import opening_of_scene

SHARES = 0.07, 0.29, 0.5, 0.71, 0.93  # of the time
FRAMES, SIZE, VIEWS = 90, 400, 3


@dataclass(frozen=True)
class Options:
    run: tyro.conf.Positional[Path]
    duration: float = 3.0


@torch.no_grad()
def main(options: Options) -> None:
    opened = open_any(options.run)
    method, cameras = opened.method(), opened.cameras()["train"]
    first, last = method.frame.times
    begin = time.process_time()
    moving = method.moving(options.duration)
    print(f"{len(moving):,} spans, {moving.moving:,} of them move; {time.process_time() - begin:.1f} s to fit")
    views = [cameras[int(i)] for i in np.linspace(0, len(cameras) - 1, VIEWS)]
    with tempfile.TemporaryDirectory() as folder:
        path, page = Path(folder) / "moving.4dgs", Path(folder) / "page.html"
        fourdgs.write_moving(path, moving)
        moving_page(page, moving, opening_of_scene("moving", cameras, opened.frame, None, None))
        back, theirs = fourdgs.read_moving(path), reference.read(path).gaussians
        sizes = []
        for share in SHARES:
            now = method.given(time=first + share * (last - first))
            clouds = {"spans": moving.at(share * options.duration), "read back": back.at(share * options.duration)}
            clouds["read by fourdgs"] = of_reference(theirs, share * options.duration)
            found = {name: np.mean([quality(now, cloud, view) for view in views]) for name, cloud in clouds.items()}
            print(f"at {share:.2f}: " + ", ".join(f"{name} {value:.1f} dB" for name, value in found.items()))
            write_gaussians(Path(folder) / "moment.spz", now.gaussians())
            sizes.append((Path(folder) / "moment.spz").stat().st_size)
        print(f".4dgs {path.stat().st_size / 1e6:.2f} MB, page {page.stat().st_size / 1e6:.2f} MB")
        print(f".spz {np.mean(sizes) / 1e6:.3f} MB each, {FRAMES} of them {FRAMES * np.mean(sizes) / 1e6:.1f} MB")
    camera = views[0].resized(SIZE / int(views[0].size.max()))
    method.given(time=first).render(camera)
    begin = time.process_time()
    for share in SHARES:
        method.given(time=first + share * (last - first)).render(camera)
    print(f"{len(SHARES) / (time.process_time() - begin):.1f} frames per processor second, {SIZE} pixels")


def quality(method, moment: Gaussians, camera: Camera) -> float:
    """PSNR of a cloud against the method's own picture."""
    ours = method.given(time=method.settings["time"]).render(camera).rgb
    return float(psnr(render(moment, camera, method.frame.background, method.near_plane).rgb, ours))


def of_reference(theirs, seconds: float) -> Gaussians:
    """The cloud of a moment as `fourdgs` reconstructs it."""
    state = theirs.state_at(seconds)
    there = state["indices"]
    count = theirs.sh.shape[1] // 3 + 1 if theirs.sh is not None else 1
    harmonics = np.zeros((len(there), count, 3))
    harmonics[:, 0] = (theirs.colors[there, :3] - 0.5) / BAND_0
    if count > 1:
        coefficients = theirs.sh[there].reshape(len(harmonics), 3, count - 1)
        harmonics[:, 1:] = -4 + coefficients.transpose(0, 2, 1) * (8 / 255)
    alpha = state["opacity"].clip(1e-6, 1 - 1e-6)
    turns = theirs.rotations[there][:, [3, 0, 1, 2]]
    return cloud(state["centers"], turns, np.log(theirs.scales[there]), np.log(alpha / (1 - alpha)), harmonics)


if __name__ == "__main__":
    main(tyro.cli(Options))
