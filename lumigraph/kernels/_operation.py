"""Parts of an operation: its facts, input checks, engine dispatch, and autograd around engines.

Compiled loops check no index. So `door` checks the shapes and types that annotations state, and each function
checks all else that is used as an index: the starts of rays and tiles, the numbers of Gaussians. The values of
samples are trusted, because checking each would cost as much as the loop. On a GPU indices are trusted too, because
checking them would synchronise with it.
"""

import contextlib
import contextvars
import importlib
import inspect
import os
import pkgutil
import typing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, partial, wraps
from pathlib import Path
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

import torch
from torch import Tensor

from ..errors import LumigraphError

NO_TRITON = (
    "needs Triton, which is not installed; PyTorch's CUDA and ROCm builds bring it, so install one of them, or take "
    "--device cpu"
)
Engine = Literal["reference", "cpu", "gpu"]
Given = ParamSpec("Given")
Found = TypeVar("Found")


@dataclass(frozen=True)
class Facts:
    """Properties of an operation, for tests and benchmarks. Inputs and outputs are named by position, cases as in
    `cases()`.

    unit:           benchmarked unit, counted per second
    unit_axes:      number of leading axes of the first input that count units
    outputs:        number of returned tensors
    differentiable: inputs with gradients; () for an operation without
    typical:        a case that is neither empty nor extreme
    compiled:       the case whose options reach most of the GPU engine's code
    smooth:         cases without inputs near discontinuous derivatives, small enough for `gradcheck`
    """

    unit: str
    outputs: int
    differentiable: tuple[int, ...]
    typical: int
    compiled: int
    smooth: tuple[int, ...] = ()
    unit_axes: int = 1


def operations() -> list[str]:
    """Names of all operations: the folders beside this file."""
    return sorted(module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]) if module.ispkg)


def tensors(found: Any) -> tuple[Tensor, ...]:
    """Outputs of an operation as a tuple, from a tensor, a tuple or a dataclass of tensors."""
    if is_dataclass(found):
        found = tuple(getattr(found, field.name) for field in fields(found))
    return tuple(x for x in found if isinstance(x, Tensor)) if isinstance(found, tuple) else (found,)


class Annotation(NamedTuple):
    """Names or sizes of a tensor's axes, and its permitted types."""

    axes: tuple[str | int, ...]
    types: frozenset[torch.dtype]


