"""Learn a scene in blocks, or one of its blocks again, by the options of training."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from .. import methods
from ..budget import given_budget
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..files import scene_name
from ..files.names import next_free
from ..opening import kind_of
from ..readers import Places
from ..system.memory import free_memory
from ..training.options import BlockOptions, TrainOptions
from .layout import MIN_LARGE_VIEWS
from .plan import DONE_FILE, PLAN_FILE, Plan
from .planning import SCENE_OPTIONS, begin, difference, make_plan, place_of, survey
from .training import Workers, update
from .worker import Ended

MEMORY_BYTES = 2 << 30  # bytes reserved for a block


def places_in_blocks(source: str, train: TrainOptions, blocks: BlockOptions) -> Places | None:
    """Positions of the photographs of a scene that is learnt in blocks; None for one that is learnt as a whole."""
    if kind_of(source, Scene) is not Scene or Path(source).is_file() or (blocks.blocks == "1" and not blocks.field):
        return None  # a file is a single picture
    places = survey(source, train.reader)
    few = places.splits.count("train") < MIN_LARGE_VIEWS
    if few and not blocks.field and (blocks.blocks, blocks.workers, blocks.address) == (None, None, None):
        return None
    for name in ("view", "pause_at", "views", "depth_from"):
        if getattr(train, name, None):
            raise LumigraphError(f"--{name.replace('_', '-')} is for one block; leave it out, or give --blocks 1")
    return places


def begin_blocks(
    source: str,
    places: Places,
    method: str,
    config: Any,
    device: torch.device,
    train: TrainOptions,
    blocks: BlockOptions,
    output: Path | None = None,
) -> tuple[Path, Plan, Workers]:
    """Begin a run in blocks, or go on with the latest one of the same plan. Returns its folder, plan and workers.

    config: of the method of the blocks, which is the user's unless the options name another
    """
    learner, here = methods.check(blocks.field or method), blocks.address is None
    plan = make_plan(source, places, learner, config, train, blocks, str(device))
    folder = output or unfinished(f"runs/{scene_name(source)}-{methods.check(method)}", plan)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = blocks.workers
    cpus = max(1, cores // count) if count else 1
    plan = begin(folder, plan, places, None if here and count is None else cpus)
    memory = min(MEMORY_BYTES, free_memory() // (2 * count)) if here and count else MEMORY_BYTES
    return folder, plan, Workers(count, blocks.address, cpus, 1.0 if device.type == "cuda" else 0.0, memory)


def learn_again(run: Path, source: str, train: TrainOptions, blocks: BlockOptions) -> Ended:
    """Learn a block of a run again, from the photographs of a source; see `update`."""
    if blocks.blocks is None or not blocks.blocks.isdigit():
        raise LumigraphError("--into needs the name of the block to learn again; give it as --blocks 3")
    options = {name: getattr(train, name) for name in SCENE_OPTIONS}
    budget = given_budget(train.steps, train.seconds, train.quality)
    return update(run, blocks.blocks, source, survey(source, train.reader), options, budget)


def unfinished(prefix: str, plan: Plan) -> Path:
    """The latest run of this name, if it is the same and not done; else the next name that is free."""
    free = next_free(prefix)
    number = int(free.name.rpartition("-")[2])
    latest = free.with_name(f"{free.name.rpartition('-')[0]}-{number - 1}")
    if (latest / PLAN_FILE).is_file() and difference(known := Plan.read(latest / PLAN_FILE), plan) is None:
        if not all((place_of(latest, block) / DONE_FILE).exists() for block in known.blocks):
            return latest
    return free
