"""The ball of `tiny` as blocks: grass above, stone below."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import tiny
import torch

from lumigraph.datasets.images import Layer, LayerSource
from lumigraph.datasets.world import LABELS, BlockLabels, BlockWorld

SIDE, RADIUS = 8, 0.6  # blocks of the box from -1 to 1, scene units
NAMES = ("grass", "stone")


def labels() -> np.ndarray:
    middle = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    distance = np.sqrt(middle[:, None, None] ** 2 + middle[:, None] ** 2 + middle**2)
    kinds = np.where(middle > 0, LABELS.index("grass"), LABELS.index("stone"))
    return np.where(distance < RADIUS, kinds, 0).astype(np.uint8)


def number(depth: torch.Tensor, surface: torch.Tensor) -> np.ndarray:
    """Index into `NAMES` of each pixel; -1 beside the ball."""
    return torch.where(depth.isfinite(), (surface[..., 2] <= 0).long(), -1).numpy()


@cache
def world() -> BlockWorld:
    scene = tiny.scene()
    planes = [LayerSource(lambda p=p: number(*tiny.ball(p))) for p in tiny.poses(len(scene))]
    layer = Layer(scene.images, planes, np.dtype(np.int64), 1, "index", names=NAMES)
    # The source's unit is the edge of a block.
    scale = SIDE / 2
    rows = tuple(tuple(scale * (i == j) for j in range(3)) + (0.0,) for i in range(3)) + ((0.0, 0.0, 0.0, 1.0),)
    frame = replace(scene.frame, source_from_scene=rows, tracks=())
    fields = vars(scene) | {"frame": frame, "layers": scene.layers | {"labels": layer}}
    return BlockWorld(**fields, blocks=BlockLabels(labels(), (-SIDE / 2,) * 3))
