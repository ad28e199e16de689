"""tsdf-fusion beside Open3D: frames a second, bytes beside a dense grid, errors against exact geometry.

    pip install open3d==0.19                             # optional; without it ours is measured alone
    python benchmarks/fusion.py --size 320 --views 60
    python benchmarks/fusion.py --size 640 --views 30 --output FILE

Depth and colour of `procedural:room,depth`, with exact poses, once with the sensor's noise and once without. All fuse
the same pictures one after another, by turns, into voxels of the same size with the same truncation. Reading pictures
is not counted, and the first is fused once before. Seconds are the clock's, and processor seconds of all threads, for a
machine that does other work. Errors are distances of the mesh's vertices from the exact surface. Completeness is the
share of exactly seen points that have a vertex within two voxels. The dense grid covers the box of all blocks.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.table import Table
from scipy.spatial import cKDTree

from lumigraph.datasets.images import cosines
from lumigraph.datasets.scene import Photograph, Scene
from lumigraph.export.mesh_file import write_mesh
from lumigraph.files import write_json
from lumigraph.kernels.fuse_depth import CHANNELS
from lumigraph.methods.tsdf_fusion import TSDFFusion
from lumigraph.opening import open_scene
from lumigraph.synthetic import scenes, signed_distance
from lumigraph.system.console import console

try:
    import open3d
except ImportError:
    open3d = None

SEEN_POINTS = 20_000  # exact points whose completeness is tested
BLOCKS_AT_FIRST = 50_000  # of Open3D's hash map, enough that it does not grow


@dataclass(frozen=True)
class Options:
    size: int = 320  # pixels across
    views: int = 60
    seed: int = 0
    voxel: float = 0.01  # metres
    truncation: float = 4.0  # voxels
    open3d: bool = True
    output: Path | None = None  # also write the figures there, as JSON
    mesh: Path | None = None  # also write our last mesh there


@dataclass
class Program:
    """One program: `fuse` takes a picture, `vertices` gives the mesh's, `held` its bytes and those of a dense grid."""

    name: str
    fuse: Callable[[int], None]
    vertices: Callable[[], np.ndarray]
    held: Callable[[], tuple[float, float]] | None = None
    clock: list[float] = field(default_factory=list)
    processors: list[float] = field(default_factory=list)

    def timed(self, frame: int) -> None:
        begin, used = time.perf_counter(), time.process_time()
        self.fuse(frame)
        self.clock.append(time.perf_counter() - begin)
        self.processors.append(time.process_time() - used)


def main(options: Options) -> None:
    request = f"room,depth,views={options.views},size={options.size},seed={options.seed}"
    scene = open_scene(f"procedural:{request}")
    rows = []
    for layer in ("depth", "exact_depth"):
        photographs = [scene.photograph(int(i), (layer,)) for i in scene.splits["train"]]
        photographs = [replace(p, extra={"depth": p.extra[layer]}) for p in photographs]
        programs = [ours(scene, photographs, options)]
        if open3d is not None and options.open3d:
            programs += [volume(scene, photographs, options), block_grid(scene, photographs, options)]
        for frame in range(len(photographs)):
            for program in programs:
                program.timed(frame)
        rows += [figures(program, layer, scene, options) for program in programs]
    table = Table(
        "program",
        "depth",
        "frames/s",
        "processor s/frame",
        "median error, voxels",
        "95 %",
        "complete",
        "MB",
        "MB dense",
    )
    for row in rows:
        names = ("frames_per_second", "processor_seconds", "median", "p95", "complete")
        held = ("" if row[x] is None else f"{row[x] / 1e6:,.0f}" for x in ("bytes", "dense_bytes"))
        table.add_row(row["program"], row["depth"], *(f"{row[x]:.3g}" for x in names), *held)
    console().print(table)
    if options.output:
        write_json(options.output, {"scene": request, "rows": rows}, ours=True)


def ours(scene: Scene, photographs: list[Photograph], options: Options) -> Program:
    config = replace(TSDFFusion.cpu_preset(), voxel_size=options.voxel, truncation=options.truncation)
    method = TSDFFusion(scene.frame, config)
    TSDFFusion(scene.frame, config).step(photographs[0], 0, descend)

    def fuse(i: int) -> None:
        method.step(photographs[i], i, descend)

    def vertices() -> np.ndarray:
        made = method.mesh().in_source(scene.frame)
        if options.mesh:
            write_mesh(options.mesh, made, np.array([0.0, 0, 1]))
        return made.vertices

    def held() -> tuple[float, float]:
        low, high = method.volume.bounds()
        return method.volume.bytes, 4 * CHANNELS * float(((high - low) / method.volume.edge).prod())

    return Program("ours", fuse, vertices, held)


def descend(terms: Any, optimizers: Any = None) -> None:
    raise AssertionError("fusion has no gradients")


