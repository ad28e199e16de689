"""Create a block run: its folder, the task of every block and a map of the plan, before any training."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from .. import files
from ..errors import LumigraphError
from ..figures import save_picture
from ..files.plain import alike
from ..opening import read_capture
from ..readers import Places, places_of
from ..run import check_new, processor
from ..run.folder import versions
from ..training.options import DEFAULT_SECONDS, BlockOptions, TrainOptions
from .layout import lay_out
from .plan import BLOCKS_FOLDER, PLAN_FILE, TASK_FILE, Block, Plan, Task, source_of

SCENE_OPTIONS = "downscale", "reader", "scales"  # of `open_dataset`, for the whole scene
PICTURE_FILE = "blocks.png"
DRAWING_SIDE, SUPERSAMPLING = 1000, 3  # pixels of the longer side; supersampling factor
MARGIN, HEADER_HEIGHT = 40, 60
PAPER_COLOUR, INK_COLOUR, FAINT_COLOUR, HELD_OUT_COLOUR = "#fbfaf8", "#1b1d22", "#6d717a", "#d97706"
BLOCK_COLOURS = ("#2563eb", "#059669", "#7c3aed", "#db2777", "#0891b2", "#65a30d")
DIRECTION_LENGTH = 14  # pixels of the line along a photograph's viewing direction
MAX_SHOWN = 20_000  # photographs


def survey(source: str, reader: str | None = None) -> Places:
    """Positions of the photographs of a source; no pixel is read."""
    return places_of(read_capture(source, reader))


def make_plan(
    source: str,
    places: Places,
    method: str,
    config: Any,
    train: TrainOptions,
    blocks: BlockOptions = BlockOptions(),
    device: str = "cpu",
) -> Plan:
    """The plan of a scene: its blocks, see `lay_out`, and what each of them learns, by a method of its own."""
    parts = lay_out(places, blocks.blocks or "auto", source)
    turn: Any = tuple(tuple(float(x) for x in row) for row in places.upright)
    return Plan(
        method,
        asdict(config),
        source_of(source, {name: getattr(train, name) for name in SCENE_OPTIONS}),
        turn,
        parts,
        budget_of_each(train, len(parts)),
        getattr(config, "seed", train.seed),
        device,
        processor(torch.device(device)) if blocks.address is None else "machines of a cluster",
        versions(),
    )


def budget_of_each(train: TrainOptions, blocks: int) -> dict[str, Any]:
    """Budget of one of so many blocks: the steps or seconds are shared out, and a quality is that of each."""
    if train.quality:
        return {"quality": train.quality}
    if train.steps is not None:
        return {"steps": max(1, math.ceil(train.steps / blocks))}
    return {"seconds": DEFAULT_SECONDS if train.seconds is None else train.seconds / blocks}


def begin(folder: Path, plan: Plan, places: Places | None = None, threads: int | None = None) -> Plan:
    """Write a run's plan and a task for every block, or check that the folder has the same plan already.

    places:  of all photographs, for the map of the plan
    threads: see `Task`
    Returns the plan in the folder. Raises LumigraphError for a folder with other contents or another plan.
    """
    if (folder / PLAN_FILE).exists():
        known = Plan.read(folder / PLAN_FILE)
        if (what := difference(known, plan)) is not None:
            raise LumigraphError(f"{folder} holds a run in blocks with another {what}; choose another --output")
        plan = known
    else:
        check_new(folder)
        plan.write(folder / PLAN_FILE)  # a folder with it is a run; what is missing of it is made anew
    for block in plan.blocks:
        write_task(place_of(folder, block), replace(plan.task(block), threads=threads))
    if places is not None and not (folder / PICTURE_FILE).exists():
        save_picture(folder / PICTURE_FILE, draw_plan(places, plan.blocks), ours=True)
    return plan


def write_task(folder: Path, task: Task) -> None:
    """Write a task to a block's folder, unless the same is there already."""
    if (folder / TASK_FILE).exists() and (there := Task.read(folder)).key == task.key and there.threads == task.threads:
        return
    files.write_json(folder / TASK_FILE, asdict(task))  # a run that begins there knows it for ours


