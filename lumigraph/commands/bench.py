"""`lumigraph bench`: how fast kernels are, how good methods are, how many photographs they need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from .benches.kernels import Kernels
from .benches.methods import Methods
from .benches.views import Views

# One line for each thing that can be measured; the files are in benches/.
What = (
    Annotated[Kernels, subcommand("kernels")]
    | Annotated[Methods, subcommand("methods")]
    | Annotated[Views, subcommand("views")]
)


@dataclass(frozen=True)
class Bench:
    """Measure kernels on this machine, or methods on scenes."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
