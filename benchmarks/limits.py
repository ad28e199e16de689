"""Kernels of the three hottest methods against the machine: operations and bytes, as shares of what it can do at most.

    python benchmarks/limits.py --output limits.json

Splats: tile, project, rasterize, photometric. instant-ngp: hash_encode, perceptron, composite. TensoRF: factor_grid.
Inputs are each kernel's `benchmark_case`. Floating-point operations are counted by the formulas of `OPERATIONS`, an
addition, a multiplication and an exponential as one each. Bytes: each input read once and each output written once;
backward, gradients too. The machine's peaks are measured first: products of two matrices of 2048 rows, and a copy of
256 MB.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from lumigraph.files import write_json
from lumigraph.kernels import using
from lumigraph.kernels._operation import tensors
from lumigraph.lab.benchmark.step import memory_rate

WINDOW, CHANNELS, MAPS = 11, 3, 5  # of SSIM: taps of a pass, colours, blurred maps
LEVELS, CORNERS, FEATURES = 16, 8, 2  # of the hash table
COMPONENTS, TAPS = 48, 6  # of VM-192's density: of three planes and lines, and values that each takes
EVALUATION = 30  # of a Gaussian at a pixel: exponent, exponential, blending of four values
ROWS = 2048  # of the matrices
CALLS = 7


def footprint_evaluations(inputs: Sequence[Any]) -> float:
    """Pairs of a pixel and a Gaussian that adds at least 1/255 there: the areas of the ellipses."""
    _, conics, opacities = inputs[:3]
    reach = 2 * (255 * opacities.detach()).clamp_min(1).log()
    a, b, c = conics.detach().unbind(-1)
    return float((math.pi * reach / (a * c - b * b).clamp_min(1e-12).sqrt()).sum())


def products(inputs: Sequence[Any]) -> float:
    """Multiplications and additions of a perceptron's layers."""
    return 2.0 * len(inputs[0]) * sum(weight.numel() for weight in inputs[1:])


# Operations of all inputs, forward; and backward as a multiple of it, 0 where no gradient is taken.
OPERATIONS: dict[str, tuple[Callable[[Sequence[Any]], float], float]] = {
    "tile": (lambda x: 40.0 * len(x[0]), 0),
    "project": (lambda x: (250.0 + 2 * 3 * 16) * len(x[0]), 2.5),
    "rasterize": (lambda x: EVALUATION * footprint_evaluations(x), 2),
    "photometric": (lambda x: math.prod(x[0].shape[:2]) * CHANNELS * (MAPS * 2 * 2 * WINDOW + 20.0), 0.8),
    "hash_encode": (lambda x: len(x[0]) * LEVELS * (CORNERS * (2 * FEATURES + 3) + 6.0), 1),
    "perceptron": (products, 2),
    "composite": (lambda x: 15.0 * len(x[0]), 2),
    "factor_grid": (lambda x: len(x[0]) * COMPONENTS * (2 * TAPS + 2.0), 2),
}


@dataclass(frozen=True)
class Options:
    size: int = 2**18  # samples or pixels of each case
    output: Path | None = None


def main(options: Options) -> None:
    rate, moved = arithmetic_rate(), memory_rate()
    print(f"{torch.get_num_threads()} threads: {rate / 1e9:.0f} GFLOP/s, {moved / 1e9:.1f} GB/s")
    rows = {}
    for name, (operations, backward) in OPERATIONS.items():
        folder = importlib.import_module(f"lumigraph.kernels.{name}")
        inputs = list(folder.benchmark_case(torch.Generator().manual_seed(0), options.size))
        count = operations(inputs)
        wanted = [x for x in inputs if isinstance(x, Tensor) and x.requires_grad]
        run = getattr(folder, name)
        with using("cpu"):
            outputs = tensors(run(*inputs))
            rows[f"{name}, forward"] = row(count, [*inputs, *outputs], median(lambda: run(*inputs)), rate, moved)  # noqa: B023
            if not (wanted and backward):
                continue
            made = [x for x in outputs if x.requires_grad]
            slopes = [torch.randn_like(x) for x in made]
            seconds = median(lambda: torch.autograd.grad(made, wanted, slopes, retain_graph=True))  # noqa: B023
        rows[f"{name}, backward"] = row(backward * count, [*inputs, *slopes, *wanted], seconds, rate, moved)
    for name, one in rows.items():
        print(
            f"{name:22} {one['ms']:8.2f} ms  {one['GFLOP/s']:7.1f} GFLOP/s {one['of arithmetic']:6.1%}"
            f"  {one['GB/s']:6.1f} GB/s {one['of memory']:6.1%}"
        )
    if options.output:
        write_json(options.output, {"GFLOP/s": rate / 1e9, "GB/s": moved / 1e9, "kernels": rows})


def arithmetic_rate() -> float:
    """Floating-point operations of a second, of matrix products."""
    a, b = torch.randn(2, ROWS, ROWS)
    return 2 * ROWS**3 / median(lambda: a @ b)


def row(operations: float, parts: Sequence[Any], seconds: float, rate: float, moved: float) -> dict[str, float]:
    bytes_ = sum(x.nbytes for part in parts for x in tensors(part) if isinstance(x, Tensor))
    return {
        "ms": 1000 * seconds,
        "GFLOP/s": operations / seconds / 1e9,
        "of arithmetic": operations / seconds / rate,
        "GB/s": bytes_ / seconds / 1e9,
        "of memory": bytes_ / seconds / moved,
    }


def median(call: Callable[[], Any]) -> float:
    """Seconds of a call, the median after a first one."""
    call()
    times = []
    for _ in range(CALLS):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return sorted(times)[CALLS // 2]


if __name__ == "__main__":
    main(tyro.cli(Options))
