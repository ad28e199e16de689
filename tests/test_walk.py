"""The walk in docs/architecture.md: the calls from `fit` to the compositing kernel, as they happen."""

from __future__ import annotations

import sys
from pathlib import Path

import tiny
import torch
from budgets import budget
from shape_checks import PACKAGE

from lumigraph.kernels.composite import cpu
from lumigraph.methods.instant_ngp import InstantNGP
from lumigraph.run import build
from lumigraph.training import fit

pytestmark = budget("house")

PAGE = PACKAGE.parent / "docs" / "architecture.md"
MAX_FRAMES = 10  # of own code, from `fit` to the engine of `kernels.composite`


def own_frames() -> list[str]:
    """Own code on the stack from `fit` to the caller, as "file: function"."""
    frame, found = sys._getframe(1), list[str]()
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(PACKAGE):
            found.append(f"{path.relative_to(PACKAGE).as_posix()}: {frame.f_code.co_name}")
        if found and found[-1] == "training/loop.py: fit":
            break
        frame = frame.f_back
    return found[::-1]


def test_the_walk_to_the_kernel_is_short_and_as_written(monkeypatch):
    stacks, compiled = list[list[str]](), cpu._forward

    def forward(*arrays):
        stacks.append(own_frames())
        return compiled(*arrays)

    monkeypatch.setattr(cpu, "_forward", forward)
    scene = tiny.scene()
    method = build(InstantNGP, scene.frame, InstantNGP.smallest(), torch.device("cpu"), 0)
    fit(method, scene, steps=1, show=False, rehearsal=False)
    (walk,) = (stack for stack in stacks if "methods/instant_ngp.py: loss, volume.py: composite" in ", ".join(stack))
    assert len(walk) <= MAX_FRAMES, walk
    page, here = PAGE.read_text(encoding="utf-8"), 0
    for stop in walk:
        path, function = stop.split(": ")
        here = page.find(f"`{path}` | `{function}`", here)
        assert here >= 0, f"docs/architecture.md lacks {stop}, after the stops before it: {walk}"
