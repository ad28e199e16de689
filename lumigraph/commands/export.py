"""`lumigraph export`: what was trained, in the formats of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from .exports.mesh import Mesh
from .exports.panorama import Panorama
from .exports.points import Points
from .exports.splats import Splats
from .exports.stereo import Stereo
from .exports.web import Web

# One line for each thing that can be written; the files are in exports/.
What = (
    Annotated[Mesh, subcommand("mesh")]
    | Annotated[Panorama, subcommand("panorama")]
    | Annotated[Points, subcommand("points")]
    | Annotated[Splats, subcommand("splats")]
    | Annotated[Stereo, subcommand("stereo")]
    | Annotated[Web, subcommand("web")]
)


@dataclass(frozen=True)
class Export:
    """Write a trained scene for other programs."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
