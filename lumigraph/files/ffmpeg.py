"""Pixels of a picture that FFmpeg reads: OpenEXR, Radiance HDR, and files of more than eight bits."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

FFMPEG_PLANES = ("g", "b", "r", "a")  # order of FFmpeg's floating-point planes


def decode(path: Path) -> np.ndarray:
    """A picture's numbers by FFmpeg: RGB or RGBA, or one number to a pixel."""
    with open(path, "rb") as file, av.open(file, "r") as container:
        frame = next(container.decode(video=0))
    if not frame.format.name.endswith(("f16le", "f16be")):
        return frame.to_ndarray()
    rows = [np.frombuffer(bytes(plane), np.float16).reshape(-1, plane.line_size // 2) for plane in frame.planes]
    rows = [row[: frame.height, : frame.width] for row in rows]
    if len(rows) == 1:
        return rows[0].copy()
    by_name = dict(zip(FFMPEG_PLANES, rows, strict=False))
    return np.stack([by_name[k] for k in "rgba" if k in by_name], -1)
