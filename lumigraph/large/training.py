"""Train all blocks of a run, in this process one after another or on the workers of a Ray cluster; then align their
appearances, or merge their clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..components.fields.appearance import Appearance
from ..errors import LumigraphError
from ..exchange import write_gaussians
from ..files.locks import held
from ..method.capabilities import HasGaussians, can
from .appearance_alignment import align_appearance
from .block_cache import Nearby
from .block_run import BlockRun
from .monitor import Watching, in_order
from .on_ray import Workers, on_workers
from .plan import PLAN_FILE, Done, Plan
from .planning import place_of
from .worker import Conducted, train_block

CLOUD_FILE = "cloud.ply"


def conduct(run: Path, plan: Plan, workers: Workers, show: bool = True) -> Conducted:
    """Train all blocks of a run that are not done yet.

    A block that fails leaves the others alone. Raises LumigraphError where another process works in the run, and where
    workers cannot be had.
    """
    folders = {block.name: place_of(run, block) for block in plan.blocks}
    with held(run, "trained"), Watching(run, folders, show):
        if workers.count is None and workers.address is None:
            return one_by_one(folders)
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


def finish(folder: Path, again: Sequence[str] = ()) -> Plan:
    """Align the blocks' appearances and write their codes into blocks.json; of clouds, write the one that they make.

    again: names of blocks that were learnt again, which are aligned to the others as these are
    Returns the plan as it is then. What is done already is not done again.
    """
    opened = BlockRun(folder)
    first = opened.placed(opened.blocks[0]).method
    if Appearance in first.takes:
        return aligned(opened, again)
    if can(first, HasGaussians):
        write_gaussians(folder / CLOUD_FILE, opened.source_gaussians())
    return opened.plan


def aligned(opened: BlockRun, again: Sequence[str]) -> Plan:
    """The plan with an appearance for every block; those that are known stay as they are (Tancik 2022, 4.3.3)."""
    names = [block.name for block in opened.blocks]
    known = {name: code for name, code in opened.plan.appearance.items() if name not in again}
    if all(name in known for name in names):
        return opened.plan
    opened.plan = replace(opened.plan, appearance=known)
    parts = Nearby(lambda i: opened.placed(opened.blocks[i]), len(names))
    kept = [i for i, name in enumerate(names) if name in known]
    codes = align_appearance(parts, opened.centres, opened.radii, opened.cameras()["train"], kept or None)
    found = {name: code.tolist() for name, code in zip(names, codes, strict=True)}
    plan = replace(opened.plan, appearance=found | known)
    plan.write(opened.folder / PLAN_FILE)
    return plan
