"""Our tree of triangles beside libigl's fast winding number and Embree's rays, in one run.

    pip install libigl embreex
    python benchmarks/triangles.py bunny.obj

Building, winding numbers and distances of random points in the box of the mesh; and which points are inside: by the
exact winding number, and by the parity of a ray's crossings, of the mesh and of a soup of it and a shifted copy.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
import trimesh
import tyro
from trimesh.ray.ray_pyembree import RayMeshIntersector

from lumigraph.datasets.shapes.triangles import Triangles


@dataclass(frozen=True)
class Options:
    mesh: tyro.conf.Positional[Path]
    points: int = 100_000
    exact: int = 2_000
    seed: int = 0


def timed(call: Callable[[], Any], repeats: int = 3) -> tuple[Any, float]:
    """Result, and the least processor seconds of all threads."""
    call()
    seconds = []
    for _ in range(repeats):
        begin = time.process_time()
        result = call()
        seconds.append(time.process_time() - begin)
    return result, min(seconds)


def main(options: Options) -> None:
    mesh = trimesh.load(options.mesh, process=True)
    random = np.random.default_rng(options.seed)
    soup = trimesh.util.concatenate([mesh, mesh.copy().apply_translation(0.2 * mesh.extents)])
    for name, shape in (("mesh", mesh), ("soup of two", soup)):
        vertices, faces = np.ascontiguousarray(shape.vertices, np.float64), np.ascontiguousarray(shape.faces, np.int64)
        low, high = vertices.min(0), vertices.max(0)
        points = random.uniform(low, high, (options.points, 3))
        few = points[: options.exact]
        tree, building = timed(lambda corners=vertices[faces]: Triangles(corners))
        exact = tree.winding(few, np.inf)
        ours, winding = timed(lambda tree=tree, points=points: tree.winding(points))
        distance, distances = timed(lambda tree=tree, points=points: tree.nearest(points)[0])
        print(f"{name}: {len(faces):,} triangles, {options.points:,} points; processor seconds")
        row("ours", building, winding, distances, ours[: len(few)], exact)
        theirs, both = timed(lambda v=vertices, f=faces, p=points: igl.fast_winding_number(v, f, p))
        _, one = timed(lambda v=vertices, f=faces, p=points: igl.fast_winding_number(v, f, p[:1]))
        square, nearest = timed(lambda v=vertices, f=faces, p=points: igl.point_mesh_squared_distance(p, v, f)[0])
        row("libigl", one, both - one, nearest, np.asarray(theirs)[: len(few)], exact)
        print(f"  distances differ by {np.abs(np.sqrt(square) - distance).max():.1e} at most")
        rays, building = timed(lambda shape=shape: RayMeshIntersector(shape))
        inside, parity = timed(lambda rays=rays, points=points: rays.contains_points(points))
        wrong = (inside[: len(few)] != (exact > 0.5)).mean()
        print(f"  {'embreex':8} build {building:.3f}  parity {parity:.3f}  wrong side {100 * wrong:.2f} %")


def row(name: str, building: float, winding: float, distances: float, found: np.ndarray, exact: np.ndarray) -> None:
    off, wrong = np.abs(found - exact), ((found > 0.5) != (exact > 0.5)).mean()
    print(
        f"  {name:8} build {building:.3f}  winding {winding:.3f}  distance {distances:.3f}  "
        f"winding off by {off.mean():.1e} (most {off.max():.1e})  wrong side {100 * wrong:.2f} %"
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
