"""Each `--preset paper` trained for a hundred steps at its published width: whether its loss falls, and what it costs.

    python benchmarks/paper_presets.py                    methods that benchmarks/results/paper-presets-cpu.json lacks
    python benchmarks/paper_presets.py nerf dvgo --again  these, once more

Networks, tables, grids and the samples of a ray are the preset's. Smaller are the photographs, the grid of empty space,
and the batch of a step: rays that take about `evaluations` of the field, one member, one shape. The schedule is that of
118 steps, of which 100 are taken, ahead of stages that bake a field. A method stops at `seconds` of a processor. Each
runs in a process of its own and is written at once, so that the program goes on where it was stopped.
"""

from __future__ import annotations

import dataclasses
import datetime
import importlib.metadata
import json
import multiprocessing
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import tyro

from lumigraph import methods
from lumigraph.components.sampling.hierarchical_sampler import RayNumbers
from lumigraph.errors import LumigraphError
from lumigraph.files import write_json
from lumigraph.files.ranges import changed, holds, value_of
from lumigraph.lab.benchmark.conduct import launch
from lumigraph.lab.benchmark.gallery import CAPTIONS, MESH, PICTURE, SHOWPIECES, prepare
from lumigraph.opening import open_dataset
from lumigraph.run import build, processor
from lumigraph.system.console import console
from lumigraph.training import fit

