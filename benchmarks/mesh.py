"""How near exported meshes lie to the truth, and how well mesh, points and splats of one capture overlap.

    lumigraph train instant-ngp procedural:still-life --seconds 60 --output A
    lumigraph train gaussian-splatting procedural:still-life --seconds 60 --output B
    python benchmarks/mesh.py --exact A B

    lumigraph train gaussian-splatting FOX --downscale 4 --seconds 60 --output C
    python benchmarks/mesh.py --overlap C --scene FOX

Exact: of a run of a procedural scene, or of a folder of `benchmarks/photographed.py`, whose truth.ply is the surface.
The chamfer distance is the mean of two means, in per cent of the diagonal of the box around the world's objects: from
points spread evenly over the mesh to the exact surface, and from points of the surface that the training cameras see
(one per ray, traced; of a truth.ply by embreex) to the mesh's points. Normal consistency is the mean of two means
likewise, of the absolute cosine between the normals there. PSNR is of held-out photographs.
Overlap: in the capture's frame. From points of the mesh, inside the mesh's own box, to the nearest of the exported
points; from exported points, Gaussians (opacity above one half) and sparse points of the capture there to the mesh.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from rich.table import Table
from scipy.spatial import cKDTree

from lumigraph.camera import Camera
from lumigraph.camera.rays import Rays
from lumigraph.datasets.mesh import Mesh
from lumigraph.datasets.shapes.triangles import Triangles
from lumigraph.evaluation.views import evaluate
from lumigraph.export.mesh import extract_mesh
from lumigraph.export.options import MeshOptions, PointsOptions
from lumigraph.export.points import extract_points
from lumigraph.files import write_json
from lumigraph.method import Method
from lumigraph.opening import open_scene
from lumigraph.run import Run
from lumigraph.synthetic import scenes, signed_distance, trace
from lumigraph.system.console import console

SAMPLES = 200_000  # points spread over a mesh
RAYS = 100_000  # of the training cameras, towards the exact surface


@dataclass(frozen=True)
class Options:
    exact: tuple[Path, ...] = ()  # runs of procedural scenes, and of folders with a truth.ply
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


@dataclass(frozen=True)
class Truth:
    """An exact surface in the frame of the photographs.

    diagonal: of the box around it
    nearest:  distances of points from it, and its unit normals at the nearest places
    seen:     points of it that the training cameras see;  normals: there
    """

    diagonal: float
    nearest: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    seen: np.ndarray
    normals: np.ndarray


def beside_truth(run: Run, views: int) -> dict:
    """Chamfer distance, normal consistency, and whether the mesh is closed."""
    file = Path(run.settings.scene.source) / "truth.ply"
    truth = truth_of_mesh(file, run) if file.is_file() else truth_of_world(run)
    method = run.method()
    begin = time.perf_counter()
    mesh = extract_mesh(method, run.cameras()["train"], MeshOptions(views=views)).in_source(run.frame)
    seconds = time.perf_counter() - begin
    points, normals = spread(mesh)
    away, there = truth.nearest(points)
    back, index = cKDTree(points).query(truth.seen)
    alike = [np.abs((normals * there).sum(-1)), np.abs((normals[index] * truth.normals).sum(-1))]
    return {
        "method": run.method_name,
        "training s": round(run.state.seconds, 1),
        "triangles": len(mesh.faces),
        "mesh s": round(seconds, 1),
        "watertight": bool(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight),
        "mesh to truth %": 100 * float(away.mean()) / truth.diagonal,
        "truth to mesh %": 100 * float(back.mean()) / truth.diagonal,
        "chamfer %": 50 * float(away.mean() + back.mean()) / truth.diagonal,
        "normals": float(np.mean([x.mean() for x in alike])),
        "psnr": evaluate(method, open_scene(run.settings.scene.source, **run.settings.scene.options)).psnr,
    }


def truth_of_world(run: Run) -> Truth:
    """The surface of a procedural world."""
    name = run.settings.scene.source.removeprefix("procedural:").partition(",")[0]
    stage = scenes.stage(name)

    def nearest(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        steps = np.concatenate([np.zeros((1, 3)), np.eye(3) * 1e-4, -np.eye(3) * 1e-4])
        around = [signed_distance(stage.world, torch.from_numpy(points + step)).numpy() for step in steps]
        slope = np.stack([around[1 + k] - around[4 + k] for k in range(3)], -1)
        return np.abs(around[0]), slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)

    points, normals = [], []
    for rays in some_rays(stage.cameras["train"]):
        seen = trace(stage.world, rays, shaded=False)
        depth = torch.from_numpy(seen.depth).float()
        points.append(rays.at(depth)[depth.isfinite()].numpy())
        normals.append(seen.normal[depth.isfinite().numpy()])
    low, high = stage.world.bounds()
    return Truth(float(np.linalg.norm(high - low)), nearest, np.concatenate(points), np.concatenate(normals))


def truth_of_mesh(file: Path, run: Run) -> Truth:
    """The surface in a file beside photographs, in their frame."""
    mesh = trimesh.load(file, process=False)
    tree = Triangles(np.asarray(mesh.triangles))

    def nearest(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance, face = tree.nearest(points)
        return distance, mesh.face_normals[face]

    points, normals = [], []
    for rays in some_rays(run.cameras()["train"].transformed(run.frame.to_source.matrix)):
        given = rays.origins.numpy(), rays.directions.numpy()
        places, _, faces = mesh.ray.intersects_location(*given, multiple_hits=False)
        points.append(places)
        normals.append(mesh.face_normals[faces])
    return Truth(float(np.linalg.norm(mesh.extents)), nearest, np.concatenate(points), np.concatenate(normals))


def some_rays(cameras: Camera) -> Iterator[Rays]:
    """Rays through random pixels of each camera, RAYS of all."""
    for i in range(len(cameras)):
        pixels = cameras[i].pixels()
        chosen = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(i))
        yield cameras[i].rays(pixels[chosen])[: RAYS // len(cameras)]


def beside_each_other(run: Run, scene: Path | None, views: int) -> dict:
    """Median distances between what is exported of one run."""
    method, cameras = run.method(), run.cameras()["train"]
    mesh = extract_mesh(method, cameras, MeshOptions(views=views)).in_source(run.frame)
    points = extract_points(method, cameras, PointsOptions(views=views)).in_source(run.frame).positions
    surface, _ = spread(mesh)
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


def spread(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Points evenly over a mesh, and normals of their faces."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, faces = trimesh.sample.sample_surface(solid, SAMPLES, seed=0)
    return np.asarray(points), solid.face_normals[faces]


def show(title: str, rows: list[dict]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = Table(*names, title=title)
    for row in rows:
        table.add_row(*(f"{x:.4g}" if isinstance(x, float) else str(x) for x in (row.get(n, "") for n in names)))
    console(width=160).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
