"""Panoramas and omnidirectional stereo of trained methods against a scene that is known exactly.

    python benchmarks/panorama.py --seconds 90

Each method learns the procedural room from 100 photographs, then looks around from its middle. The panorama is compared
with our ray tracer's (PSNR over the picture, and with each pixel weighted by its share of the sphere). Of the stereo
pair the distances of ten places are measured, by nothing but matching patches between its halves, and compared with
the tracer's.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

import torch
import tyro
from rich.table import Table
from torch import Tensor

from lumigraph import methods
from lumigraph.camera import Camera
from lumigraph.camera.lens import Equirectangular, OmnidirectionalStereo
from lumigraph.export.panorama import (
    level_camera,
    panorama,
    save_sphere,
    sphere_size,
    stereo_pair,
    surrounding_distances,
    top_bottom,
)
from lumigraph.files import write_json
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene
from lumigraph.run import Run, build
from lumigraph.synthetic import render, scenes, trace
from lumigraph.system.console import console
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

PLACE, HEADING = torch.zeros(3), torch.tensor([1.0, 0.0, 0.0])
EYES = 0.05  # room units between them
PATCH = 10  # pixels around a place that are matched
SEARCH = 60  # pixels to the left, at most
FINE = 32  # parts of a pixel told apart
EVEN = 0.02  # how much of its depth a patch may span
STEEPEST = 55  # degrees of latitude up to which places are chosen
POINTS = 10


@dataclasses.dataclass(frozen=True)
class Options:
    methods: tuple[str, ...] = ("instant-ngp", "gaussian-splatting")
    seconds: float = 90.0  # of training, each
    size: int = 1024  # width of the panorama
    stereo_size: int = 2048  # width of the pair
    photographs: int = 256  # pixels of each side
    runs: tuple[Path, ...] = ()  # runs trained on procedural:room already; then nothing is trained
    output: Path = Path("panoramas")  # where pictures and figures go


def main(options: Options) -> None:
    world = scenes.stage("room").world
    truth = render(world, level_camera(PLACE, HEADING, Equirectangular(sphere_size(options.size))))
    save_sphere(options.output / "truth.png", truth.rgb, whole=True)
    eyes = [
        level_camera(
            PLACE, HEADING, OmnidirectionalStereo(sphere_size(options.stereo_size), offset=torch.tensor([[x]]))
        )
        for x in (-EYES / 2, EYES / 2)
    ]
    exact = render(world, eyes[0], samples=4, more=0)
    points = choose_points(exact.rgb, exact.depth)
    distances = level_distance(world, eyes[0], points)
    rows = []
    for name, method in trained(options):
        scene_from_world = torch.linalg.inv(torch.tensor(method.frame.source_from_scene))
        place, scale = scene_from_world[:3, 3], float(scene_from_world[:3, 0].norm())  # of PLACE, the world's origin
        began = time.perf_counter()
        seen = panorama(method, place, HEADING, options.size)
        seconds = time.perf_counter() - began
        near, _ = surrounding_distances(method, place, HEADING)
        began = time.perf_counter()
        pair = stereo_pair(method, place, HEADING, options.stereo_size, scale * EYES, near)
        stereo_seconds = time.perf_counter() - began
        off = measured(pair[0].rgb, pair[1].rgb, points) / distances - 1
        save_sphere(options.output / f"{name}.png", seen.rgb, whole=True)
        save_sphere(options.output / f"{name}-stereo.jpg", top_bottom(*pair), whole=False)
        rows.append(
            {
                "method": name,
                "psnr": psnr(seen.rgb, truth.rgb),
                "psnr_of_the_sphere": sphere_psnr(seen.rgb, truth.rgb),
                "seconds": seconds,
                "stereo_seconds": stereo_seconds,
                "distance_errors": off.tolist(),
            }
        )
    table = Table("method", "PSNR", "by solid angle", "seconds", "pair: seconds", "distances: worst", "median")
    for row in rows:
        wrong = torch.tensor(row["distance_errors"]).abs()
        figures = (row["psnr"], row["psnr_of_the_sphere"], row["seconds"], row["stereo_seconds"])
        table.add_row(
            row["method"], *(f"{x:.2f}" for x in figures), f"{100 * wrong.max():.2f} %", f"{100 * wrong.median():.2f} %"
        )
    console().print(table)
    write_json(options.output / "panorama.json", {"options": str(options), "rows": rows})


def trained(options: Options):
    """Names and methods that know the room."""
    for folder in options.runs:
        run = Run(folder)
        yield run.method_name, run.method()
    if options.runs:
        return
    scene = open_scene(f"procedural:room,size={options.photographs}")
    for name in options.methods:
        kind, device = methods.find(name), torch.device("cuda" if torch.cuda.is_available() else "cpu")
        method = build(kind, scene.frame, kind.preset(device), device, 0)
        go_on_unless(fit(method, scene, seconds=options.seconds).signal)
        yield name, method.eval()


def sphere_psnr(a: Tensor, b: Tensor) -> float:
    """Each row counts as much as it covers of the sphere."""
    height = a.shape[0]
    weight = torch.sin(math.pi * (torch.arange(height) + 0.5) / height)
    return -10 * math.log10(float(((a - b).square().mean((1, 2)) * weight).sum() / weight.sum()))


def choose_points(left: Tensor, depth: Tensor) -> Tensor:
    """Pixels (column, row) of the left eye's picture where patches can be matched: unlike all that is beside them, and
    even in depth. The most unlike first, each far from those before."""
    height, width = depth.shape
    around = {"kernel_size": 2 * PATCH + 1, "stride": 1, "padding": PATCH}
    shifts = [x for x in range(-SEARCH, SEARCH + 1, 2) if abs(x) > 3]
    unlike = torch.full_like(depth, torch.inf)
    for shift in shifts:
        apart = (left - left.roll(shift, 1)).square().mean(-1)
        unlike = torch.minimum(unlike, torch.nn.functional.avg_pool2d(apart[None], **around)[0])
    far, near = (torch.nn.functional.max_pool2d(x[None], **around)[0] for x in (depth, -depth))
    row = torch.arange(height)[:, None]
    usable = (far + near < EVEN * depth) & ((row / height - 0.5).abs() < STEEPEST / 180)
    usable[:, : SEARCH + PATCH] = usable[:, -PATCH:] = False  # patches do not wrap around
    score = torch.where(usable, unlike, 0.0)
    chosen: list[tuple[int, int]] = []
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    for _ in range(POINTS):
        at_row, at_column = divmod(int(score.argmax()), width)
        chosen.append((at_column, at_row))
        score = torch.where(torch.hypot(x - at_column, (y - at_row).float()) < width / 16, 0.0, score)
    return torch.tensor(chosen)


def level_distance(world, camera: Camera, points: Tensor) -> Tensor:
    """Of places from the vertical axis, as the tracer has them."""
    rays = camera.rays(points + 0.5)
    met = rays.at(torch.from_numpy(trace(world, rays, shaded=False).depth).float())
    return (met - PLACE)[:, :2].norm(dim=-1)


def measured(left: Tensor, right: Tensor, points: Tensor) -> Tensor:
    """Distances by sin(theta) = r / R, from where each patch of the left picture is found further left in the right."""
    width = left.shape[1]
    found = []
    for column, row in points.tolist():
        rows = slice(row - PATCH, row + PATCH + 1)
        patch = left[rows, column - PATCH : column + PATCH + 1]
        strip = right[rows, column - PATCH - SEARCH : column + PATCH + 1].permute(2, 0, 1)[None]
        fine = torch.nn.functional.interpolate(
            strip, (strip.shape[2], FINE * (strip.shape[3] - 1) + 1), mode="bicubic", align_corners=True
        )[0].permute(1, 2, 0)
        errors = torch.stack(
            [(fine[:, s::FINE][:, : 2 * PATCH + 1] - patch).square().mean() for s in range(FINE * SEARCH + 1)]
        )
        disparity = SEARCH - int(errors.argmin()) / FINE
        found.append(0.5 * EYES / math.sin(math.pi * disparity / width))
    return torch.tensor(found)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
