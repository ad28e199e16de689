"""`lumigraph jump`: a ring of cameras as omnidirectional stereo panoramas."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..export.options import JumpOptions
from ..files.options import Overwrite, needed
from .common import show


@dataclass(frozen=True, kw_only=True)
class Jump(JumpOptions):
    """Stitch the photographs of a ring of cameras to an omnidirectional stereo pair, the left eye on top.

    The cameras look outward from one level circle, six or more, and their poses are known (transforms.json, or
    procedural:ring). The nearest distance that is reliable follows from the rig, and is printed.
    """

    scene: Annotated[Positional[str], needed("RIG")]
    """Folder of photographs with poses, or procedural:ring,views=12."""
    output: Annotated[Positional[Path], needed("FILE.jpg|.png")]
    """The pair, a square picture for headsets."""
    overwrite: Overwrite = False

    def run(self) -> int:
        import torch

        from ..export.jump import stereo_panorama
        from ..export.panorama import picture_format, save_sphere
        from ..files import claim
        from ..opening import open_scene

        picture_format(self.output)
        claim(self.output, "panorama", self.overwrite)
        scene = open_scene(self.scene, self.downscale, self.reader, whole=True)
        unit = scene.frame.to_export.scale
        found, _ = stereo_panorama(scene, self)
        save_sphere(self.output, torch.cat([found.left, found.right]), whole=False)
        reliable = f"{found.nearest * unit:.4g} on; what is nearer may tear"
        if math.isinf(found.nearest):
            reliable = "nowhere: the lenses are too narrow for so few cameras, so places at seams are seen by one only"
        show(
            {
                "stereo pair": f"{self.output}, the left eye on top",
                "rig": f"{len(found.rig.order)} cameras on a circle of radius {found.rig.radius * unit:.4g}",
                "eyes": f"{found.eyes * unit:.4g} apart",
                "reliable from": reliable,
                "trusted depth": f"{100 * found.trusted:.0f} % of matched pixels",
                "filled": f"{100 * (1 - float(found.seen.float().mean())):.0f} % that no camera saw, above and below",
            }
        )
        return 0
