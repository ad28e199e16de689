"""A run of many blocks begins: its folder, with every block's task, before anything is learnt."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from .. import files, methods
from ..budget import Budget
from ..capture import Places, places_of, read_capture
from ..errors import LumigraphError
from ..figures import save_picture
from ..plain import alike
from ..run import check_new, processor
from ..run.folder import versions
from ..run.settings import Source
from .drawing import draw_plan
from .layout import lay_out
from .plan import FOLDER, NAME, TASK, Block, Plan, Task

BY_BLOCK = 60.0  # seconds, where nobody says
PICTURE = "blocks.png"


def survey(source: str, reader: str | None = None) -> Places:
    """Where the photographs of a source were taken; no pixel is read."""
    return places_of(read_capture(source, reader))


def make_plan(
    source: str,
    places: Places,
    wish: str,
    kind: type[Any],
    config: Any,
    options: dict[str, Any],
    budget: Budget | None,
    quality: str | None = None,
    seed: int = 0,
    device: Any = "cpu",
    here: bool = True,
) -> Plan:
    """What all blocks of a source will learn.

    wish:    see `lay_out`
    budget:  of all blocks together, shared out evenly; None for a minute each, or a quality
    options: what `open_dataset` is told of the whole
    here:    whether the device is this machine's
    """
    path = Path(source)
    said = {name: value for name, value in options.items() if value is not None}
    scene = Source(str(path.resolve()) if path.exists() else source, said)
    blocks = lay_out(places, wish, source)
    turn: Any = tuple(tuple(float(x) for x in row) for row in places.upright)
    return Plan(
        methods.name_of(kind),
        asdict(config),
        scene,
        turn,
        blocks,
        {"quality": quality} if quality else shared(budget or Budget(seconds=BY_BLOCK * len(blocks)), len(blocks)),
        seed,
        str(device),
        processor(torch.device(device)) if here else "machines of a cluster",
        versions(),
    )


def shared(budget: Budget, blocks: int) -> dict[str, Any]:
    """Each block's part of a budget for all."""
    if budget.steps is not None:
        return {"steps": max(1, math.ceil(budget.steps / blocks))}
    return {"seconds": budget.total / blocks}


def begin(folder: Path, plan: Plan, places: Places | None = None, threads: int | None = None) -> Plan:
    """Write a run's plan, with a task for every block; where it is there already, find that it is the same.

    places:  of all photographs, for the picture of the plan
    threads: see `Task`
    Returns the plan as the folder has it. Raises LumigraphError where something else lies there, or another plan.
    """
    if (folder / NAME).exists():
        known = Plan.read(folder / NAME)
        if (what := difference(known, plan)) is not None:
            raise LumigraphError(f"{folder} holds a run in blocks with another {what}; choose another --output")
        plan = known
    else:
        check_new(folder)
        plan.write(folder / NAME)  # a folder with it is a run; what is missing of it is made anew
    for block in plan.blocks:
        write_task(place_of(folder, block), replace(plan.task(block), threads=threads))
    if places is not None and not (folder / PICTURE).exists():
        save_picture(folder / PICTURE, draw_plan(places, plan.blocks), ours=True)
    return plan


def write_task(folder: Path, task: Task) -> None:
    """Leave a task in a block's folder; one that is there already stays if it is the same."""
    if (folder / TASK).exists() and (there := Task.read(folder)).key == task.key and there.threads == task.threads:
        return
    files.write_json(folder / TASK, asdict(task))  # a run that begins there knows it for ours


def place_of(run: Path, block: Block) -> Path:
    """Where a block of a run is learnt."""
    return run / FOLDER / block.name


def difference(known: Plan, wanted: Plan) -> str | None:
    """The first thing that two plans differ in, in a user's words; None if they come to the same. Blocks that were
    learnt again from other photographs do not count."""
    mine, other = asdict(known), asdict(wanted)
    for name in ("method", "scene", "config", "budget", "seed", "device", "upright"):
        if not alike(mine[name], other[name]):
            return name
    again = {block.name for block in known.blocks if block.scene is not None}
    blocks = [[x for x in plan["blocks"] if x["name"] not in again] for plan in (mine, other)]
    return None if alike(blocks[0], blocks[1]) else "layout of blocks"
