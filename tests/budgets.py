"""Budgets of the tests: one for each group of files, shares by a mark in each file, a table, a failure beyond a share.

What counts is the lesser of a test's seconds and its processors' seconds, without what Numba compiled for the first
time: so neither a busy machine nor a fresh clone makes a file costly. It is divided by how slow the machine proves to
be. `pytest_terminal_summary` prints the table and the files beyond their shares. A file beyond TOO_MUCH times its share
ends the session with code 1. In two runs of all 4700 tests no file took more than 1.5 times its share of then,
and the costliest took 0.9 to 1.4 times as much in one run as in the other: 1.5 * 1.4 is 2.1, and TOO_MUCH is a fifth
above that. With 32 operations test_kernels, test_seeded_faults and test_gpu_compiles take 59, 23 and 62 s.
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np
import pytest
from numba.core import event

# Seconds on two cores like those of a plain cloud machine, by group.
BUDGETS: dict[str, float] = {
    "kernels": 180,
    "capture": 150,
    "exports": 95,
    "runs": 180,
    "methods": 120,
    "house": 27,
}
GROUP, EACH = "capture", 5.0  # of a file without a mark
PER_METHOD = 4.0  # seconds of the contract for each method, beside the method's own file
MUCH, TOO_MUCH = 1.5, 2.5  # times its share: what is told, and what fails
CALIBRATION = 0.021  # processor seconds that `probe` takes on the machine that the budgets were set on


def budget(group: str, seconds: float = EACH) -> pytest.MarkDecorator:
    """Mark a test file: `pytestmark = budget("methods", 10)` gives it ten seconds of a group of BUDGETS."""
    if group not in BUDGETS:
        raise pytest.UsageError(f"budget({group!r}) names no group of tests/budgets.py: {', '.join(BUDGETS)}")
    return pytest.mark.budget(group, seconds)


def share_of(mark: pytest.Mark | None) -> tuple[str, float]:
    """Group and seconds of a test file by its mark. Raises pytest.UsageError for an unknown group."""
    return budget(*mark.args, **mark.kwargs).args if mark else (GROUP, EACH)


@dataclass
class Cost:
    """What tests took: their number, seconds, seconds of processors, and seconds of compiling within them."""

    tests: int = 0
    wall: float = 0.0
    cpu: float = 0.0
    compiling: float = 0.0

    @property
    def counted(self) -> float:
        return max(0.0, min(self.wall, self.cpu) - self.compiling)

    def __add__(self, other: Cost) -> Cost:
        return Cost(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


def processor_seconds() -> float:
    """Of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def probe() -> float:
    """Processor seconds of a fixed piece of work, some of it Python's and some NumPy's."""
    values, begin = np.arange(1 << 16, dtype=np.float64), time.process_time()
    total = sum(i * i % 7 for i in range(300_000))
    for _ in range(40):
        values = np.sqrt(values * values + total % 3)
    return time.process_time() - begin


def busy() -> bool:
    """Whether others use the machine too: more wait for processors than there are, and two for the tests."""
    return os.getloadavg()[0] > (os.cpu_count() or 1) + 2


class Compiling(event.Listener):
    """Seconds in which Numba compiled; what it finds in its cache does not count."""

    def __init__(self) -> None:
        self.seconds, self._depth, self._begin = 0.0, 0, 0.0

    def on_start(self, event: Any) -> None:
        self._begin = self._begin if self._depth else time.perf_counter()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        self.seconds += 0.0 if self._depth else time.perf_counter() - self._begin


@dataclass
class Ledger:
    """Costs and shares of a session's files, and measurements of how slow the machine is."""

    methods: int = 0
    probes: list[float] = field(default_factory=list)
    files: dict[str, Cost] = field(default_factory=lambda: defaultdict(Cost))
    shares: dict[str, tuple[str, float]] = field(default_factory=dict)
    compiling: Compiling = field(default_factory=Compiling)

    @property
    def slowness(self) -> float:
        """Times as slow as the machine that the budgets were set on; never below 1."""
        return max(1.0, sum(self.probes) / len(self.probes)) if self.probes else 1.0

    def readings(self) -> tuple[float, float, float]:
        return time.perf_counter(), processor_seconds(), self.compiling.seconds

    def note(self, file: str, share: tuple[str, float], before: tuple[float, float, float]) -> None:
        """Add one more test of a file, which has run since the readings."""
        cost = Cost(1, *(now - then for now, then in zip(self.readings(), before, strict=True)))
        if file not in self.files:
            self.probes.append(probe() / CALIBRATION)
        self.files[file] += cost
        self.shares[file] = share

    def to_plain(self) -> dict[str, Any]:
        """What another process can read; `add` takes it."""
        files = {file: list(astuple(cost)) for file, cost in self.files.items()}
        return {"methods": self.methods, "probes": self.probes, "files": files, "shares": self.shares}

    def add(self, other: dict[str, Any] | None) -> None:
        """The costs of one more process; nothing of one that fell."""
        if other:
            self.methods = other["methods"]
            self.probes += other["probes"]
            for file, cost in other["files"].items():
                self.files[file] += Cost(*cost)
                self.shares[file] = tuple(other["shares"][file])

    def excessive(self, times: float = TOO_MUCH) -> list[str]:
        """A sentence for each file that took more than so many times its share."""
        found = []
        for file, cost in sorted(self.files.items()):
            taken, (_, share) = cost.counted / self.slowness, self.shares[file]
            if taken > times * share:
                found.append(f"{file}.py took {taken:.0f} s of its {share:.0f} s; see tests/budgets.py")
        return found

    def table(self) -> list[str]:
        """A line for each group."""
        groups: dict[str, Cost] = {name: Cost() for name in BUDGETS}
        counted = dict.fromkeys(BUDGETS, 0.0)
        for file, cost in self.files.items():
            group = self.shares[file][0]
            groups[group] += cost
            counted[group] += cost.counted / self.slowness
        budgets = BUDGETS | {"methods": BUDGETS["methods"] + PER_METHOD * self.methods}
        rows = [f"{'group':8} {'tests':>6} {'counted':>8} {'budget':>7} {'seconds':>8} {'compiling':>10}"]
        for name, cost in groups.items():
            told = f"{counted[name]:8.1f} {budgets[name]:7.0f} {cost.wall:8.1f} {cost.compiling:10.1f}"
            rows.append(f"{name:8} {cost.tests:6} {told}")
        total = sum(groups.values(), Cost())
        told = f"{sum(counted.values()):8.1f} {sum(budgets.values()):7.0f} {total.wall:8.1f} {total.compiling:10.1f}"
        rows.append(f"{'all':8} {total.tests:6} {told}   this machine is {self.slowness:.2f} times as slow")
        return rows
