"""`lumigraph export stereo`: a panorama for each eye, for headsets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional

from ...errors import LumigraphError
from ...files import claim
from ...ranges import Positive, SphereSize
from ..common import Overwrite, needed, option, show
from ..controls import Set, open_method
from ..keeping import Keeping
from .panorama import Place


@dataclass(frozen=True)
class ExportStereo:
    """Export an omnidirectional stereo pair as one square picture, the left eye on top.

    The horizon is level, the photographs' main direction in the middle. The ending chooses the format: .png or .jpg.
    Photographs seldom determine the scale of a scene. If yours is in metres (GPS, a measured model), real sizes need
    the option --interpupillary 0.064.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file (.ply, .spz ...), or a composition (.json)."""
    output: Annotated[Positional[Path], needed("FILE")]
    """The new picture."""
    place: Place = None
    """Position of the middle between the eyes, in the frame of the photographs."""
    interpupillary: Annotated[Positive | None, option("LENGTH", "1/50 of the median depth around")] = None
    """Distance between the eyes, in units of the photographs' frame; larger makes the scene look smaller and deeper."""
    size: Annotated[SphereSize, option("PIXELS")] = 2048
    """Width in pixels, and height of both halves together."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    told: Set = ()
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ...export.panorama import picture_format, save_sphere, sphere_size, standpoint
        from ...export.stereo import SHARE, stereo_pair, surrounding_distances, top_bottom

        picture_format(self.output)
        sphere_size(self.size)
        claim(self.output, "panorama", self.overwrite, [self.source])
        opened, method, cameras = open_method(self.source, self.device, self.told)
        method = self.part.of_method(method)
        place, heading, where = standpoint(cameras["train"], opened.frame, self.place)
        unit = opened.frame.to_source.scale
        near, middle = surrounding_distances(method, place, heading)
        apart = SHARE * middle if self.interpupillary is None else self.interpupillary / unit
        if apart > near:
            raise LumigraphError(
                f"Eyes {apart * unit:.4g} apart do not fit where things are {near * unit:.4g} away; "
                "give a smaller --interpupillary or another --from"
            )
        pair = stereo_pair(method, place, heading, self.size, apart, near)
        save_sphere(self.output, top_bottom(*pair), whole=False)
        show(
            {
                "stereo pair": f"{self.output}, the left eye on top",
                "size": f"{self.size}x{self.size}",
                "from": where,
                "eyes": f"{apart * unit:.4g} apart; half of all is nearer than {middle * unit:.4g}",
            }
        )
        return 0
