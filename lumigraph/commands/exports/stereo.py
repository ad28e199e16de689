"""`lumigraph export stereo`: a panorama for each eye, for headsets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ...errors import LumigraphError
from ...files.ranges import Positive
from ..common import option, show
from .panorama import SphereExport


@dataclass(frozen=True)
class ExportStereo(SphereExport):
    """An omnidirectional stereo pair on one square picture, the left eye on top.

    The horizon is level, the photographs' main direction in the middle. The ending chooses the format: .png or .jpg.
    Photographs seldom determine the scale of a scene. If yours is in metres (GPS, a measured model), real sizes need
    the option --interpupillary 0.064.
    """

    interpupillary: Annotated[Positive | None, option("LENGTH", "1/50 of the median distance to what is around")] = None
    """Distance between the eyes, in units of the photographs' frame; larger makes the scene look smaller and deeper."""

    def run(self) -> int:
        from ...export.panorama import save_sphere
        from ...export.stereo import EYE_DISTANCE_SHARE, stereo_pair, surrounding_distances, top_bottom

        opened, method, place, heading, where = self.stand()
        unit = opened.frame.to_source.scale
        near, middle = surrounding_distances(method, place, heading)
        apart = EYE_DISTANCE_SHARE * middle if self.interpupillary is None else self.interpupillary / unit
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
