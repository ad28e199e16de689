"""Planes of flat Gaussians, and the depth, normals and distances of the planes that a camera sees (Chen 2024)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from ...camera import Camera
from ...depth_maps.depth_map import SURFACE_OPACITY
from ...gaussians import Gaussians
from ...gaussians.splatting import Splatted
from ...geometry import to_matrix, to_quaternion, unit

MIN_FACING = 0.02  # cosine between a plane's normal and a ray; below it they have no crossing that counts
DISC_NEIGHBOURS = 10  # nearest points that determine the normal of a disc
DISC_THICKNESS = 0.2  # of its width, at first
DISC_OPACITY = 0.7  # at first: points that plane sweeps find lie on surfaces


@dataclass(frozen=True)
class PlaneMaps:
    """Planes visible in one camera; sums are over a pixel's Gaussians with the weights w_i = a_i T_i of its colour, up
    to termination, or to the median Gaussian.

    rays:     unit directions of the pixels, in the scene's frame
    normals:  N = sum_i w_i n_i, towards the camera, in the scene's frame
    distance: D = sum_i w_i n_i . (mu_i - eye), of the planes from the camera, negative
    mean:     sum_i w_i t_i / sum_i w_i of the centres' distances t_i along the ray
    opacity:  sum_i w_i
    """

    rays: Float[Tensor, "height width 3"]
    normals: Float[Tensor, "height width 3"]
    distance: Float[Tensor, "height width"]
    mean: Float[Tensor, "height width"]
    opacity: Float[Tensor, "height width"]

    @property
    def slope(self) -> Float[Tensor, "height width"]:
        """N . d over the opacity, with the ray's direction d; negative, -1 where the plane faces the camera."""
        return (self.normals * self.rays).sum(-1) / self.opacity.clamp_min(1e-6)

    @property
    def crossed(self) -> Bool[Tensor, "height width"]:
        """Pixels that show a surface, whose ray crosses its plane."""
        return (self.opacity > SURFACE_OPACITY) & (self.slope < -MIN_FACING)

    @property
    def depth(self) -> Float[Tensor, "height width"]:
        """Unbiased depth t = D / (N . d) along the ray to the plane; where none is crossed, `mean`."""
        crossing = self.distance / self.opacity.clamp_min(1e-6) / self.slope.clamp(max=-MIN_FACING)
        return torch.where(self.crossed, crossing, self.mean)


def plane_maps(cloud: Gaussians, picture: Splatted, camera: Camera, stop: float) -> PlaneMaps:
    """Plane maps of a cloud from a camera's rendering.

    stop: transmittance at which a pixel terminates; 1/2 for the Gaussians up to the median one
    """
    rays = camera.rays(camera.pixels()).directions.view(*picture.opacity.shape, 3)
    normals, distance, opacity = picture.composited(*planes(cloud, camera.position[0]), stop)
    along = (rays @ camera.forward[0]).clamp_min(1e-3)
    mean = picture.depth / picture.opacity.clamp_min(1e-3) / along
    return PlaneMaps(rays, normals, distance, mean, opacity)


def planes(
    cloud: Gaussians, eye: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "gaussian 3"], Float[Tensor, " gaussian"]]:
    """Normals of Gaussians, unit vectors towards the eye along the shortest axes, and n . (mu - eye), at most zero."""
    shortest = cloud.log_scales.argmin(-1)[:, None, None].expand(-1, 3, 1)
    normals = to_matrix(cloud.quaternions).gather(2, shortest)[:, :, 0]
    distance = (normals * (cloud.means - eye)).sum(-1)
    side = torch.where(distance > 0, -1.0, 1.0)
    return side[:, None] * normals, side * distance


@torch.no_grad()
def discs(cloud: Gaussians) -> Gaussians:
    """The cloud with each Gaussian nearly opaque and flat, across the direction in which the nearest centres vary
    least."""
    if len(cloud) <= DISC_NEIGHBOURS:
        return cloud
    means = cloud.means.cpu()
    nearest = torch.from_numpy(KDTree(means.numpy()).query(means.numpy(), DISC_NEIGHBOURS)[1])
    around = means[nearest] - means[nearest].mean(1, keepdim=True)
    axes = torch.linalg.eigh(around.mT @ around).eigenvectors.flip(-1)  # the least last
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    thin = cloud.log_scales + cloud.log_scales.new_tensor([1.0, 1.0, DISC_THICKNESS]).log()
    solid = torch.full_like(cloud.opacities, DISC_OPACITY).logit()
    return replace(cloud, quaternions=to_quaternion(axes).to(cloud.quaternions), log_scales=thin, opacities=solid)


def normals_of(depth: Float[Tensor, "height width"], maps: PlaneMaps) -> Float[Tensor, "inner_height inner_width 3"]:
    """Unit normals of a depth map at the pixels inside its border, towards the camera, by differences between the
    neighbours on both sides; differentiable."""
    points = depth[..., None] * maps.rays
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    return unit(torch.linalg.cross(down, across))
