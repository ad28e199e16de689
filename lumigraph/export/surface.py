"""Marching cubes in blocks, only where the zero level can be (Lorensen and Cline 1987); and postprocessing of triangle
meshes: removal of small pieces, smoothing, simplification."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import fast_simplification
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.ndimage import binary_dilation
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from ..depth_maps.level_set import zero_level_of_blocks
from ..errors import LumigraphWarning
from ..system.progress import track

BLOCK = 16  # corners of a block along each axis
BLOCKS_PER_BATCH = 64  # blocks whose corners are evaluated together
SHORTEST = 1e-30  # vector that has a direction
MIN_CUT = 0.005  # share of a surface, from which on it is said to be left out
MIN_ABS_VALUE = 0.01  # no corner's value is nearer to zero, so that no two vertices fall together

Vertices = Float[np.ndarray, "vertex 3"]
Faces = Int[np.ndarray, "face 3"]
Values = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]


@dataclass(frozen=True)
class Grid:
    """Corners of cubes: number (i, j, k) lies at low + cell (i, j, k).

    low:   scene units
    cell:  side of a cube, scene units
    shape: corners along each axis
    """

    low: tuple[float, float, float]
    cell: float
    shape: tuple[int, int, int]

    @staticmethod
    def around(low: tuple[float, ...], high: tuple[float, ...], cell: float, margin: float) -> Grid:
        """The grid whose cubes cover a box and a margin of that many cubes around it."""
        first = np.array(low) - margin * cell
        corners = np.ceil((np.array(high) - np.array(low)) / cell - 1e-6 + 2 * margin).astype(int) + 1
        x, y, z = first.tolist()
        i, j, k = corners.tolist()
        return Grid((x, y, z), cell, (i, j, k))

    def points(self, corners: Int[Tensor, "corner 3"]) -> Float[Tensor, "corner 3"]:
        return torch.tensor(self.low) + self.cell * corners.float()

    def every(self, step: int) -> Int[Tensor, "i j k 3"]:
        """Each step-th corner along each axis, one beyond the last included."""
        ranges = [torch.arange(0, n + step, step) for n in self.shape]
        return torch.stack(torch.meshgrid(*ranges, indexing="ij"), -1)


def zero_level(
    grid: Grid, values: Values, active: Bool[np.ndarray, "i j k"], elsewhere: Float[np.ndarray, "i j k"]
) -> tuple[Vertices, Faces]:
    """Triangles where a function is zero, anticlockwise seen from where it is negative; vertices in scene units.

    values:    the function, about -1 to 1; NaN where it is unknown, which leaves a border
    active:    blocks of BLOCK^3 corners to evaluate; each corner once
    elsewhere: value of all corners of the other blocks
    """
    where, beside = np.argwhere(active), np.argwhere(binary_dilation(active, np.ones((3, 3, 3))) & ~active)
    constant = np.broadcast_to(elsewhere[tuple(beside.T)][:, None, None, None], (len(beside), *(BLOCK,) * 3))
    blocks = np.concatenate([evaluate(grid, values, where), constant.astype(np.float32)])
    vertices, faces = zero_level_of_blocks(blocks, np.concatenate([where, beside]))
    return np.array(grid.low) + grid.cell * vertices, faces


def evaluate(
    grid: Grid, values: Values, where: Int[np.ndarray, "block 3"]
) -> Float[np.ndarray, "block BLOCK BLOCK BLOCK"]:
    """The function at all corners of some blocks, never nearer to zero than MIN_ABS_VALUE."""
    inside = torch.from_numpy(np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3))
    out = np.empty((len(where), BLOCK, BLOCK, BLOCK), np.float32)
    batches = range(0, len(where), BLOCKS_PER_BATCH)
    for first in track(batches, "Looking at cells near the surface", len(batches)):
        some = torch.from_numpy(where[first : first + BLOCKS_PER_BATCH])
        corners = (some[:, None] * BLOCK + inside).reshape(-1, 3)
        out[first : first + len(some)] = values(grid.points(corners)).reshape(-1, BLOCK, BLOCK, BLOCK).numpy()
    return np.where(np.abs(out) < MIN_ABS_VALUE, np.where(out < 0, -MIN_ABS_VALUE, MIN_ABS_VALUE), out)


def compact(vertices: Vertices, faces: Faces) -> tuple[Float[np.ndarray, "used 3"], Faces]:
    """A mesh without the vertices that no face has."""
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


LAMBDA, MU = 0.5, -0.53  # of Taubin's two steps: the second undoes the first one's shrinking

Triangles = tuple[Float[np.ndarray, "some 3"], Int[np.ndarray, "few 3"]]


def larger_pieces(vertices: Vertices, faces: Faces, share: float, seen: Bool[np.ndarray, " vertex"]) -> Triangles:
    """The mesh without connected pieces whose area is less than a share of the largest one's, or unseen."""
    _, piece = connected_components(adjacency(len(vertices), faces), directed=False)
    areas = np.bincount(piece[faces[:, 0]], np.linalg.norm(face_normals(vertices, faces), axis=-1), piece.max() + 1)
    visible = np.bincount(piece[seen], minlength=len(areas)) > 0
    areas = np.where(visible, areas, 0)
    keep = visible & (areas >= share * areas.max())
    name_cut(areas[~keep].sum() / max(areas.sum(), 1e-30), "is in small pieces", "a smaller --keep keeps more of them")
    return compact(vertices, faces[keep[piece[faces[:, 0]]]])