def pinhole(scene: Scene, photograph: Photograph) -> tuple[Any, np.ndarray]:
    """Open3D's intrinsics, whose pixel centres are at whole numbers, and world-to-camera in metres."""
    camera = photograph.camera.transformed(scene.frame.to_source.matrix)
    (fx, fy), (cx, cy) = camera.lens.focal[0].tolist(), (camera.lens.centre[0] - 0.5).tolist()
    width, height = camera.size[0].tolist()
    pose = np.eye(4)
    pose[:3] = camera.pose[0].double().numpy()
    return open3d.camera.PinholeCameraIntrinsic(width, height, fx, fy, cx, cy), np.linalg.inv(pose)


def along_axis(scene: Scene, photograph: Photograph) -> np.ndarray:
    """Depth along the axis in metres, 0 where it is not known, float32."""
    camera, depth = photograph.camera, photograph.extra["depth"]
    cosine = cosines(camera.rays(camera.pixels()).directions, camera.forward).view(depth.shape)
    metres = (depth * cosine * scene.frame.to_source.scale).nan_to_num(0.0, 0.0)
    return metres.float().numpy()


def pictures(scene: Scene, photograph: Photograph) -> tuple[np.ndarray, np.ndarray]:
    return along_axis(scene, photograph), (photograph.rgb * 255).round().byte().numpy()


def volume(scene: Scene, photographs: list[Photograph], options: Options) -> Program:
    """Open3D's ScalableTSDFVolume."""
    made = open3d.pipelines.integration.ScalableTSDFVolume(
        options.voxel, options.truncation * options.voxel, open3d.pipelines.integration.TSDFVolumeColorType.RGB8
    )
    frames = []
    for photograph in photographs:
        depth, rgb = (open3d.geometry.Image(np.ascontiguousarray(x)) for x in pictures(scene, photograph))
        picture = open3d.geometry.RGBDImage.create_from_color_and_depth(rgb, depth, 1.0, 100.0, False)
        frames.append((picture, *pinhole(scene, photograph)))
    return Program(
        "Open3D ScalableTSDFVolume",
        lambda i: made.integrate(*frames[i]),
        lambda: np.asarray(made.extract_triangle_mesh().vertices),
    )


def block_grid(scene: Scene, photographs: list[Photograph], options: Options) -> Program:
    """Open3D's VoxelBlockGrid with blocks of 8^3, on the CPU."""
    core, device = open3d.core, open3d.core.Device("CPU:0")
    types = (core.float32, core.float32, core.float32)
    shapes = ((1,), (1,), (3,))
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), types, shapes, options.voxel, 8, BLOCKS_AT_FIRST, device
    )
    frames = []
    for photograph in photographs:
        depth, rgb = pictures(scene, photograph)
        lens, pose = pinhole(scene, photograph)
        images = open3d.t.geometry.Image(depth), open3d.t.geometry.Image(rgb.astype(np.float32) / 255)
        frames.append((*images, core.Tensor(lens.intrinsic_matrix), core.Tensor(pose)))

    def fuse(i: int) -> None:
        depth, rgb, lens, pose = frames[i]
        found = grid.compute_unique_block_coordinates(depth, lens, pose, 1.0, 100.0, options.truncation)
        grid.integrate(found, depth, rgb, lens, lens, pose, 1.0, 100.0, options.truncation)

    def vertices() -> np.ndarray:
        return grid.extract_triangle_mesh(0.0).vertex.positions.numpy()

    return Program("Open3D VoxelBlockGrid", fuse, vertices)


def figures(program: Program, layer: str, scene: Scene, options: Options) -> dict[str, Any]:
    unit = scenes.stage("room", size=8, views=1, depth=1).unit
    world = scenes.stage("room", size=8, views=1, depth=1).world
    found = program.vertices()
    error = signed_distance(world, torch.from_numpy(found / unit).float()).abs().numpy() * unit / options.voxel
    seen = exact_points(scene)
    near = cKDTree(found).query(seen, distance_upper_bound=2 * options.voxel)[0]
    held = program.held() if program.held else (None, None)
    return {
        "program": program.name,
        "depth": layer,
        "frames_per_second": len(program.clock) / sum(program.clock),
        "processor_seconds": sum(program.processors) / len(program.processors),
        "median": float(np.median(error)),
        "p95": float(np.quantile(error, 0.95)),
        "complete": float(np.isfinite(near).mean()),
        "vertices": len(found),
        "bytes": held[0],
        "dense_bytes": held[1],
    }


def exact_points(scene: Scene) -> np.ndarray:
    """Points in the source's frame that the training cameras see exactly."""
    random, parts = torch.Generator().manual_seed(0), []
    train = scene.splits["train"]
    for i in train.tolist():
        photograph = scene.photograph(i, ("exact_depth",))
        rays = photograph.camera.rays(photograph.camera.pixels())
        some = torch.randint(len(rays), (SEEN_POINTS // len(train),), generator=random)
        parts.append(rays[some].at(photograph.extra["exact_depth"].flatten()[some]))
    return scene.frame.to_source.points(torch.cat(parts)).numpy()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
