"""Modes: pictures of a rendering's colour, depth, opacity or normals, or of one of its extras, such as labels."""

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..color.blending import before, over
from ..datasets.scene import Vector
from ..errors import LumigraphError
from ..figures import EMPTY_COLOUR, colour_depth, depth_range, hex_colour, ramp
from ..geometry import normals_from_depth

MODES = ("colour", "depth", "opacity", "normals")  # of every method
EMPTY_DEPTH = 1e4  # scene units; where nothing is


def picture(
    rendering: Rendering, camera: Camera, mode: str, rendered: Vector, background: Vector
) -> Float[Tensor, "height width 3"]:
    """A picture of a rendering on the CPU; values may need clipping to [0, 1].

    mode:       one of MODES, or the name of an extra
    rendered:   the background colour of the rendering
    background: its replacement, in mode colour
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
    """Names of the extras that are modes of their own."""
    return [name for name in drawable(rendering) if name.lower() not in MODES]


def normals(rendering: Rendering, camera: Camera) -> Float[Tensor, "height width 3"]:
    """Unit normals of the surface, in the scene's frame, towards the camera: the method's, or else cross products of
    differences between neighbouring surface points."""
    if "normals" in rendering.extra:
        return rendering.extra["normals"]
    height, width = rendering.depth.shape
    depth = rendering.depth.nan_to_num(EMPTY_DEPTH, EMPTY_DEPTH).clamp_max(EMPTY_DEPTH)
    points = camera.rays(camera.pixels()).at(depth.reshape(-1)).view(height, width, 3)
    return -normals_from_depth(points, depth)


def along_axis(rendering: Rendering, camera: Camera) -> Float[Tensor, "height width"]:
    """Depth along the optical axis, as in a depth buffer, rather than along each ray."""
    return rendering.depth * camera.cosines()


# Twenty distinct colours; labels beyond begin again at the first.
PALETTE = (
    *("e6194b", "3cb44b", "ffe119", "4363d8", "f58231", "911eb4", "46f0f0", "f032e6", "bcf60c", "fabebe"),
    *("008080", "e6beff", "9a6324", "fffac8", "800000", "aaffc3", "808000", "ffd8b1", "000075", "a9a9a9"),
)
MAX_QUANTILE_VALUES = 1_000_000  # values that a range is found from; quantile() takes no more than 16 million


def drawable(rendering: Rendering) -> list[str]:
    """Names of the extras that can be drawn: one number or label per pixel, or three channels of numbers."""
    return [
        name
        for name, values in rendering.extra.items()
        if not values.is_complex() and (is_plane(values) or (values.is_floating_point() and values.shape[2:] == (3,)))
    ]


def is_plane(values: Shaped[Tensor, "height width *channel"]) -> bool:
    return values.shape[2:] in ((), (1,))


def draw_extra(
    values: Shaped[Tensor, "height width *channel"], opacity: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 3"]:
    """A picture of one drawable extra.

    Three channels are colours, clipped to [0, 1]. Numbers are bright where high and dark where low, labels have the
    palette's colours; both only where the scene is opaque, and labels where they are not negative.
    """
    if not is_plane(values):
        return values.float().nan_to_num(0.0).clamp(0, 1)
    plane = values.reshape(opacity.shape)
    if plane.is_floating_point():
        drawn = plane.isfinite() & (opacity > 0)
        colours = heat(plane.float(), drawn)
    else:
        drawn = (plane >= 0) & (opacity > 0)
        colours = label_colours(plane.long())
    return torch.where(drawn[..., None], colours, hex_colour(EMPTY_COLOUR))


def heat(values: Float[Tensor, "height width"], among: Bool[Tensor, "height width"]) -> Float[Tensor, "height width 3"]:
    """Colours of numbers along the ramp from their 2nd to their 98th percentile within a mask."""
    low, high = percentiles(values[among])
    return ramp(1 - ((values - low) / max(high - low, 1e-12)).nan_to_num(0.0))


def percentiles(values: Float[Tensor, " value"]) -> tuple[float, float]:
    """The 2nd and the 98th percentile; 0 and 1 for no values."""
    if not len(values):
        return 0.0, 1.0
    some = values[:: -(-len(values) // MAX_QUANTILE_VALUES)]
    low, high = torch.quantile(some, torch.tensor([0.02, 0.98])).tolist()
    return low, high


def label_colours(labels: Int[Tensor, "height width"]) -> Float[Tensor, "height width 3"]:
    """The palette's colour of each label."""
    palette = torch.stack([hex_colour(text) for text in PALETTE])
    return palette[labels % len(PALETTE)]
