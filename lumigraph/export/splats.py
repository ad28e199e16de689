"""A trained cloud as a file that any splat viewer opens, in the frame of the photographs it came from."""

from __future__ import annotations

from pathlib import Path

from ..datasets.scene import Frame
from ..exchange import write_gaussians
from ..exchange.streamed_sog import Detail
from ..gaussians import Gaussians


def export_splats(gaussians: Gaussians, frame: Frame, path: Path, detail: Detail | None = None) -> Gaussians:
    """Undo the capture's similarity, colours turned with it, and write. The format is the path's ending.

    detail: the levels of a streamed SOG
    Returns what was written, in the source's frame. Raises LumigraphError for an ending that is no splat format.
    """
    moved = gaussians.transformed(frame.to_source.matrix)
    write_gaussians(path, moved, detail)
    return moved
