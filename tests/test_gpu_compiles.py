"""Without any GPU: every Triton kernel compiles to machine code for NVIDIA's and AMD's."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from agreement import OPERATIONS, module
from conftest import PACKAGE

pytest.importorskip("triton")


def kernels_that_are_launched() -> set[tuple[str, str]]:
    """Every function that some engine launches on a grid, as (operation, function)."""
    sources = {name: Path(module(name).__file__).with_name("gpu.py").read_text() for name in OPERATIONS}
    return {(name, kernel) for name, text in sources.items() for kernel in re.findall(r"(\w+)\[.*\]\(", text)}


def test_every_kernel_compiles():
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"PYTHONPATH": str(PACKAGE.parent)}
    script = Path(__file__).with_name("compile_for_gpus.py")
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    compiled = [tuple(line.split()[:3]) for line in done.stdout.splitlines()]
    for architecture in ("90", "gfx942"):
        assert {
            (name, kernel) for arch, name, kernel in compiled if arch == architecture
        } == kernels_that_are_launched()
