"""`lumigraph train` of a large scene in blocks: options of methods that divide one, and training of all its blocks, on
this machine or on a cluster."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from .. import methods
from ..errors import LumigraphError
from ..files.names import counted
from ..files.ranges import Count
from .capture import posed
from .common import (
    choose_device,
    exit_code,
    method_config,
    next_free,
    option,
    say,
    scene_name,
    show,
    told_budget,
    typed,
)

MEMORY_BYTES = 2 << 30  # bytes that a block asks of its machine
OPTIONS = "downscale", "reader", "scales"  # of `open_dataset`, for the whole scene


@dataclass(frozen=True)
class Blocks:
    """A large scene is trained in blocks, each a run of its own; from few photographs one block, an ordinary run.

    --steps and --seconds are for all blocks together and divided evenly; the default is a minute for each block. After
    Ctrl-C, a crash or a lost machine the same command continues; finished blocks are kept. RUN/blocks.png shows the
    plan. `eval`, `render`, `view` and `export` open the run as one scene. --field METHOD, such as gaussian-splatting,
    trains each block with another method; for clouds, RUN/cloud.ply joins each block's own cell.
    """

    blocks: Annotated[str | None, option("auto|N|FILE", "auto from 200 photographs on, else one block")] = None
    """Positions of blocks: auto (street crossings, or evenly spread), a number of evenly spread ones, or a JSON file in
    the frame of the photographs: {"blocks": [{"centre": [x, y, z], "radius": r}, ...]}. With --into, a block's name."""
    workers: Annotated[Count | None, option("N", "1, in this process")] = None
    """Number of blocks to train at a time on this machine, with Ray."""
    address: Annotated[str | None, option("HOST:PORT", "this machine")] = None
    """Train blocks on an existing Ray cluster; --output must be on storage that all its machines share."""
    into: Annotated[Path | None, option("RUN", "a new run")] = None
    """Learn one block of this run again, from other photographs, as the run's own were learnt; the rest stays."""
    field: Annotated[str, arg(metavar="METHOD", help="The method that learns each block.")] = ""

    def run(self, train: Any) -> int | None:
        """Train all blocks of a scene. Returns the exit code; None for a scene that `train` learns as a whole.

        train: the command's other options, a `Train`
        """
        from ..capture import kind_of
        from ..datasets.scene import Scene
        from ..large.layout import MIN_LARGE_VIEWS
        from ..large.planning import survey

        if self.into is not None:
            return self._again(train, self.into)
        source, other = posed(train.scene), bool(self.field)
        if kind_of(source, Scene) is not Scene or Path(source).is_file() or (self.blocks == "1" and not other):
            return None  # a file is a single picture
        places = survey(source, train.reader)
        few = places.splits.count("train") < MIN_LARGE_VIEWS
        if few and not other and (self.blocks, self.workers, self.address) == (None, None, None):
            return None
        for name in ("view", "pause_at", "views"):
            if getattr(train, name):
                raise LumigraphError(f"--{name.replace('_', '-')} is for one block; leave it out, or give --blocks 1")
        return self._all(train, source, places)

    def _all(self, train: Any, source: str, places: Any) -> int:
        import torch

        from ..large.planning import BlockRecipe, begin, make_plan
        from ..large.training import Workers, conduct, finish
        from ..system.memory import free_memory

        here = self.address is None
        budget = told_budget(train.steps, train.seconds, train.quality)
        if here or train.device == "auto":
            device = choose_device(train.device)
        else:  # of the cluster's machines
            device = torch.device("cuda" if train.device == "gpu" else train.device)
        method = methods.check(self.field or train.method)
        config = method_config(train, method)
        seed = getattr(config, "seed", train.seed)
        options = {name: getattr(train, name) for name in OPTIONS}
        recipe = BlockRecipe(method, config, options, budget, train.quality, seed, str(device), here)
        plan = make_plan(source, places, self.blocks or "auto", recipe)
        output = train.output or unfinished(f"runs/{scene_name(source)}-{methods.check(train.method)}", plan)
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        cpus = max(1, cores // self.workers) if self.workers else 1
        plan = begin(output, plan, places, None if here and self.workers is None else cpus)
        tell_plan(output, plan, budget)
        gpus = 1.0 if device.type == "cuda" else 0.0
        memory = min(MEMORY_BYTES, free_memory() // (2 * self.workers)) if here and self.workers else MEMORY_BYTES
        found = conduct(output, plan, Workers(self.workers, self.address, cpus, gpus, memory))
        if found.signal is not None:
            say(f"Stopped and saved, {len(found.done)} of {len(plan.blocks)} blocks done; the same command goes on")
            return exit_code(found.signal)
        if found.failed:
            first, why = next(iter(found.failed.items()))
            raise LumigraphError(
                f"{len(found.failed)} of {len(plan.blocks)} blocks of {output} could not be learnt; block {first}: "
                f"{why}; the others are kept, and the same command tries again"
            )
        finish(output)
        tell_done(output, found)
        return 0

    def _again(self, train: Any, run: Path) -> int:
        from ..large.planning import survey
        from ..large.training import update

        if self.blocks is None or not self.blocks.isdigit():
            raise LumigraphError("--into needs the name of the block to learn again; give it as --blocks 3")
        source, budget = posed(train.scene), told_budget(train.steps, train.seconds, train.quality)
        options = {name: getattr(train, name) for name in OPTIONS}
        ended = update(run, self.blocks, source, survey(source, train.reader), options, budget)
        if ended.done is None:
            say("Stopped and saved; the same command goes on")
            return exit_code(ended.signal)
        took = f"{ended.done.steps} steps in {ended.done.seconds:.1f} s, from {ended.done.photographs} photographs"
        show({"run": str(run), f"block {self.blocks}": took} | onward(run, source))
        return 0


def unfinished(prefix: str, plan: Any) -> Path:
    """The latest run of this name, if it is the same and not done; else the next name that is free."""
    from ..large.plan import DONE_FILE, PLAN_FILE, Plan
    from ..large.planning import difference, place_of

    free = next_free(prefix)
    number = int(free.name.rpartition("-")[2])
    latest = free.with_name(f"{free.name.rpartition('-')[0]}-{number - 1}")
    if (latest / PLAN_FILE).is_file() and difference(known := Plan.read(latest / PLAN_FILE), plan) is None:
        if not all((place_of(latest, block) / DONE_FILE).exists() for block in known.blocks):
            return latest
    return free


def tell_plan(output: Path, plan: Any, budget: Any) -> None:
    """Print the plan before training."""
    counts = [len(block.photographs) for block in plan.blocks]
    each = " ".join(
        f"{value:g} {name}" if name != "quality" else f"as {value} asks" for name, value in plan.budget.items()
    )
    least, most = min(counts), counted(max(counts), "photograph")
    many = most if least == max(counts) else f"{least} to {most}"
    total = f" of {budget}" if budget is not None else ""
    say(f"{counted(len(counts), 'block')} of {many}, each learnt for {each}{total}; {output / 'blocks.png'} shows them")


def tell_done(output: Path, found: Any) -> None:
    """Print the cost of all blocks."""
    done = list(found.done.values())
    rows = {"run": str(output), "blocks": f"{len(done)}, {sum(x.bytes for x in done) / 1e6:.1f} MB of weights"}
    steps, seconds = sum(x.steps for x in done), sum(x.seconds for x in done)
    rows["training"] = f"{steps:,} steps in {seconds:.1f} s, all blocks together"
    if memory := max(x.peak_memory for x in done):
        rows["memory"] = f"{memory / 1e9:.2f} GB at most in one process"
    show(rows | onward(output))


def onward(run: Path, source: str | None = None) -> dict[str, str]:
    """Command to type next."""
    from .outcome import NEXT

    again = ["--scene", source] if source else []
    return {NEXT["eval"]: typed("eval", run, *again), NEXT["view"]: typed("view", run)}