OUTPUT = Path(__file__).parent / "results" / "paper-presets-cpu.json"
DATA = Path(tempfile.gettempdir()) / "lumigraph-paper-presets"  # a mesh, a picture and a model of captions
SHARE, PARTS = 0.85, 5  # of the schedule's steps that are taken; parts of the curve
OBJECT, MOVING = "procedural:still-life,size=64,views=40", "procedural:jelly,size=64,views=40,sweeps=4"
RECORDING, TOYS = "procedural:room,depth,views=40,size=64", "procedural:toys,count=10,size=32,views=10"
SCENES = {  # by method, where that is no object and not the gallery's smallest data
    "block-nerf": "procedural:city,crossings=2,views=40,size=64",
    "neural-scene-graph": "procedural:traffic,size=64,views=40",
    "nerf-w": "procedural:tourists,size=64,views=40",
    "rawnerf": "procedural:night,size=64,views=40",
    "regnerf": "procedural:courtyard,size=64,views=3",
    "nerfactor": "procedural:materials,size=64,views=20",
    "srn": "procedural:chairs,count=10,size=32,views=10",
    "neural-volumes": "procedural:jelly,rig=12,size=64,views=60",
    **dict.fromkeys(("lumigraph", "view-interpolation"), "procedural:still-life,size=64,views=12"),
    **dict.fromkeys(("hyp-nerf", "pixelnerf", "eg3d"), TOYS),
    **dict.fromkeys(("tsdf-fusion", "imap", "splat-slam"), RECORDING),
    **dict.fromkeys(("nerfies", "nsff", "deformable-splatting"), MOVING),
}
ONE = "members_per_step", "shapes_per_step", "landscapes_per_step", "textures_per_step", "moments_per_step"
ONE += "unseen_patches", "crops_per_view"
TWO = "views_per_step", "pictures_per_step"  # of which an adversary compares several
LENGTHS = {  # steps of the paper or its release, where the page of the method or the test of its numbers has them
    "nerf": 300_000, "mip-nerf": 1_000_000, "nerf-w": 300_000, "nerfies": 250_000, "nsff": 500_000,
    "neural-volumes": 500_000, "humannerf": 400_000, "deformable-splatting": 23_000, "regnerf": 69_768,
    "nerfactor": 30_000, "neus": 300_000, "plenoxels": 128_000, "dvgo": 25_000, "tensorf": 30_000,
    "gaussian-splatting": 30_000, "planar-splatting": 30_000, "object-nerf": 200_000, "eg3d": 27_500_000 // 32,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Options:
    names: tyro.conf.Positional[tuple[str, ...]] = ()  # methods; all by default
    steps: int = 100
    seconds: float = 20.0  # of a processor, of each method
    evaluations: int = 1024  # of the field in a step, about
    seed: int = 0
    again: bool = False  # also methods that the file has
    output: Path = OUTPUT


@dataclasses.dataclass
class Notes:
    """Lines of metrics.jsonl, by the trainer's protocol of a watch. It ends training after seconds of a processor,
    without those of the first step, which compiles."""

    seconds: float
    rows: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    times: list[float] = dataclasses.field(default_factory=list)
    asked = False

    def give_way(self, stopping: Callable[[], object]) -> None:
        pass

    def note(self, step: int, progress: float, row: dict[str, Any]) -> bool:
        self.rows += [row] if row else []
        self.times.append(time.process_time())
        return self.times[-1] - self.times[0] > self.seconds


def main(options: Options) -> None:
    found = json.loads(options.output.read_text("utf-8")) if options.output.exists() else {"cells": []}
    old = {row["method"]: row for row in found["cells"]}
    for name in options.names or methods.available():
        if options.again or name not in old:
            old[name] = apart(name, options)
            kept = [old[each] for each in methods.available() if each in old]
            write_json(options.output, about() | {"cells": kept}, ours=True)
            console().print(name, old[name].get("fault") or f"{old[name]['steps']} steps, loss {old[name]['loss']}")


def about() -> dict[str, Any]:
    """Machine, threads, versions and command of the file; commit, date and load are each method's."""
    versions = {name: importlib.metadata.version(name) for name in ("torch", "numba", "numpy")}
    machine = f"cpu, {processor(torch.device('cpu'))}"
    return {"machine": machine, "threads": torch.get_num_threads(), "versions": versions} | {
        "commands": ["python benchmarks/paper_presets.py"]
    }


def apart(name: str, options: Options) -> dict[str, Any]:
    """Figures of a method that a process of its own trained, or its fault; with commit, date and load."""
    commit = subprocess.run(["git", "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True, check=True)
    told = {"method": name, "commit": commit.stdout.strip(), "date": f"{datetime.date.today()}"}
    told |= {"load": round(os.getloadavg()[0], 1)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figures.json"
        child = multiprocessing.get_context("fork").Process(target=write, args=(name, options, path))
        child.start()
        child.join()
        if not path.exists():
            return told | {"fault": f"the process ended with code {child.exitcode}"}
        return told | json.loads(path.read_text("utf-8"))


def write(name: str, options: Options, path: Path) -> None:
    """Write the figures of a method's training, or the fault that ended it."""
    try:
        found = trained(name, options)
    except Exception as fault:  # any: it is the result
        found = {"fault": f"{type(fault).__name__}: {fault}"[:300]}
    path.write_text(json.dumps(found), "utf-8")


def trained(name: str, options: Options) -> dict[str, Any]:
    """Train one method: the scene, numbers that differ, steps, memory, seconds of a processor, and the two curves."""
    kind, device, notes = methods.find(name), torch.device("cpu"), Notes(options.seconds)
    source = SCENES.get(name) or next((x for x in [SHOWPIECES[name].source] if "still-life" not in x), OBJECT)
    guided = source.startswith("words:")
    if prepare({source}, guided, DATA, print, launch):
        raise LumigraphError("The model of captions was stopped; start the program again")
    further = {"guidance": str(DATA / CAPTIONS)} if guided else {}
    data = open_dataset(DATA / source if source in (MESH, PICTURE) else source, kind.learns_from, **further)
    numbers = smaller_batch(kind.Config(), options.evaluations)
    method = build(kind, data.frame, changed(kind.Config(), **numbers), device, options.seed, learning=True)
    budget = {"steps": round(options.steps / SHARE), "pause_at": options.steps}
    outcome = fit(method, data, **budget, seed=options.seed, show=False, log_every=1, watch=notes, rehearsal=False)
    curves = {key: parts([row[key] for row in notes.rows if key in row]) for key in ("loss", "psnr")}
    found = {"scene": source, "numbers": numbers, "steps": outcome.state.step} | curves
    seconds = [after - before for before, after in zip(notes.times, notes.times[1:], strict=False)]
    found["seconds_per_step"] = statistics.mean(seconds) if seconds else None
    found |= {"peak_memory": outcome.state.peak_memory, "paper_steps": LENGTHS.get(name)}
    return found | {"batch_share": batch_share(kind.Config(), numbers)}


def smaller_batch(config: Any, evaluations: int) -> dict[str, int]:
    """The numbers of a Config that make a step as small as some evaluations of the field."""
    few = {
        "samples_per_step": evaluations,
        "pixels_per_step": evaluations,
        "patches": 1024,
        "crop": 64,
        "depth_size": 64,
    }
    few |= {"rays_per_step": max(8, evaluations // 128), "rays_per_member": evaluations // 128, "points_per_step": 512}
    few |= {"points_per_shape": 1024, "pool_points": 50_000, "background_points": evaluations // 8}
    few |= {"sparsity_points": evaluations} | dict.fromkeys(ONE, 1) | dict.fromkeys(TWO, 2)
    if value_of(config, "occupancy_resolution") if holds(config, "occupancy_resolution") else 0:
        few["occupancy_resolution"] = 32
    if isinstance(rays := getattr(config, "rays", None), RayNumbers):
        few["rays_per_step"] = max(8, evaluations // (rays.coarse_samples + rays.fine_samples))
    return {key: value for key, value in few.items() if holds(config, key) and value_of(config, key) > value}


def batch_share(config: Any, numbers: dict[str, int]) -> float:
    """Share of the preset's batch that a step took: the smallest of its rays, members and samples."""
    shares = {key: value / value_of(config, key) for key, value in numbers.items() if key.endswith(PER)}
    members = shares.pop("members_per_step", 1.0) * shares.pop("rays_per_member", 1.0)
    return min([members, *shares.values()])


PER = "_per_step", "_per_member"


def parts(values: list[float]) -> list[float]:
    """Means over equal parts of the values; none of too few."""
    length = len(values) // PARTS
    return [statistics.mean(values[i * length : (i + 1) * length]) for i in range(PARTS)] if length else []


if __name__ == "__main__":
    main(tyro.cli(Options))
