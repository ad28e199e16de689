"""A depth camera of structured light, like Microsoft's Kinect: noise, quantisation, shadows of its projector.

    Z' = f b q / round(f b q / Z(x + n, y + n) + m),    n ~ N(0, 1/2 pixel), m ~ N(0, 1/2 level)

Disparity is quantised to q = 8 levels a pixel, and noisy (Barron and Malik 2013, eq. 27; the noise of half a level is
Khoshelham and Elberink's 2012, sec. 3.2): the error of depth grows with its square, 1.4 mm at 1 m and 13 mm at 3 m.
Nothing is measured in the shadow of the projector, at grazing angles and outside the range.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt16

from ..camera import Camera
from ..camera.rays import Rays
from ..datasets.images import cosines
from .rendering import trace
from .world import World

LEVELS_AT_ONE_METRE = 351.3  # of disparity: focal length 585 pixels, baseline 7.5 cm, 8 levels a pixel
LEVEL_NOISE = 0.5  # levels of disparity, standard deviation
PIXEL_NOISE = 0.5  # pixels at 640 across, standard deviation
FULL_WIDTH = 640  # pixels of the sensor across
MILLIMETRES = 1000  # to a metre
SHADOW_TOLERANCE = 0.01  # metres before a point within which nothing casts a shadow on it
UNMEASURED = 0  # stored where nothing was measured


@dataclass(frozen=True)
class DepthCamera:
    """Parameters of a depth camera, and the length of the world's unit.

    unit:     metres to a unit of the world
    baseline: metres from the camera to the projector on its right
    range:    measured depths along the axis, metres
    grazing:  cosines between ray and normal: nothing is measured below the first, everything above the second
    seed:     of the noise, combined with the number of the picture
    """

    unit: float
    baseline: float = 0.075
    range: tuple[float, float] = (0.4, 5.0)
    grazing: tuple[float, float] = (0.06, 0.25)
    seed: int = 0

    def measure(self, world: World, camera: Camera) -> UInt16[np.ndarray, "height width"]:
        """Depth along the optical axis in millimetres, 0 for unmeasured, of a batch of one camera."""
        width, height = camera.size[0].tolist()
        random = np.random.default_rng([self.seed, 0 if camera.image_index is None else int(camera.image_index)])
        shift = PIXEL_NOISE * width / FULL_WIDTH * random.standard_normal((width * height, 2))
        rays = camera.rays(camera.pixels() + torch.from_numpy(shift).float())
        seen = trace(world, rays, shaded=False)
        cosine = cosines(rays.directions, camera.forward).numpy()
        depth = self.unit * seen.depth * cosine
        facing = np.abs((seen.normal * rays.directions.numpy()).sum(-1))
        none, all_of_them = self.grazing
        returned = random.uniform(none, all_of_them, facing.shape) < facing
        sure = np.isfinite(depth) & returned
        sure[sure] = ~self.shadowed(world, camera, rays[torch.from_numpy(sure)], seen.depth[sure])
        levels = np.rint(LEVELS_AT_ONE_METRE / depth[sure] + LEVEL_NOISE * random.standard_normal(int(sure.sum())))
        measured = LEVELS_AT_ONE_METRE / levels.clip(1)
        near, far = self.range
        found = np.full(depth.shape, UNMEASURED, np.uint16)
        found[sure] = np.where((near < measured) & (measured < far), np.rint(measured * MILLIMETRES), UNMEASURED)
        return found.reshape(height, width)

    def shadowed(self, world: World, camera: Camera, rays: Rays, depth: Float[np.ndarray, " ray"]) -> np.ndarray:
        """Mask of the points on rays that are occluded from the projector."""
        points = rays.at(torch.from_numpy(depth).float())
        projector = camera.position + camera.pose[0, :, 0] * self.baseline / self.unit
        beams = points - projector
        distance = beams.norm(dim=-1)
        found = trace(world, Rays(projector.expand_as(points), beams / distance[:, None], rays.radius), shaded=False)
        return found.depth < distance.numpy() - SHADOW_TOLERANCE / self.unit
