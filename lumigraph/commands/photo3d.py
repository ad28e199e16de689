"""`lumigraph photo3d`: neighbouring photographs as one 3-D photograph, a page or a textured mesh."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..errors import LumigraphError
from ..export.options import Photo3DOptions
from ..files.options import Overwrite, needed
from .capture import posed
from .common import show, typed
from .export import place_row, size_text


@dataclass(frozen=True, kw_only=True)
class Photo3DCommand(Photo3DOptions):
    """Make a 3-D photograph of a burst: a page that follows the mouse or a phone's tilt, or a textured mesh.

    Photographs without poses are captured first. Depth is that of a sensor, if the photographs have it, else multi-view
    stereo. Behind edges a second layer shows what other photographs saw there, or continues what is beside.
    """

    scene: Annotated[Positional[str], needed("PHOTOS")]
    """Folder of neighbouring photographs, with or without poses."""
    output: Annotated[Positional[Path], needed("FILE.html|.glb")]
    """The page, or the mesh."""
    overwrite: Overwrite = False

    def run(self) -> int:
        from ..export.photo3d import export_photo3d
        from ..files import claim
        from ..opening import open_scene

        page = self.output.suffix.lower() == ".html"
        if not page and self.output.suffix.lower() != ".glb":
            raise LumigraphError(f"{self.output} is neither a page nor a mesh; name a file that ends in .html or .glb")
        claim(self.output, "page" if page else "mesh", self.overwrite)
        source = posed(self.scene)
        scene = open_scene(source, self.downscale, self.reader, whole=True)
        found = export_photo3d(scene, self.output, Path(self.scene).stem, self)
        trusted = f"{100 * found.trusted:.0f} % of the photographs' pixels"
        if found.flat:
            trusted = "none: the photographs were taken from one place, without parallax; this is a panorama instead"
        rows = {"trusted depth": trusted, "triangles": f"{len(found.mesh.faces):,}"}
        rows |= {"page" if page else "mesh": f"{self.output} ({size_text(self.output)})"}
        rows |= place_row(scene.frame, self.origin and not page)
        show(rows | {"next": typed("depth", source, "--output", "FOLDER")})
        return 0
