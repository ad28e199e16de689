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

OPERATIONS = [
    "spherical_harmonics",
    "composite",
    "hash_encode",
    "march",
    "perceptron",
    "project",
    "tile",
    "rasterize",
    "ssim",
]
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
    if isinstance(found, kernels.Tiles):
        return found.order, found.starts
    return found if isinstance(found, tuple) else (found,)


def outputs_and_gradients(name: str, engine: str, inputs: tuple, wanted=None, used=None) -> list[Tensor]:
    """All outputs, then the gradient of a fixed mixture of them in each input that is real.

    wanted: the inputs to differentiate, by position; all that are real if None
    used:   the outputs that take part in the mixture; all if None
    """
    real = [i for i, x in enumerate(inputs) if torch.is_tensor(x) and x.is_floating_point()]
    inputs = [x.detach() if torch.is_tensor(x) else x for x in inputs]
    inputs = [x.to(DEVICES[engine]) if hasattr(x, "to") else x for x in inputs]
    wanted = [inputs[i].requires_grad_() for i in real if wanted is None or i in wanted]
    outputs = call(name, engine, tuple(inputs))
    mixture = []
    for i, output in enumerate(outputs):
        if output.requires_grad and (used is None or i in used):
            weight = torch.randn(output.shape, generator=torch.Generator().manual_seed(i))
            if not output.ndim:  # a mean, whose gradient has a norm of about 1 / sqrt(n)
                weight = torch.tensor(inputs[0].numel() ** 0.5)
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


# What replaces the engines' vector operations, which are below the level at which Numba could check.
PLAIN_LANES = {
    "from .lanes import BLOCK, blend, place_dense, place_hashed, spread\n": """
from .lanes import BLOCK


@njit
def _corners(points, at, axes, resolution, strides, mask, base, features, entries, weights, i):
    flat = points.reshape(-1)
    for j in range(min(LANES, points.shape[1] - at)):
        cx, fx = _cell(flat[at + j], resolution)
        cy, fy = _cell(flat[at + j + axes], resolution)
        cz, fz = _cell(flat[at + j + 2 * axes], resolution)
        for corner in range(8):
            bx, by, bz = corner & 1, corner >> 1 & 1, corner >> 2
            x, y, z = np.int64(cx) + bx, (np.int64(cy) + by) * strides[0], (np.int64(cz) + bz) * strides[1]
            x, y, z = x & 0xFFFFFFFF, y & 0xFFFFFFFF, z & 0xFFFFFFFF
            entry = (x ^ y ^ z) & mask if mask else x + y + z
            entries[corner * BLOCK + i + j] = (entry + base) * features
            weight = (fx if bx else 1 - fx) * (fy if by else 1 - fy) * (fz if bz else 1 - fz)
            weights[corner * BLOCK + i + j] = weight


@njit
def place_dense(points, at, axes, resolution, stride_y, stride_z, mask, base, lanes, entries, weights, i):
    strides = np.int64(stride_y), np.int64(stride_z)
    _corners(points, at, axes, resolution, strides, np.int64(mask), base, len(lanes), entries, weights, i)


place_hashed = place_dense


@njit
def blend(table, entries, weights, i, lanes, out, first, stride):
    for f in range(len(lanes)):
        total = ZERO
        for corner in range(8):
            total += weights[corner * BLOCK + i] * table.reshape(-1)[np.int64(entries[corner * BLOCK + i]) + f]
        out[first + f * stride] = total


@njit
def spread(grad, first, stride, entries, weights, i, lanes, table):
    flat = table.reshape(-1)
    for f in range(len(lanes)):
        for corner in range(8):
            at = np.int64(entries[corner * BLOCK + i]) + f
            flat[at] += weights[corner * BLOCK + i] * grad[first + f * stride]
""",
    "from .lanes import BLOCK, TILE, added, gated, move, product, rectified, transpose\n": """
from .lanes import BLOCK, TILE


@njit
def move(source, start, target, to):
    a, b = source.reshape(-1), target.reshape(-1)
    for i in range(BLOCK):
        b[to + i] = a[start + i]


@njit
def transpose(buffer, source, target):
    for i in range(BLOCK):
        for j in range(BLOCK):
            buffer[(target + i) * BLOCK + j] = buffer[(source + j) * BLOCK + i]


@njit
def _tile(inputs, first_input, depth, weights, first_weight, down, across, outputs, y, first_gate, lanes, kind):
    for o in range(len(lanes)):
        for s in range(BLOCK):
            total = np.float32(0)
            for i in range(depth):
                total += weights[first_weight + down * i + across * o] * inputs[(first_input + i) * BLOCK + s]
            gate = outputs[(first_gate + o) * BLOCK + s]
            if (kind == 1 and total < 0) or (kind == 2 and not gate > 0):
                total = np.float32(0)
            outputs[(y + o) * BLOCK + s] = total + gate if kind == 3 else total


@njit
def product(x, i, d, w, f, down, across, y, o, g, lanes):
    _tile(x, i, d, w, f, down, across, y, o, g, lanes, 0)


@njit
def rectified(x, i, d, w, f, down, across, y, o, g, lanes):
    _tile(x, i, d, w, f, down, across, y, o, g, lanes, 1)


@njit
def gated(x, i, d, w, f, down, across, y, o, g, lanes):
    _tile(x, i, d, w, f, down, across, y, o, g, lanes, 2)


@njit
def added(x, i, d, w, f, down, across, y, o, g, lanes):
    _tile(x, i, d, w, f, down, across, y, o, g, lanes, 3)
""",
}


def plain_lanes(source: str) -> str:
    """An engine's source with its vector operations written out in numbers."""
    assert "from .lanes import" not in source or any(line in source for line in PLAIN_LANES)
    for line, plain in PLAIN_LANES.items():
        source = source.replace(line, plain)
    return source
