"""`lumigraph depth`: depth maps of photographs by multi-view stereo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..files.ranges import Downscale, between
from .common import lines, show, typed
from .options import ReaderOption, needed, option

Views = Annotated[int, between(2, 100_000)]


@dataclass(frozen=True)
class Depth:
    """Find the depth of every photograph by comparing it with its neighbours (multi-view stereo, PatchMatch).

    The result is a folder that opens as a scene: undistorted pictures, 16-bit depth of the pixels on which neighbours
    agree, transforms.json, and a contact sheet, depth.png.
    """

    scene: Annotated[Positional[str], needed("SCENE")]
    """Folder of photographs with poses, or procedural:NAME."""
    output: Annotated[Path, needed("FOLDER")]
    """Folder for the depth maps."""
    size: Annotated[int, between(50, 4000), option("PIXELS")] = 400
    """Longer side of the depth maps, about; twice as large takes four times as long."""
    views: Annotated[Views | None, option("N", "all")] = None
    """Number of photographs, spread evenly."""
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce the photographs by this whole number before reading."""
    reader: ReaderOption = None

    def run(self) -> int:
        from ..capture import open_scene
        from ..depth_maps.multi_view import multi_view_depth
        from ..export.depth import SHEET, write_depth
        from ..files import claim_folder

        claim_folder(self.output, "depth maps")
        scene = open_scene(self.scene, self.downscale, self.reader, whole=True)
        maps = multi_view_depth(scene, self.size, views=self.views or len(scene))
        write_depth(self.output, scene, maps)
        shares = [float(seen.solid.float().mean()) for seen in maps]
        by_photograph = [
            f"{scene.names[int(seen.camera.image_index)]}: {100 * share:.0f} %"  # type: ignore[arg-type]
            for seen, share in zip(maps, shares, strict=True)
        ]
        show(
            {
                "photographs": str(len(maps)),
                "sure pixels": f"{100 * sum(shares) / len(shares):.0f} %",
                "of each": lines(by_photograph, str(self.output / SHEET)),
                "depth": str(self.output / "depth"),
                "picture": str(self.output / SHEET),
                "next": typed("train", "gaussian-splatting", self.scene),
            }
        )
        return 0
