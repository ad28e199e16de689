"""Splatting: rendering a cloud of Gaussians for a camera (Kerbl 2023)."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from .. import kernels
from ..camera import Camera
from ..camera.lens import Mixed, OpenCV, Pinhole
from ..camera.rays import Rendering
from ..color.blending import over
from ..errors import LumigraphError
from ..kernels.tile import Tiles
from ..system.work import at_work
from .cloud import Gaussians

FOOTPRINT_BLUR = 0.3  # square pixels added to the covariance of every footprint (Kerbl 2023; the original release)
DEFAULT_NEAR = 0.01  # scene units in front of a camera; Gaussians before it are not rendered
IMAGE_MARGIN = 0.15  # of the picture's width and height beyond its edges, within which the lens is linearised
EDGE_SAMPLES = 9  # pixels along each edge that measure a lens's field of view


@dataclass(frozen=True)
class Splatted:
    """A picture of a cloud, and its footprints (see `kernels.project` and `kernels.rasterize`).

    rgb:     colours over black
    number:  opacity-weighted sum of one number of each Gaussian, by default its depth
    opacity: accumulated opacity
    centres, conics, opacities, depths: of each Gaussian's footprint, zero for invisible ones
    tiles:   footprints of each tile, in order
    stop:    early termination transmittance
    of_depth: whether `number` sums depths
    """

    rgb: Float[Tensor, "height width 3"]
    number: Float[Tensor, "height width"]
    opacity: Float[Tensor, "height width"]
    centres: Float[Tensor, "gaussian 2"]
    conics: Float[Tensor, "gaussian 3"]
    opacities: Float[Tensor, " gaussian"]
    depths: Float[Tensor, " gaussian"]
    tiles: Tiles
    stop: float
    of_depth: bool

    @cached_property
    def depth(self) -> Float[Tensor, "height width"]:
        """Opacity-weighted sum of depths along the optical axis; a second pass where `number` is of something else."""
        if self.of_depth:
            return self.number
        return self.composited(self.rgb.new_zeros(len(self.depths), 3), self.depths, self.stop)[1]

    def composited(
        self, vectors: Float[Tensor, "gaussian 3"], numbers: Float[Tensor, " gaussian"], stop: float
    ) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"], Float[Tensor, "height width"]]:
        """Further values of the Gaussians, composited as colours are: sums of w_i v_i, of w_i x_i and of w_i.

        stop: early termination transmittance; 1/2 excludes Gaussians behind the median depth
        """
        footprints = self.centres, self.conics, self.opacities
        return kernels.rasterize(*footprints, vectors, numbers, self.tiles, stop)

    def along_rays(self, camera: Camera) -> Float[Tensor, "height width"]:
        """Expected distance along each pixel's ray, over its opacity; infinity for empty pixels."""
        along = camera.cosines().clamp_min(1e-3).to(self.depth.device)
        return torch.where(self.opacity > 1e-3, self.depth / self.opacity.clamp_min(1e-3) / along, torch.inf)


def splat(
    cloud: Gaussians,
    view: kernels.View,
    bands: int = 4,
    stop: float = 1e-4,
    blur: float = FOOTPRINT_BLUR,
    numbers: Float[Tensor, " gaussian"] | None = None,
) -> Splatted:
    """Project, tile, rasterise; differentiable in the cloud and the numbers.

    bands:   of the harmonics in use, at most as many as there are
    stop:    early termination transmittance
    numbers: composited in place of depths
    """
    ellipsoids = cloud.means, cloud.quaternions, cloud.log_scales.exp(), cloud.opacities.sigmoid()
    centres, conics, depths, colours, opacities = kernels.project(
        *ellipsoids, cloud.harmonics, view, min(bands, cloud.degree + 1), blur, cloud.antialiased
    )
    tiles = kernels.tile(centres, conics, opacities, depths, view.size)
    own = depths if numbers is None else numbers
    rgb, number, opacity = kernels.rasterize(centres, conics, opacities, colours, own, tiles, stop)
    return Splatted(rgb, number, opacity, centres, conics, opacities, depths, tiles, stop, numbers is None)


@at_work()
@torch.no_grad()
def render(
    cloud: Gaussians,
    camera: Camera,
    background: tuple[float, float, float],
    near: float = DEFAULT_NEAR,
    bands: int = 4,
    blur: float = FOOTPRINT_BLUR,
) -> Rendering:
    """Render a cloud for one camera over a background colour."""
    seen = splat(cloud, view_of(camera, near).to(cloud.means.device), bands, blur=blur)
    rgb = seen.rgb
    if any(background):
        rgb = over(rgb, seen.opacity, torch.tensor(background, device=rgb.device))
    return Rendering(rgb, seen.along_rays(camera), seen.opacity)


def view_of(camera: Camera, near: float = DEFAULT_NEAR) -> kernels.View:
    """One camera as kernel input. Raises LumigraphError for lenses without a flat picture."""
    lens = camera.lens[0] if isinstance(camera.lens, Mixed) else camera.lens
    if not isinstance(lens, Pinhole | OpenCV):
        raise LumigraphError(
            f"Gaussians are seen through a flat picture, and the lens here is {type(lens).__name__}; "
            "undistort the photographs, or train instant-ngp, which follows any lens"
        )
    width, height = camera.size[0].tolist()
    distortion = lens.distortion[0] if isinstance(lens, OpenCV) else lens.focal.new_zeros(8)
    rotation = camera.pose[0, :, :3].T
    limits = _limits(lens, width, height)
    return kernels.View(
        rotation, camera.position[0], lens.focal[0], lens.centre[0], distortion, limits, (width, height), near
    )


def _limits(lens: Pinhole | OpenCV, width: int, height: int) -> Float[Tensor, " 4"]:
    """Bounds of the picture on the plane z = 1, with a margin. On the CPU: a GPU would need hundreds of launches."""
    x, y = (torch.linspace(0, n, EDGE_SAMPLES) for n in (width, height))
    left, top = torch.zeros_like(y), torch.zeros_like(x)
    edges = [torch.stack(pair, -1) for pair in ((left, y), (left + width, y), (x, top), (x, top + height))]
    directions = lens.to("cpu").unproject(torch.cat(edges))
    plane = directions[:, :2] / directions[:, 2:]
    low, high = plane.amin(0), plane.amax(0)
    margin = IMAGE_MARGIN * (high - low)
    return torch.stack([low - margin, high + margin], -1).flatten().to(lens.device)