def name_cut(share: float, where: str, way_out: str) -> None:
    """Warn of a share of the surface that an export leaves out."""
    if share >= MIN_CUT:
        sentence = f"{100 * share:.2g} % of the surface {where} and is left out; {way_out}"
        warnings.warn(sentence, LumigraphWarning, stacklevel=3)


def majority(chosen: Bool[np.ndarray, " vertex"], faces: Faces, times: int) -> Bool[np.ndarray, " vertex"]:
    """Majority filter on a graph: mask of vertices with at least half of their surroundings chosen, after some rounds
    of diffusion. It removes thin spikes and fills small gaps."""
    around = mean_of_neighbours(adjacency(len(chosen), faces))
    share = chosen.astype(np.float64)
    for _ in range(times):
        share = 0.5 * (share + around @ share)
    return share >= 0.5


def manifold(faces: Faces) -> tuple[Int[np.ndarray, " vertex"], Int[np.ndarray, "kept 3"]]:
    """Vertices, some duplicated, and faces of a manifold with borders.

    A vertex whose faces form several fans is duplicated for each. Edges of more than two faces become borders, so that
    no edge has more than two faces. Faces without three distinct vertices are dropped.
    """
    faces = faces[(faces != np.roll(faces, 1, 1)).all(-1)]
    corner = np.arange(faces.size).reshape(faces.shape)  # a number for each vertex of each face
    ends = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)
    corners = np.stack([corner, np.roll(corner, -1, 1)], -1).reshape(-1, 2)
    swap = ends[:, 0] > ends[:, 1]
    ends[swap], corners[swap] = ends[swap, ::-1], corners[swap, ::-1]
    _, edge, count = np.unique(ends[:, 0] << 32 | ends[:, 1], return_inverse=True, return_counts=True)
    shared = np.argsort(edge, kind="stable")
    one, other = corners[shared[count[edge[shared]] == 2]].reshape(-1, 2, 2).swapaxes(0, 1)
    joined = sparse.coo_array((np.ones(one.size), (one.ravel(), other.ravel())), (faces.size, faces.size))
    _, fan = connected_components(joined, directed=False)
    _, first = np.unique(fan, return_index=True)
    return faces.ravel()[first], fan.reshape(faces.shape).astype(np.int64)


def smoothed(vertices: Vertices, faces: Faces, times: int) -> Vertices:
    """Taubin smoothing (1995): vertices moved towards the mean of their neighbours and back. Border vertices move along
    the border."""
    if not times:
        return vertices
    neighbours, rim = adjacency(len(vertices), faces), border(len(vertices), faces)
    mean = mean_of_neighbours(sparse.diags_array((rim.sum(1) == 0).astype(float)) @ neighbours + rim)
    for _ in range(times):
        for factor in (LAMBDA, MU):
            vertices = vertices + factor * (mean @ vertices - vertices)
    return vertices