def door(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """Wrap a function to raise ValueError for tensors that differ from their annotations, `Float[Tensor, "ray 3"]`.

    Axes of one name have one size. Floating-point tensors are of one type, and all tensors on one device.
    """
    names = [*inspect.signature(function).parameters]

    @wraps(function)
    def guarded(*args: Given.args, **kwargs: Given.kwargs) -> Found:
        expected, sizes = annotations_of(function), dict[str, int]()
        floats, devices = set[torch.dtype](), set[torch.device]()
        further = ((names[-1], value) for value in args[len(names) :])  # of *weights
        for name, value in (*zip(names, args, strict=False), *further, *kwargs.items()):
            if about := expected.get(name):
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
def annotations_of(function: Callable) -> dict[str, Annotation]:
    """Annotations of the tensor parameters of a function, by name."""
    found = {}
    for name, kind in typing.get_type_hints(function).items():
        if name != "return" and hasattr(kind, "dim_str"):
            axes = (int(axis) if axis.isdecimal() else axis for axis in kind.dim_str.split())
            types = (getattr(torch, dtype, None) for dtype in kind.dtypes)
            found[name] = Annotation(tuple(axes), frozenset(dtype for dtype in types if dtype is not None))
    return found


def fits(tensor: Tensor, about: Annotation, sizes: dict[str, int]) -> bool:
    """Check a tensor against an annotation. sizes: named axes of earlier tensors; new ones are added"""
    if tensor.ndim != len(about.axes) or tensor.dtype not in about.types:
        return False
    for axis, size in zip(about.axes, tensor.shape, strict=True):
        if axis != "_" and size != (axis if isinstance(axis, int) else sizes.setdefault(axis, size)):
            return False
    return True


def require(holds: bool, fault: str) -> None:
    """Raise ValueError with the fault unless the condition holds."""
    if not holds:
        raise ValueError(fault)


def require_starts(name: str, starts: Tensor, count: int) -> None:
    """Raise ValueError unless the starts are int64 and non-decreasing from 0 to the count."""
    holds = len(starts) > 0 and starts.dtype == torch.int64
    if holds and not starts.is_cuda:
        holds = int(starts[0]) == 0 and int(starts[-1]) == count and bool((starts[1:] >= starts[:-1]).all())
    require(holds, f"{name} must be int64 and lead from 0 to {count} without going back")


def require_indices(name: str, indices: Tensor, count: int) -> None:
    """Raise ValueError unless all indices are at least 0 and below the count."""
    if len(indices) and not indices.is_cuda:
        least, most = (int(x) for x in indices.aminmax())
        require(least >= 0 and most < count, f"{name} goes from {least} to {most}, and must stay from 0 below {count}")


_forced: contextvars.ContextVar[Engine | None] = contextvars.ContextVar("engine", default=None)


@contextlib.contextmanager
def using(engine: Engine) -> Iterator[None]:
    """Run every operation inside this block on one engine, on any device."""
    token = _forced.set(engine)
    try:
        yield
    finally:
        _forced.reset(token)


Watch = Callable[[str, Callable[[], Any], tuple], Any]
_watch: Watch | None = None


@contextlib.contextmanager
def watching(watch: Watch) -> Iterator[None]:
    """Replace the result of each kernel's call() by that of watch(name, call, inputs) inside this block, on all
    threads.

    name: "project forward", "project backward"; inputs: the forward inputs, or the context with saved tensors
    """
    global _watch
    before, _watch = _watch, watch
    try:
        yield
    finally:
        _watch = before


def watched(name: str, run: Callable, *inputs: Any) -> Any:
    """Result of run(*inputs), through the hook of `watching` if one is set."""
    return run(*inputs) if _watch is None else _watch(name, partial(run, *inputs), inputs)


def implementation(operation: str, tensor: Tensor) -> Callable:
    """`run` function of an operation on the engine for the tensor's device."""
    engine = _forced.get() or ("gpu" if tensor.is_cuda else "cpu")
    try:
        run = importlib.import_module(f"{__package__}.{operation}.{engine}").run
        return run if _watch is None else partial(watched, f"{operation} forward", run)
    except ModuleNotFoundError as fault:
        if fault.name != "triton":
            raise
        raise LumigraphError(f"The GPU kernel {operation} {NO_TRITON}") from fault


def empty(*shape: int, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
    """Uninitialised output tensor. LUMIGRAPH_DEBUG fills it with NaN, which shows entries never written."""
    out = torch.empty(shape, dtype=dtype, device=device)
    if os.environ.get("LUMIGRAPH_DEBUG") and dtype.is_floating_point:
        out.fill_(torch.nan)
    return out


def differentiable(forward: Callable, backward: Callable, contiguous: bool = True) -> Callable:
    """`run` function of an engine from `forward` and `backward` as in `torch.autograd.Function`.

    contiguous: make input tensors and gradients contiguous first
    """

    def laid_out(inputs: Iterable[Any]) -> Iterator[Any]:
        return (x.contiguous() if contiguous and isinstance(x, Tensor) else x for x in inputs)

    name = forward.__module__.split(".")[-2]

    def back(ctx: Any, *grads: Tensor) -> Any:
        return watched(f"{name} backward", backward, ctx, *laid_out(grads))

    once = torch.autograd.function.once_differentiable(back)
    ways = {"forward": staticmethod(forward), "backward": staticmethod(once)}
    function: Any = type(name, (torch.autograd.Function,), ways)

    def run(*inputs: Any) -> Any:
        return function.apply(*laid_out(inputs))

    return run
