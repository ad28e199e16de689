"""`lumigraph depth`: depth maps of photographs by multi-view stereo, or of a pair by stereo."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..export.options import DepthOptions
from ..files.options import needed
from .common import lines, show, typed
from .results import Output

LOW_SURE_SHARE = 0.3
LOW_SHARE = " (little: walls without texture, or too little in common; trust only the sure pixels)"


@dataclass(frozen=True, kw_only=True)
class Depth(DepthOptions, Output):
    """Find the depth of every photograph by comparing it with its neighbours (multi-view stereo, PatchMatch).

    The result is a folder that opens as a scene: undistorted pictures, 16-bit depth of the pixels on which neighbours
    agree, transforms.json, and a contact sheet, depth.png.
    """

    scene: Annotated[Positional[str], needed("SCENE")]
    """Folder of photographs with poses, or procedural:NAME."""
    output: Annotated[Path, needed("FOLDER")]
    """Folder for the depth maps."""

    def run(self) -> int:
        from ..export.depth import SHEET, export_depth, export_pair
        from ..files import claim_folder
        from ..opening import open_scene

        claim_folder(self.output, "depth maps")
        scene = open_scene(self.scene, self.downscale, self.reader, whole=True)
        if self.pair:
            left, baseline, (low, high), sure = export_pair(scene, self.output, self.pair, self)
            rows = {"left": left, "baseline": f"{baseline:.4g} units of the capture"}
            rows |= {"disparities": f"{low} to {high} pixels"}
            rows |= {"sure pixels": f"{100 * sure:.0f} %" + LOW_SHARE * (sure < LOW_SURE_SHARE)}
        else:
            maps = export_depth(scene, self.output, self)
            names = [scene.names[int(seen.camera.image_index)] for seen in maps]  # type: ignore[arg-type]
            shares = {name: float(seen.solid.float().mean()) for name, seen in zip(names, maps, strict=True)}
            rows = {
                "photographs": str(len(shares)),
                "sure pixels": f"{100 * sum(shares.values()) / len(shares):.0f} %",
                "of each": lines([f"{x}: {100 * y:.0f} %" for x, y in shares.items()], str(self.output / SHEET)),
            }
        rows |= {"depth": str(self.output / "depth"), "picture": str(self.output / SHEET)}
        show(rows | ({} if self.pair else {"next": typed("train", "gaussian-splatting", self.scene)}))
        return 0
