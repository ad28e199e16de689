"""Layouts of captures, by their file names in `capture/`, for help texts without loading PyTorch.

Folders are tested in this order. A transforms.json comes first because someone made it on purpose, often beside the
model that it came from; COLMAP's lenses know more than LLFF's. `--reader` overrides the order.
"""

from __future__ import annotations

from ..system.plugins import offered

READERS = (
    "transforms",
    "blender",
    "nerfies",
    "nr_nerf",
    "tum",
    "seven_scenes",
    "nice_slam",
    "phones",
    "kitti",
    "zju_mocap",
    "rig",
    "colmap",
    "llff",
    "nsvf",
    "light_field",
    "recording",
    "minecraft",
)
OWN_NAMES = tuple(name.replace("_", "-") for name in READERS)
NAMES = (*OWN_NAMES, *(name for name in offered("readers") if name not in OWN_NAMES))  # what a user types
LISTED = f"{', '.join(NAMES[:-1])} or {NAMES[-1]}"
