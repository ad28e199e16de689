"""One comparison for every kernel: an engine against the float64 reference, in outputs and gradients."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import torch
from torch import Tensor

from lumigraph import kernels
from lumigraph.rays import Samples

OPERATIONS = ["spherical_harmonics", "composite", "hash_encode", "march"]
ENGINES = ["cpu", "gpu"]
DEVICES = {"reference": "cpu", "cpu": "cpu", "gpu": "cuda" if torch.cuda.is_available() else "cpu"}


def module(name: str):
    """An operation's folder. (As an attribute of `kernels` its name means the operation itself.)"""
    return importlib.import_module(f"lumigraph.kernels.{name}")


def cases(name: str) -> list[tuple]:
    return list(module(name).cases(torch.Generator().manual_seed(0)))


def call(name: str, engine: str, inputs: tuple) -> tuple[Tensor, ...]:
    """The operation's outputs. What an engine forgets to write is NaN."""
    with kernels.using(engine), mock.patch.dict(os.environ, LUMIGRAPH_DEBUG="1"):
        found = getattr(module(name), name)(*inputs)
    if isinstance(found, Samples):
        return found.t_start, found.t_end, found.ray_starts
    return found if isinstance(found, tuple) else (found,)


def outputs_and_gradients(name: str, engine: str, inputs: tuple, wanted=None, used=None) -> list[Tensor]:
    """All outputs, then the gradient of a fixed mixture of them in each input that is real.

    wanted: the inputs to differentiate, by position; all that are real if None
    used:   the outputs that take part in the mixture; all if None
    """
    real = [i for i, x in enumerate(inputs) if torch.is_tensor(x) and x.is_floating_point()]
    inputs = [x.detach().to(DEVICES[engine]) if torch.is_tensor(x) else x for x in inputs]
    wanted = [inputs[i].requires_grad_() for i in real if wanted is None or i in wanted]
    outputs = call(name, engine, tuple(inputs))
    mixture = []
    for i, output in enumerate(outputs):
        if output.requires_grad and (used is None or i in used):
            weight = torch.randn(output.shape, generator=torch.Generator().manual_seed(i))
            mixture.append((output * weight.to(output)).sum())
    if not mixture:
        return list(outputs)
    with mock.patch.dict(os.environ, LUMIGRAPH_DEBUG="1"):
        return [*outputs, *torch.autograd.grad(sum(mixture), wanted, materialize_grads=True)]


def assert_agrees(name: str, engine: str, inputs: tuple, **selection) -> None:
    exact = tuple(x.double() if torch.is_tensor(x) and x.is_floating_point() else x for x in inputs)
    truth = outputs_and_gradients(name, "reference", exact, **selection)
    found = outputs_and_gradients(name, engine, inputs, **selection)
    for i, (expected, actual) in enumerate(zip(truth, found, strict=True)):
        scale = max(1.0, expected.abs().max().item()) if expected.numel() else 1.0
        torch.testing.assert_close(
            actual.cpu().to(expected.dtype),
            expected,
            rtol=1e-4,
            atol=1e-5 * scale,
            msg=lambda report, i=i: f"{name} on {engine}, result {i}: {report}",
        )


def edit_engine(name: str, engine: str, edit: Callable[[str], str], folder: Path, monkeypatch) -> None:
    """Until the test ends, a copy of the engine with its source edited stands in the engine's place."""
    package = module(name)
    original = importlib.import_module(f"{package.__name__}.{engine}")
    path = folder / f"{engine}.py"
    path.write_text(edit(Path(original.__file__).read_text(encoding="utf-8")), encoding="utf-8")
    spec = importlib.util.spec_from_file_location(f"{package.__name__}.edited", path)
    copy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    monkeypatch.setattr(original, "run", copy.run)


# What replaces the hash encoding's vector operations, which are below the level at which Numba could check.
PLAIN_LANES = """
from .lanes import BLOCK


@njit
def blend(table, base, entries, weights, i, lanes, out, first, stride):
    for f in range(len(lanes)):
        total = ZERO
        for corner in range(8):
            total += weights[corner * BLOCK + i] * table[base + entries[corner * BLOCK + i], f]
        out[first + f * stride] = total


@njit
def spread(grad, first, stride, base, entries, weights, i, lanes, table):
    for f in range(len(lanes)):
        for corner in range(8):
            table[base + entries[corner * BLOCK + i], f] += weights[corner * BLOCK + i] * grad[first + f * stride]
"""


def plain_lanes(source: str) -> str:
    line = "from .lanes import BLOCK, blend, spread\n"
    assert line in source or "lanes import" not in source
    return source.replace(line, PLAIN_LANES)
