"""VoxelMask: a part of a field by voxels, as `lumigraph segment` writes it; and its file.

object    (x, y, z), 1 in voxels of the part observed  (x, y, z), 1 in voxels that photographs saw; the colour of any
other is a guess and is shown as unknown lower     lower corner of the grid in the frame of the method's scene edge
of a voxel, scene units
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import safetensors.numpy
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from .. import files
from ..camera.crop import Crop, CropBox
from ..camera.rays import Rays
from ..errors import LumigraphError
from ..files.reading import reading
from ..geometry import Similarity, Vector
from ..selection.cutting import UNKNOWN_COLOUR

MAX_CELLS = 512  # along an axis of a file
ONE = Similarity.make(1.0)


@dataclass(frozen=True, eq=False)
class VoxelMask(Crop):
    """The voxels of a part, or with `outside` their complement.

    place: similarity from the frame of the grid
    """

    part: UInt8[Tensor, "x y z"]
    observed: UInt8[Tensor, "x y z"]
    lower: Vector
    edge: float
    outside: bool = False
    place: Similarity = ONE

    convex = False

    def _values(self, voxels: UInt8[Tensor, "x y z"], points: Tensor, beyond: int) -> Bool[Tensor, "*point"]:
        """Values at points. beyond: that of points outside the grid"""
        local = self.place.inverse.points(points)
        cell = ((local - local.new_tensor(self.lower)) / self.edge).floor().long()
        inside = ((cell >= 0) & (cell < torch.tensor(voxels.shape, device=cell.device))).all(-1)
        x, y, z = torch.where(inside[..., None], cell, 0).unbind(-1)
        return torch.where(inside, voxels.to(cell.device)[x, y, z], beyond) > 0

    def holds(self, points: Float[Tensor, "*point 3"], tolerance: float = 0.0) -> Bool[Tensor, "*point"]:
        return self._values(self.part, points, 0) ^ self.outside

    def coloured(self, points: Float[Tensor, "point 3"], rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        known = self._values(self.observed, points, 1)
        return torch.where(known[:, None], rgb, rgb.new_tensor(UNKNOWN_COLOUR))

    def through(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Entry and exit distances of rays in the box around the part; unbounded for `outside`."""
        if self.outside:
            return torch.zeros_like(rays.radius), torch.full_like(rays.radius, torch.inf)
        return self.box.through(rays)

    def transformed(self, place: Similarity) -> VoxelMask:
        return replace(self, place=place @ self.place)

    @property
    def box(self) -> CropBox:
        """Box around the voxels of the part; around the whole grid if there are none."""
        cells = self.part.nonzero()
        first, last = (
            (cells.amin(0), cells.amax(0) + 1) if len(cells) else (torch.zeros(3), torch.tensor(self.part.shape))
        )
        (a, b, c), (d, e, f) = ((torch.tensor(self.lower) + self.edge * x).tolist() for x in (first, last))
        return CropBox((a, b, c), (d, e, f)).transformed(self.place)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        return self.box.bounds

    def write(self, path: Path) -> None:
        """Write the file; see above."""
        arrays = {"object": self.part.cpu().numpy(), "observed": self.observed.cpu().numpy()}
        arrays |= {"lower": np.array(self.lower), "edge": np.array([self.edge])}
        with files.replacing(path, "masks") as partial:
            safetensors.numpy.save_file(arrays, partial)


def mask_of(
    chosen: Bool[np.ndarray, "x y z"], seen: Bool[np.ndarray, "x y z"], lower: Vector, edge: float
) -> VoxelMask:
    """Mask of chosen voxels among visible ones; hidden ones, such as an object's inside, follow the nearest visible."""
    nearest = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    part = torch.from_numpy(chosen[tuple(nearest)].astype(np.uint8))
    return VoxelMask(part, torch.from_numpy(seen.astype(np.uint8)), lower, edge)


def read_mask(path: Path) -> VoxelMask:
    """Read a mask's file. Raises LumigraphError for an invalid one."""
    with reading(path, "is no mask of voxels", "`lumigraph segment` makes one"):
        arrays = safetensors.numpy.load(path.read_bytes())
        part, observed, lower, edge = (arrays[name] for name in ("object", "observed", "lower", "edge"))
    sound = part.ndim == 3 and part.shape == observed.shape and 0 < min(part.shape) and max(part.shape) <= MAX_CELLS
    sound = sound and part.dtype == observed.dtype == np.uint8 and lower.shape == (3,) and edge.shape == (1,)
    if not (sound and np.isfinite(lower).all() and np.isfinite(edge).all() and edge[0] > 0):
        raise LumigraphError(f"{path} is a damaged mask of voxels; make it again by `lumigraph segment`")
    x, y, z = lower.tolist()
    return VoxelMask(torch.from_numpy(part.copy()), torch.from_numpy(observed.copy()), (x, y, z), float(edge[0]))
