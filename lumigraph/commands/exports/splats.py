"""`lumigraph export splats`: a trained cloud in the formats of splat viewers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional

from ...errors import LumigraphError
from ..common import Overwrite, needed, show
from ..controls import Set, tell
from ..keeping import Keeping


@dataclass(frozen=True)
class ExportSplats:
    """A trained cloud of Gaussians for splat viewers, or one splat format turned into another.

    The ending says which format: .ply (all there is), .glb (glTF), .sog, .spz, .compressed.ply, .splat (no
    view-dependent colour); NEW/meta.json is a folder of SOG. What a run exports lies in the frame of the photographs it
    was trained on.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file, or a composition."""
    output: Annotated[Positional[Path], needed("FILE")]
    """The new file."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    told: Set = ()

    def run(self) -> int:
        from ...capabilities import HasGaussians, needs
        from ...exchange import check_ending, claim_splats, is_splat_file, read_gaussians, size_of, write_gaussians
        from ...export.splats import export_splats
        from ...run import open_any
        from ...run.splat_file import frame_of

        check_ending(self.output)
        claim_splats(self.output, self.overwrite, [self.source])
        if is_splat_file(self.source):
            if self.told:
                raise LumigraphError(f"{self.source} is a file of Gaussians, which has no controls; leave out --set")
            written = read_gaussians(self.source)
            if self.part.crops or self.part.floaters:
                frame = frame_of(written)
                crop = self.part.crop(frame)
                written = self.part.of_gaussians(written, crop and crop.moved(frame.to_source))
            write_gaussians(self.output, written)
        else:
            opened = open_any(self.source)
            method = tell(opened, opened.method(), self.told)
            gaussians = needs(method, HasGaussians).gaussians()
            gaussians = self.part.of_gaussians(gaussians, self.part.crop(method.frame))
            written = export_splats(gaussians, method.frame, self.output)
        size = size_of(self.output)
        show(
            {
                "file": str(self.output),
                "Gaussians": f"{len(written):,}",
                "size": f"{size / 1e6:.1f} MB, {size / max(len(written), 1):.1f} bytes each",
            }
        )
        return 0