def place_of(run: Path, block: Block) -> Path:
    """Folder of a block in a run."""
    return run / BLOCKS_FOLDER / block.name


def difference(known: Plan, wanted: Plan) -> str | None:
    """First difference between two plans, for users; None if equivalent. Retrained blocks are ignored."""
    mine, other = asdict(known), asdict(wanted)
    for name in ("method", "scene", "config", "budget", "seed", "device", "upright"):
        if not alike(mine[name], other[name]):
            return name
    again = {block.name for block in known.blocks if block.scene is not None}
    blocks = [[x for x in plan["blocks"] if x["name"] not in again] for plan in (mine, other)]
    return None if alike(blocks[0], blocks[1]) else "layout of blocks"


def draw_plan(places: Places, blocks: Sequence[Block]) -> Image.Image:
    """Map of the plan. North is the second axis of the levelled source; held-out photographs are orange."""
    turn = places.upright.T
    centres = np.array([block.centre for block in blocks]) @ turn
    radii = np.array([block.radius for block in blocks])
    ground, gaze = places.ground, (places.forwards @ turn)[:, :2]
    low = np.minimum(ground.min(0), (centres[:, :2] - radii[:, None]).min(0))
    high = np.maximum(ground.max(0), (centres[:, :2] + radii[:, None]).max(0))
    scale = SUPERSAMPLING * DRAWING_SIDE / max(float((high - low).max()), 1e-9)
    width, height = (np.ceil((high - low) * scale) + 2 * SUPERSAMPLING * MARGIN).astype(int)
    image = Image.new("RGB", (int(width), int(height) + SUPERSAMPLING * HEADER_HEIGHT), PAPER_COLOUR)
    draw = ImageDraw.Draw(image, "RGBA")

    def at(point: np.ndarray) -> tuple[float, float]:
        x, y = (point - low) * scale + SUPERSAMPLING * MARGIN
        return float(x), float(height - y) + SUPERSAMPLING * HEADER_HEIGHT

    letters = ImageFont.load_default(18 * SUPERSAMPLING)
    for i, (centre, radius) in enumerate(zip(centres[:, :2], radii, strict=True)):
        colour, (x, y), r = BLOCK_COLOURS[i % len(BLOCK_COLOURS)], at(centre), radius * scale
        draw.ellipse([x - r, y - r, x + r, y + r], f"{colour}18", colour, 2 * SUPERSAMPLING)
    for i in range(0, len(ground), max(1, len(ground) // MAX_SHOWN)):
        held_out = places.splits[i] != "train"
        (x, y), colour, dot = at(ground[i]), HELD_OUT_COLOUR if held_out else FAINT_COLOUR, 2.2 * SUPERSAMPLING
        dx, dy = SUPERSAMPLING * DIRECTION_LENGTH * gaze[i]
        draw.line([x, y, x + dx, y - dy], colour, SUPERSAMPLING)
        draw.ellipse([x - dot, y - dot, x + dot, y + dot], colour)
    for i, (block, centre) in enumerate(zip(blocks, centres[:, :2], strict=True)):
        (x, y), text = at(centre), f"{block.name}: {len(block.photographs)}"
        box = draw.textbbox((x, y), text, letters, anchor="mm")
        draw.rounded_rectangle([box[0] - 12, box[1] - 9, box[2] + 12, box[3] + 9], 12, f"{PAPER_COLOUR}e0")
        draw.text((x, y), text, BLOCK_COLOURS[i % len(BLOCK_COLOURS)], letters, anchor="mm")
    head = (
        f"{len(blocks)} blocks, {len(places)} photographs; beside each name how many are of it, overlap counted twice"
    )
    letters = ImageFont.load_default(17 * SUPERSAMPLING)
    draw.text((SUPERSAMPLING * MARGIN, SUPERSAMPLING * 22), head, INK_COLOUR, letters)
    return image.resize((image.width // SUPERSAMPLING, image.height // SUPERSAMPLING), Image.Resampling.LANCZOS)
