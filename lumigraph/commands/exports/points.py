"""`lumigraph export points`: where a trained scene is solid, as coloured points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional

from ...errors import LumigraphError
from ...files import claim
from ..common import Overwrite, needed, option, show
from ..controls import Set, open_method
from ..keeping import Keeping


@dataclass(frozen=True)
class ExportPoints:
    """A cloud of coloured points with normals, spread evenly over the surfaces that the photographs show.

    They lie in the frame of the photographs. Floaters are left out: several cameras must see each point.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file, or a composition."""
    output: Annotated[Positional[Path], needed("FILE.ply")]
    """The new file."""
    count: Annotated[int, option("N")] = 200_000
    """Points at most."""
    size: Annotated[int, option("PIXELS")] = 400
    """Longer side of the pictures that the points come from; at most that of the photographs."""
    views: Annotated[int, option("N")] = 64
    """Number of these pictures at most."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    told: Set = ()
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        if self.output.suffix.lower() != ".ply":
            raise LumigraphError(f"{self.output} should end in .ply, the one kind of point cloud there is; rename it")
        if self.count < 1:
            raise LumigraphError(f"A cloud cannot have {self.count} points; give --count a number above 0")
        check_pictures(self.size, self.views)
        self.part.check()
        claim(self.output, "points", self.overwrite, [self.source])
        from ...export.points import extract_points, write_points

        opened, method, cameras = open_method(self.source, self.device, self.told)
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


def check_pictures(size: int, views: int) -> None:
    """Refuse pictures that cannot be, before anything is opened."""
    if not 16 <= size <= 8192:
        raise LumigraphError(f"Pictures cannot be {size} pixels large; give --size a number from 16 to 8192")
    if views < 1:
        raise LumigraphError(f"{views} views show nothing; give --views a number above 0")
