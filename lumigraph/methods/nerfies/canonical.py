"""The canonical scene of Nerfies: a field at moved points, in the paper's network or in a hash table."""

from __future__ import annotations

import copy
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...components.fields.coordinate_field import CoordinateField, NetworkNumbers
from ...components.fields.coordinate_network import CoordinateNetwork
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.hash_field import HashField, side_by_side
from ...components.fields.layers import MLP, in_chunks
from ...components.fields.spaces import Space
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points
from .warp import MotionField, SliceField

SLICE_BANDS = 1  # of the encoding of ambient coordinates (Park 2021b, section 5.1)

Ambient = Float[Tensor, "point ambient"]


class SlicedHash(HashField):
    """A hash table whose density network also gets ambient coordinates."""

    def __init__(self, *arguments: Any, ambient: int = 0, **named: Any):
        super().__init__(*arguments, **named)
        if ambient:
            inputs, *widths = [x.shape[1] for x in self.density_network.weights]
            self.density_network = MLP(inputs + ambient, *widths, self.density_network.weights[-1].shape[0])

    def geometry_at(self, points: Points, ambient: Ambient | None) -> tuple[Densities, Any]:
        encoded = self.encode(points)
        return self.decode(points, encoded if ambient is None else side_by_side(encoded, ambient))


class SliceEncoding(nn.Module):
    """Waves of a position beside waves of ambient coordinates."""

    def __init__(self, position: FrequencyEncoding, ambient: int):
        super().__init__()
        self.position, self.ambient = position, FrequencyEncoding(ambient, SLICE_BANDS, base=1.0)
        self.width = self.position.width + self.ambient.width

    def forward(self, coordinates: Tensor, weights: Tensor | None = None) -> Tensor:
        position, ambient = coordinates.split([3, coordinates.shape[1] - 3], 1)
        return torch.cat([self.position(position, weights), self.ambient(ambient)], 1)


class SlicedNetwork(CoordinateField):
    """The paper's network, of positions and ambient coordinates."""

    def __init__(
        self, numbers: NetworkNumbers, hidden_width: int, space: Space, code: int = 0, ambient: int = 0, **named: Any
    ):
        super().__init__(numbers, hidden_width, space, code, **named)
        self.joint = False  # type: ignore[misc]  # features are kept also without an appearance
        if ambient:
            n = numbers
            encoding = SliceEncoding(self.encode_position, ambient)  # type: ignore[arg-type]
            inputs = encoding.width, self.encode_direction.width + code
            self.encode_position = encoding
            self.network = CoordinateNetwork(*inputs, n.depth, hidden_width, n.skip_layer, not n.bfloat16)

    def encode(self, coordinates: Float[Tensor, "point coordinate"]) -> Float[Tensor, "point width"]:
        return self.encode_position(coordinates, self.octave_weights())

    def geometry_at(self, points: Points, ambient: Ambient | None) -> tuple[Densities, Any]:
        coordinates = self.space.warp(points)
        places = coordinates if ambient is None else torch.cat([coordinates, ambient], 1)
        density, features = self.features_at(places)
        return density * self.space.stretch(points), features

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        given = (features, directions) if code is None else (features, directions, code)
        return in_chunks(lambda *x: (self._seen(*x),), *given)[0]


class WarpedField(Field):
    """A field under a deformation: density and colour at the canonical positions of points (Park 2021, eq. 3).

    The code of a point is an appearance of `appearance` numbers, for colour, and the code of a moment, for geometry.
    motion, slice: of the deformation; None without one
    first:         canonical scene of the coarse pass; None for the same
    """

    deforms = True

    def __init__(
        self,
        canonical: SlicedHash | SlicedNetwork,
        motion: MotionField | None,
        ambient: SliceField | None,
        appearance: int,
        first: SlicedNetwork | None = None,
    ):
        super().__init__()
        self.canonical, self.motion, self.ambient, self.first = canonical, motion, ambient, first
        self.appearance = appearance

    @property
    def coarse(self) -> WarpedField | None:
        """The same deformation of the coarse pass's scene."""
        if self.first is None:
            return None
        other = copy.copy(self)
        other._modules = self._modules | {"canonical": self.first, "first": None}
        return other

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Any]:
        assert code is not None, "a deformation needs the code of a moment"
        moment = code[:, self.appearance :]
        canonical = points if self.motion is None else self.motion(points, moment)
        return self.canonical.geometry_at(canonical, None if self.ambient is None else self.ambient(points, moment))

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        shown = None if code is None or not self.appearance else code[:, : self.appearance]
        return self.canonical.colour(features, directions, shown)
