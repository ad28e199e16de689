"""Without Triton, as on a plain CPU: everything works but kernels for GPUs, whose lack is a sentence."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

from budgets import budget

pytestmark = budget("kernels")

ROOT = Path(__file__).parent.parent
SCRIPT = """
import sys
sys.modules["triton"] = None  # what an import of it then raises is what it raises where it is missing
import torch
from lumigraph import kernels
from lumigraph.errors import LumigraphError
from lumigraph.kernels import using
x = torch.nn.functional.normalize(torch.randn(5, 3), dim=-1)
assert kernels.spherical_harmonics(x, 2).shape == (5, 4)
try:
    with using("gpu"):
        kernels.spherical_harmonics(x, 2)
except LumigraphError as fault:
    print(fault)
"""


def test_the_package_works_and_gpu_kernels_say_what_is_missing():
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (sentence,) = done.stdout.splitlines()
    assert sentence.startswith("The GPU kernel spherical_harmonics needs Triton, which is not installed")


def test_only_developers_install_triton():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert not any(word in line for line in project["dependencies"] for word in ("triton", "matplotlib"))
    assert any(line.startswith("triton") for line in project["optional-dependencies"]["dev"])
