"""Bones of captures of any reader: bones.json has the skeleton of a character at all times.

Its layout is in `exchange/bones.py`; it is in the frame and unit of the photographs' poses.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..camera import Camera
from ..datasets.skeleton import Skeleton
from ..errors import LumigraphError
from ..exchange.bones import read_bones
from ..geometry import Similarity
from .capture import Capture

BONES_FILE = "bones.json"


def with_bones(capture: Capture, folder: Path) -> Capture:
    """The capture with the skeleton of its folder's bones.json. Raises LumigraphError for an invalid file."""
    path = folder / BONES_FILE
    return replace(capture, skeleton=read_bones(path)) if path.is_file() else capture


def scene_skeleton(capture: Capture, to_scene: Similarity, cameras: Camera) -> Skeleton | None:
    """The skeleton in the scene's frame, or None. Raises LumigraphError for several poses without times of views."""
    skeleton = capture.skeleton
    if skeleton is None:
        return None
    if len(skeleton.times) > 1 and cameras.time is None:
        raise LumigraphError(
            f"{capture.source}: the bones have {len(skeleton.times)} moments, and photographs have none; give each its "
            "time"
        )
    return skeleton.transformed(to_scene)
