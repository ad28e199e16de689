"""Vectors, rotations, similarities, and choosing some of many evenly.

Quaternions are (w, x, y, z). Poses are camera-to-world, (3, 4), with +x right, +y down, +z forward.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

T = TypeVar("T")
Vector = tuple[float, float, float]
Rows = tuple[tuple[float, float, float, float], ...]  # of a 4x4 matrix, as plain numbers
SIMILARITY_TOLERANCE = 1e-3  # by which a matrix may fail to be a similarity
ANCHOR_WEIGHT = 0.02  # weight of the other point in `nearest_to_lines`, relative to one line
RIGID_TOLERANCE = 0.01  # deviation of a pose's axes from unit length and right angles


def unit(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The same directions with length 1; zero stays zero."""
    return vectors / vectors.norm(dim=-1, keepdim=True).clamp_min(1e-12)


def look_at(
    position: Float[Tensor, "*batch 3"], forward: Float[Tensor, "*batch 3"], up: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3 4"]:
    """Poses of cameras at positions that look along directions, `up` (one, or one each) pointing upwards in the
    picture."""
    z = unit(forward)
    x = unit(torch.linalg.cross(z, up.expand_as(z)))
    return torch.stack([x, torch.linalg.cross(z, x), z, position], -1)


def nearest_to_lines(
    origins: Float[Tensor, "line 3"], directions: Float[Tensor, "line 3"], otherwise: Float[Tensor, " 3"]
) -> Float[Tensor, " 3"]:
    """The point nearest to all lines by least squares; where they leave it open, nearest to another point.

    directions: unit length
    """
    across = torch.eye(3).to(directions) - directions[:, :, None] * directions[:, None, :]
    loose = ANCHOR_WEIGHT * torch.eye(3).to(directions)
    target = (across @ origins[:, :, None])[:, :, 0].mean(0) + loose @ otherwise
    return torch.linalg.solve(across.mean(0) + loose, target)


def turning(start: Float[Tensor, " 3"], end: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes one direction to another, in double precision (Rodrigues)."""
    a, b = unit(start.double()), unit(end.double())
    cosine, axis = float(a @ b), torch.linalg.cross(a, b)
    eye = torch.eye(3, dtype=torch.float64)
    if cosine < -1 + 1e-9:  # half a turn, about any direction at right angles
        across = unit(torch.linalg.cross(a, torch.linalg.cross(eye[a.abs().argmin()], a)))
        return 2 * across[:, None] * across - eye
    cross = torch.linalg.cross(axis.expand(3, 3), eye).T
    return eye + cross + cross @ cross / (1 + cosine)


def rotated(vectors: Float[Tensor, "row 3"], omega: Float[Tensor, "row 3"]) -> Float[Tensor, "row 3"]:
    """Each vector turned about an axis by its length in radians (Rodrigues); differentiable at zero as well."""
    squared = omega.square().sum(-1, keepdim=True)
    angle = squared.clamp_min(1e-12).sqrt()
    once = torch.linalg.cross(omega, vectors)
    twice = torch.linalg.cross(omega, once)
    return vectors + angle.sin() / angle * once + (1 - angle.cos()) / angle.square() * twice


def to_matrix(quaternions: Float[Tensor, "rotation 4"]) -> Float[Tensor, "rotation 3 3"]:
    """Rotation matrices of quaternions, which need not have unit length."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def to_quaternion(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of rotation matrices: eigenvectors of Bar-Itzhack's matrix (2000, eq. 4)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotation.double().unbind(-2))
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ]
    return torch.linalg.eigh(torch.stack([torch.stack(row, -1) for row in rows], -2)).eigenvectors[..., -1]


def multiply(a: Float[Tensor, "#rotation 4"], b: Float[Tensor, "#rotation 4"]) -> Float[Tensor, "rotation 4"]:
    """Hamilton's product of quaternions: the rotation b, then a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


@dataclass(frozen=True)
class Similarity:
    """A change of frame, x' = s R x + t, held as one 4x4 matrix in double precision. A negative determinant mirrors;
    `scale` is then still positive."""

    matrix: Float[Tensor, "4 4"]

    @staticmethod
    def of(rows: Rows) -> Similarity:
        """The similarity that plain numbers say, as `Frame.source_from_scene` does."""
        return Similarity(torch.tensor(rows, dtype=torch.float64))

    @staticmethod
    def make(
        scale: float, rotation: Float[Tensor, "3 3"] | None = None, translation: Float[Tensor, " 3"] | None = None
    ) -> Similarity:
        """The similarity with a scale, a rotation (none: the identity) and a translation (none: zero)."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = scale * (torch.eye(3, dtype=torch.float64) if rotation is None else rotation.double())
        if translation is not None:
            matrix[:3, 3] = translation.double()
        return Similarity(matrix)

    @property
    def scale(self) -> float:
        """Units of the target's frame to one of the source's."""
        return float(torch.linalg.det(self.matrix[:3, :3]).abs() ** (1 / 3))

    @property
    def rotation(self) -> Float[Tensor, "3 3"]:
        return self.matrix[:3, :3] / self.scale

    @property
    def rows(self) -> Rows:
        """The matrix as plain numbers."""
        return tuple((a, b, c, d) for a, b, c, d in self.matrix.tolist())

    @property
    def inverse(self) -> Similarity:
        return Similarity(torch.linalg.inv(self.matrix))

    def __matmul__(self, other: Similarity) -> Similarity:
        """The similarity `other`, then this one."""
        return Similarity(self.matrix @ other.matrix)

    def points(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points transformed to the target's frame; computed in double precision, returned in the points' own."""
        matrix = self.matrix.to(points.device)
        return (points.double() @ matrix[:3, :3].T + matrix[:3, 3]).to(points.dtype)

    def directions(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The same directions in the target's frame; lengths stay."""
        return (directions.double() @ self.rotation.T.to(directions.device)).to(directions.dtype)


def normals_from_depth(
    points: Float[Tensor, "height width 3"], depth: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 3"]:
    """Unit normals of a surface from where each pixel sees it, in single precision; their side is not determined.
    Differences are taken towards that neighbour which is nearer in depth, so that they do not reach across edges."""
    across, down = (_nearer_difference(points.double(), depth, axis) for axis in (1, 0))
    return torch.nn.functional.normalize(torch.linalg.cross(across, down), dim=-1).float()


def _nearer_difference(
    points: Float[Tensor, "height width 3"], depth: Float[Tensor, "height width"], axis: int
) -> Float[Tensor, "height width 3"]:
    """From the last pixel or to the next one along an axis, whichever is the smaller step in depth."""
    if points.shape[axis] < 2:
        return torch.zeros_like(points)
    step, jump = points.diff(dim=axis), depth.diff(dim=axis).abs()
    place = torch.arange(depth.shape[axis])
    onward, back = place.clamp(max=len(place) - 2), (place - 1).clamp_min(0)
    nearer = jump.index_select(axis, onward) <= jump.index_select(axis, back)
    return torch.where(nearer[..., None], step.index_select(axis, onward), step.index_select(axis, back))


def is_similarity(matrix: Tensor) -> bool:
    """True for a 4 x 4 similarity matrix (translation, rotation, scale; no reflection), up to rounding."""
    if matrix.shape != (4, 4) or not matrix.isfinite().all() or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        return False
    linear, one = matrix[:3, :3], torch.eye(3, dtype=torch.float64)
    size = float(torch.linalg.det(linear))
    if size <= 0:
        return False
    return bool((linear @ linear.T / size ** (2 / 3) - one).abs().max() <= SIMILARITY_TOLERANCE)


def is_far(points: Float[np.ndarray, "point 3"], size: float) -> bool:
    """True if float32 rounds points by more than a hundredth of a size, as far from the origin."""
    return bool(len(points)) and float(np.finfo(np.float32).eps * np.abs(points).max()) > 0.01 * size


def evenly(items: Sequence[T], count: int) -> list[T]:
    """Evenly spread subset of at most `count` items, in order, with the first and the last."""
    count = min(count, len(items))
    if count == 1:
        return [items[0]]
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]
