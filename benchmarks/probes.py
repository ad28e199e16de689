"""Light probes against traced light: irradiance by order, and an inserted ball on a page beside the traced one.

    python benchmarks/probes.py --output probes
    python benchmarks/probes.py --output probes --runs runs/room-1          # the same from runs on procedural:room

Irradiance: at points of the surfaces of `procedural:room` that held-out cameras see, from the probes and by rays of our
tracer over the hemisphere. First the error of the harmonics alone, of probes at the very points; then of the grid.

The ball: `export probes --page` in a headless Chromium, a white ball in the scene, against our tracer's picture of the
same ball. In `procedural:materials` all light is visible to the probes: an environment map, and one bounce. In the room
the traced ball gathers the light of the room as the tracer shows it.
"""

from __future__ import annotations

import dataclasses
import io
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from PIL import Image
from rich.table import Table
from torch import Tensor

from lumigraph.camera import Camera
from lumigraph.camera.rays import Rays, Rendering
from lumigraph.color.srgb import linear_from_srgb
from lumigraph.components.training.development import encoded
from lumigraph.datasets.scene import Frame
from lumigraph.export.options import ProbesOptions
from lumigraph.export.probes import bake_probes
from lumigraph.export.probes_page import BALL_WHITE, flat_camera, probes_page
from lumigraph.figures import to_image
from lumigraph.files import write_json
from lumigraph.light.probes import ProbeGrid
from lumigraph.method import Method
from lumigraph.run import Run
from lumigraph.synthetic import lit, radiance, render, scenes, trace
from lumigraph.synthetic.cameras import look_at, pinhole
from lumigraph.synthetic.shapes import Ball
from lumigraph.synthetic.textures import Plain
from lumigraph.synthetic.world import Material, Object, Pose, World
from lumigraph.system.console import console

GATHERED_RAYS = 512  # over a hemisphere, for the truth
POINTS_PER_VIEW, VIEWS = 40, 16
BARE = "#caption, #buttons, #wait { display: none !important } * { transition: none !important }"
SOFTWARE = "--use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist"
SIZE = 320  # pixels of a page's picture
ALBEDO = float(linear_from_srgb(BALL_WHITE / 255))
# Where the balls are: middle, radius, and the camera's position.
ROOM_BALL = ((-0.05, 0.05, -0.25), 0.14, (0.45, -0.4, -0.05))
MATERIALS_BALL = ((0.05, 0.02, 0.1), 0.2, (1.0, -2.6, 1.4))


@dataclasses.dataclass(frozen=True)
class Options:
    output: Path = Path("probes")
    runs: tuple[Path, ...] = ()  # trained on procedural:room
    parts: tuple[Literal["balls", "irradiance"], ...] = ("balls", "irradiance")
    counts: tuple[tuple[int, int, int], ...] = ((4, 4, 3), (8, 7, 5), (14, 12, 8))  # of grids
    ball_counts: tuple[int, int, int] = (6, 6, 4)  # of the grids that light the balls
    face_size: int = 32  # pixels along a side of the six pictures of each probe
    scenes: str = ""  # beginning of the names of those with balls
    chromium: Path = Path("/usr/bin/chromium")
    webgl: str = SOFTWARE


class Traced(Method):
    """A procedural scene as a method. linear: whether it gives light rather than sRGB-encoded colours alone"""

    def __init__(self, world: World, bounds: Any, near: float, linear: bool = False, samples: int = 1):
        super().__init__(Frame(bounds=bounds, near=near), None)
        self.world, self.linear, self.samples = world, linear, samples

    def batch(self, data: Any, generator: torch.Generator) -> Any:
        raise NotImplementedError

    def render(self, camera: Camera) -> Rendering:
        seen = render(self.world, camera, samples=self.samples, more=0)
        if self.world.environment is None:
            return seen.with_extra(radiance=torch.from_numpy(radiance(self.world, camera, 1))) if self.linear else seen
        light = shown(self.world, camera, self.samples)
        extra = {"radiance": light} if self.linear else {}
        return Rendering(encoded(light.clamp(0, 1)), seen.depth, torch.ones_like(seen.opacity), extra)


def shown(world: World, camera: Camera, samples: int) -> Tensor:
    """Light of a world before its environment map, linear."""
    assert world.environment is not None
    straight = torch.from_numpy(lit(world, camera, samples))
    rgb, opacity = straight.split((3, 1), -1)
    rays = camera.rays(camera.pixels())
    return opacity * rgb + (1 - opacity) * world.environment.at(rays.directions).view_as(rgb)


