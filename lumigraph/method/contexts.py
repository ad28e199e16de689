"""Contexts: seeded random numbers, frozen parameters."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import nn


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Block with seeded random numbers of PyTorch's global CPU generator, whose state is restored afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


@contextlib.contextmanager
def frozen(*modules: nn.Module) -> Iterator[None]:
    """Block in which parameters of modules get no gradient, which still flows through to their inputs."""
    learnt = [p for module in modules for p in module.parameters() if p.requires_grad]
    for p in learnt:
        p.requires_grad_(False)
    try:
        yield
    finally:
        for p in learnt:
            p.requires_grad_(True)
