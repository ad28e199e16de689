"""Mesh fitting by gradients: from a sphere to its target, with plain and with preconditioned steps (Nicolet 2021)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from ...camera import Camera, dome, ring
from ...datasets.images import ImageStore
from ...datasets.mesh import Mesh
from ...datasets.scene import Frame, Scene
from ...datasets.shapes import Shape, Shapes
from ...errors import LumigraphError
from ...figures import Row, contact_sheet, save_picture
from ...figures.charts import Series, line_chart, standalone
from ...files import write_bytes, write_json
from ...files.ranges import changed
from ...geometry import unit
from ...methods.mesh_fit import Config, MeshFit
from ...system.progress import track

SIZE, VIEWS = 160, 24  # pixels a side of a mesh's pictures, and how many there are about
LIGHT = (0.4, -0.5, 0.77)  # direction to the light of shaded surfaces
AMBIENT = 0.3
POINTS = 10_000  # on each surface, of the chamfer distance
COLUMNS = 6  # steps that are drawn
CELLS = 64  # of the sphere's triangles along its longest side
# Rates of about the same movement: the preconditioner shortens steps.
WAYS: dict[str, dict[str, float]] = {
    "large steps": {"learning_rate": 0.3, "final_learning_rate": 0.03},
    "plain steps": {"learning_rate": 0.02, "final_learning_rate": 0.002, "smoothness": 0.0},
}


@dataclass(frozen=True)
class Fit:
    """One optimisation run.

    steps, pictures: shaded renderings at some steps
    errors:  mean squared error of each step's photographs
    chamfer: distance to the target at those steps, percent of its diagonal; empty without a target mesh
    """

    name: str
    steps: list[int]
    pictures: list[Float[Tensor, "height width 3"]]
    errors: list[float]
    chamfer: list[float]


def compare(data: Scene | Shapes, steps: int, seed: int = 0) -> tuple[Float[Tensor, "height width 3"], list[Fit]]:
    """Rendering of the target, and the fits from a sphere, which differ only in the preconditioner. Raises
    LumigraphError for a target that is neither a mesh nor photographs of an object."""
    shape = data.members[0] if isinstance(data, Shapes) else None
    if shape is not None and shape.is_cloud:
        raise LumigraphError("A cloud of points has no surface to be photographed; name a mesh, or photographs")
    scene = photographed(shape) if shape is not None else data
    assert isinstance(scene, Scene)
    first = int(scene.splits["train"][0])
    camera = scene.cameras[first]
    if shape is not None:
        target = shaded(holding(scene.frame, shape.mesh), camera)
    else:
        target = scene.photograph(first).before(scene.frame.background)
    chosen = sorted({round((steps - 1) * (k / (COLUMNS - 1)) ** 2) for k in range(COLUMNS)})
    config = Config(first_cells=CELLS, remeshings=0, views_per_step=4, seed=seed)
    ways = {name: changed(config, **way) for name, way in WAYS.items()}
    return target, [fitted(scene, way, name, chosen, camera, shape) for name, way in ways.items()]


def fitted(scene: Scene, config: Config, name: str, chosen: Sequence[int], camera: Camera, shape: Shape | None) -> Fit:
    """Fit a sphere with one configuration. chosen: steps before which the surface is rendered; the last ends it"""
    method, chance = MeshFit(scene.frame, config), torch.Generator().manual_seed(config.seed)
    optimizers, last = method.optimizers(), chosen[-1] + 1
    method.begin(scene)
    made = Fit(name, list(chosen), [], [], [])
    for step in track(range(last), f"Fitting in {name}", last):
        if step in chosen:
            made.pictures.append(shaded(method, camera))
            if shape is not None:
                made.chamfer.append(chamfer(method.mesh(), shape))
        rates = method.learning_rate(step, step / last)
        for group in (group for optimizer in optimizers for group in optimizer.param_groups):
            group["lr"] = rates[group["name"]]
        torch.stack([*method.loss(method.batch(scene, chance), step).values()]).sum().backward()
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad()
        made.errors.append(method.figures["mse"])
    return made


def photographed(shape: Shape) -> Scene:
    """Renderings of a mesh under one light, from all around, by our own rasteriser."""
    around = dome(ring(shape.frame.bounds, size=SIZE))
    cameras = around[torch.arange(0, len(around), math.ceil(len(around) / VIEWS))]
    index = torch.arange(len(cameras))
    frame = replace(shape.frame, has_alpha=True, image_count=len(cameras))
    method, pictures = holding(frame, shape.mesh), []
    for i in range(len(cameras)):
        rgb, opacity = shaded(method, cameras[i]), method.render(cameras[i]).opacity
        rgba = torch.cat([rgb, opacity[..., None]], -1)
        pictures.append((rgba.clamp(0, 1) * 255).round().byte().numpy())
    cameras, names = replace(cameras, image_index=index), [f"view {i}" for i in range(len(cameras))]
    return Scene(cameras, ImageStore.from_arrays(pictures), frame, {"train": index}, names, shape.name)


def holding(frame: Frame, mesh: Mesh) -> MeshFit:
    """The method of a given mesh."""
    method = MeshFit(frame, Config()).eval()
    method.surface.replace(mesh)
    return method


@torch.no_grad()
def shaded(method: MeshFit, camera: Camera) -> Float[Tensor, "height width 3"]:
    """The surface in grey under one light, over white."""
    seen = method.render(camera)
    light = unit(torch.tensor(LIGHT))
    grey = AMBIENT + (1 - AMBIENT) * (seen.extra["normals"] @ light + 1) / 2
    return (1 + seen.opacity * (grey - 1))[..., None].expand(-1, -1, 3)


def chamfer(mesh: Mesh, shape: Shape) -> float:
    """Mean distance of random points of either surface to those of the other, percent of the target's diagonal."""
    chance = torch.Generator().manual_seed(0)
    a, b = (x.surface(POINTS, chance).points.numpy() for x in (Shape("fit", mesh), shape))
    diagonal = float(np.linalg.norm(np.ptp(shape.mesh.vertices, axis=0)))
    return 50 * float(cKDTree(a).query(b)[0].mean() + cKDTree(b).query(a)[0].mean()) / diagonal


def draw(folder: Path, name: str, target: Float[Tensor, "height width 3"], fits: Sequence[Fit]) -> dict[str, Any]:
    """Write fitting.png, the sequence, fitting.svg, the curves, and fitting.json, the figures, which are returned."""
    columns = ["target", *(f"step {step}" for step in fits[0].steps)]
    rows = [Row(fit.name, [target, *fit.pictures]) for fit in fits]
    save_picture(folder / "fitting.png", contact_sheet(f"{name}: a sphere becomes its target", columns, rows), "figure")
    series = [Series(fit.name, range(1, len(fit.errors) + 1), fit.errors) for fit in fits]
    chart = line_chart(series, "step", "mean squared error of photographs", log=True)
    write_bytes(folder / "fitting.svg", standalone(chart), "figure")
    figures = {
        fit.name: {"steps": fit.steps, "chamfer_percent": fit.chamfer, "mean_squared_errors": fit.errors}
        for fit in fits
    }
    write_json(folder / "fitting.json", figures, "figure")
    return figures
