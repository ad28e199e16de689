"""`lumigraph bench kernels`: time the kernels on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ...files import claim
from ..common import Overwrite, choose_device, option


@dataclass(frozen=True)
class BenchKernels:
    """Measure every kernel's throughput on every engine, and its ratio to the reference in the same run."""

    output: Annotated[Path | None, option("FILE.json", "print the table only")] = None
    """File for the figures, in addition to the table."""
    overwrite: Overwrite = False
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ...kernels.bench import bench_kernels

        if self.output is not None:
            claim(self.output, "benchmark", self.overwrite)
        bench_kernels(device=choose_device(self.device), output=self.output)
        return 0
