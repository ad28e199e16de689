"""Field: density and colour of a scene at points."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

from jaxtyping import Float
from torch import Tensor

from .part import Part

Points = Float[Tensor, "point 3"]  # in the scene
Directions = Float[Tensor, "point 3"]  # unit length
Colours = Float[Tensor, "point 3"]  # sRGB-encoded
Densities = Float[Tensor, " point"]  # per scene unit
Codes = Float[Tensor, "point code"]
Features = Tensor | tuple[Tensor, ...]  # of points, one row each: what `Field.colour` takes of `Field.geometry`


class Field(Part):
    """Density and colour at points, in two steps: a sampler needs density at many points and colour at few.

    A code is a row of numbers for each point on which colour, or with `deforms` geometry too, depends: an appearance, a
    time, a shape. A field without one ignores it. Fields compose: a field under a deformation is a field.

    deforms:       whether geometry depends on the code
    cheap_density: whether density is a mere look-up, so that a sampler evaluates it at all samples at once
    joint:         whether density and colour come from one look-up, so that calling the field costs less than
                   `geometry` and then `colour`
    """

    deforms: ClassVar[bool] = False
    cheap_density: ClassVar[bool] = False
    joint: ClassVar[bool] = False

    @abstractmethod
    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Features]:
        """Density per scene unit, and features for `colour`."""

    @abstractmethod
    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        """sRGB-encoded colour seen along unit directions. features: from `geometry`"""

    def density(self, points: Points, code: Codes | None = None) -> Densities:
        """Density per scene unit."""
        return self.geometry(points, code)[0]

    def forward(self, points: Points, directions: Directions, code: Codes | None = None) -> tuple[Densities, Colours]:
        """Density per scene unit and sRGB-encoded colour."""
        density, features = self.geometry(points, code)
        return density, self.colour(features, directions, code)

    @property
    def step_length(self) -> float:
        """Sample length, in the field's coordinates, that resolves its grid."""
        raise NotImplementedError(f"{type(self).__name__} has no grid, so a sampler needs a step length of its own")

    @property
    def min_weight(self) -> float | None:
        """Compositing weight below which a sample gets no colour; None if every sample gets one."""
        return None
