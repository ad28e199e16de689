"""Convex decomposition of a mesh for collision detection in game engines."""

from __future__ import annotations

import numpy as np

from ..datasets.mesh import Mesh
from ..errors import LumigraphError
from ..system.progress import counting
from .surface import Triangles, simplified

MAX_FACES = 20_000  # of the mesh that is cut into pieces; pieces are coarser than that
MAX_PIECE_VERTICES = 255  # of one piece, as engines allow


def convex_pieces(mesh: Mesh, concavity: float, count: int | None = None) -> list[Triangles]:
    """Vertices and faces of convex pieces that cover a mesh (CoACD: Wei 2022).

    concavity: largest distance between a piece and its part of the mesh, as a share of the mesh's size
    count:     largest number of pieces
    Raises LumigraphError if CoACD is missing.
    """
    try:
        import coacd
    except ImportError as error:
        raise LumigraphError(
            "Convex pieces are made by CoACD, which is missing; pip install 'lumigraph[mesh]'"
        ) from error
    coacd.set_log_level("error")
    places, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    vertices, faces = simplified(places, same.reshape(-1)[mesh.faces], MAX_FACES)
    with counting("Cutting into convex pieces"):
        found = coacd.run_coacd(
            coacd.Mesh(vertices, faces),
            threshold=concavity,
            max_convex_hull=-1 if count is None else count,
            max_ch_vertex=MAX_PIECE_VERTICES,
            decimate=True,
            seed=0,
        )
    return [(np.asarray(vertices, np.float64), np.asarray(faces, np.int64)) for vertices, faces in found]
