"""`lumigraph export snerg`: a baked run as the folder that SNeRG's own viewer opens."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ...errors import LumigraphWarning
from ..common import needed, show

CONTRACTED = (
    "This open capture was baked whole, in contracted coordinates, which Lumigraph opens again and SNeRG's viewer "
    "shows out of shape; for that viewer train with --no-whole, which bakes the box of interest alone"
)


@dataclass(frozen=True)
class ExportSnerg:
    """Export a baked run as the folder of SNeRG's own viewer: scene_params.json and slices of its atlas as PNG.

    It is in the scene's frame with +y up. Such a folder also opens like a run. A folder of an open capture is
    contracted (docs/methods/snerg.md), which other viewers do not undo, unless trained with --no-whole.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FOLDER")]
    """Folder of a baked run, or one that SNeRG's viewer opens."""
    output: Annotated[Positional[Path], needed("FOLDER")]
    """The new folder."""

    def run(self) -> int:
        from ...exchange import size_of, snerg
        from ...files import claim_folder
        from ...method.capabilities import HasAtlas, needs
        from ...run import open_any

        claim_folder(self.output, "atlas")
        atlas = needs(open_any(self.source).method(), HasAtlas).atlas()
        snerg.write(self.output, atlas)
        if atlas.contracted:
            warnings.warn(CONTRACTED, LumigraphWarning, stacklevel=2)
        x, y, z = (n * atlas.block for n in atlas.index.shape)
        show(
            {
                "folder": str(self.output),
                "voxels": f"{x} x {y} x {z}, in {len(atlas.values):,} of {atlas.index.numel():,} blocks",
                "size": f"{size_of(self.output) / 1e6:.1f} MB",
            }
        )
        return 0
