"""Facts of each operation, for the benchmark and the tests."""

from __future__ import annotations

import pkgutil
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Facts:
    """One operation in numbers. Inputs and outputs are meant by their position, cases by theirs in `cases()`.

    unit:           what the benchmark counts per second
    unit_axes:      the first input has one unit for each entry along its leading so many axes
    outputs:        how many tensors are returned
    differentiable: the inputs that gradients reach; () where nothing is differentiated
    typical:        a case that is neither empty nor extreme
    compiled:       the case whose options reach most of the GPU engine's code
    smooth:         cases in which no input lies where the reference's slope jumps, small enough for `gradcheck`
    """

    unit: str
    outputs: int
    differentiable: tuple[int, ...]
    typical: int
    compiled: int
    smooth: tuple[int, ...] = ()
    unit_axes: int = 1


def operations() -> list[str]:
    """Names of all operations: those of the folders beside this file."""
    return sorted(module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]) if module.ispkg)


def tensors(found: Any) -> tuple[Tensor, ...]:
    """Outputs of an operation as a tuple: a tensor, several, or those that a dataclass holds."""
    if is_dataclass(found):
        found = tuple(getattr(found, field.name) for field in fields(found))
    return tuple(x for x in found if isinstance(x, Tensor)) if isinstance(found, tuple) else (found,)
