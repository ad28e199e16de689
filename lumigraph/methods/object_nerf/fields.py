"""Object branches: density and colour of one instance, by its code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ...components.fields.coordinate_field import CoordinateField
from ...components.fields.hash_field import DENSITY_LAYERS, GEOMETRY_FEATURES, HashField, HashNumbers, side_by_side
from ...components.fields.layers import MLP
from ...components.fields.spaces import Space
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points

BINS = 64  # of each half of the coordinates along an axis, in which seen surfaces are counted; of all for an object
BOX_SHARE = 0.02  # of an instance's seen surface that may lie outside its box, on each side
BOX_MARGIN = 0.03  # of the sides of the box of interest, around an instance's box


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
    """Boxes of instances in the space's coordinates, from their visible surface points: a histogram along each axis.

    counts: two rows of an instance hold both halves of a contracted space; runs saved before boxes were contracted have
            one row, for the box of interest
    """

    grows: ClassVar[tuple[str, ...]] = ("counts",)
    counts: Tensor

    def __init__(self, instances: int, bounds: tuple[Any, Any], space: Space):
        super().__init__()
        self.instances, self.bounds, self.space = instances, bounds, space
        self.register_buffer("counts", torch.zeros((1 + space.is_open) * instances, 3, BINS))

    @property
    def contracted(self) -> bool:
        return len(self.counts) > self.instances

    def coordinates(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Coordinates of points, in which boxes are."""
        return self.space.warp(points) if self.contracted else points

    def points(self, coordinates: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Points with these coordinates, and scene units in a unit of coordinates there."""
        points = self.space.unwarp(coordinates) if self.contracted else coordinates
        return points, 1 / self.space.stretch(points) if self.contracted else torch.ones_like(points[:, 0])

    def _sides(self) -> tuple[Tensor, Tensor, int]:
        """Lower corner and sides of what the histograms cover, and their bins along an axis."""
        low, high = self.counts.new_tensor(((-1.0,) * 3, (1.0,) * 3) if self.contracted else self.bounds)
        return low, high - low, BINS * len(self.counts) // self.instances

    @torch.no_grad()
    def add(self, points: Float[Tensor, "point 3"], labels: Int[Tensor, " point"]) -> None:
        """Add surface points to the histograms."""
        low, side, count = self._sides()
        bins = (count * (self.coordinates(points) - low) / side).floor().long()
        inside = ((bins >= 0) & (bins < count)).all(-1)
        bins, labels = bins[inside], labels[inside]
        row = labels[:, None] * (count // BINS) + bins // BINS
        place = ((row * 3 + torch.arange(3, device=bins.device)) * BINS + bins % BINS).flatten()
        self.counts.view(-1).index_add_(0, place, torch.ones_like(place, dtype=self.counts.dtype))

    def _counted(self) -> Float[Tensor, "label 3 bin"]:
        return self.counts.unflatten(0, (self.instances, -1)).movedim(1, 2).flatten(2)

    @property
    def learnt(self) -> Bool[Tensor, " label"]:
        """Instances with a box."""
        return self._counted()[:, 0].sum(-1) > 0

    def box(self, number: int) -> Float[Tensor, "2 3"]:
        """Lower and upper corner, in coordinates, around all but a share of an instance's surface."""
        (low, side, count), counted = self._sides(), self._counted()[number]
        shares = counted.cumsum(-1) / counted.sum(-1, keepdim=True).clamp_min(1)
        first, last = (shares <= BOX_SHARE).sum(-1), (shares < 1 - BOX_SHARE).sum(-1) + 1
        return torch.stack(
            [low + side * (end / count + sign * BOX_MARGIN * BINS / count) for end, sign in ((first, -1), (last, 1))]
        )
