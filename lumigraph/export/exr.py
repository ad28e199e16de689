"""OpenEXR: pictures of linear light with all their range, written by FFmpeg as 32-bit floats."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
from jaxtyping import Float
from torch import Tensor

from ..camera.rays import Rendering
from ..components.fields.development import decoded

PIXEL_FORMAT = "gbrpf32le"  # planes of 32-bit floats


def light_of(seen: Rendering) -> Float[Tensor, "height width 3"]:
    """The linear light of a rendering, 1 for white: its own `radiance` where it has that, else its colours decoded."""
    return seen.extra["radiance"] if "radiance" in seen.extra else decoded(seen.rgb.clamp(0, 1))


def exr(light: Float[Tensor, "height width 3"]) -> bytes:
    """The bytes of an OpenEXR file of linear sRGB, compressed without loss."""
    pixels = np.ascontiguousarray(light.detach().cpu().numpy(), np.float32)
    codec = av.CodecContext.create("exr", "w")
    assert isinstance(codec, av.VideoCodecContext)
    codec.height, codec.width = pixels.shape[:2]
    codec.pix_fmt, codec.time_base, codec.options = PIXEL_FORMAT, Fraction(1), {"compression": "zip16"}
    frame = av.VideoFrame.from_ndarray(pixels, format=PIXEL_FORMAT)
    return b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)])
