"""`lumigraph export points`: coloured points on the surfaces of a trained scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional

from ...errors import LumigraphError
from ...files import claim
from ...files.ranges import CloudSize, Count, Pixels
from ..common import Overwrite, needed, option, show
from ..controls import Set, open_method
from ..keeping import Keeping


@dataclass(frozen=True)
class ExportPoints:
    """Export coloured points with normals, spread evenly over the surfaces that the photographs show.

    They are in the frame of the photographs. Floaters are left out: several cameras must see each point.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file (.ply, .spz ...), or a composition (.json)."""
    output: Annotated[Positional[Path], needed("FILE.ply")]
    """The new file."""
    count: Annotated[CloudSize, option("N")] = 200_000
    """Largest number of points."""
    size: Annotated[Pixels, option("PIXELS")] = 400
    """Longer side of the pictures that points are taken from, at most that of the photographs."""
    views: Annotated[Count, option("N")] = 64
    """Largest number of these pictures."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        if self.output.suffix.lower() != ".ply":
            raise LumigraphError(f"{self.output} should end in .ply, the one kind of point cloud there is; rename it")
        claim(self.output, "points", self.overwrite, [self.source])
        from ...export.points import extract_points, write_points

        opened, method, cameras = open_method(self.source, self.device, self.settings)
        seers = opened.survey(cameras["train"])
        method, crop = self.part.without_floaters(method), self.part.crop(opened.frame)
        points = extract_points(method, seers, self.count, self.size, self.views, crop).in_source(opened.frame)
        write_points(self.output, points)
        show(
            {
                "file": str(self.output),
                "points": f"{len(points.positions):,}",
                "size": f"{self.output.stat().st_size / 1e6:.1f} MB",
            }
        )
        return 0
