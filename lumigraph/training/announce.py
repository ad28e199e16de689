"""Announcement before the first step: data, method, machine and budget."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from ..budget import Budget, lasting
from ..datasets.dataset import Dataset
from ..datasets.scene import Scene
from ..method.capabilities import HasGaussians, can
from ..system import threads


def learnt_from(data: Dataset) -> str:
    """Number of training and held-out inputs; size of photographs now and in the source."""
    held_out = len(data.splits.get("test", ()))
    aside = f", {held_out:,} held out"
    if not isinstance(data, Scene):
        return f"Learning from {len(data.splits['train']):,} of {data.kind}{aside}"
    count = len(data.splits["train"])
    size, full = sizes(data.cameras.size), None if data.full_sizes is None else sizes(data.full_sizes)
    reduced = f", reduced from {full}" if full and full != size else ""
    return f"Learning from {count:,} photograph{'' if count == 1 else 's'}{aside}, {size} pixels{reduced}"


def sizes(of: Int[Tensor, "photograph 2"]) -> str:
    """One size, or the smallest and the largest."""
    some = sorted({(int(w), int(h)) for w, h in of.tolist()}, key=lambda size: size[0] * size[1])
    told = [f"{width}x{height}" for width, height in some]
    return told[0] if len(told) == 1 else f"{told[0]} to {told[-1]}"


def learner(name: str, method: Any) -> str:
    """A method's name and how large it is: Gaussians, or numbers that it learns."""
    if can(method, HasGaussians):
        return f"{name}, {len(method.gaussians()):,} Gaussians"
    return f"{name}, {sum(x.numel() for x in method.parameters() if x.requires_grad):,} numbers to learn"


def machine(device: torch.device) -> str:
    """A device; on a CPU how many threads compute."""
    if device.type == "cuda":
        return f"on {torch.cuda.get_device_name(device)} ({device})"
    return f"on the CPU with {threads.description()}"


def how_long(budget: Budget, step: int, seconds: float) -> str:
    """Remaining budget. The time of a step is known only after some steps."""
    if budget.steps is None:
        return f"for {lasting(budget.total - seconds)}"
    done = f", {step:,} of them done" if step else ""
    return f"for {budget}{done}; how long they take is told once a few are done"
