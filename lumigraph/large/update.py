"""Train one block again from other photographs, of a place that has changed; the others stay as they are."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import files
from ..budget import Budget
from ..capture import Places
from ..errors import LumigraphError
from ..files.locks import held
from .layout import Disc, members
from .monitor import Watching
from .plan import PLAN_FILE, TASK_FILE, Block, Plan, Task, source_of
from .planning import place_of, write_task
from .training import finish
from .worker import Ended, finished, train_block

UPDATES_FOLDER = "updates"  # in the run: a block is trained there before it replaces the old one


def update(
    run: Path, name: str, source: str, places: Places, options: dict[str, Any], budget: Budget | None, show: bool = True
) -> Ended:
    """Learn a block of a run again, put it into its place, and align it to its neighbours.

    source, places: of the new photographs, in the frame of the old ones
    options: what `open_dataset` is told of them
    budget:  None for the one that the block had
    The new block takes its place when it is done; what is lost before is gone on with. Files of other blocks stay.
    Raises LumigraphError for a block that there is not, and where no photograph is of it.
    """
    if not files.is_file(run / PLAN_FILE):
        raise LumigraphError(f"{run} holds no run in blocks; give --into one that `lumigraph train block-nerf` made")
    with held(run, "trained"):
        plan = Plan.read(run / PLAN_FILE)
        block = again(plan.block(name), source, places, options, budget)
        task, place = plan.task(block), place_of(run, block)
        if not ((place / TASK_FILE).exists() and Task.read(place).key == task.key and finished(place, task)):
            folder = run / UPDATES_FOLDER / f"{name}-{task.key[:8]}"
            write_task(folder, task)
            with Watching(run, {name: folder}, show):
                ended = train_block(folder)
            if ended.done is None:
                return ended
            files.exchange(folder, place)
            shutil.rmtree(folder, ignore_errors=True)  # what was there before
        blocks = [block if one.name == name else one for one in plan.blocks]
        replace(plan, blocks=blocks).write(run / PLAN_FILE)
        finish(run, again=[name])
    return Ended(finished(place, task))


def again(block: Block, source: str, places: Places, options: dict[str, Any], budget: Budget | None) -> Block:
    """The block as it will learn from other photographs."""
    chosen = members(places, Disc(block.centre, block.radius))
    learnt = np.array([split == "train" for split in places.splits])
    if (chosen & learnt).sum() < 2:
        raise LumigraphError(
            f"{source} has fewer than two photographs to learn from within block {block.name}; their poses must be in "
            "the frame of the run's own photographs, so capture them together with some of those"
        )
    names = [places.names[i] for i in np.flatnonzero(chosen)]
    told = budget.to_json() if budget else block.budget
    return replace(block, photographs=names, scene=source_of(source, options), budget=told)
