"""`lumigraph export splats`: a trained cloud in the formats of splat viewers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..common import needed, show


@dataclass(frozen=True)
class Splats:
    """A trained cloud of Gaussians for splat viewers, or one splat format turned into another.

    The ending says which format: .ply (all there is), .compressed.ply, .spz, .splat (no view-dependent colour). What a
    run exports lies in the frame of the photographs it was trained on.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, or a splat file."""
    output: Annotated[Positional[Path], needed("FILE")]
    """The new file."""

    def run(self) -> int:
        from ...exchange import is_splat_file, read_gaussians, write_gaussians
        from ...export.splats import export_splats
        from ...run import Run

        if is_splat_file(self.source):
            written = read_gaussians(self.source)
            write_gaussians(self.output, written)
        else:
            method = Run(self.source).method()
            written = export_splats(method.gaussians(), method.frame, self.output)
        size = self.output.stat().st_size
        show(
            {
                "file": str(self.output),
                "Gaussians": f"{len(written):,}",
                "size": f"{size / 1e6:.1f} MB, {size / max(len(written), 1):.1f} bytes each",
            }
        )
        return 0
