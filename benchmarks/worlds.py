"""A walk through a block world: how steady gancraft is against translating each frame by the label-to-picture network
alone, how well colours follow labels, and two styles.

    lumigraph train gancraft procedural:blocks --output runs/blocks
    python benchmarks/worlds.py runs/blocks --output worlds.png

Every frame is rendered by the field, and painted from its label map by the run's own painter with one style code for
all frames. A frame is compared with the one before, warped by the exact depth of the blocks, where both show the same
place.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from lumigraph.camera import Camera
from lumigraph.datasets.world import LABELS, BlockWorld
from lumigraph.evaluation.walks import colours_by_label, warped_difference
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.geometry import evenly
from lumigraph.methods.gancraft.landscapes import landscape
from lumigraph.methods.gancraft.spade import channels
from lumigraph.run import Run
from lumigraph.synthetic import block_stage
from lumigraph.synthetic.cameras import pinhole
from lumigraph.synthetic.rendering import photograph, trace

SHOWN = 8  # frames of a strip
REFERENCE = 77  # seed of the landscape whose style the painter gets, a land that no run learns from


@dataclass(frozen=True)
class Options:
    run: tyro.conf.Positional[Path]
    output: Path = Path("worlds.png")
    frames: int = 60
    loop: float = 0.2  # share of the walk around the world that these frames cover
    size: int = 128  # pixels
    styles: tuple[str, str] = ("summer", "evening")
    scene: str | None = None  # where the world is, if not where it was


@dataclass(frozen=True)
class Step:
    """One frame of the walk: its camera in the scene's frame, exact depth in scene units, labels, and the blocks."""

    camera: Camera
    depth: Tensor
    labels: Tensor
    blocks: Tensor


def walk(world: BlockWorld, options: Options) -> Iterator[Step]:
    labels = world.blocks.labels
    unit = max(labels.shape) / 2
    stage = block_stage.stage_of(world.blocks, options.size, 1, 0, world.source)
    numbers = torch.tensor([*(LABELS.index(name) for name in stage.world.names), 0])
    poses = block_stage.walk(labels, round(options.frames / options.loop), unit)[: options.frames]
    to_scene = torch.linalg.inv(world.blocks_from_scene)
    scale = float(to_scene[0, 0]) * unit  # scene units to a unit of the tracer
    for pose in poses:
        camera = pinhole(pose[None], options.size, block_stage.FIELD_OF_VIEW)
        seen = trace(stage.world, camera.rays(camera.pixels()), shaded=False)
        rgb, _ = photograph(stage.world, camera)
        moved = pose.copy()
        blocks = pose[:, 3] * unit + np.array(labels.shape) / 2
        moved[:, 3] = (to_scene[:3, :3].numpy() @ blocks) + to_scene[:3, 3].numpy()
        side = (options.size, options.size)
        depth = torch.from_numpy(seen.depth * scale).float().view(side)
        found = numbers[torch.from_numpy(seen.identity)].view(side)
        yield Step(pinhole(moved[None], options.size, block_stage.FIELD_OF_VIEW), depth, found, torch.from_numpy(rgb))


@torch.no_grad()
def painted(method: Any, steps: list[Step], style: str) -> list[Tensor]:
    """Each frame from its label map by the painter alone, all with the style code of one landscape."""
    size = 2 * method.config.crop
    rgb = torch.from_numpy(landscape(REFERENCE, style, size, land=REFERENCE)[0]).movedim(-1, 0)[None]
    code, _ = method.painter.encoder(2 * rgb - 1)
    maps = (channels(step.labels[None], len(LABELS), method.config.label_window) for step in steps)
    return [(0.5 + 0.5 * method.painter(labels, code)[0].movedim(0, -1)).clamp(0, 1) for labels in maps]


def rendered(method: Any, steps: list[Step], style: str) -> list[Tensor]:
    shown = method.given(style=style)
    return [shown.render(step.camera).rgb.clamp(0, 1) for step in steps]


def unsteadiness(pictures: list[Tensor], steps: list[Step]) -> float:
    """Mean warped difference of successive frames, percent of white."""
    pairs = zip(pictures[1:], steps[1:], pictures, steps, strict=False)
    found = [warped_difference(a, s.camera, s.depth, b, t.camera, t.depth)[0] for a, s, b, t in pairs]
    known = [x for x in found if x is not None]
    return 100 * sum(known) / len(known)


def main(options: Options) -> None:
    run = Run(options.run)
    method, world = run.method().eval(), run.dataset(options.scene)
    assert isinstance(world, BlockWorld)
    steps = list(walk(world, options))
    labels = torch.stack([step.labels for step in steps])
    rows, means = [("blocks", [step.blocks for step in steps], 0.0)], {}
    for style in options.styles:
        for name, make in (("each frame painted", painted), ("gancraft", rendered)):
            begin = time.process_time()
            pictures = make(method, steps, style)
            rows.append((f"{name}, {style}", pictures, (time.process_time() - begin) / len(steps)))
    print(
        f"{len(steps)} frames of {options.size} pixels, {run.state.step} steps, {run.state.seconds:.0f} s of training"
    )
    print(f"{'':32} {'warped difference':>18} {'colours by label':>17} {'processor s/frame':>18}")
    for name, pictures, seconds in rows:
        separation, means[name] = colours_by_label(torch.stack(pictures), labels)
        print(f"{name:32} {unsteadiness(pictures, steps):16.2f} % {100 * separation:15.1f} % {seconds:18.2f}")
    for name, colours in means.items():
        print(f"{name:32} " + "  ".join(f"{k} {' '.join(f'{255 * x:.0f}' for x in v)}" for k, v in colours.items()))
    shown = evenly(list(range(len(steps))), SHOWN)
    strips = [Row(name, [pictures[k] for k in shown]) for name, pictures, _ in rows]
    sheet = contact_sheet(f"A walk through {world.source}", [f"frame {k + 1}" for k in shown], strips)
    save_picture(options.output, sheet, "evaluation")
    near = contact_sheet("Successive frames", [str(k) for k in range(SHOWN)], [Row(n, p[:SHOWN]) for n, p, _ in rows])
    save_picture(options.output.with_name(f"{options.output.stem}-successive.png"), near, "evaluation")


if __name__ == "__main__":
    main(tyro.cli(Options))