def gathered(world: World, points: Tensor, normals: Tensor, count: int = GATHERED_RAYS) -> Tensor:
    """Irradiance from the light that the tracer shows around points: cosine-weighted rays."""
    k = torch.arange(count) + 0.5
    level, turn = (k / count).sqrt(), k * math.pi * (3 - math.sqrt(5))
    local = torch.stack([level * turn.cos(), level * turn.sin(), (1 - level**2).clamp_min(0).sqrt()], -1)
    aside = torch.where(normals[:, :1].abs() > 0.9, torch.tensor([[0.0, 1, 0]]), torch.tensor([[1.0, 0, 0]]))
    x = torch.nn.functional.normalize(torch.linalg.cross(aside, normals), dim=-1)
    axes = torch.stack([x, torch.linalg.cross(normals, x), normals], 1)
    directions = torch.einsum("cj,njk->nck", local, axes).reshape(-1, 3)
    origins = (points + 1e-3 * normals).repeat_interleave(count, 0)
    seen = trace(world, Rays(origins, directions, torch.full((len(origins),), 1e-2)))
    return math.pi * torch.from_numpy(seen.radiance).float().view(-1, count, 3).mean(1)


def surface_places(stage: Any) -> tuple[Tensor, Tensor]:
    """Points of surfaces that held-out cameras see, and their normals."""
    chance, cameras = torch.Generator().manual_seed(0), stage.cameras["test"]
    points, normals = [], []
    for i in torch.linspace(0, len(cameras) - 1, VIEWS).long().tolist():
        pixels = cameras[i].pixels()
        rays = cameras[i].rays(pixels[torch.randperm(len(pixels), generator=chance)[:POINTS_PER_VIEW]])
        seen = trace(stage.world, rays, shaded=False)
        points.append(rays.at(torch.from_numpy(seen.depth).float()))
        normals.append(torch.from_numpy(seen.normal).float())
    return torch.cat(points), torch.cat(normals)


def error(found: Tensor, truth: Tensor) -> tuple[float, float]:
    """Root mean square over that of the truth, and the median of relative errors."""
    rms = float((found - truth).square().mean().sqrt() / truth.square().mean().sqrt())
    return rms, float(((found - truth).abs() / truth.clamp_min(1e-4)).median())


def cut(grid: ProbeGrid, order: int) -> ProbeGrid:
    return dataclasses.replace(grid, radiance=grid.radiance[:, : (order + 1) ** 2])


def unobstructed(grid: ProbeGrid) -> ProbeGrid:
    """The probes, with nothing between them and any surface: plain trilinear interpolation but for facing."""
    return dataclasses.replace(grid, mean=torch.full_like(grid.mean, grid.far))


