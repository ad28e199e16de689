"""Blocks: land of grass, dirt, stone, sand, water, trees and snow as cubes, seen by cameras that walk above it.

`width` is the world's width in blocks. Opened by its name it is a `BlockWorld`, with the label of every block.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ...datasets.terrain import DIRT, GRASS, SAND, STONE, TREE, WATER, WATER_LEVEL, Terrain, terrain
from ...datasets.world import BlockLabels
from ...files.ranges import Seed, between
from ..block_stage import stage_of
from ..stage import Pictures, SyntheticStage

MARGIN = 8  # blocks of air above the highest ground
SOIL = 2  # blocks of dirt below grass


@dataclass(frozen=True)
class Options(Pictures):
    """width: of the world, blocks; land: seed of the terrain"""

    size: Annotated[int, between(1, 8192)] = 128
    views: Annotated[int, between(1, 10_000)] = 60
    width: Annotated[int, between(8, 512)] = 64
    land: Seed = 1


def blocks(options: Options) -> BlockLabels:
    """The world's blocks."""
    return cubes(terrain(options.width, options.land))


def cubes(land: Terrain) -> BlockLabels:
    """Land as blocks: soil below grass, stone below all, water up to its level, trunks and crowns of trees."""
    height = np.maximum(np.round(land.ground), 1).astype(int)
    side, top = len(height), int(max(height.max(), WATER_LEVEL)) + MARGIN
    labels, z = np.zeros((side, side, top), np.uint8), np.arange(top)
    labels[z < height[:, :, None]] = STONE
    soil = (z >= height[:, :, None] - 1 - SOIL) & (z < height[:, :, None])
    for label in np.unique(land.label):
        here = (land.label == label)[:, :, None] & soil
        labels[here] = DIRT if label == GRASS else SAND if label == WATER else label
    x, y = np.indices(height.shape)
    labels[x, y, height - 1] = np.where(land.label == WATER, SAND, land.label)
    level = int(WATER_LEVEL)
    wet = land.label == WATER
    labels[wet[:, :, None] & (z >= np.minimum(height, level - 1)[:, :, None]) & (z < level)] = WATER
    for x, y, tall, radius in land.trees:
        plant(labels, int(x), int(y), int(height[int(x), int(y)]), round(tall), radius)
    return BlockLabels(labels[:, :, : int(np.flatnonzero((labels > 0).any((0, 1)))[-1]) + 2])


def plant(labels: np.ndarray, x: int, y: int, ground: int, tall: int, radius: float) -> None:
    """Add a tree: a trunk, and a crown around its upper half."""
    labels[x, y, ground : ground + tall - 1] = TREE
    i, j, k = np.ogrid[tuple(map(slice, labels.shape))]
    centre = ground + 0.65 * tall
    ball = ((i - x) ** 2 + (j - y) ** 2) / (radius + 0.2) ** 2 + ((k + 0.5 - centre) / (0.42 * tall)) ** 2 <= 1
    labels[ball & (labels == 0)] = TREE


def stage(size: int = 128, views: int = 60, seed: int = 0, width: int = 64, land: int = 1) -> SyntheticStage:
    """Cameras above the land; held-out ones walk around its middle."""
    return stage_of(cubes(terrain(width, land)), size, views, seed, "blocks")
