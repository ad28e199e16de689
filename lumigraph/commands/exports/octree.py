"""`lumigraph export octree`: a baked run in the format of the PlenOctrees viewers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ...errors import LumigraphError
from ...files import claim
from ...files.ranges import between
from ..common import Overwrite, needed, option, show
from ..controls import Set, tell


@dataclass(frozen=True)
class ExportOctree:
    """Export the octree of a plenoctrees run as one .npz, for volrend and svox.

    It is in the frame of the photographs. If that is rotated against the scene's, it is in the scene's frame, because
    the format has no rotation.
    """

    source: Annotated[Positional[Path], needed("RUN")]
    """Folder of a run."""
    output: Annotated[Positional[Path], needed("FILE.npz")]
    """The new file."""
    depth: Annotated[Annotated[int, between(1, 10)] | None, option("N", "all there are")] = None
    """Largest depth of the octree; deeper levels are averaged, for a smaller file."""
    overwrite: Overwrite = False
    settings: Set = ()

    def run(self) -> int:
        if self.output.suffix.lower() != ".npz":
            raise LumigraphError(f"{self.output} should end in .npz, as viewers of octrees expect; rename it")
        claim(self.output, "octree", self.overwrite, [self.source])
        from ...export.octree import write_octree
        from ...method.capabilities import HasOctree, needs
        from ...run import open_any

        opened = open_any(self.source)
        octree = needs(tell(opened, opened.method(), self.settings), HasOctree).octree(self.depth)
        in_source = write_octree(self.output, octree, opened.frame)
        show(
            {
                "file": str(self.output),
                "nodes": f"{len(octree.child):,}",
                "frame": "of the photographs" if in_source else "of the scene, for the format knows no rotation",
                "size": f"{self.output.stat().st_size / 1e6:.1f} MB",
            }
        )
        return 0
