"""Textures of meshes: a UV atlas, colours from photographs or renderings, and normal maps of decimated detail."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch

from ...components.fields.charts import unwrap
from ...datasets.mesh import Mesh, MeshTexture
from ...errors import LumigraphError
from ...system.memory import ask_for
from ...system.progress import counting
from ..surface import Faces, Triangles, Vertices, unit, vertex_normals
from .atlas import texels_of
from .colours import PosedPicture as PosedPicture
from .colours import blended, collected, gains, spread_to_unseen
from .colours import photographed as photographed
from .colours import rendered as rendered
from .detail import normal_map

BYTES_PER_TEXEL = 200  # while a texture is made
Views = Callable[[float], Iterable[PosedPicture]]  # pictures, by the length between neighbouring texels in scene units


def textured(
    surface: tuple[Vertices, Faces],
    sources: Sequence[Views],
    tolerance: float,
    size: int,
    detailed: Triangles | None = None,
) -> Mesh:
    """The mesh of a surface with a texture.

    sources:   of pictures, the best one first; the next ones are for texels invisible in earlier ones
    tolerance: depth behind the first surface of a picture at which a texel still counts as visible, scene units
    size:      of the texture, texels a side
    detailed:  the surface before its decimation, for a normal map
    Invisible texels take the colours of the nearest in space. Raises LumigraphError for a surface without triangles or
    with vertices that are not finite, and for a texture that exceeds memory.
    """
    vertices, faces = surface
    check_surface(vertices, faces)
    check_room(size)
    with counting("Unwrapping the surface"):
        original, charts, uv = unwrap(vertices, faces, size)
        normals, vertices = vertex_normals(vertices, faces)[original], vertices[original]
        texels = texels_of(vertices, charts, uv, size)
    points, facing = texels.interpolated(vertices, charts), unit(texels.interpolated(normals, charts))
    rgb, known = np.zeros((len(texels), 3), np.float32), np.zeros(len(texels), bool)
    for source in sources:
        left = np.flatnonzero(~known)
        if not len(left):
            break
        some = texels[left], (vertices, charts), points[left], facing[left]
        samples = collected(*some, source(texels.spacing), tolerance)
        if samples.known.any():
            rgb[left], known[left] = blended(samples, gains(samples)), samples.known
    with counting("Colouring what no picture shows"):
        rgb = spread_to_unseen(rgb, points, known)
    with counting("Taking detail from the surface"):
        picture = texels.picture(np.rint(255 * rgb).astype(np.uint8))
        detail = None
        if detailed is not None:
            detail = texels.picture(normal_map(texels, (vertices, charts), uv, normals, detailed))
    column, row = (uv * size).astype(int).clip(0, size - 1).T
    return Mesh(vertices, charts, picture[row, column], MeshTexture(uv, picture, detail))


def check_room(size: int) -> None:
    """Raises LumigraphError if a texture of this side in texels exceeds memory."""
    what, less = f"A texture of {size} x {size} texels", "give a smaller --texture-size"
    ask_for(BYTES_PER_TEXEL * size * size, torch.device("cpu"), what, less)


def check_surface(vertices: Vertices, faces: Faces) -> None:
    """Raises LumigraphError for a surface that cannot be unwrapped."""
    if not len(faces):
        raise LumigraphError("The mesh has no faces, so there is nothing to put a texture on; name another mesh")
    if not np.isfinite(vertices).all():
        raise LumigraphError(
            f"{int((~np.isfinite(vertices)).any(-1).sum()):,} vertices of the mesh are not finite, so it has no "
            "texture; repair the mesh"
        )
