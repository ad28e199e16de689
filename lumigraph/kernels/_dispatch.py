"""One operation, three engines: `reference` says what it means, `cpu` is Numba, `gpu` is Triton."""

from __future__ import annotations

import contextlib
import contextvars
import importlib
import os
from collections.abc import Callable, Iterator
from typing import Any, Literal

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


def differentiable(forward: Callable, backward: Callable) -> Callable:
    """The `run` of an engine from its ways there and back, which are as in `torch.autograd.Function`.

    Tensors are contiguous when they come to `forward`; gradients come to `backward` as they are.
    """
    once = torch.autograd.function.once_differentiable(backward)
    ways = {"forward": staticmethod(forward), "backward": staticmethod(once)}
    function: Any = type(forward.__module__.split(".")[-2], (torch.autograd.Function,), ways)

    def run(*inputs: Any) -> Any:
        return function.apply(*(x.contiguous() if isinstance(x, Tensor) else x for x in inputs))

    return run
