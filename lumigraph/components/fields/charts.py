"""Charts of a mesh in the plane of its texture."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

PADDING_TEXELS = 4  # between charts


def unwrap(
    vertices: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    size: int,
    padding: int = PADDING_TEXELS,
) -> tuple[Int[np.ndarray, " split"], Int[np.ndarray, "face 3"], Float[np.ndarray, "split 2"]]:
    """Charts of a mesh, packed into a square of so many texels a side (xatlas). padding: texels between them

    Returns the vertex that each vertex of a chart is a copy of, the faces between these copies, and their places in the
    square: (0, 0) is its upper left corner, (1, 1) its lower right one.
    """
    import xatlas

    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = size, padding, True
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    atlas.generate(pack_options=packing)
    original, charts, uv = atlas.get_mesh(0)
    longest = max(atlas.width, atlas.height)
    return original.astype(np.int64), charts.astype(np.int64), uv * (np.array([atlas.width, atlas.height]) / longest)
