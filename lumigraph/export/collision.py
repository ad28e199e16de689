"""Convex decomposition of a mesh for collision detection in game engines."""

import numpy as np

from ..datasets.mesh import Mesh
from ..errors import LumigraphError
from ..system.progress import counting
from .options import CollisionOptions
from .surface import Triangles, simplified

NAMES = {"unreal": "UCX_{name}_{number:02}", "godot": "{name}_{number:02}-convcolonly"}  # of pieces, by engine
MAX_FACES = 20_000  # of the mesh that is cut into pieces; pieces are coarser than that
MAX_PIECE_VERTICES = 255  # of one piece, as engines allow


def convex_pieces(mesh: Mesh, options: CollisionOptions = CollisionOptions()) -> dict[str, Triangles]:
    """Vertices and faces of convex pieces that cover a mesh (CoACD: Wei 2022), by the names that an engine expects.

    Raises LumigraphError where CoACD is missing.
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
            threshold=options.concavity,
            max_convex_hull=-1 if options.pieces is None else options.pieces,
            max_ch_vertex=MAX_PIECE_VERTICES,
            decimate=True,
            seed=0,
        )
    pieces = [(np.asarray(vertices, np.float64), np.asarray(faces, np.int64)) for vertices, faces in found]
    return {NAMES[options.engine].format(name="source", number=i): piece for i, piece in enumerate(pieces)}
