"""One thread for everything, where it is imported ahead of PyTorch and Numba: for processes whose copies are made by
fork, which no other thread survives."""

from __future__ import annotations

import os

os.environ |= {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
os.environ["NUMBA_THREADING_LAYER"] = "workqueue"  # GNU's OpenMP ends a program that uses it after a fork
