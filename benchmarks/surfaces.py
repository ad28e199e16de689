"""Surfaces of three unlike objects by several methods: the table of docs/meshes.md, by one command.

    python benchmarks/surfaces.py --meshes stanford-bunny.obj spot.obj openwork --seconds 100

`openwork` is made here: a bowl of thin walls on a ring with a hole, beneath two bars. Each object is photographed as by
`photographed.py`, each method learns for so many seconds, and `mesh.py` compares its mesh with the exact one.
OUTPUT/surfaces.json has the figures and the processor seconds, OUTPUT/OBJECT-METHOD.ply the meshes. Needs embreex.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import mesh
import numpy as np
import photographed
import torch
import trimesh
import tyro
from skimage.measure import marching_cubes

from lumigraph import methods
from lumigraph.files import write_json
from lumigraph.opening import open_scene
from lumigraph.run import Run, build
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

CELLS = 160  # of the grid of the made object, along each side
WALL, BAR = 0.035, 0.03  # half of the bowl's wall, radius of the bars, of a box of half-size 1


@dataclass(frozen=True)
class Options:
    meshes: tuple[str, ...]
    methods: tuple[str, ...] = ("voxel-fit", "dvr", "mesh-fit", "neus", "instant-ngp")
    seconds: float = 100.0
    views: int = 60
    size: int = 200
    output: Path = Path("surfaces")


def main(options: Options) -> None:
    options.output.mkdir(parents=True, exist_ok=True)
    scenes = {Path(name).stem: photographs(name, options) for name in options.meshes}
    rows = []
    for name in options.methods:
        for object_name, folder in scenes.items():
            row = {"object": object_name} | learnt(name, folder, options.output / f"{object_name}-{name}", options)
            rows.append(row)
            print(row, flush=True)
            write_json(options.output / "surfaces.json", rows)


def photographs(name: str, options: Options) -> Path:
    """Folder of an object's photographs; made once."""
    folder = options.output / f"{Path(name).stem}-photographs"
    if not folder.is_dir():
        file = Path(name)
        if name == "openwork":
            file = options.output / "openwork.ply"
            openwork().export(file)
        photographed.main(photographed.Options(file, folder, views=options.views, size=options.size))
    return folder


def openwork() -> trimesh.Trimesh:
    """A bowl of thin walls on a ring, beneath two crossed bars."""
    axis = np.linspace(-1, 1, CELLS)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    bowl = np.maximum(np.abs(np.sqrt(x**2 + y**2 + (z - 0.1) ** 2) - 0.6) - WALL, z - 0.1)
    ring = np.hypot(np.hypot(x, y) - 0.42, z + 0.62) - 0.14
    bars = [np.hypot(a, z - 0.4) - BAR for a in (x, y)]
    legs = [np.hypot(a, b - side * 0.8) - BAR for a, b in ((x, y), (y, x)) for side in (-1, 1)]
    bars = [np.maximum(bar, np.abs(along) - 0.8) for bar, along in zip(bars, (y, x), strict=True)]
    legs = [np.maximum(leg, np.abs(z + 0.1) - 0.5) for leg in legs]
    vertices, faces, _, _ = marching_cubes(-np.min([bowl, ring, *bars, *legs], 0), 0.0, spacing=(2 / (CELLS - 1),) * 3)
    made = trimesh.Trimesh(vertices - 1, faces[:, ::-1])
    return made if made.volume > 0 else trimesh.Trimesh(vertices - 1, faces)


def learnt(name: str, folder: Path, output: Path, options: Options) -> dict:
    """Figures of a method's mesh of an object."""
    scene, kind = open_scene(str(folder)), methods.find(name)
    run = Run.create(output, build(kind, scene.frame, kind.cpu_preset(), torch.device("cpu"), 0), scene)
    begin = time.process_time()
    go_on_unless(fit(run.new_method(), scene, run, seconds=options.seconds, show=False).signal)
    spent = time.process_time() - begin
    found = mesh.beside_truth(run, 40)
    return {"steps": run.state.step, "processor s": round(spent, 1)} | found


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
