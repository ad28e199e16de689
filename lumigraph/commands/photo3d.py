"""`lumigraph photo3d`: neighbouring photographs as one 3-D photograph, a page or a textured mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files.ranges import Downscale, between
from .capture import posed
from .common import show, typed
from .options import OriginOption, Overwrite, ReaderOption, needed, option, told_origin

Views = Annotated[int, between(2, 100)]


@dataclass(frozen=True)
class Photo3DCommand:
    """Make a 3-D photograph of a burst: a page that follows the mouse or a phone's tilt, or a textured mesh.

    Photographs without poses are captured first. Depth is that of a sensor, if the photographs have it, else multi-view
    stereo. Behind edges a second layer shows what other photographs saw there, or continues what is beside.
    """

    scene: Annotated[Positional[str], needed("PHOTOS")]
    """Folder of neighbouring photographs, with or without poses."""
    output: Annotated[Positional[Path], needed("FILE.html|.glb")]
    """The page, or the mesh."""
    size: Annotated[int, between(80, 1600), option("PIXELS")] = 320
    """Longer side of the depth maps, about; the texture has twice as many. Twice as large takes four times as long."""
    views: Annotated[Views, option("N")] = 8
    """Number of photographs at most, spread evenly."""
    title: Annotated[str | None, option("TEXT", "the folder's name")] = None
    """Title of the page."""
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce the photographs by this whole number before reading."""
    reader: ReaderOption = None
    origin: OriginOption = True
    overwrite: Overwrite = False

    def run(self) -> int:
        from ..export.mesh_file import write_mesh
        from ..export.photo3d import photo3d, write_page
        from ..files import claim
        from ..opening import open_scene

        page = self.output.suffix.lower() == ".html"
        if not page and self.output.suffix.lower() != ".glb":
            raise LumigraphError(f"{self.output} is neither a page nor a mesh; name a file that ends in .html or .glb")
        claim(self.output, "page" if page else "mesh", self.overwrite)
        source = posed(self.scene)
        scene = open_scene(source, self.downscale, self.reader, whole=True)
        found = photo3d(scene, self.size, self.views)
        origin, place = told_origin(scene.frame, self.origin and not page)
        if page:
            write_page(self.output, found, self.title or Path(self.scene).stem)
        else:
            up = scene.frame.to_source.rotation[:, 2].numpy()
            write_mesh(self.output, found.mesh.in_source(scene.frame), up, origin=origin)
        trusted = f"{100 * found.trusted:.0f} % of the photographs' pixels"
        if found.flat:
            trusted = "none: the photographs were taken from one place, without parallax; this is a panorama instead"
        show(
            {
                "trusted depth": trusted,
                "triangles": f"{len(found.mesh.faces):,}",
                "page" if page else "mesh": f"{self.output} ({self.output.stat().st_size / 1e6:.1f} MB)",
                **place,
                "next": typed("depth", source, "--output", "FOLDER"),
            }
        )
        return 0
