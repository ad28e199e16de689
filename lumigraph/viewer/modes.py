"""Modes: what of a rendering is shown - its colour, depth, opacity or normals."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..figures import NOTHING, colour_depth, depth_range, hex_colour
from ..paths import unit
from ..rays import Rendering
from ..scene import Vector

Mode = Literal["colour", "depth", "opacity", "normals"]
MODES: tuple[Mode, ...] = get_args(Mode)
FAR = 1e4  # scene units; where nothing is


def picture(
    rendering: Rendering, camera: Camera, mode: Mode, rendered: Vector, background: Vector
) -> Float[Tensor, "height width 3"]:
    """A rendering as a person looks at it, on the CPU.

    rendered:   the background colour it was rendered in front of
    background: the one it shall have instead, in mode colour
    """
    if mode == "colour":
        change = torch.tensor(background) - torch.tensor(rendered)
        return rendering.rgb + (1 - rendering.opacity)[..., None] * change if change.any() else rendering.rgb
    if mode == "depth":
        within = depth_range(rendering.depth, rendering.opacity)
        return colour_depth(rendering.depth, rendering.opacity, within)
    if mode == "opacity":
        return rendering.opacity[..., None].expand(*rendering.opacity.shape, 3)
    opacity = rendering.opacity.clamp(0, 1)[..., None]
    return opacity * (0.5 + 0.5 * normals(rendering, camera)) + (1 - opacity) * hex_colour(NOTHING)


def normals(rendering: Rendering, camera: Camera) -> Float[Tensor, "height width 3"]:
    """Unit normals of what is seen, in the scene's frame, towards the camera: those that the method gives, or else
    the cross product of how the seen point moves from pixel to pixel."""
    if "normals" in rendering.extra:
        return rendering.extra["normals"]
    height, width = rendering.depth.shape
    depth = rendering.depth.nan_to_num(FAR, FAR).clamp_max(FAR).reshape(-1)
    points = camera.rays(camera.pixels()).at(depth).view(height, width, 3)
    return unit(torch.linalg.cross(slope(points, 0), slope(points, 1)))


def slope(points: Float[Tensor, "height width 3"], dim: int) -> Float[Tensor, "height width 3"]:
    """From each pixel to a neighbour along an axis: the nearer of the two, which is not across an edge."""
    if points.shape[dim] < 2:
        return torch.zeros_like(points)
    step = points.diff(dim=dim)
    before = torch.cat([step.narrow(dim, 0, 1), step], dim)
    after = torch.cat([step, step.narrow(dim, step.shape[dim] - 1, 1)], dim)
    return torch.where(before.norm(dim=-1, keepdim=True) < after.norm(dim=-1, keepdim=True), before, after)


def along_axis(rendering: Rendering, camera: Camera) -> Float[Tensor, "height width"]:
    """Depth along the optical axis, as graphics cards compare it."""
    directions = camera.rays(camera.pixels()).directions
    return rendering.depth * (directions @ camera.forward[0]).view(rendering.depth.shape)
