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

TARGETS = [GPUTarget("cuda", 90, 32), GPUTarget("hip", "gfx942", 64)]
# For each operation, the case whose options reach most of the code.
CASES = {
    "spherical_harmonics": 0,
    "composite": 15,
    "hash_encode": 3,
    "march": 7,
    "project": 5,
    "tile": 6,
    "rasterize": 3,
    "ssim": 4,
}


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
    for name, case in CASES.items():
        operation = importlib.import_module(f"lumigraph.kernels.{name}")
        inputs = list(operation.cases(torch.Generator().manual_seed(0)))[case]
        real = [x.requires_grad_() for x in inputs if torch.is_tensor(x) and x.is_floating_point()]
        with kernels.using("gpu"):
            found = getattr(operation, name)(*inputs)
        outputs = [x for x in (found if isinstance(found, tuple) else [found]) if getattr(x, "requires_grad", False)]
        if outputs:
            torch.autograd.grad(sum(x.sum() for x in outputs), real)
