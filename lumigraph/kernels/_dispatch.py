"""One operation, three engines: `reference` says what it means, `cpu` is Numba, `gpu` is Triton."""

from __future__ import annotations

import contextlib
import contextvars
import importlib
import os
from collections.abc import Callable, Iterator
from typing import Literal

import torch
from torch import Tensor

Engine = Literal["reference", "cpu", "gpu"]

_forced: contextvars.ContextVar[Engine | None] = contextvars.ContextVar("engine", default=None)


@contextlib.contextmanager
def using(engine: Engine) -> Iterator[None]:
    """Run every operation inside this block on one engine, whatever device its tensors are on."""
    token = _forced.set(engine)
    try:
        yield
    finally:
        _forced.reset(token)


def implementation(operation: str, tensor: Tensor) -> Callable:
    """The `run` function of an operation, on the engine that fits the tensor's device."""
    engine = _forced.get() or ("gpu" if tensor.is_cuda else "cpu")
    return importlib.import_module(f"{__package__}.{operation}.{engine}").run


def empty(*shape: int, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
    """Memory for an engine's output. With LUMIGRAPH_DEBUG set it starts as NaN, so that what is never written shows."""
    out = torch.empty(shape, dtype=dtype, device=device)
    if os.environ.get("LUMIGRAPH_DEBUG") and dtype.is_floating_point:
        out.fill_(torch.nan)
    return out
