"""Checks of the inputs of kernels, before compiled loops use them unchecked.

Loops check no index. So `door` makes sure of the shapes and types that annotations state, and each function itself of
whatever else an index is taken from: the starts of rays and tiles, the numbers of Gaussians. The values of samples are
trusted, for a look at each would cost as much as the loop; on a GPU indices are too, for a look would wait for it.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable
from functools import cache, wraps
from typing import NamedTuple, ParamSpec, TypeVar

import torch
from torch import Tensor

Given = ParamSpec("Given")
Found = TypeVar("Found")


class Stated(NamedTuple):
    """Annotation of a tensor: names or sizes of its axes, and permitted types."""

    axes: tuple[str | int, ...]
    types: frozenset[torch.dtype]


def door(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """The function, which raises ValueError for tensors that are not as its annotations say: `Float[Tensor, "ray 3"]`.

    An axis has the same size wherever its name stands. Floating-point tensors are of one type, and all on one device.
    """
    names = [*inspect.signature(function).parameters]

    @wraps(function)
    def guarded(*args: Given.args, **kwargs: Given.kwargs) -> Found:
        said, sizes, floats, devices = stated(function), dict[str, int](), set[torch.dtype](), set[torch.device]()
        further = ((names[-1], value) for value in args[len(names) :])  # of *weights
        for name, value in (*zip(names, args, strict=False), *further, *kwargs.items()):
            if about := said.get(name):
                assert isinstance(value, Tensor)
                if not fits(value, about, sizes):
                    raise ValueError(f"{name} is {value.dtype} {tuple(value.shape)}, not {about.axes} of {sizes}")
                devices.add(value.device)
                if value.is_floating_point():
                    floats.add(value.dtype)
        if len(floats) > 1 or len(devices) > 1:
            raise ValueError(f"tensors of {floats} on {devices} meet; they must be of one type and on one device")
        return function(*args, **kwargs)

    return guarded


@cache
def stated(function: Callable) -> dict[str, Stated]:
    """Annotations of the tensor parameters of a function, by name."""
    found = {}
    for name, kind in typing.get_type_hints(function).items():
        if name != "return" and hasattr(kind, "dim_str"):
            axes = (int(axis) if axis.isdecimal() else axis for axis in kind.dim_str.split())
            types = (getattr(torch, dtype, None) for dtype in kind.dtypes)
            found[name] = Stated(tuple(axes), frozenset(dtype for dtype in types if dtype is not None))
    return found


def fits(tensor: Tensor, about: Stated, sizes: dict[str, int]) -> bool:
    """Check a tensor against an annotation. sizes: of the axes that have been seen, to which it adds its own."""
    if tensor.ndim != len(about.axes) or tensor.dtype not in about.types:
        return False
    for axis, size in zip(about.axes, tensor.shape, strict=True):
        if axis != "_" and size != (axis if isinstance(axis, int) else sizes.setdefault(axis, size)):
            return False
    return True


def require(holds: bool, fault: str) -> None:
    """Raise ValueError with the fault unless something holds."""
    if not holds:
        raise ValueError(fault)


def require_starts(name: str, starts: Tensor, count: int) -> None:
    """Raise ValueError unless int64 starts lead from 0 to the count without going back."""
    holds = len(starts) > 0 and starts.dtype == torch.int64
    if holds and not starts.is_cuda:
        holds = int(starts[0]) == 0 and int(starts[-1]) == count and bool((starts[1:] >= starts[:-1]).all())
    require(holds, f"{name} must be int64 and lead from 0 to {count} without going back")


def require_indices(name: str, indices: Tensor, count: int) -> None:
    """Raise ValueError unless all indices are at least 0 and below the count."""
    if len(indices) and not indices.is_cuda:
        least, most = (int(x) for x in indices.aminmax())
        require(least >= 0 and most < count, f"{name} goes from {least} to {most}, and must stay from 0 below {count}")
