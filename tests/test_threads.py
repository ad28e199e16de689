"""How threads wait: what Lumigraph settles before PyTorch and Numba are loaded, and what it leaves to the user."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lumigraph import threads

LOOP = """
import lumigraph, torch, numpy
from lumigraph.loops import unbend
none = numpy.zeros((0, 2), numpy.float32)
unbend(none, numpy.zeros(0, int), none, none, none, none, 1, 0.1, numpy.zeros((0, 3), numpy.float32))
print(torch.ones(1 << 18).exp().sum())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="GNU's OpenMP")
def test_torch_and_numba_share_one_set_of_threads_which_wait_for_a_bounded_time():
    environment = {name: value for name, value in os.environ.items() if name not in threads.OWN}
    environment |= {"PYTHONPATH": str(Path(__file__).parent.parent), "OMP_DISPLAY_ENV": "VERBOSE"}
    told = subprocess.run([sys.executable, "-c", LOOP], env=environment, capture_output=True, text=True, check=True)
    copies = told.stderr.split("OPENMP DISPLAY ENVIRONMENT BEGIN")[1:]  # each copy of the library says so when loaded
    assert len(copies) == 1
    assert f"GOMP_SPINCOUNT = '{threads.LOOKS}'" in copies[0]


@pytest.mark.parametrize("own", threads.OWN)
def test_a_users_own_way_of_waiting_stays(own):
    environment = {own: "1"}
    threads.settle(environment)
    assert environment == {own: "1"}


def test_a_busy_machine_is_told(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(threads, "processors", lambda: 2)
    monkeypatch.setattr(os, "getloadavg", lambda: (1.5, 0.0, 0.0))
    assert threads.told() == "2 threads"
    monkeypatch.setattr(os, "getloadavg", lambda: (3.25, 0.0, 0.0))
    assert threads.told() == "2 threads, on a machine that is busy (load 3.2)"
