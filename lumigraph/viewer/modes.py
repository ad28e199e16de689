"""Modes: what of a rendering is shown: its colour, depth, opacity or normals, or one of its extras by name."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..color.blending import before, over
from ..datasets.scene import Vector
from ..errors import LumigraphError
from ..figures import EMPTY_COLOUR, colour_depth, depth_range, hex_colour
from ..geometry import normals_from_depth
from .extras import draw_extra, drawable

MODES = ("colour", "depth", "opacity", "normals")  # of every method
EMPTY_DEPTH = 1e4  # scene units; where nothing is


def picture(
    rendering: Rendering, camera: Camera, mode: str, rendered: Vector, background: Vector
) -> Float[Tensor, "height width 3"]:
    """A picture of a rendering on the CPU, with values in [0, 1] or to be clipped to it.

    mode:       one of MODES, or the name of an extra
    rendered:   the background colour it was rendered in front of
    background: the one it shall have instead, in mode colour
    """
    if mode == "colour":
        change = torch.tensor(background) - torch.tensor(rendered)
        return over(rendering.rgb, rendering.opacity, change) if change.any() else rendering.rgb
    if mode == "depth":
        within = depth_range(rendering.depth, rendering.opacity)
        return colour_depth(rendering.depth, rendering.opacity, within)
    if mode == "opacity":
        return rendering.opacity[..., None].expand(*rendering.opacity.shape, 3)
    if mode != "normals":
        if mode not in drawable(rendering):
            raise LumigraphError(f"The method gives no {mode} for this picture; choose something else under Show")
        return draw_extra(rendering.extra[mode], rendering.opacity)
    return before(0.5 + 0.5 * normals(rendering, camera), rendering.opacity.clamp(0, 1), hex_colour(EMPTY_COLOUR))


def extra_modes(rendering: Rendering) -> list[str]:
    """Names of the extras that are modes beside those of every method."""
    return [name for name in drawable(rendering) if name.lower() not in MODES]


def normals(rendering: Rendering, camera: Camera) -> Float[Tensor, "height width 3"]:
    """Unit normals of what is seen, in the scene's frame, towards the camera: those that the method gives, or else
    the cross product of how the seen point moves from pixel to pixel."""
    if "normals" in rendering.extra:
        return rendering.extra["normals"]
    height, width = rendering.depth.shape
    depth = rendering.depth.nan_to_num(EMPTY_DEPTH, EMPTY_DEPTH).clamp_max(EMPTY_DEPTH)
    points = camera.rays(camera.pixels()).at(depth.reshape(-1)).view(height, width, 3)
    return -normals_from_depth(points, depth)


def along_axis(rendering: Rendering, camera: Camera) -> Float[Tensor, "height width"]:
    """Depth along the optical axis, as graphics cards compare it, rather than along each ray."""
    directions = camera.rays(camera.pixels()).directions
    return rendering.depth * (directions @ camera.forward[0]).view(rendering.depth.shape)
