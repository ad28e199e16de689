"""One comparison for every kernel: an engine against the float64 reference, in outputs and gradients."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import numba
import torch
from proofs import sources
from shape_checks import PACKAGE
from torch import Tensor

from lumigraph import kernels
from lumigraph.kernels._operation import Facts, operations, tensors

OPERATIONS = operations()
ENGINES = ["cpu", "gpu"]
OUTPUT_BOUND, GRADIENT_BOUND = 0.01, 0.25  # of their norms, for products in bfloat16: see `assert_near`
DEVICES = {"reference": "cpu", "cpu": "cpu", "gpu": "cuda" if torch.cuda.is_available() else "cpu"}


def module(name: str) -> Any:
    """An operation's folder. (As an attribute of `kernels` its name means the operation itself.)"""
    return importlib.import_module(f"lumigraph.kernels.{name}")


def folder(name: str) -> Path:
    return PACKAGE / "kernels" / name


def depends(name: str) -> set[Path]:
    """All files that a comparison of one operation rests on."""
    return {Path(__file__), *sources(folder(name))}


def facts(name: str) -> Facts:
    return module(name).FACTS


@functools.cache
def cases(name: str) -> list[tuple]:
    """All of an operation's cases, made once: nobody may write to them."""
    return list(module(name).cases(torch.Generator().manual_seed(0)))


def call(name: str, engine: str, inputs: Sequence) -> tuple[Tensor, ...]:
    """The operation's outputs. What an engine forgets to write is NaN."""
    with kernels.using(engine), mock.patch.dict(os.environ, LUMIGRAPH_DEBUG="1"):
        return tensors(getattr(module(name), name)(*inputs))


def exact(inputs: Sequence) -> tuple:
    """The same in double precision."""
    return tuple(x.double() if torch.is_tensor(x) and x.is_floating_point() else x for x in inputs)


def moved(inputs: Sequence, engine: str) -> list:
    """The same inputs on the engine's device; what is done to them reaches no other engine's."""
    detached = (x.detach() if torch.is_tensor(x) else x for x in inputs)
    return [x.to(DEVICES[engine]) if hasattr(x, "to") else x for x in detached]


def outputs_and_gradients(name: str, engine: str, inputs: Sequence, wanted=None, used=None) -> list[Tensor]:
    """All outputs, then the gradient of a fixed mixture of them in each input that is real.

    wanted: the only input to differentiate, by position; all that are real if None
    used:   the only output that takes part in the mixture; all if None
    """
    real = [i for i, x in enumerate(inputs) if torch.is_tensor(x) and x.is_floating_point()]
    inputs = moved(inputs, engine)
    differentiated = [inputs[i].requires_grad_() for i in real if wanted in (None, i)]
    outputs = call(name, engine, inputs)
    mixture = []
    for i, output in enumerate(outputs):
        if output.requires_grad and used in (None, i):
            weight = torch.randn(output.shape, generator=torch.Generator().manual_seed(i))
            if not output.ndim:  # a mean, whose gradient has a norm of about 1 / sqrt(n)
                weight = torch.tensor(inputs[0].numel() ** 0.5)
            mixture.append((output * weight.to(output)).sum())
    if not mixture:
        return list(outputs)
    with mock.patch.dict(os.environ, LUMIGRAPH_DEBUG="1"):
        return [*outputs, *torch.autograd.grad(sum(mixture), differentiated, materialize_grads=True)]


def in_bfloat16(name: str, engine: str) -> bool:
    """True for what multiplies in bfloat16: the perceptron on a GPU."""
    return name == "perceptron" and DEVICES[engine] == "cuda"


def assert_near(actual: Tensor, expected: Tensor, bound: float) -> None:
    """By norms. In bfloat16, rounded on a CPU, outputs of the perceptron's cases differ by up to 0.0055 of theirs, and
    gradients by 0.165: a hidden unit near zero changes sides, and its gradient comes or goes."""
    gap, size = (actual - expected).norm().item(), expected.norm().item()
    assert gap <= bound * size, f"{gap / size:.3g} of the norm, more than {bound}"


