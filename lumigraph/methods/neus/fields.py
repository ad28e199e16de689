"""Signed distance fields whose zero level is the surface: the paper's network, and a hash table with small networks."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import logsigmoid, normalize
from torch.nn.utils.parametrizations import weight_norm

from ... import kernels
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.hash_field import HashField, HashNumbers, Joining
from ...components.fields.spaces import Box
from ...files.ranges import Depth, Octaves
from ...geometry import Vector
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points

INITIAL_DEVIATION = 0.3  # v, the learnt number at first: s = exp(10 v) is 20 per scene unit
SOFTPLUS_BETA = 100.0  # of the distance network's activations, section E.1
MAX_SHARPNESS = 1.3  # s times the finest cell of a hash table: a steeper surface falls between its places
EXTENT = 1.1  # half-size of the cube that the hash table covers: taps beyond the box of interest stay inside
TETRAHEDRON = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))  # corners, times sqrt(3)
SKIP_LAYER = 4  # layer whose activation the input is concatenated to again
COLOUR_DEPTH = 4  # hidden layers of the colour network
DIRECTION_FREQUENCIES = 4  # octaves of directions for colour


@dataclass(frozen=True)
class DistanceNumbers:
    """A Config's numbers of the distance and colour networks; the paper's (Wang 2021, section E.1)."""

    depth: Depth = 8  # hidden layers of the distance network; more hold more detail, and cost time
    position_frequencies: Octaves = 6  # octaves of positions for the distance; more give finer detail, and noise


class Surface(NamedTuple):
    """A distance field at points.

    distance:  f, scene units, negative inside
    gradient:  of the distance by the point
    features:  inputs of the colour network
    laplacian: sum of second derivatives; None if unknown
    """

    distance: Float[Tensor, " point"]
    gradient: Float[Tensor, "point 3"]
    features: Float[Tensor, "point feature"]
    laplacian: Float[Tensor, " point"] | None = None


class DistanceField(nn.Module, ABC):
    """Signed distance f and colour at points. It begins as the distance to a sphere.

    centre, radius: of that sphere
    sign:           1 for a sphere that is solid, -1 for one that is hollow in a solid world: a room
    """

    centre: Tensor
    radius: Tensor
    sign: Tensor
    finest_cell = 0.0  # scene units, of a table that holds it; 0 for a network

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("centre", torch.zeros(3))
        self.register_buffer("radius", torch.tensor(0.5))
        self.register_buffer("sign", torch.tensor(1.0))

    def begin_as(self, centre: Float[Tensor, " 3"], radius: float, hollow: bool) -> None:
        """Set the initial sphere, before the first step."""
        self.centre.copy_(centre)
        self.radius.fill_(radius)
        self.sign.fill_(-1.0 if hollow else 1.0)

    @abstractmethod
    def distance(self, points: Points) -> Float[Tensor, " point"]:
        """Signed distance alone."""

    @abstractmethod
    def surface(self, points: Points) -> Surface:
        """Distance, its gradient, and features for `shade`."""

    @abstractmethod
    def shade(self, points: Points, surface: Surface, directions: Directions) -> Colours:
        """sRGB-encoded colour seen along unit directions."""


class NetworkDistance(DistanceField):
    """The paper's networks: f and 256 features from a position; colour from position, gradient, direction, features.

    Initialised so that f is about |x| - radius (Atzmon 2020, theorem 1): the waves of the encoding have weight 0, so
    each layer keeps the norm of its input on average, and the last one takes the mean of its inputs.
    """

    def __init__(self, numbers: DistanceNumbers, width: int):
        super().__init__()
        n = numbers
        self.encode_position = FrequencyEncoding(3, n.position_frequencies, base=1.0)
        self.encode_direction = FrequencyEncoding(3, DIRECTION_FREQUENCIES, base=1.0)
        inputs, self.skip = self.encode_position.width, min(SKIP_LAYER, n.depth - 1)
        narrow = max(width - inputs, 1)  # the layer before the skip: with the input again it has the usual width
        self.activation = nn.Softplus(SOFTPLUS_BETA)
        layers = []
        for i in range(n.depth):
            before = inputs if i == 0 else narrow + inputs if i == self.skip else width
            waves = inputs - 3 if i in (0, self.skip) else 0
            layers.append(geometric(nn.Linear(before, narrow if i == self.skip - 1 else width), waves))
        self.layers = nn.ModuleList(weight_norm(layer) for layer in layers)
        last = nn.Linear(width, 1 + width)
        nn.init.normal_(last.weight, math.sqrt(math.pi / width), 1e-4)
        nn.init.zeros_(last.bias)
        self.last = weight_norm(last)
        widths = [3 + 3 + self.encode_direction.width + width, *[width] * COLOUR_DEPTH, 3]
        colour = [weight_norm(nn.Linear(a, b)) for a, b in zip(widths[:-1], widths[1:], strict=True)]
        self.colour = nn.Sequential(*[x for layer in colour for x in (layer, nn.ReLU())][:-1])

    def begin_as(self, centre, radius, hollow):
        super().begin_as(centre, radius, hollow)
        with torch.no_grad():
            self.last.bias.fill_(-radius)

    def outputs(self, points: Points) -> Float[Tensor, "point output"]:
        """Distance and features."""
        encoded = h = self.encode_position(points - self.centre)
        for i, layer in enumerate(self.layers):
            if i == self.skip:
                h = torch.cat([h, encoded], -1) / math.sqrt(2)
            h = self.activation(layer(h))
        return self.last(h)

    def distance(self, points):
        return self.sign * self.outputs(points)[:, 0]

    def surface(self, points):
        learns = torch.is_grad_enabled()
        with torch.enable_grad():
            points = points.detach().requires_grad_()
            out = self.outputs(points)
            distance = self.sign * out[:, 0]
            (gradient,) = torch.autograd.grad(distance.sum(), points, create_graph=learns)
        found = distance, gradient, out[:, 1:]
        return Surface(*found) if learns else Surface(*(x.detach() for x in found))

    def shade(self, points, surface, directions):
        seen = self.encode_direction(directions)
        inputs = torch.cat([points - self.centre, surface.gradient, seen, surface.features], -1)
        return self.colour(inputs).sigmoid()


def geometric(layer: nn.Linear, waves: int) -> nn.Linear:
    """A hidden layer that keeps the norm of its input on average (Atzmon 2020). waves: last inputs of weight 0"""
    nn.init.normal_(layer.weight, 0.0, math.sqrt(2 / layer.out_features))
    nn.init.zeros_(layer.bias)
    with torch.no_grad():
        layer.weight[:, layer.in_features - waves :] = 0
    return layer


class HashDistance(DistanceField):
    """Signed distance to a sphere plus a hash table's correction.

        f(x) = sign (|x - centre| - radius) + g(x)

    The gradient is numerical (Li 2023, Neuralangelo, section 3.2): the kernel of the hash table has no second
    derivative, and differences over a cell also reach its neighbours' entries. Differences at the four corners of a
    tetrahedron suffice (instead of six along the axes). Their mean gives the Laplacian. The step is a cell of the
    finest active level.
    """

    corners: Tensor

    def __init__(self, numbers: HashNumbers, width: int, joining: Joining | None):
        super().__init__()
        whole = ((-EXTENT,) * 3, (EXTENT,) * 3)
        self.table = HashField(numbers, width, Box(whole, 0.0), EXTENT, code=3, joining=joining)
        self.register_buffer("corners", torch.tensor(TETRAHEDRON) / math.sqrt(3), persistent=False)
        self.finest_cell = 2 * EXTENT / self.table.levels.resolutions[-1]

    @property
    def tap_distance(self) -> float:
        """Scene units between a point and the taps of its gradient."""
        levels = self.table.levels
        weights = self.table.joining(levels.levels) if self.table.joining else None
        finest = levels.levels if weights is None else int((weights > 0).sum())
        return 2 * EXTENT / levels.resolutions[finest - 1]

    def begun(self, points: Points) -> Float[Tensor, " point"]:
        """Distance to the initial sphere."""
        return self.sign * ((points - self.centre).norm(dim=-1) - self.radius)

    def added(self, encoded: Float[Tensor, "point width"]) -> Float[Tensor, " point"]:
        """Correction g(x) of the table and its network, without features."""
        *hidden, last = self.table.density_network.weights
        return kernels.perceptron(encoded, *hidden, last[:1].contiguous())[:, 0]

    def distance(self, points):
        return self.begun(points) + self.added(self.table.encode(points))

    def surface(self, points):
        count, step = len(points), self.tap_distance
        taps = (points + step * self.corners[:, None]).view(-1, 3)
        encoded = self.table.encode(torch.cat([points, taps]))
        geometry = self.table.density_network(encoded[:count])
        distance = self.begun(points) + geometry[:, 0]
        around = (self.begun(taps) + self.added(encoded[count:])).view(4, count)
        gradient = around.t() @ self.corners * (0.75 / step)
        return Surface(distance, gradient, geometry, (around.mean(0) - distance) * (6 / step**2))

    def shade(self, points, surface, directions):
        return self.table.colour(surface.features, directions, normalize(surface.gradient, dim=-1))


class NeuSField(Field):
    """Density and colour from a signed distance in a box, and a field of density around it, if there is one.

    bounds:   of the box, in which the distance holds
    outside:  field of all else; None where nothing is
    margin:   scene units around the surface, in which a mask of empty space sees density
    annealed: share a of the way from the slope's half to the slope itself; see `thickness`

    s is bounded where a table holds the distance. Unbounded it ran away: once a surface is thinner than the sections,
    a ray has one section, and nothing is learnt beside it.
    """

    joint = True
    box: Tensor

    def __init__(
        self,
        shape: DistanceField,
        bounds: tuple[Vector, Vector],
        outside: Field | None = None,
        margin: float = 0.0,
        annealed: Any = None,
    ):
        super().__init__()
        self.shape, self.outside, self.margin, self._annealed = shape, outside, margin, annealed
        self.deviation = nn.Parameter(torch.tensor(INITIAL_DEVIATION))
        self.max_sharpness = MAX_SHARPNESS / shape.finest_cell if shape.finest_cell else math.inf
        self.register_buffer("box", torch.tensor(bounds), persistent=False)

    @property
    def sharpness(self) -> Float[Tensor, ""]:
        """s, the inverse deviation of the logistic density around the surface, per scene unit."""
        return (10 * self.deviation).exp().clamp_max(self.max_sharpness)

    def thickness(
        self,
        distance: Float[Tensor, "*n"],
        slope: Float[Tensor, "*n"],
        length: Float[Tensor, "*n"],
        sharpness: Tensor | float | None = None,
    ) -> Float[Tensor, "*n"]:
        """Optical thickness of sections with unbiased weights, -log(1 - alpha) (Wang 2021, eq. 13).

            alpha_i = max((Phi_s(f_i) - Phi_s(f_i+1)) / Phi_s(f_i), 0),   Phi_s(f) = 1 / (1 + exp(-s f))

        distance:  f in the middle of each section
        slope:     derivative of f along the ray: f_i and f_i+1 are half a length of it away
        sharpness: s; None for the learnt one
        A section counts where f falls. At first one that the ray passes at an angle counts as if it faced the ray:
        the slope m is -(1 - a) max(1/2 - m/2, 0) - a max(-m, 0), where a grows to 1.
        """
        s, a = self.sharpness if sharpness is None else sharpness, self.annealed
        falls = a * (-slope).clamp_min(0) + ((1 - a) * (0.5 - 0.5 * slope).clamp_min(0) if a < 1 else 0)
        half = 0.5 * falls * length
        return logsigmoid(s * (distance + half)) - logsigmoid(s * (distance - half))

    @property
    def annealed(self) -> float:
        return 1.0 if self._annealed is None else float(self._annealed.joined)

    # At points

    def distance(self, points: Points) -> Float[Tensor, " point"]:
        """Signed distance in scene units; outside the box that of its nearest point plus the distance to it."""
        within = self.within(points)
        return self.shape.distance(within) + (points - within).norm(dim=-1)

    def within(self, points: Points) -> Points:
        """The nearest points of the box."""
        return points.maximum(self.box[0]).minimum(self.box[1])

    def facing_density(self, distance: Float[Tensor, " point"]) -> Float[Tensor, " point"]:
        """Density where a ray meets the surface at right angles, s Phi_s(-f) (eq. 10 with a slope of -1)."""
        return self.sharpness * torch.sigmoid(-self.sharpness * distance)

    def density_at(self, coordinates: Points) -> Densities:
        """Density for a mask of empty space: maximal within the margin around the surface."""
        return self.facing_density(self.shape.distance(coordinates) - self.margin)

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, tuple[Points]]:
        """Density; the points themselves are the features."""
        return self.density(points), (points,)

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        return self(*features, directions)[1]

    def density(self, points: Points, code: Codes | None = None) -> Densities:
        inside = (points == self.within(points)).all(-1)
        density = self.facing_density(self.shape.distance(self.within(points))) * inside
        return density if self.outside is None else torch.where(inside, density, self.outside.density(points))

    def forward(self, points: Points, directions: Directions, code: Codes | None = None) -> tuple[Densities, Colours]:
        inside = (points == self.within(points)).all(-1)
        surface = self.shape.surface(self.within(points))
        density = self.facing_density(surface.distance) * inside
        rgb = self.shape.shade(points, surface, directions)
        if self.outside is None:
            return density, rgb
        around = self.outside(points, directions)
        return torch.where(inside, density, around[0]), torch.where(inside[:, None], rgb, around[1])
