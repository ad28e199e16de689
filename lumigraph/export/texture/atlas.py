"""UV atlas of a mesh, and surface points of a square texture's texels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy import ndimage

from ..surface import Faces, Vertices
from . import loops

BORDER_TEXELS = 1.5  # around charts, whose points are extrapolated, for bilinear interpolation at a chart's edge


@dataclass(frozen=True)
class Texels:
    """Texels of a square texture that charts cover, or that touch them.

    size:    texels a side
    index:   of each texel in the picture, row by row
    face:    that it belongs to
    shares:  barycentric coordinates in that face; negative ones in the border around a chart
    spacing: scene units from a texel to the next, in the mean
    """

    size: int
    index: Int[np.ndarray, " texel"]
    face: Int[np.ndarray, " texel"]
    shares: Float[np.ndarray, "texel 3"]
    spacing: float

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, some: slice | np.ndarray) -> Texels:
        """The texels that a slice or a mask picks."""
        return replace(self, index=self.index[some], face=self.face[some], shares=self.shares[some])

    def interpolated(
        self, values: Float[np.ndarray, "vertex channel"], faces: Faces
    ) -> Float[np.ndarray, "texel channel"]:
        """Values of vertices, linear in each face, in single precision."""
        corners = faces[self.face]
        found = self.shares[:, :1] * values[corners[:, 0]].astype(np.float32)
        for k in (1, 2):
            found += self.shares[:, k : k + 1] * values[corners[:, k]].astype(np.float32)
        return found

    def picture(self, values: Shaped[np.ndarray, "texel channel"]) -> Shaped[np.ndarray, "size size channel"]:
        """Values of texels as a picture; texels between charts take those of the nearest chart, so that mipmaps do not
        mix a background in."""
        empty = np.ones(self.size * self.size, bool)
        empty[self.index] = False
        filled = np.zeros((self.size * self.size, values.shape[1]), values.dtype)
        filled[self.index] = values
        rows, columns = nearest(empty.reshape(self.size, self.size))[1]
        return filled.reshape(self.size, self.size, -1)[rows, columns]


def nearest(empty: Bool[np.ndarray, "row column"]) -> tuple[Float[np.ndarray, "row column"], np.ndarray]:
    """Distance in texels to the nearest texel that is not empty, and its row and column."""
    return ndimage.distance_transform_edt(empty, return_indices=True)


def texels_of(vertices: Vertices, faces: Faces, uv: Float[np.ndarray, "vertex 2"], size: int) -> Texels:
    """Texels of a mesh's charts, and of a border around them. faces: of vertices that are split where charts end"""
    corners = uv[faces] * size
    face = np.full((size, size), -1, np.int32)
    loops.rasterize(corners, face)
    away, (rows, columns) = nearest(face < 0)
    index = np.flatnonzero(away.reshape(-1) <= BORDER_TEXELS)
    found = face[rows, columns].reshape(-1)[index].astype(np.int64)
    centres = np.stack([index % size, index // size], -1) + 0.5
    a, b, c = corners[found].swapaxes(0, 1)
    across = cross(b - a, c - a)
    second, third = cross(centres - a, c - a) / across, cross(b - a, centres - a) / across
    shares = np.stack([1 - second - third, second, third], -1).astype(np.float32)
    a, b, c = vertices[faces].swapaxes(0, 1)
    surface = np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum()
    a, b, c = corners.swapaxes(0, 1)
    spacing = float(np.sqrt(surface / max(np.abs(cross(b - a, c - a)).sum(), 1e-30)))
    return Texels(size, index, found, shares, spacing)


def cross(a: Float[np.ndarray, "row 2"], b: Float[np.ndarray, "row 2"]) -> Float[np.ndarray, " row"]:
    """Twice the signed area between vectors of the plane."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
