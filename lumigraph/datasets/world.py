"""Block worlds: voxels with labels, and cameras that walk above them."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from .scene import Scene

# Labels of blocks and of pixels. The first is air in blocks, and sky in pictures.
LABELS = ("sky", "grass", "dirt", "stone", "sand", "water", "tree", "snow")


@dataclass(frozen=True)
class BlockLabels:
    """Cubes with an edge of 1 in the source's frame.

    labels: index into `LABELS` of each block, 0 for air; x east, y north, z up
    corner: lowest corner of block (0, 0, 0), source's frame
    """

    labels: UInt8[np.ndarray, "x y z"]
    corner: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, repr=False)
class BlockWorld(Scene):
    """A block world. Its pictures show the blocks in plain colours; its layer `labels` counts `LABELS`."""

    kind: ClassVar[str] = "a block world"

    blocks: BlockLabels = BlockLabels(np.zeros((1, 1, 1), np.uint8))

    @property
    def label_numbers(self) -> Int[Tensor, " name"]:
        """Number in `LABELS` of each index of the layer `labels`; the last is that of -1, the sky."""
        return torch.tensor([*(LABELS.index(name) for name in self.layer("labels").names), LABELS.index("sky")])

    @property
    def blocks_from_scene(self) -> Float[Tensor, "4 4"]:
        """The similarity from the scene's frame to blocks: block (i, j, k) lies between (i, j, k) and (i, j, k) + 1."""
        matrix = self.frame.to_source.matrix.double().clone()
        matrix[:3, 3] -= torch.tensor(self.blocks.corner, dtype=torch.float64)
        return matrix
