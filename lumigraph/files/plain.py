"""Serialisation of values to plain JSON and named tensors, without pickle: reading a file must not execute it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from torch import Tensor

from .reading import reading


def flatten(value: Any, tensors: dict[str, Tensor], name: str = "optimizers") -> Any:
    """The value as JSON; its tensors are added to `tensors` under their paths."""
    match value:
        case Tensor():
            tensors[name] = value
            return {"tensor": name}
        case dict():
            return {"dict": [[key, flatten(x, tensors, f"{name}.{key}")] for key, x in value.items()]}
        case list() | tuple():
            items = [flatten(x, tensors, f"{name}.{i}") for i, x in enumerate(value)]
            return {"tuple": items} if isinstance(value, tuple) else items
        case None | bool() | int() | float() | str():
            return value
    raise TypeError(f"{name} holds a {type(value).__name__}, which a checkpoint cannot keep")


def unflatten(value: Any, tensors: dict[str, Tensor]) -> Any:
    """The inverse of `flatten`."""
    match value:
        case {"tensor": str(name)}:
            return tensors[name]
        case {"dict": items}:
            return {key: unflatten(x, tensors) for key, x in items}
        case {"tuple": items}:
            return tuple(unflatten(x, tensors) for x in items)
        case list():
            return [unflatten(x, tensors) for x in value]
    return value


def understood(path: Path) -> AbstractContextManager[None]:
    """`reading` for files that Lumigraph wrote."""
    return reading(path, "does not hold what it should", "it was edited, or written by another version")


def alike(a: Any, b: Any, tolerance: float = 1e-4) -> bool:
    """True if two JSON values agree, numbers up to a tolerance."""
    match a, b:
        case dict(), dict():
            return a.keys() == b.keys() and all(alike(a[k], b[k], tolerance) for k in a)
        case ((list() | tuple()), (list() | tuple())):
            return len(a) == len(b) and all(alike(x, y, tolerance) for x, y in zip(a, b, strict=True))
        case ((int() | float()), (int() | float())):
            return bool(abs(a - b) <= tolerance * max(1.0, abs(a)))
    return bool(a == b)
