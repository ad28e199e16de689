"""Colours of other screens as sRGB: primaries and transfer curves by their numbers in ITU-T H.273.

Light of HLG and PQ is in cd/m2, with diffuse white at 203 (ITU-R BT.2408). What is brighter is rolled off by the curve
of ITU-R BT.2390, section 5.4.1, from the brightest light of a film or picture to white. Other light is 1 at white.
"""

from functools import cache

import numpy as np
from jaxtyping import Float, UInt16

from .srgb import linear_from_srgb, srgb_from_linear

BT709, UNKNOWN, BT2020, P3 = 1, 2, 9, 12  # primaries
ADOBE = 1001  # primaries and transfer of Adobe RGB (1998), which has no number there
GAMMAS = {4: 2.2, 5: 2.8, 8: 1.0, ADOBE: 563 / 256}  # transfers that are powers
PQ, HLG = 16, 18  # transfers of light brighter than white
LIKE_SRGB = (BT709, UNKNOWN, 6, 7, 11, 12, 13, 14, 15)  # shown by screens as sRGB is
CHROMATICITIES = {  # x, y of red, green and blue, where white is D65
    BT709: (0.64, 0.33, 0.30, 0.60, 0.15, 0.06),
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06),
    6: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07),
    7: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07),
    BT2020: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046),
    P3: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060),
    ADOBE: (0.64, 0.33, 0.21, 0.71, 0.15, 0.06),
    22: (0.63, 0.34, 0.295, 0.605, 0.155, 0.077),
}
D65 = (0.3127, 0.3290)
WHITE, PQ_PEAK, HLG_PEAK, HLG_GAMMA = 203.0, 10000.0, 1000.0, 1.2  # cd/m2; exponent (BT.2100, table 5)
M1, M2, C1, C2, C3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128  # BT.2100, table 4
A, B, C = 0.17883277, 0.28466892, 0.55991073  # BT.2100, table 5

Colours = Float[np.ndarray, "*pixels 3"]


def is_known(primaries: int, transfer: int) -> bool:
    """True if colours of these numbers can be converted."""
    curves = transfer in LIKE_SRGB or transfer in GAMMAS or transfer in (PQ, HLG)
    return curves and (primaries == UNKNOWN or primaries in CHROMATICITIES)


def is_srgb(primaries: int, transfer: int) -> bool:
    """True if colours of these numbers, or of numbers that are not known, are used as they are."""
    return not is_known(primaries, transfer) or (primaries in (BT709, UNKNOWN) and transfer in LIKE_SRGB)


def srgb_of(
    signal: UInt16[np.ndarray, "*pixels 3"], primaries: int, transfer: int, white: float = WHITE, peak: float = HLG_PEAK
) -> Colours:
    """Colours encoded as sRGB. white, peak: of HLG and PQ, cd/m2: the peak is that of all pictures that belong
    together"""
    light = light_of(signal, transfer)
    if transfer in (PQ, HLG):
        light = rolled_off(light, white, peak) / np.float32(white)
    if primaries not in (BT709, UNKNOWN):
        light = light @ to_bt709(primaries).T
    return srgb_from_linear(light.clip(0, 1))


def light_of(signal: UInt16[np.ndarray, "*pixels 3"], transfer: int) -> Colours:
    """Light of a signal: cd/m2 of HLG and PQ, of others 1 at white."""
    return curve(transfer)[signal]


@cache
def curve(transfer: int) -> Float[np.ndarray, " 65536"]:
    """Light by signal. HLG's system gamma is applied to each channel, as FFmpeg's zscale does and its films are made,
    where BT.2100 has it on the luminance: colours keep a little more saturation."""
    signal = np.linspace(0, 1, 1 << 16)
    if transfer == PQ:
        light = light_of_pq(signal)
    elif transfer == HLG:
        scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - C) / A) + B) / 12)
        light = HLG_PEAK * scene**HLG_GAMMA
    elif transfer in GAMMAS:
        light = signal ** GAMMAS[transfer]
    else:
        light = linear_from_srgb(signal)
    return light.astype(np.float32)


def light_of_pq(signal: np.ndarray) -> np.ndarray:
    """PQ's electro-optical transfer function (BT.2100, table 4), in cd/m2."""
    power = signal ** (1 / M2)
    return np.asarray((np.maximum(power - C1, 0) / (C2 - C3 * power)) ** (1 / M1) * PQ_PEAK)


def pq_of_light(light: np.ndarray) -> np.ndarray:
    """The inverse of `light_of_pq`."""
    power = (light / PQ_PEAK) ** M1
    return np.asarray(((C1 + C2 * power) / (1 + C3 * power)) ** M2)


def rolled_off(light: Colours, white: float, peak: float) -> Colours:
    """Light up to a peak as light up to white: a pixel's largest channel by BT.2390's spline, the hue as it is."""
    if peak <= white:
        return light
    largest = np.maximum(light.max(-1, keepdims=True), 1e-3)
    top = pq_of_light(np.array(peak))
    signal, most = np.minimum(pq_of_light(largest) / top, 1), pq_of_light(np.array(white)) / top
    knee = 1.5 * most - 0.5
    t = ((signal - knee) / (1 - knee)).clip(0, 1)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    shown = light_of_pq(np.where(signal < knee, signal, spline) * top)
    return light * (shown / largest).astype(np.float32)


@cache
def to_bt709(primaries: int) -> Float[np.ndarray, "3 3"]:
    """Linear colours of primaries to those of BT.709 and sRGB."""
    return (np.linalg.inv(to_xyz(BT709)) @ to_xyz(primaries)).astype(np.float32)


def to_xyz(primaries: int) -> Float[np.ndarray, "3 3"]:
    """Linear colours to CIE XYZ, such that (1, 1, 1) is D65."""
    x, y = np.array(CHROMATICITIES[primaries]).reshape(3, 2).T
    rgb = np.stack([x / y, np.ones(3), (1 - x - y) / y])
    white = np.array([D65[0] / D65[1], 1, (1 - D65[0] - D65[1]) / D65[1]])
    return rgb * np.linalg.solve(rgb, white)
