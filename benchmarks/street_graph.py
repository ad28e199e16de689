"""Neural scene graphs on procedural traffic with its truth: held-out frames, moving boxes, edits, unseen instances.

    python benchmarks/street_graph.py --seeds 0 1 --seconds 80
    python benchmarks/street_graph.py --seeds 0 --seconds 80 --track-errors 0.04

Trains neural-scene-graph, and instant-ngp for the same time without a graph; seconds are those of processors, because a
machine may be busy. Held-out frames lie between those of training. PSNR in boxes is of the pixels whose rays cross the
box of a car. Each edit (a car moved, turned, removed, added, two swapped) is rendered from held-out frames and compared
with the edited scene traced anew, inside the boxes that the edit concerns: where its car was, and where it is.
--track-errors moves and turns the given boxes at random by so many scene units and radians, and also trains with
--refine-tracks. --unseen finds the code of one more car. OUTPUT/SEED.png has the truth above renderings, of a held-out
frame and of each edit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor

from lumigraph import methods
from lumigraph import synthetic as procedural
from lumigraph.camera import Camera
from lumigraph.datasets.scene import Scene
from lumigraph.datasets.tracks import GraphNode, TrackEdit, TrackEdits, nodes_of
from lumigraph.evaluation.views import evaluate
from lumigraph.figures import to_bytes
from lumigraph.files import write_json
from lumigraph.files.ranges import changed
from lumigraph.method import Method
from lumigraph.methods.neural_scene_graph.nodes import PoseTable, crossings
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.synthetic.rendering import photograph
from lumigraph.synthetic.scenes.traffic import with_edits
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit, loop

NAME, BASELINE = "neural-scene-graph", "instant-ngp"
EDITED_VIEWS = 3  # held-out frames that each edit is compared at
EDITS = {
    "moved": (TrackEdit("car 1", shift=(0.06, -0.1, 0.0)),),
    "turned": (TrackEdit("car 2", turn=60.0),),
    "removed": (TrackEdit("car 1", remove=True),),
    "added": (TrackEdit("another car", like="car 3"),),  # on the track of the next car of the scene
    "swapped": (TrackEdit("car 1", like="car 2"), TrackEdit("car 2", like="car 1")),
}


@dataclass(frozen=True)
class Options:
    seeds: tuple[int, ...] = (0, 1)
    size: int = 100  # pixels a side
    views: int = 60  # photographs of the moving camera
    cars: int = 4
    seconds: float = 80.0  # processor seconds of training each
    track_errors: float = 0.0  # deviation of the given boxes: scene units and radians
    edits: bool = True  # compare edits too
    unseen: bool = False  # find the code of one more car
    output: Path = Path("street_graph")


def main(options: Options) -> None:
    options.output.mkdir(parents=True, exist_ok=True)
    rows = {}
    for seed in options.seeds:
        request = f"procedural:traffic,size={options.size},views={options.views},seed={seed},cars={options.cars}"
        scene = open_scene(request)
        truth = scene.frame.tracks
        scene = replace(scene, frame=replace(scene.frame, tracks=wrong(truth, options.track_errors, seed)))
        kinds = {NAME: {}, BASELINE: {}}
        if options.track_errors:
            kinds = {NAME: {}, f"{NAME} --refine-tracks": {"refine_tracks": True}}
        row = {}
        for name, numbers in kinds.items():
            method, spent, steps = trained(name.split()[0], scene, options.seconds, numbers)
            found = evaluate(method, scene).to_json()
            row[name] = {"PSNR": found["psnr"], "in boxes": in_boxes(method, scene, nodes_of(truth))}
            row[name] |= {"processor seconds": spent, "steps": steps}
            print(seed, name, row[name], flush=True)
            if name == NAME and options.edits:
                row["edits"] = edited(method, scene, options, seed)
                print(seed, row["edits"], flush=True)
            if name == NAME and options.unseen:
                row["unseen"] = unseen(method, options, seed)
                print(seed, row["unseen"], flush=True)
        rows[seed] = row
        write_json(options.output / "street_graph.json", rows)


def trained(name: str, scene: Scene, seconds: float, numbers: dict) -> tuple[Method, float, int]:
    """A method with its numbers for a plain CPU, trained for so many seconds of the processor."""
    kind = methods.find(name)
    config = changed(kind.cpu_preset(), **numbers)
    method = build(kind, scene.frame, config, torch.device("cpu"), 0, learning=True)
    begin = time.process_time()
    with mock.patch.object(loop, "time", SimpleNamespace(perf_counter=time.process_time)):
        outcome = fit(method, scene, seconds=seconds, show=False)
    go_on_unless(outcome.signal)
    return method.eval(), time.process_time() - begin, outcome.state.step


def wrong(tracks: tuple, deviation: float, seed: int) -> tuple:
    """Tracks whose boxes are somewhere else by a deviation, the same at all moments of one."""
    random = np.random.default_rng((seed, 5))
    found = []
    for track in tracks:
        x, y, turn = deviation * random.normal(size=3)
        edit = TrackEdit(track.name, shift=(float(x), float(y), 0.0), turn=float(np.degrees(turn)))
        found += [node.track for node in nodes_of((track,), TrackEdits((edit,)))] if deviation else [track]
    return tuple(found)


def crossing(camera: Camera, nodes: tuple[GraphNode, ...]) -> Tensor:
    """Mask (height, width) of pixels whose rays cross a box."""
    width, height = camera.size[0].tolist()
    rays = camera.rays(camera.pixels())
    found = crossings(rays, rays.time, PoseTable(nodes, ()), None, 1.0, 0.05)
    mask = torch.zeros(len(rays), dtype=torch.bool)
    mask[found.ray] = True
    return mask.view(height, width)


def psnr(errors: list[Tensor]) -> float:
    return float(-10 * torch.cat(errors).square().mean().log10())


def in_boxes(method: Method, scene: Scene, nodes: tuple[GraphNode, ...]) -> float:
    """PSNR of all pixels of held-out frames whose rays cross a box."""
    errors = []
    for i in scene.splits["test"].tolist():
        seen, mask = method.render(scene.cameras[i]).rgb, crossing(scene.cameras[i], nodes)
        errors.append((seen - scene.photograph(i).rgb)[mask])
    return psnr(errors)


def edited(method: Method, scene: Scene, options: Options, seed: int) -> dict[str, float]:
    """PSNR against truth inside the boxes that each edit concerns; and a sheet."""
    stage = procedural.scenes.stage("traffic", options.size, options.views, seed, cars=options.cars)
    more = procedural.scenes.stage("traffic", options.size, options.views, seed, cars=options.cars + 1)
    to_source, scores, sheet = scene.frame.to_source, {}, []
    test = scene.splits["test"].tolist()
    chosen = [test[i] for i in np.linspace(1, len(test) - 2, EDITED_VIEWS).astype(int)]
    for name, changes in {"as it was": (), **EDITS}.items():
        if name == "added":
            changes = tuple(replace(edit, track=more.tracks[-1]) for edit in changes)
        edits = TrackEdits(changes)
        here = edits.transformed(to_source.inverse)
        told = method.given(here)
        names = {edit.node for edit in changes} or {track.name for track in scene.frame.tracks}
        before, after = nodes_of(scene.frame.tracks), nodes_of(scene.frame.tracks, here)
        concerned = tuple(node for node in (*before, *after) if node.name in names)
        errors, column = [], []
        for place, i in enumerate(chosen):
            camera = scene.cameras[i]
            world = with_edits(stage, edits, float(camera.time), seed)
            source = stage.cameras["test"][test.index(i)]
            truth = torch.from_numpy(photograph(world, source)[0]).clamp(0, 1)
            seen, mask = told.render(camera).rgb, crossing(camera, concerned)
            errors.append((seen - truth)[mask])
            if place == 1:
                column = [to_bytes(truth).numpy(), to_bytes(seen).numpy()]
        scores[name] = psnr(errors)
        sheet.append(np.concatenate(column))
    Image.fromarray(np.concatenate(sheet, 1)).save(options.output / f"{seed}.png")
    return scores


def unseen(method: Method, options: Options, seed: int) -> dict[str, float]:
    """PSNR in the box of a car that the graph has not learnt, with the mean code and with the one found from views."""
    name = f"car {options.cars + 1}"
    more = open_scene(
        f"procedural:traffic,size={options.size},views={options.views},seed={seed},cars={options.cars + 1}"
    )
    found = method.given(more)
    mean = method.given(more)
    kept = mean.found
    mean.found = kept[0], method.codes.detach().mean(0, keepdim=True)
    own = tuple(node for node in nodes_of(more.frame.tracks) if node.name == name)
    return {"mean code": in_boxes(mean, more, own), "found code": in_boxes(found, more, own)}


if __name__ == "__main__":
    main(tyro.cli(Options))
