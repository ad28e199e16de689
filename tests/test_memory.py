"""What a process is told to have needed."""

from __future__ import annotations

import subprocess
import sys

import tiny
import torch

from lumigraph.memory import peak_memory
from lumigraph.train import fit

TAKE = """
import torch
from lumigraph.memory import peak_memory
before = peak_memory(torch.device("cpu"))
taken = torch.ones({size}, dtype=torch.uint8)
del taken
print(peak_memory(torch.device("cpu")) - before)
"""


def test_the_peak_grows_by_what_was_taken_and_stays():
    size = 300_000_000
    ran = subprocess.run([sys.executable, "-c", TAKE.format(size=size)], capture_output=True, text=True, check=True)
    assert abs(int(ran.stdout) - size) < 20_000_000


def test_a_run_remembers_its_peak(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    fit(tiny.method(run.frame), tiny.scene(), run, steps=2, show=False)
    assert 0 < run.state.peak_memory <= peak_memory(torch.device("cpu"))
