"""Floaters put into trained runs: the share that `lumigraph clean` finds, and the share of the run that it removes.

    python benchmarks/floaters.py RUN [RUN ...] --output floaters.json

Each run gets 200 seeded blobs of one colour in free space between a camera and the surface that it sees, a third of
them near the camera. Half are one Gaussian, half 2 to 12. A blob is found if half of its Gaussians go. The run's
own Gaussians that go are not all errors: a run has floaters of its own. PSNR is of held-out
views in dB, reduced: of the run, with blobs, and after cleaning. "alone" is the run without blobs, cleaned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from jaxtyping import Int
from rich.table import Table
from scipy.spatial import cKDTree
from torch import Tensor
from tyro.conf import Positional

from lumigraph.camera import Camera
from lumigraph.composition import PickedCloud
from lumigraph.composition.floaters import evidence
from lumigraph.datasets.scene import Scene
from lumigraph.depth_maps import render_depth_maps
from lumigraph.files import write_json
from lumigraph.gaussians import Gaussians
from lumigraph.gaussians.cloud import BAND_0, EXTENT_OPACITY, joined
from lumigraph.geometry import evenly
from lumigraph.large import open_any
from lumigraph.metrics import psnr
from lumigraph.system.console import console

FREE_DEVIATIONS = 2.0  # of a blob, between its centre and the nearest solid Gaussian, at least
NEAR_SHARE = (0.03, 0.15)  # of the way from a camera to the surface: places of a third of the blobs
FAR_SHARE = (0.15, 0.85)  # of the others
SIZE_SHARE = (0.004, 0.04)  # standard deviation of a blob, in distances of the surface; near a camera, twice its own
OPACITY = (0.3, 0.98)
MAX_MAPS, MAP_SIDE = 40, 200  # depth maps that place the blobs, and pixels of the longer side of each


@dataclass(frozen=True)
class Options:
    runs: Positional[tuple[Path, ...]]  # of gaussian-splatting
    blobs: int = 200
    strengths: tuple[float, ...] = (0.2, 0.4, 0.6)
    views: int = 4  # held-out ones, at most
    size: int = 300  # pixels of the longer side of the views
    seed: int = 0
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    rows: list[dict[str, Any]] = []
    for folder in options.runs:
        rows += measured(folder, options)
        show(rows)
        if options.output:
            write_json(options.output, rows)


@torch.no_grad()
def measured(folder: Path, options: Options) -> list[dict[str, Any]]:
    """Figures of a run, one row for each strength."""
    run: Any = open_any(folder)
    method, scene = run.method("cpu").eval(), run.open_scene()
    cameras, own = run.cameras()["train"], method.gaussians()
    blobs, owners = blobs_in(method, method.refined(cameras), options)
    soiled = joined([own, blobs])
    found, alone = evidence(soiled, cameras, method.frame), evidence(own, cameras, method.frame)

    def quality(cloud: Gaussians) -> float:
        return held_out_psnr(PickedCloud(method.frame, cloud), method, scene, options)

    before = {"of the run": quality(own), "with blobs": quality(soiled)}
    rows = []
    for strength in options.strengths:
        gone, gone_alone = found.floaters(strength), alone.floaters(strength)
        share = torch.zeros(options.blobs).index_add(0, owners, gone[len(own) :].float()) / owners.bincount()
        row: dict[str, Any] = {"run": folder.name, "Gaussians": len(own), "strength": strength}
        row["blobs found"] = float((share >= 0.5).float().mean())
        row["own removed"] = float(gone[: len(own)].float().mean())
        row["own removed alone"] = float(gone_alone.float().mean())
        after = {"cleaned": quality(soiled[~gone]), "cleaned alone": quality(own[~gone_alone])}
        rows.append(row | before | after)
    return rows


def blobs_in(method: Any, cameras: Camera, options: Options) -> tuple[Gaussians, Int[Tensor, " gaussian"]]:
    """Gaussians of blobs in free space, and for each the number of its blob."""
    generator = torch.Generator().manual_seed(options.seed)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    cloud = method.gaussians()
    solid = cKDTree(cloud.means[cloud.opacities.sigmoid() > EXTENT_OPACITY].numpy())
    maps = render_depth_maps(method.render, cameras, method.frame.background, MAX_MAPS, MAP_SIDE)
    maps = [seen for seen in maps if seen.solid.any()]
    blobs: list[Gaussians] = []
    while len(blobs) < options.blobs:
        seen = maps[int(torch.randint(len(maps), (1,), generator=generator))]
        pixels = seen.solid.flatten().nonzero()[:, 0]
        surface = seen.positions(pixels[torch.randint(len(pixels), (1,), generator=generator)])[0]
        eye, near = seen.camera.position[0], len(blobs) % 3 == 0
        share = uniform(*(NEAR_SHARE if near else FAR_SHARE))
        middle = eye + share * (surface - eye)
        size = math.exp(uniform(*map(math.log, SIZE_SHARE))) * float((surface - eye).norm())
        size *= 2 * share if near else 1
        if solid.query(middle.numpy())[0] < FREE_DEVIATIONS * size:
            continue
        count = 1 if len(blobs) % 2 else int(torch.randint(2, 13, (1,), generator=generator))
        means = middle + (size * normal(count, 3) if count > 1 else torch.zeros(1, 3))
        scales = math.log(size if count == 1 else 0.7 * size) + 0.4 * normal(count, 3)
        harmonics = torch.zeros(count, cloud.harmonics.shape[1], 3)
        harmonics[:, 0] = (torch.rand(3, generator=generator) - 0.5) / BAND_0
        opacities = torch.full((count,), uniform(*OPACITY)).logit()
        blobs.append(Gaussians(means, normal(count, 4), scales, opacities, harmonics, cloud.antialiased))
    return joined(blobs), torch.arange(len(blobs)).repeat_interleave(torch.tensor([len(x) for x in blobs]))


def held_out_psnr(cloud: PickedCloud, method: Any, scene: Scene, options: Options) -> float:
    """Mean PSNR in dB of reduced held-out views, through their own cameras."""
    values = []
    for index in evenly(scene.splits["test"].tolist(), options.views):
        shot = scene.photograph(index)
        shot = shot.reduced(max(1, round(int(shot.camera.size.max()) / options.size)))
        truth = shot.before(scene.frame.background)
        mask = torch.ones(truth.shape[:2], dtype=torch.bool) if shot.mask is None else shot.mask
        values.append(psnr(cloud.render(method.refined(shot.camera)).rgb.clamp(0, 1)[mask], truth[mask]))
    return sum(values) / len(values)


def show(rows: list[dict[str, Any]]) -> None:
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(cell(name, value) for name, value in row.items()))
    console().print(table)


def cell(name: str, value: Any) -> str:
    if name in ("run", "Gaussians", "strength"):
        return str(value)
    return f"{100 * value:.1f} %" if "found" in name or "removed" in name else f"{value:.2f}"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
