"""Level sets of grids as meshes (Lorensen and Cline 1987)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ...datasets.mesh import Mesh
from ...depth_maps.level_set import zero_level_of_grid

GREY = 160  # of a mesh that has no colours yet


def level_set(values: Float[np.ndarray, "x y z"], low: Float[np.ndarray, " 3"], cell: float | np.ndarray) -> Mesh:
    """Grey mesh of the zero level of values on a grid, positive inside; closed at the grid's border.

    low:  position of the first corner
    cell: distance of corners, one for all axes or one for each
    """
    closed = np.pad(values, 1, constant_values=min(float(values.min()), -1e-3))
    vertices, faces = zero_level_of_grid(closed.astype(np.float32))
    vertices = low + (vertices - 1) * cell
    return Mesh(vertices, faces, np.full((len(vertices), 3), GREY, np.uint8))
