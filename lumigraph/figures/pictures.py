"""Pictures for people: PNG files, depth and error in colour."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from ..color.blending import before
from ..files import Kind, replacing

# Bright and warm to dark and cool, evenly falling in lightness.
RAMP = ("fff6dc", "fbcf7f", "f39a5b", "db5f60", "a93b77", "6c2e80", "352a6e", "131a3e")
EMPTY_COLOUR = "0a0c12"  # where a ray meets nothing
ERROR_GAIN = 5

Range = tuple[float, float]


def to_bytes(rgb: Float[Tensor, "height width 3"]) -> UInt8[Tensor, "height width 3"]:
    """Colours in [0, 1] as bytes; others are clipped."""
    return (rgb.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8)


def to_image(rgb: Float[Tensor, "height width 3"]) -> Image.Image:
    return Image.fromarray(to_bytes(rgb).numpy())


def save_picture(
    path: Path, rgb: Float[Tensor, "height width 3"] | Image.Image, kind: Kind = "file", ours: bool = False
) -> None:
    """Write a PNG, whole or not at all. kind, ours: as for `files.replacing`."""
    image = rgb if isinstance(rgb, Image.Image) else to_image(rgb)
    with replacing(path, kind, ours) as partial:
        image.save(partial, "PNG")


def depth_range(depth: Float[Tensor, "*pixels"], opacity: Float[Tensor, "*pixels"]) -> Range:
    """Near and far for colouring: what all but the outermost two hundredths of solid pixels lie between."""
    solid = depth[(opacity > 0.5) & depth.isfinite() & (depth > 0)].flatten()
    if not len(solid):
        return 1.0, 2.0
    solid = solid[:: max(1, len(solid) // 100_000)]  # quantile() takes no more than 16 million
    near, far = torch.quantile(solid, torch.tensor([0.02, 0.98], device=solid.device)).tolist()
    return near, max(far, near * 1.05)


def colour_depth(
    depth: Float[Tensor, "height width"], opacity: Float[Tensor, "height width"], within: Range
) -> Float[Tensor, "height width 3"]:
    """Near is bright and warm, far dark and cool, on a logarithmic scale; faint where the scene is see-through."""
    near, far = (torch.tensor(x).log() for x in within)
    share = (depth.clamp_min(1e-9).log() - near) / (far - near)
    colours = ramp(torch.where(share.isfinite(), share, 1.0))
    return before(colours, opacity.clamp(0, 1), hex_colour(EMPTY_COLOUR).to(colours))


def colour_error(
    a: Float[Tensor, "height width 3"], b: Float[Tensor, "height width 3"], gain: float = ERROR_GAIN
) -> Float[Tensor, "height width 3"]:
    """Mean absolute difference times a gain: dark is none, bright is 1 / gain and more."""
    return ramp(1 - gain * (a - b).abs().mean(-1))


def ramp(share: Float[Tensor, "*pixels"]) -> Float[Tensor, "*pixels 3"]:
    """The colour ramp at a share of its length in [0, 1]."""
    colours = torch.stack([hex_colour(c) for c in RAMP]).to(share)
    position = share.clamp(0, 1) * (len(RAMP) - 1)
    below = position.long().clamp(max=len(RAMP) - 2)
    return torch.lerp(colours[below], colours[below + 1], (position - below)[..., None])


def hex_colour(text: str) -> Float[Tensor, " 3"]:
    return torch.tensor(list(bytes.fromhex(text))) / 255


def fit_into(image: Image.Image, width: int, height: int) -> Image.Image:
    """Shrunk to fit, never enlarged."""
    size = fitted(*image.size, width, height)
    return image if size == image.size else image.resize(size, Image.Resampling.LANCZOS)


def fitted(width: int, height: int, most_width: int, most_height: int) -> tuple[int, int]:
    """The size of what is shrunk to fit, never enlarged."""
    scale = min(most_width / width, most_height / height, 1.0)
    return max(1, round(width * scale)), max(1, round(height * scale))
