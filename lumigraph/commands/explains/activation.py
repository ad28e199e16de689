"""`lumigraph explain activation`: why voxel grids interpolate first and activate afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ...files.ranges import Steps, between
from ..common import Overwrite, option, show


@dataclass(frozen=True)
class ExplainActivation:
    """Fit a sharp edge with a coarse grid in three orders: activation before, within and after interpolation.

    One picture shows the result of each, with its PSNR.
    """

    output: Annotated[Path, option("FILE.png")] = Path("explained/activation.png")
    """File of the picture."""
    overwrite: Overwrite = False
    cells: Annotated[int, between(2, 128), option("N")] = 10
    """Cells of the grid along each axis; more reduce the differences."""
    steps: Annotated[Steps, option("N")] = 1500
    """Training steps for each order."""

    def run(self) -> int:
        from ...explain.activation import draw, fits
        from ...files import claim
        from ...system.progress import counting

        claim(self.output, "figure", self.overwrite)
        with counting("Learning an edge in three orders"):
            found = fits(self.cells, self.steps)
        draw(self.output, found, self.cells)
        show({fit.name: f"{fit.psnr:.2f} dB" for fit in found} | {"picture": str(self.output)})
        return 0
