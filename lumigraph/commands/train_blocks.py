"""`lumigraph train block-nerf`: train a large scene as blocks, on this machine or on a cluster."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from .. import methods
from ..errors import LumigraphError
from ..names import counted
from ..ranges import Count
from .capture import posed
from .common import choose_device, exit_code, next_free, option, say, scene_name, show, told_budget, typed
from .train import Train, option_group, preset_device, with_options_of

IN_BLOCKS = "block-nerf"
MEMORY = 2 << 30  # bytes that a block requests from its machine


@dataclass(frozen=True)
class TrainBlocks(Train):
    """Train a large scene in blocks, each a separate run; with few photographs one block, an ordinary run.

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
    """Train one block of this run again, from other photographs, with the run's own settings; the rest stays."""

    def run(self) -> int:
        from ..capture import kind_of
        from ..scene import Scene

        if self.into is not None:
            return self._again(self.into)
        told = [name for name in ("view", "pause_at", "views") if getattr(self, name)]
        source = posed(self.scene)
        if kind_of(source, Scene) is not Scene or Path(source).is_file():  # of a single picture
            return super().run()
        if self.blocks == "1" and self._own:
            return super().run()
        from ..blocks.layout import LARGE
        from ..blocks.planning import survey

        places = survey(source, self.reader)
        many = places.splits.count("train") >= LARGE
        if self.blocks is None and not many and self._own and (self.workers, self.address) == (None, None):
            return super().run()
        if told:
            raise LumigraphError(f"--{told[0].replace('_', '-')} is for one block; leave it out, or give --blocks 1")
        return self._all(source, places)

    @property
    def _field(self) -> str:
        """The method of each block."""
        return IN_BLOCKS

    @property
    def _own(self) -> bool:
        return self._field == IN_BLOCKS

    def _all(self, source: str, places: Any) -> int:
        from ..blocks.conduct import conduct
        from ..blocks.finishing import finish
        from ..blocks.planning import begin, make_plan
        from ..blocks.workers import Workers
        from ..memory import free_memory

        budget = told_budget(self.steps, self.seconds, self.quality)
        kind, device = methods.find(self._field), self._device()
        options = {"downscale": self.downscale, "reader": self.reader, "scales": self.scales}
        config = getattr(self, option_group(self._field), None) or kind.preset(preset_device(self.device, self.preset))
        seed = getattr(config, "seed", self.seed)
        wish = self.blocks or "auto"
        plan = make_plan(
            source, places, wish, kind, config, options, budget, self.quality, seed, device, self.address is None
        )
        output = self.output or unfinished(f"runs/{scene_name(source)}-{IN_BLOCKS}", plan)
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        cpus = max(1, cores // self.workers) if self.workers else 1
        shared_out = self.workers is not None or self.address is not None
        plan = begin(output, plan, places, cpus if shared_out else None)
        tell_plan(output, plan, budget)
        gpus = 1.0 if device.type == "cuda" else 0.0
        here = self.address is None and self.workers is not None
        memory = min(MEMORY, free_memory() // (2 * (self.workers or 1))) if here else MEMORY
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

    def _device(self) -> Any:
        """The device of blocks: of this machine, or --device of the cluster's machines."""
        import torch

        if self.address is None or self.device == "auto":
            return choose_device(self.device)
        return torch.device("cuda" if self.device == "gpu" else self.device)

    def _again(self, run: Path) -> int:
        from ..blocks.planning import survey
        from ..blocks.update import update

        if self.blocks is None or not self.blocks.isdigit():
            raise LumigraphError("--into needs the name of the block to learn again; give it as --blocks 3")
        source = posed(self.scene)
        options = {"downscale": self.downscale, "reader": self.reader, "scales": self.scales}
        budget = told_budget(self.steps, self.seconds, self.quality)
        ended = update(run, self.blocks, source, survey(source, self.reader), options, budget)
        if ended.done is None:
            say("Stopped and saved; the same command goes on")
            return exit_code(ended.signal)
        took = f"{ended.done.steps} steps in {ended.done.seconds:.1f} s, from {ended.done.photographs} photographs"
        show({"run": str(run), f"block {self.blocks}": took} | onward(run, source))
        return 0


@dataclass(frozen=True)
class TrainOthers(TrainBlocks):
    """TrainBlocks with blocks of another method."""

    field: Annotated[str, arg(metavar="METHOD", help="Method to train each block with.")] = ""

    @property
    def _field(self) -> str:
        return methods.check(self.field)


TrainOthers.__doc__ = TrainBlocks.__doc__


def with_options_of_blocks(field: str, device: str, preset: str) -> type[Any]:
    """The command, with the options of each block's method.

    field: value of --field: another method, or else a kind of Block-NeRF's own
    """
    name = field.replace("_", "-")
    if name in methods.available():
        return with_options_of(name, device, preset, TrainOthers)
    return with_options_of(IN_BLOCKS, device, preset, TrainBlocks)


def unfinished(prefix: str, plan: Any) -> Path:
    """The latest run of this name, if it is the same and not done; else the next name that is free."""
    from ..blocks.planning import difference, place_of
    from ..run.block_plan import DONE, NAME, Plan

    free = next_free(prefix)
    number = int(free.name.rpartition("-")[2])
    latest = free.with_name(f"{free.name.rpartition('-')[0]}-{number - 1}")
    if (latest / NAME).is_file() and difference(known := Plan.read(latest / NAME), plan) is None:
        if not all((place_of(latest, block) / DONE).exists() for block in known.blocks):
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
    """Next commands."""
    again = ["--scene", source] if source else []
    return {
        "compare with what it has not seen": typed("eval", run, *again),
        "look at it in the browser": typed("view", run),
    }
