"""`lumigraph export centres`: centres of Gaussians as a table."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from lumigraph import files
from lumigraph.commands.results import Exported, Reports
from lumigraph.files.options import Overwrite, SourceOption, needed


@dataclass(frozen=True)
class ExportCentres(Reports):
    """Export the centres of Gaussians as a table, in the frame of the photographs."""

    source: SourceOption
    output: Annotated[Positional[Path], needed("FILE.csv")]
    """The new file."""
    overwrite: Overwrite = False

    def of(self, opened):
        files.claim(self.output, "points", self.overwrite, [self.source])
        means = opened.source_gaussians().means.tolist()
        files.write_bytes(self.output, "".join(f"{x},{y},{z}\n" for x, y, z in means).encode(), ours=True)
        return Exported(
            self.output, {"points": len(means)}, rows={"file": str(self.output), "points": f"{len(means):,}"}
        )
