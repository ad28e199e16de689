"""`lumigraph bench`: how fast the kernels are on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional

from .common import needed


@dataclass(frozen=True)
class Bench:
    """Measure every kernel's throughput on every engine, and its ratio to the reference in the same run."""

    what: Annotated[Positional[Literal["kernels"]], needed("kernels")] = "kernels"
    """What to measure."""

    def run(self) -> int:
        from ..kernels.bench import bench_kernels

        bench_kernels()
        return 0
