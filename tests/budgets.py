"""What the tests may cost: a budget for each group of files, a table at the end, and a failure beyond it.

What counts is the lesser of a test's seconds and its processors' seconds, without what Numba compiled for the first
time: so neither a busy machine nor a fresh clone makes a file costly. It is divided by how slow the machine proves to
be. `pytest_terminal_summary` prints the table and the files beyond their shares. A file beyond four times its share
ends the session with code 1: less than that is within what one machine differs from another.
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np
from numba.core import event

# Seconds on two cores like those of a plain cloud machine, by group; the shares of files that take more than EACH.
BUDGETS: dict[str, float] = {
    "kernels": 150,
    "nouns, capture": 75,
    "exports, viewer, web": 95,
    "runs, commands, benchmark": 140,
    "methods": 120,
    "house": 10,
}
EACH = 5.0
SHARES: dict[str, tuple[str, float]] = {
    "test_display": ("runs, commands, benchmark", 8),
    "test_fewer_views": ("runs, commands, benchmark", 8),
    "test_scores": ("runs, commands, benchmark", 10),
    "test_budget": ("runs, commands, benchmark", 8),
    "test_dense_start": ("methods", 8),
    "test_schedule": ("methods", 25),
    "test_kernels": ("kernels", 80),
    "test_bounds": ("kernels", 60),
    "test_seeded_faults": ("kernels", 40),
    "test_gpu_compiles": ("kernels", 10),
    "test_capture_motion": ("nouns, capture", 20),
    "test_capture": ("nouns, capture", 10),
    "test_fuzz": ("nouns, capture", 10),
    "test_mesh": ("exports, viewer, web", 25),
    "test_web": ("exports, viewer, web", 15),
    "test_volumes": ("exports, viewer, web", 30),
    "test_viewer_page": ("exports, viewer, web", 20),
    "test_viewer": ("exports, viewer, web", 10),
    "test_viewer_guard": ("exports, viewer, web", 5),
    "test_foreign_files": ("runs, commands, benchmark", 15),
    "test_streamed_sog": ("exports, viewer, web", 8),
    "test_panorama": ("exports, viewer, web", 8),
    "test_benchmark": ("runs, commands, benchmark", 20),
    "test_cli": ("runs, commands, benchmark", 18),
    "test_run": ("runs, commands, benchmark", 8),
    "test_train": ("runs, commands, benchmark", 16),
    "test_signals": ("runs, commands, benchmark", 15),
    "test_ranges": ("methods", 20),
    "test_compress": ("runs, commands, benchmark", 15),
    "test_canonical": ("runs, commands, benchmark", 15),
    "test_convert": ("runs, commands, benchmark", 15),
    "test_priors": ("nouns, capture", 20),
    "test_shared_points": ("methods", 8),
    "test_blocks": ("runs, commands, benchmark", 15),
    "test_memory": ("runs, commands, benchmark", 12),
    "test_nerf": ("methods", 16),
    "test_tensorf": ("methods", 5),
    "test_pixelnerf": ("methods", 10),
    "test_hyp_nerf": ("methods", 10),
    "test_instant_ngp": ("methods", 10),
    "test_gaussian_splatting": ("methods", 10),
    "test_wild_splats": ("methods", 10),
    "test_dvgo": ("methods", 8),
    "test_snerg": ("methods", 12),
    "test_fourier_features": ("methods", 12),
    "test_block_nerf": ("methods", 15),
}
A_METHOD = 6.0  # by contract, of each method, beside what its own file takes
GROUPS: dict[str, str] = {
    **dict.fromkeys("test_bench_kernels test_lanes test_doors".split(), "kernels"),
    **dict.fromkeys(
        "test_export test_viewer_controls test_viewer_crop test_exchange test_explain_ray test_keyframes".split(),
        "exports, viewer, web",
    ),
    "test_browser": "exports, viewer, web",
    **dict.fromkeys("test_locks test_opened test_composed".split(), "runs, commands, benchmark"),
    **dict.fromkeys(
        "test_progress test_charts test_multiscale test_verdict test_bench_views".split(), "runs, commands, benchmark"
    ),
    **dict.fromkeys(
        "test_coordinate_network test_density_control test_gaussians test_encodings test_nerf_w".split(), "methods"
    ),
    "test_plenoctrees": "methods",
    **dict.fromkeys("test_regnerf test_few_photographs".split(), "methods"),
    **dict.fromkeys("test_house test_budgets".split(), "house"),
}  # the others are of nouns and capture
MUCH, TOO_MUCH = 1.5, 4.0  # times its share: what is told, and what fails
CALIBRATION = 0.021  # processor seconds that `probe` takes on the machine that the budgets were set on


def share_of(file: str, methods: int) -> tuple[str, float]:
    """The group of a test file, and the seconds that it may take."""
    if file == "test_contract":
        return "methods", A_METHOD * methods
    return SHARES.get(file, (GROUPS.get(file, "nouns, capture"), EACH))


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
    """The costs of a session by file, and how slow the machine was found to be, now and then."""

    methods: int = 0
    probes: list[float] = field(default_factory=list)
    files: dict[str, Cost] = field(default_factory=lambda: defaultdict(Cost))
    compiling: Compiling = field(default_factory=Compiling)

    @property
    def slowness(self) -> float:
        """Times as slow as the machine that the budgets were set on; never below 1."""
        return max(1.0, sum(self.probes) / len(self.probes)) if self.probes else 1.0

    def readings(self) -> tuple[float, float, float]:
        return time.perf_counter(), processor_seconds(), self.compiling.seconds

    def note(self, file: str, before: tuple[float, float, float]) -> None:
        """One more test of a file has run since the readings."""
        cost = Cost(1, *(now - then for now, then in zip(self.readings(), before, strict=True)))
        if file not in self.files:
            self.probes.append(probe() / CALIBRATION)
        self.files[file] += cost

    def to_plain(self) -> dict[str, Any]:
        """What another process can read; `add` takes it."""
        files = {file: list(astuple(cost)) for file, cost in self.files.items()}
        return {"methods": self.methods, "probes": self.probes, "files": files}

    def add(self, other: dict[str, Any] | None) -> None:
        """The costs of one more process; nothing of one that fell."""
        if other:
            self.methods = other["methods"]
            self.probes += other["probes"]
            for file, cost in other["files"].items():
                self.files[file] += Cost(*cost)

    def excessive(self, times: float = TOO_MUCH) -> list[str]:
        """A sentence for each file that took more than so many times its share."""
        found = []
        for file, cost in sorted(self.files.items()):
            taken, (_, share) = cost.counted / self.slowness, share_of(file, self.methods)
            if taken > times * share:
                found.append(f"{file}.py took {taken:.0f} s of its {share:.0f} s; see tests/budgets.py")
        return found

    def table(self) -> list[str]:
        """A line for each group."""
        groups: dict[str, Cost] = {name: Cost() for name in BUDGETS}
        counted = dict.fromkeys(BUDGETS, 0.0)
        for file, cost in self.files.items():
            group = share_of(file, self.methods)[0]
            groups[group] += cost
            counted[group] += cost.counted / self.slowness
        budgets = BUDGETS | {"methods": BUDGETS["methods"] + A_METHOD * self.methods}
        rows = [f"{'group':26} {'tests':>6} {'counted':>8} {'budget':>7} {'seconds':>8} {'compiling':>10}"]
        for name, cost in groups.items():
            told = f"{counted[name]:8.1f} {budgets[name]:7.0f} {cost.wall:8.1f} {cost.compiling:10.1f}"
            rows.append(f"{name:26} {cost.tests:6} {told}")
        total = sum(groups.values(), Cost())
        told = f"{sum(counted.values()):8.1f} {sum(budgets.values()):7.0f} {total.wall:8.1f} {total.compiling:10.1f}"
        rows.append(f"{'all':26} {total.tests:6} {told}   this machine is {self.slowness:.2f} times as slow")
        return rows
