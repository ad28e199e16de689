"""All blocks of a run are learnt: in this process one after another, or on the workers of a Ray cluster."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import LumigraphError
from ..locks import held
from ..run.block_plan import Done, Plan
from .planning import place_of
from .task import train_block
from .watch import Watching, in_order
from .workers import Conducted, Workers


def conduct(run: Path, plan: Plan, workers: Workers, show: bool = True, only: Sequence[str] | None = None) -> Conducted:
    """Learn all blocks of a run that are not done yet.

    only: names of some of them
    A block that fails leaves the others alone. Raises LumigraphError where another process works in the run, and where
    workers cannot be had.
    """
    folders = {block.name: place_of(run, block) for block in plan.blocks if only is None or block.name in only}
    with held(run, "trained"), Watching(run, folders, show):
        if workers.count is None and workers.address is None:
            return one_by_one(folders)
        from .on_ray import on_workers  # a library that is loaded where it is used

        return on_workers(run, folders, workers)


def one_by_one(folders: dict[str, Path]) -> Conducted:
    """In this process."""
    done: dict[str, Done] = {}
    failed: dict[str, str] = {}
    for name in in_order(folders):
        try:
            ended = train_block(folders[name])
        except LumigraphError as fault:
            failed[name] = str(fault)
            continue
        if ended.done is None:
            return Conducted(done, failed, ended.signal)
        done[name] = ended.done
    return Conducted(done, failed)
