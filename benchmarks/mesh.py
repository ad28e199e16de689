"""How near exported meshes lie to the truth, and how well mesh, points and splats of one capture overlap.

    lumigraph train instant-ngp procedural:still-life --seconds 60 --output A
    lumigraph train gaussian-splatting procedural:still-life --seconds 60 --output B
    python benchmarks/mesh.py --exact A B

    lumigraph train gaussian-splatting FOX --downscale 4 --seconds 60 --output C
    python benchmarks/mesh.py --overlap C --scene FOX

Exact: of a run of a procedural scene. The chamfer distance is the mean of two means, in per cent of the diagonal of the
box around the world's objects: from points spread evenly over the mesh to the world's surface (its signed distance),
and from points of the surface that the training cameras see (one per ray, traced) to the mesh's points.
Overlap: in the capture's frame. From points of the mesh, inside the mesh's own box, to the nearest of the exported
points; from exported points, Gaussians (opacity above one half) and sparse points of the capture there to the mesh.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from rich.table import Table
from scipy.spatial import cKDTree

from lumigraph.capture import open_scene
from lumigraph.datasets.mesh import Mesh
from lumigraph.export.mesh import extract_mesh
from lumigraph.export.points import extract_points
from lumigraph.files import write_json
from lumigraph.method import Method
from lumigraph.run import Run
from lumigraph.synthetic import scenes, signed_distance, trace
from lumigraph.system.console import console

SAMPLES = 200_000  # points spread over a mesh
RAYS = 100_000  # of the training cameras, towards the exact surface


@dataclass(frozen=True)
class Options:
    exact: tuple[Path, ...] = ()  # runs of procedural scenes
    overlap: tuple[Path, ...] = ()  # runs of a capture
    scene: Path | None = None  # its photographs, for their sparse points
    views: int = 64
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    result = {}
    if options.exact:
        result["exact"] = [beside_truth(Run(folder), options.views) for folder in options.exact]
        show("Beside the exact surface", result["exact"])
    if options.overlap:
        found = [beside_each_other(Run(folder), options.scene, options.views) for folder in options.overlap]
        result["overlap"] = found
        show("Beside each other: median distances in the capture's units", found)
    if options.output:
        write_json(options.output, result)


def beside_truth(run: Run, views: int) -> dict:
    """Chamfer distance, and whether the mesh is closed."""
    name = run.settings.scene.source.removeprefix("procedural:").partition(",")[0]
    stage = scenes.stage(name)
    begin = time.perf_counter()
    mesh = extract_mesh(run.method(), run.cameras()["train"], views=views).in_source(run.frame)
    seconds = time.perf_counter() - begin
    points = spread(mesh)
    away = signed_distance(stage.world, torch.from_numpy(points)).abs().numpy()
    visible = seen_surface(stage)
    back = cKDTree(points).query(visible)[0]
    low, high = stage.world.bounds()
    diagonal = float(np.linalg.norm(high - low))
    return {
        "method": run.method_name,
        "triangles": len(mesh.faces),
        "seconds": round(seconds, 1),
        "watertight": bool(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight),
        "mesh to truth %": 100 * float(away.mean()) / diagonal,
        "truth to mesh %": 100 * float(back.mean()) / diagonal,
        "chamfer %": 50 * float(away.mean() + back.mean()) / diagonal,
    }


def seen_surface(stage) -> np.ndarray:
    """Where rays of the training cameras meet the world."""
    cameras = stage.cameras["train"]
    found = []
    for i in range(len(cameras)):
        pixels = cameras[i].pixels()
        rays = cameras[i].rays(pixels[torch.randperm(len(pixels), generator=torch.Generator().manual_seed(i))])
        rays = rays[: RAYS // len(cameras)]
        depth = torch.from_numpy(trace(stage.world, rays, shaded=False).depth).float()
        found.append(rays.at(depth)[depth.isfinite()])
    return torch.cat(found).numpy()


def beside_each_other(run: Run, scene: Path | None, views: int) -> dict:
    """Median distances between what is exported of one run."""
    method, cameras = run.method(), run.cameras()["train"]
    mesh = extract_mesh(method, cameras, views=views).in_source(run.frame)
    points = extract_points(method, cameras, views=views).in_source(run.frame).positions
    surface = spread(mesh)
    low, high = surface.min(0), surface.max(0)
    tree = cKDTree(surface)

    def median(positions: np.ndarray) -> float:
        inside = positions[((positions > low) & (positions < high)).all(-1)]
        return float(np.median(tree.query(inside)[0]))

    cell = run.frame.to_source.scale * float(np.ptp(np.array(run.frame.bounds), axis=0).max()) / 256
    row = {
        "method": run.method_name,
        "mesh's diagonal": float(np.linalg.norm(high - low)),
        "1/256 of the box": cell,
        "mesh to points": float(np.median(cKDTree(points).query(surface)[0])),
        "points to mesh": median(points),
    }
    matrix = torch.tensor(run.frame.source_from_scene)
    if type(method).gaussians is not Method.gaussians:
        cloud = method.gaussians()
        solid = cloud[cloud.opacities.sigmoid() > 0.5].transformed(matrix)
        row["splats to mesh"] = median(solid.means.detach().double().numpy())
    sparse = None if scene is None else open_scene(str(scene), **run.settings.scene.options).points
    if sparse is not None:
        moved = sparse.double() @ matrix[:3, :3].double().T + matrix[:3, 3].double()
        row["sparse points to mesh"] = median(moved.numpy())
    return row


def spread(mesh: Mesh) -> np.ndarray:
    """Points evenly over a mesh."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return np.asarray(trimesh.sample.sample_surface(solid, SAMPLES, seed=0)[0])


def show(title: str, rows: list[dict]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = Table(*names, title=title)
    for row in rows:
        table.add_row(*(f"{x:.4g}" if isinstance(x, float) else str(x) for x in (row.get(n, "") for n in names)))
    console(width=160).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
