"""Mesh: triangles with colours, as methods learn from them and exports write them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from .scene import Frame


@dataclass(frozen=True)
class Mesh:
    """Triangles with a colour at each vertex, anticlockwise seen from outside.

    vertices: in the frame that its maker states
    colours:  sRGB-encoded
    """

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    colours: UInt8[np.ndarray, "vertex 3"]

    def transformed(self, similarity: Float[np.ndarray, "4 4"]) -> Mesh:
        """The same mesh in another frame, x' = M x. A mirroring turns the triangles, so that outside stays outside."""
        matrix = np.asarray(similarity, np.float64)
        vertices = self.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        faces = self.faces if np.linalg.det(matrix[:3, :3]) > 0 else self.faces[:, ::-1].copy()
        return replace(self, vertices=vertices, faces=faces)

    def in_source(self, frame: Frame) -> Mesh:
        """From the scene's frame to that of the capture."""
        return self.transformed(frame.to_source.matrix.numpy())