@functools.cache
def truth(name: str, case: int, wanted: int | None = None, used: int | None = None) -> list[Tensor]:
    """What the reference finds in double precision."""
    return outputs_and_gradients(name, "reference", exact(cases(name)[case]), wanted, used)


def assert_agrees(
    name: str,
    engine: str,
    case: int,
    wanted: int | None = None,
    used: int | None = None,
    laid_out: Callable[[Tensor], Tensor] = lambda x: x,
) -> None:
    """laid_out: what is done to each input's memory, its numbers staying what they are."""
    inputs = [laid_out(x) if torch.is_tensor(x) else x for x in cases(name)[case]]
    found = outputs_and_gradients(name, engine, inputs, wanted, used)
    for i, (expected, actual) in enumerate(zip(truth(name, case, wanted, used), found, strict=True)):
        if in_bfloat16(name, engine):
            assert_near(actual.cpu().double(), expected, OUTPUT_BOUND if i < facts(name).outputs else GRADIENT_BOUND)
            continue
        scale = max(1.0, expected.abs().max().item()) if expected.numel() else 1.0
        torch.testing.assert_close(
            actual.cpu().to(expected.dtype),
            expected,
            rtol=1e-4,
            atol=1e-5 * scale,
            msg=lambda report, i=i: f"{name} on {engine}, case {case}, result {i}: {report}",
        )


def assert_agrees_in_all_cases(name: str, engine: str, small_first: bool = False) -> None:
    """The typical case first, which shows most faults; or small cases first and empty ones last, so that a fault is
    found before large cases are interpreted."""

    def size(case: int) -> tuple[bool, int]:
        inputs, outputs = cases(name)[case], truth(name, case)[: facts(name).outputs]
        empty = any(not x.numel() for x in inputs if torch.is_tensor(x))
        return empty, inputs[0].numel() + sum(x.numel() for x in outputs)

    order = size if small_first else lambda case: case != facts(name).typical
    for case in sorted(range(len(cases(name))), key=order):
        assert_agrees(name, engine, case)


def faults(name: str) -> Any:
    """The faults that an operation's folder lists."""
    return importlib.import_module(f"lumigraph.kernels.{name}.faults")


def seeded(source: str, function: str, before: str, after: str) -> str:
    """An engine's source with one fault in one function: `after` where `before` stood first."""
    above, body = source.split(f"def {function}(", 1)
    assert before in body, f"{function} no longer says {before!r}"
    return f"{above}def {function}({body.replace(before, after, 1)}"


def stand_in(name: str, engine: str, edit: Callable[[str], str], copies: Path, monkeypatch) -> None:
    """Until the test ends, a copy of the engine with its source edited stands in the engine's place.

    What Numba would compile runs as plain Python, in which every index is checked, and no copy takes time to compile.
    """
    original = engine_of(name, engine)  # which itself is compiled, though imported here for the first time
    with mock.patch.object(numba.config, "DISABLE_JIT", True):
        copy = _copy(name, engine, edit, copies, monkeypatch)
    monkeypatch.setattr(original, "run", copy.run)


def engine_of(name: str, engine: str) -> ModuleType:
    return importlib.import_module(f"lumigraph.kernels.{name}.{engine}")


def _copy(name: str, engine: str, edit: Callable[[str], str], copies: Path, monkeypatch) -> ModuleType:
    source = edit((folder(name) / f"{engine}.py").read_text(encoding="utf-8"))
    for other in re.findall(rf"^from \.\.(\w+)\.{engine} import", source, re.MULTILINE):
        original = engine_of(other, engine)
        plain = _copy(other, engine, lambda same: same, copies, monkeypatch)
        monkeypatch.setitem(sys.modules, original.__name__, plain)
    path = copies / f"{name}_{engine}.py"
    path.write_text(source, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(f"lumigraph.kernels.{name}.edited", path)
    copy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    return copy
