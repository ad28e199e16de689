"""Normal map: detail lost by decimation, as normals in the tangent frame of the decimated mesh."""

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from ...system.threads import processors
from ..surface import Faces, Triangles, Vertices, tangents, unit, vertex_normals
from .atlas import Texels

NEIGHBOURS = 4  # vertices of the detailed mesh that the normal of a texel is interpolated between
CHUNK_TEXELS = 1 << 18


def normal_map(
    texels: Texels,
    mesh: tuple[Vertices, Faces],
    uv: Float[np.ndarray, "vertex 2"],
    normals: Vertices,
    detailed: Triangles,
) -> UInt8[np.ndarray, "texel 3"]:
    """Normals of a detailed mesh as bytes, 255 (n + 1) / 2, in each texel's frame of tangent, bitangent and normal.

    normals: of the mesh's vertices. Where the nearest part of the detailed mesh faces away, the mesh's own normal stays
    """
    (vertices, faces), (dense, dense_faces) = mesh, detailed
    frame = tangents(vertices, faces, uv, normals)
    fine = vertex_normals(dense, dense_faces)
    tree = cKDTree(dense)
    found = np.empty((len(texels), 3), np.uint8)
    for first in range(0, len(texels), CHUNK_TEXELS):
        part = texels[first : first + CHUNK_TEXELS]
        points, up, along = (part.interpolated(x, faces) for x in (vertices, normals, frame[:, :3]))
        away, near = tree.query(points, NEIGHBOURS, workers=processors())
        share = 1 / np.maximum(away, 1e-12)
        seen = unit((fine[near] * share[..., None]).sum(1))
        up = unit(up)
        seen = np.where(((seen * up).sum(-1) > 0)[:, None], seen, up)
        along = unit(along - (along * up).sum(-1, keepdims=True) * up)
        across = np.cross(up, along) * frame[faces[part.face, 0], 3:]
        local = np.stack([(seen * axis).sum(-1) for axis in (along, across, up)], -1)
        found[first : first + len(part)] = np.rint(255 * (0.5 + 0.5 * local))
    return found
