"""A trained cloud as a file that any splat viewer opens, in the frame of the photographs it came from."""

from __future__ import annotations

from pathlib import Path

from ..exchange import write_gaussians
from ..gaussians import Gaussians
from ..scene import Frame


def export_splats(gaussians: Gaussians, frame: Frame, path: Path) -> Gaussians:
    """Undo the capture's similarity, colours turned with it, and write. The format is the path's ending.

    Returns what was written, in the source's frame. Raises LumigraphError for an ending that is no splat format.
    """
    moved = gaussians.transformed(frame.to_source.matrix)
    write_gaussians(path, moved)
    return moved
