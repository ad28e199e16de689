"""`lumigraph bench`: the speed of kernels, the quality of methods, and PSNR against the number of photographs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from .benches.kernels import BenchKernels
from .benches.methods import BenchMethods
from .benches.views import BenchViews

# One line for each benchmark; the files are in benches/.
What = (
    Annotated[BenchKernels, subcommand("kernels")]
    | Annotated[BenchMethods, subcommand("methods")]
    | Annotated[BenchViews, subcommand("views")]
)


@dataclass(frozen=True)
class Bench:
    """Benchmark kernels on this machine, or methods on scenes."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
