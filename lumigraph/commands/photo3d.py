"""`lumigraph photo3d`: neighbouring photographs as one 3-D photograph, a page or a textured mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..errors import LumigraphError
from ..export.options import Photo3DOptions
from .capture import posed
from .common import show, typed
from .export import place_row, size_text
from .options import Overwrite, needed


@dataclass(frozen=True)
class Photo3DFiles:
    """Source and output of a 3-D photograph."""

    scene: Annotated[Positional[str], needed("PHOTOS")]
    """Folder of neighbouring photographs, with or without poses."""
    output: Annotated[Positional[Path], needed("FILE.html|.glb")]
    """The page, or the mesh."""


@dataclass(frozen=True)
class Photo3DCommand(Photo3DOptions, Photo3DFiles):
    """Make a 3-D photograph of a burst: a page that follows the mouse or a phone's tilt, or a textured mesh.

    Photographs without poses are captured first. Depth is that of a sensor, if the photographs have it, else multi-view
    stereo. Behind edges a second layer shows what other photographs saw there, or continues what is beside.
    """

    overwrite: Overwrite = False

    def run(self) -> int:
        from ..export.photo3d import export_photo3d
        from ..files import claim
        from ..opening import open_scene

        kind = {".html": "page", ".glb": "mesh"}.get(self.output.suffix.lower())
        if kind is None:
            raise LumigraphError(f"{self.output} is neither a page nor a mesh; name a file that ends in .html or .glb")
        claim(self.output, kind, self.overwrite)
        source = posed(self.scene)
        scene = open_scene(source, self.downscale, self.reader, whole=True)
        found = export_photo3d(scene, self.output, Path(self.scene).stem, self)
        trusted = f"{100 * found.trusted:.0f} % of the photographs' pixels"
        if found.flat:
            trusted = "none: the photographs were taken from one place, without parallax; this is a panorama instead"
        rows = {"trusted depth": trusted, "triangles": f"{len(found.mesh.faces):,}"}
        rows |= {kind: f"{self.output} ({size_text(self.output)})"}
        rows |= place_row(scene.frame, self.origin and kind == "mesh")
        show(rows | {"next": typed("depth", source, "--output", "FOLDER")})
        return 0
