"""Postprocessing of triangle meshes: removal of small pieces, smoothing, simplification."""

from __future__ import annotations

import fast_simplification
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from .polygons import compact

LAMBDA, MU = 0.5, -0.53  # of Taubin's two steps: the second undoes the first one's shrinking

Triangles = tuple[Float[np.ndarray, "some 3"], Int[np.ndarray, "few 3"]]


def larger_pieces(
    vertices: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    share: float,
    seen: Bool[np.ndarray, " vertex"],
) -> Triangles:
    """The mesh without connected pieces whose area is less than a share of the largest one's, or that nobody sees."""
    _, piece = connected_components(adjacency(len(vertices), faces), directed=False)
    areas = np.bincount(piece[faces[:, 0]], np.linalg.norm(face_normals(vertices, faces), axis=-1), piece.max() + 1)
    visible = np.bincount(piece[seen], minlength=len(areas)) > 0
    areas = np.where(visible, areas, 0)
    keep = visible & (areas >= share * areas.max())
    return compact(vertices, faces[keep[piece[faces[:, 0]]]])


def smoothed(
    vertices: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"], times: int
) -> Float[np.ndarray, "vertex 3"]:
    """Vertices moved towards the mean of their neighbours and back again (Taubin 1995). Borders stay where they are."""
    if not times:
        return vertices
    neighbours = adjacency(len(vertices), faces)
    mean = sparse.diags_array(1 / np.maximum(neighbours.sum(1), 1)) @ neighbours
    free = np.ones((len(vertices), 1))
    free[border(faces)] = 0
    for _ in range(times):
        for factor in (LAMBDA, MU):
            vertices = vertices + factor * free * (mean @ vertices - vertices)
    return vertices


def simplified(vertices: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"], count: int) -> Triangles:
    """A mesh of about so many faces, kept where they matter most to the shape (Garland and Heckbert 1997)."""
    if len(faces) <= count:
        return vertices, faces
    fewer, triangles = fast_simplification.simplify(
        vertices.astype(np.float64), faces.astype(np.int32), target_count=count
    )[:2]
    return compact(np.asarray(fewer, np.float64), np.asarray(triangles, np.int64))


def vertex_normals(
    vertices: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "vertex 3"]:
    """Unit normals: the sum of those of the faces around, by area; zero where they cancel."""
    across = face_normals(vertices, faces)
    total = np.stack([np.bincount(faces.ravel(), np.repeat(across[:, k], 3), len(vertices)) for k in range(3)], -1)
    return total / np.maximum(np.linalg.norm(total, axis=-1, keepdims=True), 1e-30)


def face_normals(
    vertices: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "face 3"]:
    """Normals of faces: outward, as long as twice the area."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def adjacency(count: int, faces: Int[np.ndarray, "face 3"]) -> sparse.csr_array:
    """Adjacency matrix of vertices: 1 for each shared edge, symmetric."""
    a, b = np.concatenate([faces, np.roll(faces, 1, 1)]).ravel(), np.concatenate([np.roll(faces, 1, 1), faces]).ravel()
    matrix = sparse.coo_array((np.ones(len(a)), (a, b)), (count, count)).tocsr()
    matrix.data[:] = 1
    return matrix


def border(faces: Int[np.ndarray, "face 3"]) -> Int[np.ndarray, " vertex"]:
    """The vertices of edges that only one face has."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1).astype(np.int64)
    found, count = np.unique(edges[:, 0] << 32 | edges[:, 1], return_counts=True)
    alone = found[count == 1]
    return np.unique(np.concatenate([alone >> 32, alone & 0xFFFFFFFF]))
