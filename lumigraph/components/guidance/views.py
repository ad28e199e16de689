"""Views for text guidance: cameras around a scene, random crops, and random backgrounds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, pad

from ...camera import Camera
from ...camera.lens import Pinhole
from ...color.blending import over
from ...geometry import look_at

SQUARES = 8  # of a checkerboard's side (Jain 2022, appendix A)
DECAY_POWER, DEVIATION = 1.5, 0.2  # of random textures' spectra (Mordvintsev 2018, section on transparency)
MAX_BLUR = 10 / 224  # deviation of the largest blur, in widths of the picture (Jain 2022, appendix A)
BLUR_REACH = 7  # pixels on either side
FRONT_DEGREES, OVERHEAD_DEGREES = 60.0, 60.0  # half-width of front and back view; elevation (Poole 2022, section 3.2)


@dataclass(frozen=True)
class PromptedViews:
    """Cameras around a scene, with a prompt each."""

    unit: ClassVar[str] = "views"

    camera: Camera
    prompts: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.prompts)


def camera_around(
    azimuth: Float[Tensor, " view"],
    elevation: Float[Tensor, " view"],
    distance: float,
    focal: float,
    pixels: int,
    origin: Float[Tensor, " 3"],
) -> Camera:
    """Cameras looking at an origin. Angles in degrees, the distance in scene units, the focal length in widths."""
    a, e = azimuth.deg2rad(), elevation.deg2rad()
    outward = torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], -1).to(origin)
    pose = look_at(origin + distance * outward, -outward, origin.new_tensor([0.0, 0.0, 1.0]))
    count = len(a)
    lens = Pinhole(origin.new_full((count, 2), focal * pixels), origin.new_full((count, 2), pixels / 2))
    return Camera(pose, lens, torch.full((count, 2), pixels, device=origin.device))


def named_view(azimuth: float, elevation: float) -> str:
    """Name of a view for a prompt (Poole 2022, section 3.2). Degrees; azimuth 0 is the front."""
    if elevation > OVERHEAD_DEGREES:
        return "overhead view"
    turned = abs((azimuth + 180) % 360 - 180)
    return "front view" if turned < FRONT_DEGREES else "back view" if turned > 180 - FRONT_DEGREES else "side view"


def cropped(
    rgba: Float[Tensor, "4 height width"], count: int, share: float, size: int, generator: torch.Generator
) -> Float[Tensor, "crop 4 size size"]:
    """Random square crops of a premultiplied picture, of a share of its width, resized."""
    side = rgba.shape[-1]
    width = max(1, round(share * side))
    corners = torch.randint(side - width + 1, (count, 2), generator=generator).tolist()
    crops = torch.stack([rgba[:, y : y + width, x : x + width] for y, x in corners])
    return interpolate(crops, (size, size), mode="bilinear", antialias=True, align_corners=False)


def before_backgrounds(
    rgba: Float[Tensor, "crop 4 size size"], generator: torch.Generator
) -> Float[Tensor, "crop 3 size size"]:
    """Premultiplied pictures composited over random backgrounds."""
    behind = backgrounds(len(rgba), rgba.shape[-1], generator).to(rgba)
    return over(rgba[:, :3].movedim(1, -1), rgba[:, 3], behind.movedim(1, -1)).movedim(-1, 1)


def backgrounds(count: int, size: int, generator: torch.Generator) -> Float[Tensor, "count 3 size size"]:
    """Uniform noise, checkerboards and smooth random textures, a third of each, blurred (Jain 2022, appendix A)."""
    kind = torch.randint(3, (count, 1, 1, 1), generator=generator)
    noise = torch.rand(count, 3, size, size, generator=generator)
    place = torch.arange(size) * SQUARES // size
    odd = ((place[:, None] + place) % 2).bool()
    one, other = torch.rand(2, count, 3, 1, 1, generator=generator)
    picture = torch.where(kind == 0, noise, torch.where(odd, one, other))
    picture = torch.where(kind == 2, textures(count, size, generator), picture)
    return blurred(picture, size * MAX_BLUR * torch.rand(count, generator=generator))


def textures(count: int, size: int, generator: torch.Generator) -> Float[Tensor, "count 3 size size"]:
    """Random textures with amplitude falling with frequency (Mordvintsev 2018)."""
    y, x = torch.fft.fftfreq(size)[:, None], torch.fft.rfftfreq(size)
    frequency = (x.square() + y.square()).sqrt().clamp_min(1 / size)
    spectrum = torch.randn(2, count, 3, size, size // 2 + 1, generator=generator)
    waves = torch.complex(*spectrum) * DEVIATION / frequency**DECAY_POWER
    return torch.fft.irfft2(waves, s=(size, size), norm="ortho").sigmoid()


def blurred(
    pictures: Float[Tensor, "count 3 size size"], deviation: Float[Tensor, " count"]
) -> Float[Tensor, "count 3 size size"]:
    """Gaussian blur of each picture. deviation: pixels"""
    reach = min(BLUR_REACH, pictures.shape[-1] - 1)
    steps = torch.arange(-reach, reach + 1)
    kernel = torch.exp(-0.5 * (steps / deviation.clamp_min(0.1)[:, None]).square())
    kernel = (kernel / kernel.sum(-1, keepdim=True)).repeat_interleave(3, 0)
    x = pictures.flatten(0, 1)[None]
    for _ in range(2):  # rows, then columns
        x = conv2d(pad(x, (reach, reach, 0, 0), mode="reflect"), kernel[:, None, None], groups=x.shape[1]).mT
    return x.reshape(pictures.shape)


def degrees_between(low: float, high: float, count: int, generator: torch.Generator) -> Float[Tensor, " count"]:
    """Random angles between two."""
    return low + (high - low) * torch.rand(count, generator=generator)


def opacity_target(start: float, end: float, steps: int, step: int, focal: float, distance: float) -> float:
    """Target of a picture's mean opacity in the transmittance prior: falling exponentially, proportional to the scene's
    area in the picture (Jain 2022, section 4.2 and released code)."""
    share = min(step / steps, 1.0) if steps else 1.0
    return min(1.0, start * math.pow(end / start, share) * focal**2 / (distance / 4) ** 2 / 1.2)
