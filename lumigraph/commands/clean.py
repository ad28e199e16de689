"""`lumigraph clean`: remove floaters from a cloud of Gaussians, or crop it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..derive.options import CleanOptions
from ..files.options import Overwrite, needed, option
from .common import choose_device
from .results import Output, Reports, Result


@dataclass(frozen=True, kw_only=True)
class Clean(Reports, CleanOptions, Output):
    """Remove floaters from a trained cloud of Gaussians, or crop it to a box or a sphere.

    The result is a new run, which opens, renders and resumes, or a splat file, if --output ends like one. The source
    does not change. A picture beside the result shows the cloud with the removed Gaussians coloured, and afterwards.
    To crop without removing floaters, give --strength 0 with --box or --sphere.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file, or a composition."""
    output: Annotated[Path, needed("NEW")]
    """New folder for a run, or new file: .ply, .compressed.ply, .spz, .splat, .sog, .glb."""
    overwrite: Overwrite = False
    device: Annotated[str, option("NAME")] = "auto"
    """Device for the pictures: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def of(self, opened: Any) -> Result:
        from ..derive.parts import clean

        before, removed, picture = clean(opened, self.output, self, self.overwrite, choose_device(self.device))
        rows = {"Gaussians": f"{before - sum(removed.values()):,} of {before:,} stay"}
        rows |= {reason: f"{count:,} went" for reason, count in removed.items()}
        rows |= {"saved": str(self.output), "picture": str(picture), "next": f"lumigraph view {self.output}"}
        return Result(self.output, rows=rows)