def mean_of_neighbours(neighbours: sparse.csr_array) -> sparse.csr_array:
    """The matrix that gives each vertex the mean of its neighbours' values, 0 without neighbours."""
    return sparse.diags_array(1 / np.maximum(neighbours.sum(1), 1)) @ neighbours


def simplified(vertices: Vertices, faces: Faces, count: int) -> Triangles:
    """A mesh of about `count` faces by quadric error simplification (Garland and Heckbert 1997)."""
    if len(faces) <= count:
        return vertices, faces
    pair = vertices.astype(np.float64), faces.astype(np.int32)
    fewer, triangles = fast_simplification.simplify(*pair, target_count=count)[:2]
    return compact(np.asarray(fewer, np.float64), np.asarray(triangles, np.int64))


def vertex_normals(vertices: Vertices, faces: Faces) -> Vertices:
    """Unit normals: the sum of those of the faces around, by area; that of the largest one where they cancel."""
    across = face_normals(vertices, faces)
    rising = np.argsort(np.linalg.norm(across, axis=-1), kind="stable")
    largest = np.zeros((len(vertices), 3))
    largest[faces[rising]] = across[rising][:, None]
    return unit(vertex_sums(across, faces, len(vertices)), unit(largest, np.array([0.0, 0.0, 1.0])))


def tangents(
    vertices: Vertices, faces: Faces, uv: Float[np.ndarray, "vertex 2"], normals: Vertices
) -> Float[np.ndarray, "vertex 4"]:
    """Unit tangents towards growing u, at right angles to the normals, and the sign s of the bitangent s (n x t), which
    points upwards in the picture. uv: from the picture's upper left corner, as in `MeshTexture`"""
    (a, b, c), (u, v, w) = vertices[faces].swapaxes(0, 1), (uv * [1, -1])[faces].swapaxes(0, 1)
    (du, dv), (eu, ev) = (v - u).T[:, :, None], (w - u).T[:, :, None]
    turned = np.sign(du * ev - eu * dv)
    along = unit(turned * (ev * (b - a) - dv * (c - a)))
    area = np.linalg.norm(face_normals(vertices, faces), axis=-1, keepdims=True)
    total = vertex_sums(np.hstack([along, turned]) * area, faces, len(vertices))
    across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(-1)])
    along = unit(total[:, :3] - (total[:, :3] * normals).sum(-1, keepdims=True) * normals, unit(across))
    return np.hstack([along, np.where(total[:, 3:] < 0, -1.0, 1.0)])


def vertex_sums(
    values: Float[np.ndarray, "face column"], faces: Faces, count: int
) -> Float[np.ndarray, "vertex column"]:
    """Sums of the values of the faces around each of `count` vertices."""
    return np.stack([np.bincount(faces.ravel(), np.repeat(x, 3), count) for x in values.T], -1)


def unit(rows: Float[np.ndarray, "row 3"], otherwise: Float[np.ndarray, "*row 3"] | float = 0.0) -> Vertices:
    """Rows of length 1; other ones, zeros by default, where they have no direction."""
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.where(lengths > SHORTEST, rows / np.maximum(lengths, SHORTEST), otherwise)


def face_normals(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "face 3"]:
    """Normals of faces: outward, as long as twice the area."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def adjacency(count: int, faces: Faces) -> sparse.csr_array:
    """Adjacency matrix of vertices: 1 for each shared edge, symmetric."""
    a, b = np.concatenate([faces, np.roll(faces, 1, 1)]).ravel(), np.concatenate([np.roll(faces, 1, 1), faces]).ravel()
    matrix = sparse.coo_array((np.ones(len(a)), (a, b)), (count, count)).tocsr()
    matrix.data[:] = 1
    return matrix


def border(count: int, faces: Faces) -> sparse.csr_array:
    """Adjacency matrix of vertices by edges that only one face has: 1 for each, symmetric."""
    a, b = faces.ravel(), np.roll(faces, -1, 1).ravel()
    matrix = sparse.coo_array((np.ones(2 * len(a)), (np.append(a, b), np.append(b, a))), (count, count)).tocsr()
    matrix.data[:] = matrix.data == 1
    matrix.eliminate_zeros()
    return matrix
