"""Format of the first browser viewer, https://github.com/antimatter15/splat: no header, 32 bytes per Gaussian.

Three float32 of position and three of scale (no logarithms), red, green, blue and opacity as bytes, and w, x, y, z of
the rotation as bytes round(128 q + 128). Positions and scales are exact, colours and opacities within 1/510 where they
lie in [0, 1], each component of a rotation within 1/128. Harmonics beyond degree 0 and `antialiased` are lost. The
order is preserved: the viewer's own converter puts the most visible Gaussians first, so that they load first, but all
viewers sort by depth anyway.
"""

from __future__ import annotations

import string
from pathlib import Path

import numpy as np

from ..errors import LumigraphError
from ..files import write_bytes
from ..gaussians import Gaussians
from ..kernels.spherical_harmonics import K00
from .checks import check_room
from .codes import LOGITS, alpha_to_byte, array, cloud, from_scales, to_byte, to_scales, unit

FIELDS = [("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 3), ("alpha", "u1"), ("rotation", "u1", 4)]
RECORD = np.dtype(FIELDS)


def read(path: Path) -> Gaussians:
    """Read a .splat file. Raises LumigraphError for a partial record, and for text. Missing records go unnoticed."""
    check_room(path, path.stat().st_size // RECORD.itemsize)
    data = path.read_bytes()
    if not data[:1024].strip(string.printable.encode()):
        raise LumigraphError(f"{path} is text and holds no Gaussians; name another file")
    if len(data) % RECORD.itemsize:
        raise LumigraphError(
            f"{path} is truncated or no .splat file, for its {len(data)} bytes are no multiple of {RECORD.itemsize}; "
            "copy or download it again"
        )
    records = np.frombuffer(data, RECORD)
    return cloud(
        records["mean"],
        records["rotation"] / 128 - 1,
        from_scales(records["scale"]),
        LOGITS[records["alpha"]],
        (records["colour"][:, None] / 255 - 0.5) / K00,
    )


def write(path: Path, gaussians: Gaussians) -> None:
    """Write a .splat file. Raises LumigraphError for an empty cloud, whose file would be empty."""
    if not len(gaussians):
        raise LumigraphError(f"{path} cannot hold a cloud of no Gaussians; write it as .ply")
    records = np.empty(len(gaussians), RECORD)
    records["mean"] = array(gaussians.means)
    records["scale"] = to_scales(array(gaussians.log_scales))
    records["colour"] = to_byte(255 * (K00 * array(gaussians.harmonics[:, 0]) + 0.5))
    records["alpha"] = alpha_to_byte(array(gaussians.opacities))
    records["rotation"] = to_byte(128 * unit(array(gaussians.quaternions)) + 128)
    write_bytes(path, records.tobytes(), "splats")
