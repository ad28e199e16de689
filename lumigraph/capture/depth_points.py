"""Points that depth beside photographs stands for, for captures whose reader knows no others."""

from __future__ import annotations

import numpy as np
import torch

from ..choice import evenly
from .beside import read_plane, settled
from .capture import Shot
from .pictures import read_image
from .points import SparsePoints

PHOTOGRAPHS, PIXELS = 64, 300  # asked at most, and of each


def depth_points(shots: list[Shot]) -> SparsePoints | None:
    """Pixels drawn at random from some of the photographs, where their depth along the axis says they are; in the
    source's frame, with their colours. None where no depth is known."""
    chosen = evenly([shot for shot in shots if "depth" in shot.planes], PHOTOGRAPHS)
    positions, colours, random = [], [], np.random.default_rng(0)
    for shot in chosen:
        assert shot.size is not None and isinstance(shot.image, dict)
        plane = settled(shot.planes["depth"], "depth")
        assert plane.dtype is not None and plane.encoding == "z-depth"
        stored = read_plane(plane, "depth", plane.dtype, shot.size, np.eye(3))
        rows, columns = np.nonzero(~np.isin(stored, plane.unknown))
        some = random.permutation(len(rows))[:PIXELS]
        y, x = rows[some], columns[some]
        rays = shot.lens.unproject(torch.from_numpy(np.stack([x, y], -1) + 0.5).float()).double().numpy()
        along = plane.scale * stored[y, x].astype(np.float64)
        positions.append(rays / rays[:, 2:] * along[:, None] @ shot.pose[:, :3].T + shot.pose[:, 3])
        colours.append(read_image(shot.image[1], False, shot.size)[y, x, :3])
    if not chosen:
        return None
    points = np.concatenate(positions)
    return SparsePoints(points, np.concatenate(colours), np.full(len(points), 2))
