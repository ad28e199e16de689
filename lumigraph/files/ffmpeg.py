"""Pixels of a picture that FFmpeg reads: Radiance HDR, and files of more than eight bits."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np


def decode(path: Path) -> np.ndarray:
    """A picture's numbers by FFmpeg: RGB or RGBA, or one number to a pixel."""
    with open(path, "rb") as file, av.open(file, "r") as container:
        return next(container.decode(video=0)).to_ndarray()