def irradiance_rows(options: Options) -> list[dict[str, Any]]:
    stage = scenes.stage("room")
    points, normals = surface_places(stage)
    truth = gathered(stage.world, points, normals)
    exact = Traced(stage.world, stage.bounds, stage.near)
    rows = []
    # A probe at each point, a little above the surface: its cube sees half of it from inside nothing.
    raised = points + 0.03 * normals
    alone = [
        bake_probes(
            exact, None, (tuple((p - 1e-3).tolist()), tuple((p + 1e-3).tolist())), ProbesOptions(counts=(1, 1, 1))
        )
        for p in raised[:: len(raised) // 60]
    ]
    some = slice(None, None, len(raised) // 60)
    near = gathered(stage.world, raised[some], normals[some])
    for order in range(4):
        found = [cut(g, order).irradiance(p[None], n[None]) for g, p, n in
                 zip(alone, raised[some], normals[some], strict=True)]  # fmt: skip
        rows.append({"probes": "at the points", "order": order, "error": error(torch.cat(found), near)})
    sources = [("tracer", exact, stage.cameras["train"][::2], None)]
    for folder in options.runs:
        run = Run(folder)
        sources.append((run.method_name, run.method(), run.cameras()["train"], run.frame.to_export))
    for name, method, cameras, to_export in sources:
        for counts in options.counts if name == "tracer" else options.counts[1:2]:
            grid = bake_probes(method, cameras, method.frame.bounds, ProbesOptions(counts=counts))
            there = points, normals
            if to_export is not None:  # the room's own frame is that of the photographs
                assert torch.allclose(to_export.rotation, torch.eye(3, dtype=torch.float64), atol=1e-6)
            free = f"{int((grid.state == 0).sum())} of {len(grid)}"
            about = f"{name}, {' x '.join(map(str, counts))}, {free} free"
            for order in range(4):
                rows.append(
                    {"probes": about, "order": order, "error": error(cut(grid, order).irradiance(*there), truth)}
                )
            plain = error(unobstructed(grid).irradiance(*there), truth)
            rows.append({"probes": f"{about}, without visibility", "order": 3, "error": plain})
    return rows


def traced_ball(world: World, place: tuple, radius: float) -> World:
    ball = Object(Ball(radius), Material(Plain((BALL_WHITE / 255,) * 3)), Pose(place), "inserted")
    return dataclasses.replace(world, objects=(*world.objects, ball))


def ball_rows(options: Options) -> list[dict[str, Any]]:
    from playwright.sync_api import sync_playwright

    room, still = scenes.stage("room"), scenes.stage("materials", light=4, bounces=1)
    cases: list[tuple[str, Method, Any, tuple]] = [
        ("materials, linear light", Traced(still.world, still.bounds, still.near, True), still, MATERIALS_BALL),
        ("materials, sRGB pictures", Traced(still.world, still.bounds, still.near), still, MATERIALS_BALL),
        ("room", Traced(room.world, room.bounds, room.near), room, ROOM_BALL),
    ]
    for folder in options.runs:
        run = Run(folder)
        cases.append((f"room, {run.method_name}", run.method(), room, ROOM_BALL))
    cases = [case for case in cases if case[0].startswith(options.scenes)]
    rows = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=options.chromium, args=options.webgl.split())
        for name, method, stage, (middle, radius, eye) in cases:
            camera = pinhole(np.stack([look_at(eye, middle)]), 240, 50.0)
            grid = bake_probes(
                method,
                None,
                method.frame.bounds,
                ProbesOptions(counts=options.ball_counts, resolution=options.face_size),
            )
            scene = method.frame.to_source.inverse
            length = scene.scale
            place = tuple(scene.points(torch.tensor(middle)).tolist())
            seen_from = camera.transformed(scene.matrix)
            path = options.output / f"{name.replace(', ', '-').replace(' ', '-')}.html"
            probes_page(path, method, seen_from, grid, name, place=(place, 2 * radius * length), side=SIZE)
            flat = flat_camera(camera, SIZE)
            size = flat.size[0].tolist()
            page = browser.new_page(viewport={"width": size[0], "height": size[1]})
            page.goto(path.resolve().as_uri())
            page.evaluate("lumigraph.ready")
            page.add_style_tag(content=BARE)
            page.evaluate("lumigraph.rest()")
            drawn = torch.from_numpy(
                np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).copy()
            ).float() / 255  # fmt: skip
            page.close()
            truth, mask = truth_of(stage.world, flat, middle, radius)
            inside = -10 * math.log10(float((drawn - truth)[mask].square().mean()))
            whole = -10 * math.log10(float((drawn - truth).square().mean()))
            to_image(torch.cat([drawn, truth, (0.5 + 2 * (drawn - truth)).clamp(0, 1)], 1)).save(
                path.with_suffix(".png")
            )
            rows.append({"scene": name, "ball": inside, "picture": whole})
        browser.close()
    return rows


def truth_of(world: World, camera: Camera, middle: tuple, radius: float) -> tuple[Tensor, Tensor]:
    """Our tracer's picture of a world with the ball in it, sRGB-encoded, and the ball's pixels."""
    inserted = traced_ball(world, middle, radius)
    rays = camera.rays(camera.pixels())
    seen = trace(inserted, rays, shaded=False)
    width, height = camera.size[0].tolist()
    mask = torch.from_numpy(seen.identity == inserted.names.index("inserted")).view(height, width)
    if world.environment is not None:
        return encoded(shown(inserted, camera, 4).clamp(0, 1)), mask
    picture = render(inserted, camera).rgb
    hit = mask.flatten()
    points = rays.at(torch.from_numpy(seen.depth).float())[hit]
    normals = torch.from_numpy(seen.normal).float()[hit]
    light = [gathered(inserted, p, n, 256) for p, n in zip(points.split(4096), normals.split(4096), strict=True)]
    picture[mask] = encoded((ALBEDO / math.pi * torch.cat(light)).clamp(0, 1))
    return picture, mask


def main(options: Options) -> None:
    options.output.mkdir(parents=True, exist_ok=True)
    balls = ball_rows(options) if "balls" in options.parts else []
    table = Table("scene", "ball, PSNR", "picture, PSNR")
    for row in balls:
        table.add_row(row["scene"], f"{row['ball']:.1f} dB", f"{row['picture']:.1f} dB")
    console().print(table)
    rows = irradiance_rows(options) if "irradiance" in options.parts else []
    table = Table("probes", "order", "rms error", "median error")
    for row in rows:
        table.add_row(row["probes"], str(row["order"]), *(f"{100 * x:.1f} %" for x in row["error"]))
    console().print(table)
    write_json(options.output / "probes.json", {"irradiance": rows, "balls": balls})


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
