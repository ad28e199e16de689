"""Camera poses of a capture, without any pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..camera import Camera
from ..camera.lens import Pinhole
from ..errors import LumigraphError
from .assemble import checked_pose, in_order
from .capture import Capture
from .normalise import upright_of
from .part import with_splits


@dataclass(frozen=True)
class Places:
    """Photograph i is called names[i] and serves the purpose splits[i].

    positions, forwards: in the source's frame and units; where it looks, unit length
    upright:   the rotation that brings up to +z
    """

    names: list[str]
    splits: list[str | None]
    positions: Float[np.ndarray, "photograph 3"]
    forwards: Float[np.ndarray, "photograph 3"]
    upright: Float[np.ndarray, "3 3"]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def ground(self) -> Float[np.ndarray, "photograph 2"]:
        """Positions seen from above."""
        return (self.positions @ self.upright.T)[:, :2]


def places_of(capture: Capture) -> Places:
    """The places of a capture's photographs by name, 2 ahead of 10.

    Raises LumigraphError for a capture without photographs, and for poses that are none.
    """
    shots = with_splits(in_order(capture.shots, None))
    if not shots:
        raise LumigraphError(f"{capture.source} has no photograph with a pose; add some")
    poses = np.stack([checked_pose(shot, capture.source) for shot in shots])
    away = poses[:, :, 3].mean(0)  # single precision is for what is near the origin
    near = np.concatenate([poses[:, :, :3], poses[:, :, 3:] - away[:, None]], -1)
    lens = Pinhole(torch.ones(len(shots), 2), torch.ones(len(shots), 2))
    cameras = Camera(torch.from_numpy(near).float(), lens, torch.ones(len(shots), 2, dtype=torch.int64))
    return Places(
        [shot.name for shot in shots],
        [shot.split for shot in shots],
        poses[:, :, 3],
        poses[:, :, 2],
        upright_of(capture, cameras)[:3, :3],
    )
