"""Mesh: triangles with colours, for training and export."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from .scene import Frame


@dataclass(frozen=True)
class MeshTexture:
    """Textures of a surface.

    uv:      texture coordinates of each vertex: (0, 0) is the upper left corner of the pictures, (1, 1) the lower right
    colours: sRGB-encoded
    normals: normal map 255 (n + 1) / 2 in the frame of tangent (growing u), bitangent (upwards in the picture) and the
             mesh's own normal; None without one
    """

    uv: Float[np.ndarray, "vertex 2"]
    colours: UInt8[np.ndarray, "height width 3"]
    normals: UInt8[np.ndarray, "height width 3"] | None = None


@dataclass(frozen=True)
class Mesh:
    """Triangles with vertex colours, anticlockwise seen from outside.

    vertices: in the frame of its source; split along texture seams
    colours:  sRGB-encoded
    """

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    colours: UInt8[np.ndarray, "vertex 3"]
    texture: MeshTexture | None = None

    def transformed(self, similarity: Float[np.ndarray, "4 4"]) -> Mesh:
        """The same mesh in another frame, x' = M x. A reflection also reverses the triangles."""
        matrix = np.asarray(similarity, np.float64)
        vertices = self.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        faces = self.faces if np.linalg.det(matrix[:3, :3]) > 0 else self.faces[:, ::-1].copy()
        return replace(self, vertices=vertices, faces=faces)

    def in_source(self, frame: Frame) -> Mesh:
        """From the scene's frame to that of the capture, in the unit of exports."""
        return self.transformed(frame.to_export.matrix.numpy())
