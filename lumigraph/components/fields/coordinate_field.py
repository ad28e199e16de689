"""Fields in the weights of a coordinate network: of points (Mildenhall 2020), of conical frustums (Barron 2021)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import softplus

from ...files.ranges import Depth, Layers, Octaves
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points
from .coordinate_network import CoordinateNetwork
from .encodings import FrequencyEncoding, IntegratedEncoding
from .hash_field import Joining
from .layers import in_chunks
from .spaces import Space

DIRECTION_FREQUENCIES = 4  # L for directions, section 5.1

Places = tuple[Tensor, ...]  # what is encoded: coordinates of points, or means and variances of frustums
Activation = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class NetworkNumbers:
    """A Config's numbers of a coordinate network; the paper's (Mildenhall 2020)."""

    depth: Depth = 8  # hidden layers before density, appendix A; more hold more detail, and cost time
    skip_layer: Layers = 5  # layer whose activation the input is concatenated to again, figure 7
    position_frequencies: Octaves = 10  # L for positions, section 5.1; more give finer detail, and noise
    bfloat16: bool = True  # multiply in bfloat16 where the processor is fast at it; off: float32, slower

    def activation_bytes(self, samples: int, hidden_width: int) -> int:
        """Lower bound of the bytes of a step's activations that are kept for gradients."""
        return 2 * samples * self.depth * hidden_width


class CoordinateField(Field):
    """Density from position; colour from position, direction and a code (Mildenhall 2020, figure 7).

    Without a code, density and colour are evaluated together, in cache-sized chunks of samples. With one, features of
    all samples are kept, so that colours with several codes need one evaluation.

    numbers, hidden_width: of the network
    space:      defines the network's coordinates
    code:       width of a code, input of the colour beside the direction, such as an appearance embedding
    joining:    coarse-to-fine weights of the octaves; None for no schedule
    keep_input: concatenate the raw input with its octaves
    activation: density per unit of the coordinates from the network's output
    noise:      deviation of noise added to raw density in training
    head:       channels of the hidden colour layers; one of half the width by default
    coarse:     field of the coarse pass; None for this one
    latent:     width of a further input of the network, see `LatentField`
    """

    coarse: CoordinateField | None

    def __init__(
        self,
        numbers: NetworkNumbers,
        hidden_width: int,
        space: Space,
        code: int = 0,
        joining: Joining | None = None,
        keep_input: bool = False,
        activation: Activation = torch.relu,
        noise: float = 0.0,
        head: Sequence[int] = (),
        coarse: CoordinateField | None = None,
        latent: int = 0,
    ):
        super().__init__()
        self.numbers, self.space, self.joining = numbers, space, joining
        self.activation, self.noise, self.coarse = activation, noise, coarse
        self.joint = not code  # type: ignore[misc]  # of an instance
        self.encode_position, self.encode_direction = self.encodings(keep_input)
        inputs = self.encode_position.width + latent, self.encode_direction.width + code  # type: ignore[operator]
        shape = numbers.depth, hidden_width, numbers.skip_layer
        self.network = CoordinateNetwork(*inputs, *shape, not numbers.bfloat16, head)  # type: ignore[arg-type]

    @classmethod
    def twice(cls, *arguments: Any, **named: Any) -> CoordinateField:
        """A field, with another of the same sizes for the coarse pass."""
        return cls(*arguments, **named | {"coarse": cls(*arguments, **named)})

    def encodings(self, keep_input: bool) -> tuple[nn.Module, FrequencyEncoding]:
        """Encodings of places and of directions."""
        n = self.numbers
        return (
            FrequencyEncoding(3, n.position_frequencies, keep_input),
            FrequencyEncoding(3, DIRECTION_FREQUENCIES, keep_input),
        )

    def encode(self, coordinates: Float[Tensor, "place 3"]) -> Float[Tensor, "place width"]:
        """The network's input at places."""
        return self.encode_position(coordinates, self.octave_weights())

    def octave_weights(self) -> Float[Tensor, " octave"] | None:
        """Coarse-to-fine weights of the octaves; None when all are 1."""
        return self.joining(self.numbers.position_frequencies) if self.joining else None

    def activated(self, raw: Float[Tensor, "place 3"]) -> Float[Tensor, "place 3"]:
        """sRGB-encoded colour of the network's output."""
        return raw.sigmoid()

    def optimizers_at(self, learning_rate: float, groups: Iterable[dict[str, Any]] = ()) -> list[torch.optim.Optimizer]:
        """Adam for the networks of both passes (Mildenhall 2020's release). groups: further groups of parameters"""
        return [torch.optim.Adam([{"params": list(self.parameters())}, *groups], learning_rate, eps=1e-7)]

    # At places on rays: density per unit of the coordinates

    def density_at(
        self, *places: Tensor, where: Bool[Tensor, " place"] | None = None, generator: torch.Generator | None = None
    ) -> Float[Tensor, " place"]:
        """Density alone. where: mask of places to evaluate; zero elsewhere. generator: of the noise in training"""
        return in_chunks(
            lambda *x: (self._dense(self.network.density(self.encode(*x)), generator),), *places, where=where
        )[0]

    def colours_at(
        self,
        places: Places,
        ray: Int[Tensor, " place"],
        directions: Float[Tensor, "ray 3"],
        where: Bool[Tensor, " place"] | None = None,
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, " place"], Float[Tensor, "place 3"]]:
        """Density and colour, of a field without a code. ray: of each place"""
        views = self.encode_direction(directions)

        def answer(ray: Tensor, *places: Tensor) -> tuple[Tensor, Tensor]:
            raw, rgb = self.network(self.encode(*places), views[ray])
            return self._dense(raw, generator), self.activated(rgb)

        return in_chunks(answer, ray, *places, where=where)  # type: ignore[return-value]

    def features_at(self, *places: Tensor) -> tuple[Float[Tensor, " place"], Float[Tensor, "place width"]]:
        """Density and features for `colour`, of a field with a code."""

        def answer(*places: Tensor) -> tuple[Tensor, Tensor]:
            raw, feature = self.network.geometry(self.encode(*places))
            return self.activation(raw), feature

        return in_chunks(answer, *places)  # type: ignore[return-value]

    def _dense(self, raw: Float[Tensor, " place"], generator: torch.Generator | None) -> Float[Tensor, " place"]:
        if self.noise and generator is not None:
            raw = raw + self.noise * torch.randn(len(raw), generator=generator).to(raw.device)
        return self.activation(raw)

    # At points

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Tensor | Places]:
        """Density per scene unit; features, without a code the places themselves."""
        coordinates = self.space.warp(points)
        if self.joint:
            return self.density(points), (coordinates,)
        density, features = self.features_at(coordinates)
        return density * self.space.stretch(points), features

    def colour(self, features: Tensor | Places, directions: Directions, code: Codes | None = None) -> Colours:
        if self.joint:
            assert isinstance(features, tuple)
            return self.colours_at(features, torch.arange(len(directions), device=directions.device), directions)[1]
        assert code is not None
        if isinstance(features, tuple):  # of a pass: with the encoding of each ray's direction
            return in_chunks(lambda *x: (self._coloured(*x),), *features, code)[0]
        return in_chunks(lambda *x: (self._seen(*x),), features, directions, code)[0]

    def density(self, points: Float[Tensor, "point 3"], code: Tensor | None = None) -> Float[Tensor, " point"]:
        return self.density_at(self.space.warp(points)) * self.space.stretch(points)

    def forward(self, points: Points, directions: Directions, code: Codes | None = None) -> tuple[Densities, Colours]:
        def answer(x: Tensor, *seen: Tensor) -> tuple[Tensor, Tensor]:
            raw, feature = self.network.geometry(self.encode(x))
            return self.activation(raw), self._seen(feature, *seen)

        given = (directions,) if code is None else (directions, code)
        density, rgb = in_chunks(answer, self.space.warp(points), *given)
        return density * self.space.stretch(points), rgb

    def _seen(self, feature: Tensor, directions: Tensor, *code: Tensor) -> Float[Tensor, "point 3"]:
        return self._coloured(feature, self.encode_direction(directions), *code)

    def _coloured(self, feature: Tensor, view: Tensor, *code: Tensor) -> Float[Tensor, "point 3"]:
        return self.activated(self.network.seen(feature, torch.cat([view, *code], -1)))


