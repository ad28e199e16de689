"""Functions of readers that no quick command reaches, called with one file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

FUNCTIONS = {  # by name: the suffix of the file that each reads
    "environment": ".npy",
    "strokes": ".png",
    "character": ".glb",
    "bones": ".json",
    "tracks": ".json",
    "weights": ".safetensors",
    "mask": ".safetensors",
}


def read(name: str, file: str) -> int:
    """Read a file as a command does, and the command's exit code."""
    from lumigraph.errors import LumigraphError

    try:
        called(name, Path(file))
    except LumigraphError as fault:
        print(f"lumigraph: {' '.join(str(fault).split())}", file=sys.stderr)
        return 2
    return 0


def called(name: str, path: Path) -> Any:
    import torch

    from lumigraph.camera import Camera
    from lumigraph.camera.lens import Pinhole
    from lumigraph.composition.voxel_mask import read_mask
    from lumigraph.exchange.bones import read_bones, read_motion
    from lumigraph.exchange.skinned_gltf import read_character
    from lumigraph.geometry import Similarity
    from lumigraph.light import EnvironmentLight
    from lumigraph.metrics.lpips import read_weights
    from lumigraph.readers.tracks import read_tracks
    from lumigraph.selection.strokes import read_strokes

    if name == "strokes":
        camera = Camera(torch.eye(3, 4)[None], Pinhole(torch.ones(1, 2), torch.ones(1, 2)), torch.tensor([[32, 24]]))
        return read_strokes(path, camera, "a view")
    if name == "bones":
        skeleton = read_bones(path)
        return read_motion(path, skeleton, Similarity.make(2.0))
    if name == "character":
        return read_character(path).clip(0)
    return {"environment": EnvironmentLight.open, "tracks": read_tracks, "weights": read_weights, "mask": read_mask}[
        name
    ](path)
