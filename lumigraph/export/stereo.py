"""Omnidirectional stereo: a panorama for each eye, the pair that headsets show as a sphere in depth.

All around, the two eyes' rays leave a level circle along its tangents (`lens.OmnidirectionalStereo`; Peleg 2001), so
whichever way one turns, the eyes are beside each other. Looking at the poles there is no such thing, and depth fades.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera.lens import Equirectangular, OmnidirectionalStereo
from ..camera.rays import Rendering
from ..errors import LumigraphError
from ..method import Method
from .panorama import level_camera, sphere, sphere_size

EYE_DISTANCE_SHARE = 1 / 50  # of the distance to what is around: 64 mm in a room of some three metres
PROBE_SIZE = 256  # pixels of the small panorama that tells distances
MAX_SHIFT_PIXELS = 0.1  # pixels by which a flat picture may be off at its edge, at what is near
MAX_COLUMNS = 32
MIN_OPACITY = 0.5  # opacity from which on something is there


def stereo_pair(
    method: Method,
    place: Float[Tensor, " 3"],
    heading: Float[Tensor, " 3"],
    width: int,
    interpupillary: float,
    nearest: float,
) -> tuple[Rendering, Rendering]:
    """Panoramas of the left and the right eye, (width / 2, width) pixels each; up is +z.

    place:          the middle between the eyes, in the scene's frame
    interpupillary: the distance between them, scene units
    nearest:        distance to near surfaces, scene units; smaller needs more flat pictures
    """
    columns = columns_at_once(interpupillary / 2, nearest)
    eyes = []
    for name, side in (("Left eye", -0.5), ("Right eye", 0.5)):
        offset = torch.tensor([[side * interpupillary]])
        camera = level_camera(place, heading, OmnidirectionalStereo(sphere_size(width), offset=offset))
        eyes.append(sphere(method, camera, name, columns))
    return eyes[0], eyes[1]


def top_bottom(left: Rendering, right: Rendering) -> Float[Tensor, "height width 3"]:
    """The pair as one square picture, the left eye on top."""
    return torch.cat([left.rgb, right.rgb])


def surrounding_distances(
    method: Method, place: Float[Tensor, " 3"], heading: Float[Tensor, " 3"]
) -> tuple[float, float]:
    """Near (2nd percentile) and median distance of surfaces around a point, scene units.

    Directions are weighted by solid angle. Raises LumigraphError if no surface is around.
    """
    seen = sphere(method, level_camera(place, heading, Equirectangular(sphere_size(PROBE_SIZE))), "Looking around")
    rows = torch.arange(PROBE_SIZE // 2) + 0.5
    weight = torch.sin(torch.pi * rows / len(rows))[:, None].expand_as(seen.depth)
    solid = (seen.opacity > MIN_OPACITY) & seen.depth.isfinite()
    if not solid.any():
        raise LumigraphError("Nothing is around that place; give --from another one, or --interpupillary")
    depth, order = seen.depth[solid].sort()
    share = weight[solid][order].cumsum(0)
    near, middle = (depth[int(torch.searchsorted(share, q * share[-1]))].item() for q in (0.02, 0.5))
    return near, middle


def columns_at_once(radius: float, nearest: float) -> int:
    """Largest number of columns that one flat picture may have.

    Its camera is at the origin of the middle column's rays. Rays of a column k / 2 away begin k / 2 pixels' angle
    further along the circle, which is ahead or behind by r k / 2 pixels' angle: points at a distance d and high up are
    off by up to r k / (2 d) pixels.
    """
    return max(1, min(MAX_COLUMNS, int(2 * MAX_SHIFT_PIXELS * nearest / max(radius, 1e-9))))
