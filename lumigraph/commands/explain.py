"""`lumigraph explain`: the mathematics of a paper as pictures of what it does to one's own data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from .explains.activation import ExplainActivation
from .explains.encodings import ExplainEncodings
from .explains.ray import ExplainRay

# One line for each thing that can be explained; the files are in explains/.
What = (
    Annotated[ExplainActivation, subcommand("activation")]
    | Annotated[ExplainEncodings, subcommand("encodings")]
    | Annotated[ExplainRay, subcommand("ray")]
)


@dataclass(frozen=True)
class Explain:
    """Draw what happens inside: a page, its pictures, and the figures behind them."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
