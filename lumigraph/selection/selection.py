"""Selection: a user's strokes, and the selected part of the scene, with undo."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from ..camera import Camera
from ..errors import LumigraphError
from .distilled import Distilled, Weigher, weigher_of
from .growth import GrowthNumbers, grown
from .strokes import Strokes

SEED_SHARE = 0.8  # of the weights under a stroke: the points with the largest ones that have it together are its seeds

MIN_PURITY = 0.3  # share of a point's weight in the view that is under the stroke: large ones behind an edge have less


class Selection:
    """A part of a method's scene, marked by strokes.

    method: the method of the scene
    points: features and places; see `distil_features`
    strokes: in the order in which they were made
    """

    def __init__(self, method: Any, points: Distilled, numbers: GrowthNumbers = GrowthNumbers()):
        self.method, self.points, self.numbers = method, points, numbers
        self._weigher: Weigher = weigher_of(method)
        self._seeds: list[tuple[np.ndarray, np.ndarray]] = []
        self._seen = points.is_seen
        self._about = points.positions[self._seen].numpy(), points.features[self._seen].numpy()

    def __len__(self) -> int:
        """Number of strokes."""
        return len(self._seeds)

    def add(self, strokes: Strokes) -> None:
        """Add strokes. Raises LumigraphError where they are on nothing."""
        seeds = self._under(strokes.camera, strokes.wanted), self._under(strokes.camera, strokes.unwanted)
        if not any(map(len, seeds)):
            raise LumigraphError("The strokes are on nothing; draw on something solid that photographs show")
        self._seeds.append(seeds)

    def undo(self) -> None:
        """Undo the last strokes, if any."""
        del self._seeds[-1:]

    def chosen(self) -> Bool[Tensor, " point"]:
        """The points of the part: none without wanted strokes."""
        none = np.zeros(0, int)
        wanted, unwanted = (np.unique(np.concatenate([none, *(x[i] for x in self._seeds)])) for i in (0, 1))
        unwanted = np.setdiff1d(unwanted, wanted)
        if not len(wanted):
            return torch.zeros(len(self.points), dtype=torch.bool)
        inside = grown(*self._about, *self.points.graph, wanted, unwanted, self.numbers)
        return self.points.spread(torch.from_numpy(inside))

    def mask(self, camera: Camera, chosen: Bool[Tensor, " point"]) -> Float[Tensor, "height width"]:
        """Share of each pixel that shows the part."""
        return self._weigher.shown(camera, self.spread_out(chosen))

    def spread_out(self, values: Shaped[Tensor, " point"]) -> Float[Tensor, " all"]:
        """Values of all Gaussians or of all voxels of the grid, zero where there is no point."""
        points = self.points
        if points.grid is None or points.voxels is None:
            return values.float()
        return torch.zeros(points.grid.count).index_copy(0, points.voxels, values.float())

    def _under(self, camera: Camera, pixels: Bool[Tensor, "height width"]) -> np.ndarray:
        """Indices among the seen points of those under a stroke."""
        if not pixels.any():
            return np.zeros(0, int)
        weights, total = self._weigher.sums(camera, torch.stack([pixels.float(), torch.ones(pixels.shape)], -1)).unbind(
            -1
        )
        if self.points.voxels is not None:
            weights, total = weights[self.points.voxels], total[self.points.voxels]
        weights = torch.where(weights >= MIN_PURITY * total, weights, 0.0)[self._seen]
        order = weights.argsort(descending=True)
        shares = weights[order].cumsum(0) / weights.sum().clamp_min(1e-9)
        count = int((shares < SEED_SHARE).sum()) + 1
        return order[:count][weights[order[:count]] > 1e-3].numpy()
