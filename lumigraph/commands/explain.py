"""`lumigraph explain`: pictures of a paper's equations on your own data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from .explains.activation import ExplainActivation
from .explains.encodings import ExplainEncodings
from .explains.ray import ExplainRay

# One line for each explanation; the files are in explains/.
What = (
    Annotated[ExplainActivation, subcommand("activation")]
    | Annotated[ExplainEncodings, subcommand("encodings")]
    | Annotated[ExplainRay, subcommand("ray")]
)


@dataclass(frozen=True)
class Explain:
    """Draw the equations of a paper on your own data: a page, its pictures, and the figures behind them."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
