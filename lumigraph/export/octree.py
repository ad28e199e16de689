"""An octree as the file that the viewers of PlenOctrees read: one `.npz` (Yu 2021; volrend, svox)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..datasets.scene import Frame
from ..exchange.baked import Octree
from ..files import replacing
from ..geometry import Similarity

FLOAT16_MAX = 65504.0  # the largest number of float16
ROTATION_TOLERANCE = 1e-4  # of a rotation's entries, below which there is none


def write_octree(path: Path, octree: Octree, frame: Frame) -> bool:
    """Write the file; gives whether it lies in the frame of the photographs.

    A place p is at p · invradius3 + offset in the unit cube. The file knows no rotation: where the scene's frame is
    turned against that of the photographs, the octree stays in the scene's.
    """
    straight = (frame.to_source.rotation - torch.eye(3, dtype=torch.float64)).abs().max() < ROTATION_TOLERANCE
    arrays = contents(octree, frame.to_source if straight else Similarity.make(1.0))
    with replacing(path, "octree") as new, open(new, "wb") as file:
        np.savez_compressed(file, **arrays)
    return bool(straight)


def contents(octree: Octree, moved: Similarity) -> dict[str, Any]:
    """The arrays of the file, by name. moved: to the file's frame; without rotation

    data: of each cell, all coefficients of red, of green, of blue, then density per unit of the file's frame
    """
    nodes, basis = len(octree.child), octree.harmonics.shape[-2]
    scale = moved.scale
    corner, size = moved.points(octree.low.double().cpu()).numpy(), octree.size * scale
    colours = octree.harmonics.transpose(-1, -2).flatten(-2).half().cpu().numpy()
    density = (octree.density / scale).clamp(0, FLOAT16_MAX).half().cpu().numpy()
    child = octree.child.int().cpu().numpy()
    return {
        "data_dim": np.int64(3 * basis + 1),
        "data_format": np.array(f"SH{basis}"),
        "invradius3": np.full(3, 1 / size, np.float32),
        "offset": (-corner / size).astype(np.float32),
        "child": child,
        "data": np.concatenate([colours, density[..., None]], -1),
        "parent_depth": parents(child),  # this and what follows is svox's
        "n_internal": np.int64(nodes),
        "n_free": np.int64(0),
        "depth_limit": np.int64(10),
        "geom_resize_fact": np.float64(1.0),
    }


def parents(child: np.ndarray) -> np.ndarray:
    """(node, 2) int32: the cell that each node divides, as 8 node + place, and how many levels lie above it."""
    found = np.zeros((len(child), 2), np.int32)
    divided = np.flatnonzero(child)
    below = divided // 8 + child.reshape(-1)[divided]
    found[below, 0] = divided
    for cell, node in zip(divided.tolist(), below.tolist(), strict=True):  # a node stands ahead of those below it
        found[node, 1] = found[cell // 8, 1] + 1
    return found
