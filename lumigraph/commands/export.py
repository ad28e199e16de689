"""`lumigraph export`: a trained scene in the formats of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from .exports.mesh import ExportMesh
from .exports.octree import ExportOctree
from .exports.panorama import ExportPanorama
from .exports.points import ExportPoints
from .exports.snerg import ExportSnerg
from .exports.splats import ExportSplats
from .exports.stereo import ExportStereo
from .exports.web import ExportWeb

# One line for each export; the files are in exports/.
What = (
    Annotated[ExportMesh, subcommand("mesh")]
    | Annotated[ExportOctree, subcommand("octree")]
    | Annotated[ExportPanorama, subcommand("panorama")]
    | Annotated[ExportPoints, subcommand("points")]
    | Annotated[ExportSnerg, subcommand("snerg")]
    | Annotated[ExportSplats, subcommand("splats")]
    | Annotated[ExportStereo, subcommand("stereo")]
    | Annotated[ExportWeb, subcommand("web")]
)


@dataclass(frozen=True)
class Export:
    """Export a trained scene in the formats of other programs."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