class LatentField(CoordinateField):
    """Density and colour under a latent code, which comes first in the code. latent: its width"""

    deforms = True
    density, forward = Field.density, Field.forward  # by `geometry`

    def __init__(self, *arguments: Any, latent: int, **named: Any):
        super().__init__(*arguments, **named | {"latent": latent})
        self.latent, self.joint = latent, False  # type: ignore[misc]

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Tensor]:
        assert code is not None

        def answer(x: Tensor, latent: Tensor) -> tuple[Tensor, Tensor]:
            raw, feature = self.network.geometry(torch.cat([self.encode(x), latent], -1))
            return self.activation(raw), feature

        density, features = in_chunks(answer, self.space.warp(points), code[:, : self.latent])
        return density * self.space.stretch(points), features

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        assert code is not None
        return in_chunks(lambda *x: (self._seen(*x),), features, directions, code[:, self.latent :])[0]


POINT_VARIANCE = (2 / 128) ** 2 / 12  # of points, a cell's of a grid of 128: photographs show nothing smaller
COLOUR_PADDING = 0.001  # by which colours may exceed 0 and 1, so that both are within reach of the sigmoid


def shifted_softplus(raw: Tensor) -> Tensor:
    """Density of the network's output (Barron 2021, section 3.3)."""
    return softplus(raw - 1)


class FrustumField(CoordinateField):
    """Density and colour of conical frustums; of points, as of a small volume around each.

    padding: range of colours beyond 0 and 1
    """

    def __init__(self, *arguments: Any, padding: float = COLOUR_PADDING, **named: Any):
        super().__init__(*arguments, **named)
        self.activation, self.padding = shifted_softplus, padding

    def encodings(self, keep_input: bool) -> tuple[IntegratedEncoding, FrequencyEncoding]:
        n = self.numbers
        return IntegratedEncoding(3, n.position_frequencies), FrequencyEncoding(3, DIRECTION_FREQUENCIES, base=1.0)

    def encode(
        self, means: Float[Tensor, "place 3"], variances: Float[Tensor, "place 3"] | None = None
    ) -> Float[Tensor, "place width"]:
        variances = torch.full_like(means, POINT_VARIANCE) if variances is None else variances
        return self.encode_position(means, variances, self.octave_weights())

    def activated(self, raw: Float[Tensor, "place 3"]) -> Float[Tensor, "place 3"]:
        return raw.sigmoid() * (1 + 2 * self.padding) - self.padding if self.padding else raw.sigmoid()
