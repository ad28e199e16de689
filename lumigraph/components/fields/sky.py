"""A sky behind a scene without bounds, by direction and the code of a photograph."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...camera.rays import Rays
from ...datasets.scene import Frame
from ...method import Part
from .hash_field import side_by_side
from .layers import MLP


class SkyField(Part):
    """Colours behind everything (as in Rematas 2022, beside the code).

    Photographs do not agree on the weather. Without a sky, a transient head would explain all of it, and nothing would
    be left for the scene.
    """

    def __init__(self, bands: int, code: int, hidden_width: int):
        super().__init__()
        self.bands, self.network = bands, MLP(bands**2 + code, hidden_width, 3)

    def behind(
        self, rays: Rays, code: Float[Tensor, "#ray code"] | None, background: Float[Tensor, "#ray 3"]
    ) -> Float[Tensor, "ray 3"]:
        codes = [] if code is None else [code.expand(len(rays), -1)]
        harmonics = kernels.spherical_harmonics(rays.directions, self.bands)
        return self.network(side_by_side(harmonics, *codes)).sigmoid()


def sky_for(frame: Frame, wanted: bool, bands: int, code: int, hidden_width: int) -> SkyField | None:
    """A sky where a scene without bounds shows one, and it is wanted."""
    return SkyField(bands, code, hidden_width) if wanted and frame.is_open and not frame.has_alpha else None
