"""Object branches: density and colour of one instance, by its code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ...components.fields.coordinate_field import CoordinateField
from ...components.fields.hash_field import DENSITY_LAYERS, GEOMETRY_FEATURES, HashField, HashNumbers, side_by_side
from ...components.fields.layers import MLP
from ...components.fields.spaces import Space
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points

BINS = 64  # of each axis of the box of interest, in which seen surfaces are counted
BOX_SHARE = 0.02  # of an instance's seen surface that may lie outside its box, on each side
BOX_MARGIN = 0.03  # of the box of interest's sides, around an instance's box


class ObjectTable(HashField):
    """A hash table of its own, whose density network reads it together with the code."""

    deforms = True

    def __init__(self, numbers: HashNumbers, hidden_width: int, space: Space, reach: float, latent: int):
        super().__init__(numbers, hidden_width, space, reach)
        layers = [hidden_width] * DENSITY_LAYERS
        self.density_network = MLP(numbers.width + latent, *layers, GEOMETRY_FEATURES)

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Tensor]:
        assert code is not None
        return self.decode(points, side_by_side(self.encode(points), code))

    def colour(self, features: Tensor, directions: Directions, code: Codes | None = None) -> Colours:
        return super().colour(features, directions)


class SceneWithout(Field):
    """A scene branch without an instance, so that a sampler passes through its region.

    belongs: mask of points in the instance's region
    """

    def __init__(self, scene: HashField | CoordinateField, belongs: Callable[[Tensor], Tensor]):
        super().__init__()
        self._held = scene, belongs  # in a tuple: the parameters are the scene's
        self.space = scene.space

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Any]:
        scene, belongs = self._held
        density, features = scene.geometry(points)
        return torch.where(belongs(points), 0.0, density), features

    def density(self, points: Points, code: Codes | None = None) -> Densities:
        scene, belongs = self._held
        return torch.where(belongs(points), 0.0, scene.density(points))

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        return self._held[0].colour(features, directions)


class InstanceBoxes(nn.Module):
    """Boxes of instances, from their visible surface points: a histogram along each axis."""

    counts: Tensor

    def __init__(self, instances: int, bounds: tuple[Any, Any]):
        super().__init__()
        self.bounds = bounds
        self.register_buffer("counts", torch.zeros(instances, 3, BINS))

    @torch.no_grad()
    def add(self, points: Float[Tensor, "point 3"], labels: Int[Tensor, " point"]) -> None:
        """Add surface points to the histograms."""
        low, high = points.new_tensor(self.bounds)
        bins = (BINS * (points - low) / (high - low)).floor().long()
        inside = ((bins >= 0) & (bins < BINS)).all(-1)
        bins, labels = bins[inside], labels[inside]
        axis = torch.arange(3, device=bins.device)
        place = ((labels[:, None] * 3 + axis) * BINS + bins).flatten()
        self.counts.view(-1).index_add_(0, place, torch.ones_like(place, dtype=self.counts.dtype))

    @property
    def learnt(self) -> Bool[Tensor, " label"]:
        """Instances with a box."""
        return self.counts[:, 0].sum(-1) > 0

    def box(self, number: int) -> Float[Tensor, "2 3"]:
        """Lower and upper corner around all but a share of an instance's surface."""
        low, high = self.counts.new_tensor(self.bounds)
        shares = self.counts[number].cumsum(-1) / self.counts[number].sum(-1, keepdim=True).clamp_min(1)
        first, last = (shares <= BOX_SHARE).sum(-1), (shares < 1 - BOX_SHARE).sum(-1) + 1
        side = high - low
        return torch.stack([low + side * (first / BINS - BOX_MARGIN), low + side * (last / BINS + BOX_MARGIN)])
