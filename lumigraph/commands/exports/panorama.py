"""`lumigraph export panorama`: a panorama of the whole sphere around a point."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from ...files import claim
from ...files.ranges import Coordinate, SphereSize
from ..common import Overwrite, needed, option, show
from ..controls import Set, open_method
from ..keeping import Keeping

Place = Annotated[
    tuple[Coordinate, Coordinate, Coordinate] | None,
    arg(
        name="from",
        metavar="X Y Z",
        help_behavior_hint="(default: the position of the middle camera)",
    ),
]


@dataclass(frozen=True)
class SphereExport:
    """Base of exports of the whole sphere around a place."""

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file (.ply, .spz ...), or a composition (.json)."""
    output: Annotated[Positional[Path], needed("FILE")]
    """The new picture."""
    place: Place = None
    """Position of the camera, or of the middle between two eyes, in the frame of the photographs."""
    size: Annotated[SphereSize, option("PIXELS")] = 2048
    """Width in pixels; the height of each sphere is half of it."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def stand(self) -> tuple[Any, Any, Any, Any, str]:
        """Open the source and find the standpoint: the source, its method, place and heading in the scene's frame, and
        the place in words."""
        from ...export.panorama import picture_format, sphere_size, standpoint

        picture_format(self.output)
        sphere_size(self.size)
        claim(self.output, "panorama", self.overwrite, [self.source])
        opened, method, cameras = open_method(self.source, self.device, self.settings)
        return opened, self.part.of_method(method), *standpoint(cameras["train"], opened.frame, self.place)


@dataclass(frozen=True)
class ExportPanorama(SphereExport):
    """All that is seen from one place, as an equirectangular picture that viewers and headsets show as a sphere.

    The horizon is level, the photographs' main direction in the middle. The ending says which format: .png or .jpg.
    """

    def run(self) -> int:
        from ...export.panorama import panorama, save_sphere

        _, method, place, heading, where = self.stand()
        save_sphere(self.output, panorama(method, place, heading, self.size).rgb, whole=True)
        show({"panorama": str(self.output), "size": f"{self.size}x{self.size // 2}", "from": where})
        return 0
