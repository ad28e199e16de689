"""Without any GPU: every Triton kernel compiles to machine code for NVIDIA's and AMD's."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from agreement import OPERATIONS, depends, folder
from budgets import budget
from proofs import kept
from shape_checks import PACKAGE

pytestmark = budget("kernels", 65)

pytest.importorskip("triton")
SCRIPT = Path(__file__).with_name("compile_for_gpus.py")
ROW_OPTIMIZERS = PACKAGE / "kernels" / "_row_optimizers.py"


def kernels_that_are_launched() -> set[tuple[str, str]]:
    """Every function that some engine or optimizer launches on a grid, as (folder, function)."""
    sources = {name: (folder(name) / "gpu.py").read_text(encoding="utf-8") for name in OPERATIONS}
    sources["kernels"] = ROW_OPTIMIZERS.read_text(encoding="utf-8")
    return {(name, kernel) for name, text in sources.items() for kernel in re.findall(r"launch\(\s*(\w+)", text)}


@kept(lambda: {SCRIPT, ROW_OPTIMIZERS}.union(*map(depends, OPERATIONS)))
def test_every_kernel_compiles():
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run([sys.executable, SCRIPT], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    compiled = [tuple(line.split()[:3]) for line in done.stdout.splitlines()]
    for architecture in ("90", "gfx942"):
        assert {
            (name, kernel) for arch, name, kernel in compiled if arch == architecture
        } == kernels_that_are_launched()
