"""Development of linear light: exposure, white balance and tone curve, as in a raw converter."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...method.controls import Control

STOPS = 8.0  # that exposure can be turned up or down
DAYLIGHT = 6500.0  # kelvin, of the white that sRGB has
MIN_KELVIN, MAX_KELVIN = 2000.0, 12_000.0  # kelvin
XYZ_TO_SRGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)

Light = Float[Tensor, "*pixels 3"]

WHITE = "The temperature of the light that is shown as white; 6500 is as shot, less is bluer."
TONE = "How light becomes brightness: sRGB's curve, one that keeps highlights as film does, or none."
CONTROLS = (
    Control("exposure", 0.0, (-STOPS, STOPS), unit="stops", about="Each stop doubles the light."),
    Control("white_balance", DAYLIGHT, (MIN_KELVIN, MAX_KELVIN), unit="kelvin", about=WHITE),
    Control("tone", "srgb", choices=("srgb", "filmic", "linear"), about=TONE),
)


def exposed(light: Light, stops: float, kelvin: float) -> Light:
    """Linear sRGB, brighter by as many stops, white-balanced for a colour temperature."""
    gains = white(DAYLIGHT) / white(kelvin)
    return light * (2**stops * gains).to(light)


def toned(light: Light, curve: str) -> Light:
    """Linear light as encoded colours of a picture, in [0, 1], by a tone curve."""
    if curve == "linear":
        return light.clamp(0, 1)
    return encoded(filmic(light) if curve == "filmic" else light.clamp(0, 1))


def encoded(light: Light) -> Light:
    """Linear light in [0, 1] as sRGB (IEC 61966-2-1)."""
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def decoded(rgb: Light) -> Light:
    """sRGB as linear light."""
    return torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def filmic(light: Light) -> Light:
    """Filmic tone curve: a toe and an asymptotic shoulder (Narkowicz 2015, a fit of ACES)."""
    x = 0.6 * light.clamp_min(0)
    return (x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)).clamp(0, 1)


def white(kelvin: float) -> Float[Tensor, " 3"]:
    """Linear sRGB of a black body of a temperature, with green 1 (Kim 2002's fit of the Planckian locus)."""
    t = 1e3 / kelvin
    if kelvin < 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if kelvin < 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif kelvin < 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    rgb = torch.tensor(XYZ_TO_SRGB, dtype=torch.float64) @ torch.tensor(
        [x / y, 1.0, (1 - x - y) / y], dtype=torch.float64
    )
    return (rgb / rgb[1]).clamp_min(1e-2).float()
