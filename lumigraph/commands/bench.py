"""`lumigraph bench`: how fast kernels are, how good methods are, how many photographs they need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from .benches.kernels import BenchKernels
from .benches.methods import BenchMethods
from .benches.views import BenchViews

# One line for each thing that can be measured; the files are in benches/.
What = (
    Annotated[BenchKernels, subcommand("kernels")]
    | Annotated[BenchMethods, subcommand("methods")]
    | Annotated[BenchViews, subcommand("views")]
)


@dataclass(frozen=True)
class Bench:
    """Measure kernels on this machine, or methods on scenes."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
