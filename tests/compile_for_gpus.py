"""Compile every Triton kernel for GPUs that need not be here; run by test_gpu_compiles.py in a process of its own.

Engines run as they are on tensors that lie on the CPU; what would launch a kernel only compiles it, down to the machine
code of the target. Outputs are therefore meaningless.
"""

from __future__ import annotations

import importlib

import torch
from triton.backends.compiler import GPUTarget
from triton.runtime.driver import driver
from triton.runtime.jit import JITFunction

from lumigraph import kernels
from lumigraph.kernels import _row_optimizers
from lumigraph.kernels._operation import operations, tensors

TARGETS = [GPUTarget("cuda", 90, 32), GPUTarget("hip", "gfx942", 64)]


class Absent:
    """A driver of a GPU that is not here."""

    def __init__(self, target: GPUTarget):
        self.target = target

    def get_current_target(self) -> GPUTarget:
        return self.target

    def get_current_device(self) -> int:
        return TARGETS.index(self.target)

    def get_current_stream(self, device: int) -> int:
        return 0


launch = JITFunction.run


def compile_only(kernel, *args, warmup=False, **options):
    compiled = launch(kernel, *args, warmup=True, **options)
    target = driver.active.get_current_target()
    code = compiled.asm["cubin" if target.backend == "cuda" else "hsaco"]
    print(target.arch, kernel.module.split(".")[-2], kernel.__name__, len(code), "bytes")


JITFunction.run = compile_only
for target in TARGETS:
    driver.set_active(Absent(target))
    for name in operations():
        operation = importlib.import_module(f"lumigraph.kernels.{name}")
        inputs = list(operation.cases(torch.Generator().manual_seed(0)))[operation.FACTS.compiled]
        real = [inputs[i].requires_grad_() for i in operation.FACTS.differentiable]
        with kernels.using("gpu"):
            outputs = [x for x in tensors(getattr(operation, name)(*inputs)) if x.requires_grad]
        if outputs:
            torch.autograd.grad(sum(x.sum() for x in outputs), real)
    rows, numbers = [torch.ones(5, 3) for _ in range(4)], (0.1, 0.9, 0.99, 1e-15)
    for rates in (None, torch.ones(5)):
        _row_optimizers.lazy_adam(*rows, rates, *numbers, 1.0)
    _row_optimizers.cloud_adam(*rows, torch.zeros(5), torch.ones(3), 2.0, 0.1, (0.9, 0.99), 1e-15)
