"""Estimate the memory of a method from its Config, before allocation."""

from __future__ import annotations

from dataclasses import is_dataclass, replace
from typing import Any

import torch

from .. import methods
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..files.ranges import hints, numbers, value_of
from ..method import Method
from ..system.memory import ask_for, free_on

BYTES_FACTOR = 4  # copies of a parameter: itself, its gradient, and the two moments of optimizers like Adam


def check_memory(kind: type[Method], frame: Frame, config: Any, device: torch.device, learning: bool = False) -> None:
    """Raise LumigraphError where a method would not fit into the memory that is free, naming what to make smaller."""

    def needed(config: Any) -> int:
        return bytes_of(kind, frame, config, learning)

    def remedy() -> str:
        smaller = {name: needed(less) for name, less in halved(config)}
        if not smaller:
            return "end other programs"
        name = min(smaller, key=smaller.__getitem__)
        less = config
        while needed(less) > free_on(device) and (half := dict(halved(less))[name]) != less:
            less = half
        fits = f"; {value_of(less, name):,} would fit" if needed(less) <= free_on(device) else ""
        return f"give a smaller --{name.replace('_', '-')} than {value_of(config, name):,}{fits}"

    ask_for(needed(config), device, f"{methods.name_of(kind)} with these numbers", remedy)


def bytes_of(kind: type[Method], frame: Frame, config: Any, learning: bool) -> int:
    """Bytes of a method's parameters, with all that learning keeps of each, of its buffers, and `further_bytes`.

    The method is built of tensors without memory. Where it looks at their values, and so cannot be built that way, only
    `further_bytes` is known.
    """
    further = kind.further_bytes(frame, config, learning)
    try:
        with torch.random.fork_rng(devices=[]), torch.device("meta"):
            method = kind(frame, config)
    except LumigraphError:
        raise
    except (RuntimeError, TypeError, ValueError):
        return further
    parameters = sum(x.numel() * x.element_size() for x in method.parameters())
    buffers = sum(x.numel() * x.element_size() for x in method.buffers())
    return (BYTES_FACTOR if learning else 1) * parameters + buffers + further


def halved(config: Any) -> list[tuple[str, Any]]:
    """A Config with each of its whole numbers at half its value, or at the least that its range allows, by name."""
    found = []
    for name, kind in hints(config.__class__).items():
        if is_dataclass(inner := getattr(config, name)):
            found += [(number, replace(config, **{name: less})) for number, less in halved(inner)]
            continue
        ranges = [range for number, range in numbers(kind) if number is int and range is not None]
        if ranges and isinstance(value := getattr(config, name), int):
            found.append((name, replace(config, **{name: max(value // 2, int(ranges[0].ge or 0))})))
    return found
