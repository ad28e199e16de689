"""What comes after all blocks are learnt: one light for all of them, and one cloud, where they are splats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..capabilities import HasGaussians, can, needs
from ..components.fields.appearance import Appearance
from ..composition import Nearby, align_appearance
from ..export.splats import export_splats
from ..run.block_plan import NAME, Plan
from ..run.block_run import BlockRun

CLOUD = "cloud.ply"


def finish(folder: Path, again: Sequence[str] = ()) -> Plan:
    """Align the blocks' appearances and write their codes into blocks.json; of clouds, write the one that they make.

    again: names of blocks that were learnt again, which are aligned to the others as these are
    Returns the plan as it is then. What is done already is not done again.
    """
    opened = BlockRun(folder)
    first = opened.placed(opened.blocks[0]).method
    if Appearance in first.accepts:
        return aligned(opened, again)
    if can(first, HasGaussians):
        export_splats(needs(opened.method(), HasGaussians).gaussians(), opened.frame, folder / CLOUD)
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
    plan.write(opened.folder / NAME)
    return plan
