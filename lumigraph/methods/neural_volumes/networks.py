"""Networks of Neural Volumes: pictures to a code, a code to a volume and to the affine maps that warp it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import grid_sample, interpolate, softplus

from ... import kernels
from ...geometry import to_matrix

SLOPE = 0.2  # of leaky ReLUs
MEAN_SCALE, DEVIATION_SCALE = 0.1, 0.01  # of the code's mean and log deviation (the authors' release)
COLOUR_SCALE, COLOUR_BIAS = 25.0, 100.0  # of the decoder's colours, which are then out of 255 (the release)
TURN_SCALE, SHIFT_SCALE, GROWTH_SCALE = 0.1, 0.1, 0.05  # of the affine maps' quaternions, shifts and log scales
GLOBAL_SHIFT_SCALE = 0.025  # of the map of the whole volume
MIN_WEIGHT = 1e-3  # of all affine maps together at a place
CELLS, FAINT = 64, 0.01  # along each side of the rough lattice; opacity per unit that is not seen

Code = Float[Tensor, "1 code"]
Volume = Float[Tensor, "x y z 4"]  # colours and opacity per unit of coordinates, whose outermost voxels are at -1 and 1
Lattice = Float[Tensor, "i j k 3"]  # places in the template
CUBE = torch.tensor([[-1.0] * 3, [1.0] * 3])


class Decoded(NamedTuple):
    """Decoded volume of a time. rough: opacity on a coarse lattice, which skips faint regions; None: no skipping"""

    code: Code
    volume: Volume
    warp: Lattice | None
    rough: Float[Tensor, "u v w 1"] | None = None


def dense(*widths: int) -> nn.Sequential:
    """Layers with leaky ReLUs between them."""
    layers = [nn.Linear(a, b) for a, b in zip(widths, widths[1:], strict=False)]
    for layer in layers:
        scaled(layer, layer is layers[-1])
    return nn.Sequential(*(x for layer in layers[:-1] for x in (layer, nn.LeakyReLU(SLOPE))), layers[-1])


def scaled(layer: nn.Module, last: bool = False) -> nn.Module:
    """Glorot initialisation (2010) for the slope of the next activation, zero biases. last: no activation follows"""
    gain = 1.0 if last else nn.init.calculate_gain("leaky_relu", SLOPE)
    nn.init.xavier_uniform_(layer.weight, gain)  # type: ignore[arg-type]
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


class Encoder(nn.Module):
    """Mean and log deviation of a code from pictures of a moment, a convolutional network for each camera.

    Each layer halves the pictures, down to 4 x 4; channels double at every other one, up to 4 times `width`.
    """

    def __init__(self, cameras: int, side: int, width: int, code: int):
        super().__init__()
        halvings = int(math.log2(side)) - 2
        channels = [3, *(width * 2 ** min(i // 2, 2) for i in range(halvings))]
        self.cameras = nn.ModuleList(
            nn.Sequential(
                *(
                    x
                    for a, b in zip(channels, channels[1:], strict=False)
                    for x in (scaled(nn.Conv2d(a, b, 4, 2, 1)), nn.LeakyReLU(SLOPE))
                )
            )
            for _ in range(cameras)
        )
        self.joint = nn.Sequential(scaled(nn.Linear(16 * channels[-1] * cameras, 2 * code)), nn.LeakyReLU(SLOPE))
        self.mean, self.deviation = (scaled(nn.Linear(2 * code, code), True) for _ in range(2))

    def forward(self, pictures: Float[Tensor, "moment camera 3 side side"]) -> tuple[Tensor, Tensor]:
        seen = [network(pictures[:, i]).flatten(1) for i, network in enumerate(self.cameras)]
        joint = self.joint(torch.cat(seen, 1))
        return MEAN_SCALE * self.mean(joint), DEVIATION_SCALE * self.deviation(joint)


class TemplateVolume(nn.Module):
    """A volume from numbers, by transposed convolutions that double it, from one voxel up."""

    def __init__(self, inputs: int, outputs: int, side: int, width: int):
        super().__init__()
        self.first = nn.Sequential(scaled(nn.Linear(inputs, width)), nn.LeakyReLU(SLOPE))
        layers: list[nn.Module] = []
        a, b = width, width // 2
        for _ in range(int(math.log2(side)) - 1):
            layers += [scaled(nn.ConvTranspose3d(a, b, 4, 2, 1)), nn.LeakyReLU(SLOPE)]
            a, b = (a, a // 2) if a == b else (b, b)
        self.layers = nn.Sequential(*layers, scaled(nn.ConvTranspose3d(a, outputs, 4, 2, 1), True))

    def forward(self, numbers: Float[Tensor, "1 input"]) -> Float[Tensor, "1 output side side side"]:
        return self.layers(self.first(numbers)[..., None, None, None])


class Affine(nn.Module):
    """Affine maps of a code: x to s R (x - t), the identity at first but for small numbers."""

    def __init__(self, code: int, maps: int, width: int, shift_scale: float):
        super().__init__()
        self.turn, self.growth, self.shift = (dense(code, width, n * maps) for n in (4, 3, 3))
        self.shift_scale = shift_scale

    def forward(self, code: Code, places: Float[Tensor, "*n 3"]) -> Float[Tensor, "map *n 3"]:
        still = code.new_tensor([1.0, 0.0, 0.0, 0.0])
        rotation = to_matrix(still + TURN_SCALE * self.turn(code).view(-1, 4))
        growth = (GROWTH_SCALE * self.growth(code).view(-1, 3)).exp()
        shift = self.shift_scale * self.shift(code).view(-1, 3)
        flat = places.reshape(1, -1, 3) - shift[:, None]
        return (growth[:, None] * (flat @ rotation.mT)).view(len(growth), *places.shape)


class AffineMixture(nn.Module):
    """Inverse warp of a volume: a mixture of affine maps A_i, whose weights w_i lie in the template (section 5.2):

    W^-1(x) = sum_i a_i(x) A_i(x),    a_i(x) = w_i(A_i(x)) / sum_j w_j(A_j(x))
    """

    places: Tensor

    def __init__(self, code: int, maps: int, side: int, width: int):
        super().__init__()
        self.maps = Affine(code, maps, width, SHIFT_SCALE)
        self.weights, self.side = dense(code, width // 2, maps * side**3), side
        self.register_buffer("places", lattice(side), persistent=False)

    def forward(self, code: Code) -> Lattice:
        moved = self.maps(code, self.places)  # (map, x, y, z, 3)
        weights = self.weights(code).view(len(moved), 1, self.side, self.side, self.side).exp()
        there = grid_sample(weights, moved, padding_mode="border", align_corners=True)[:, 0, ..., None]
        return (there * moved).sum(0) / there.sum(0).clamp_min(MIN_WEIGHT)


def lattice(side: int) -> Float[Tensor, "side side side 3"]:
    """Coordinates in [-1, 1] of a cube's cells."""
    line = torch.linspace(-1, 1, side)
    return torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1)


class VolumeDecoder(nn.Module):
    """TemplateVolume volume, inverse warp and the affine map of the whole from a code (section 4.2).

    shared: voxels along each side of a volume that is added to the decoded one at every moment; 0: none
    viewed: colours depend on the camera's direction too; opacity does not
    """

    def __init__(
        self, code: int, side: int, width: int, maps: int, warp_side: int, warp_width: int, shared: int, viewed: bool
    ):
        super().__init__()
        if viewed:
            self.colour: TemplateVolume | None = TemplateVolume(code + 3, 3, side, width)
            self.template = TemplateVolume(code, 1, side, width)
        else:
            self.colour, self.template = None, TemplateVolume(code, 4, side, width)
        self.warp = AffineMixture(code, maps, warp_side, warp_width) if maps else None
        self.whole = Affine(code, 1, warp_width, GLOBAL_SHIFT_SCALE)
        self.shared = nn.Parameter(torch.zeros(1, 4, shared, shared, shared)) if shared else None

    def forward(self, code: Code, toward: Float[Tensor, " 3"]) -> tuple[Volume, Lattice | None]:
        """toward: unit direction from the volume to the camera"""
        raw = self.template(code)
        if self.colour is not None:
            raw = torch.cat([self.colour(torch.cat([code, toward[None]], 1)), raw], 1)
        if self.shared is not None:
            raw = self.shared + interpolate(raw, self.shared.shape[2:], mode="trilinear")
        raw = raw[0].movedim(0, -1)
        colour = softplus(COLOUR_BIAS + COLOUR_SCALE * raw[..., :3]) / 255
        return torch.cat([colour, softplus(raw[..., 3:])], -1), None if self.warp is None else self.warp(code)

    @torch.no_grad()
    def with_rough(self, decoded: Decoded) -> Decoded:
        """The same with opacity on a coarse lattice."""
        opacity = decoded.volume[..., 3:]
        if len(opacity) > CELLS:  # so that no voxel lies unseen between places of the lattice
            opacity = interpolate(opacity.movedim(-1, 0)[None], (CELLS,) * 3, mode="area")[0].movedim(0, -1)
        places = lattice(CELLS).to(opacity)
        return decoded._replace(
            rough=sampled(opacity, self.warped(decoded, places.view(-1, 3))).view(*places.shape[:3], 1)
        )

    def look_up(
        self, decoded: Decoded, places: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Opacity per unit and colour at points: of the template at their positions under the global affine map and the
        warp; zero outside of [-1, 1]^3."""
        inside = (places.abs() <= 1).all(-1)
        if decoded.rough is None:
            found = sampled(decoded.volume, self.warped(decoded, places))
            return torch.where(inside, found[:, 3], 0.0), found[:, :3]
        seen = (inside & (sampled(decoded.rough, places)[:, 0] > FAINT)).nonzero()[:, 0]
        found = places.new_zeros(len(places), 4)
        found[seen] = sampled(decoded.volume, self.warped(decoded, places[seen]))
        return found[:, 3], found[:, :3]

    def warped(self, decoded: Decoded, places: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Positions in the template under the global affine map and the warp."""
        there = self.whole(decoded.code, places)[0]
        return there if decoded.warp is None else sampled(decoded.warp, there)


def sampled(grid: Float[Tensor, "x y z channel"], places: Float[Tensor, "point 3"]) -> Float[Tensor, "point channel"]:
    return kernels.dense_grid(places, grid, CUBE.to(places))


def opacity_roughness(volume: Volume) -> Float[Tensor, ""]:
    """Total variation of the logarithm of a volume's opacity (section 5.4)."""
    log = (1e-5 + volume[..., 3]).log()
    corner = log[:-1, :-1, :-1]
    steps = torch.stack([log[1:, :-1, :-1] - corner, log[:-1, 1:, :-1] - corner, log[:-1, :-1, 1:] - corner])
    return (1e-5 + steps.square().sum(0)).sqrt().mean()


def opacity_prior(opacity: Float[Tensor, " ray"]) -> Float[Tensor, ""]:
    """Smallest for opaque or clear rays: the logarithm of a beta distribution (section 5.4)."""
    return ((0.1 + opacity).log() + (1.1 - opacity).log() - CLEAR).mean()


CLEAR = math.log(0.1) + math.log(1.1)  # of an opacity of 0 or 1


def divergence(mean: Code, log_deviation: Code) -> Float[Tensor, ""]:
    """Kullback-Leibler divergence of a code's distribution from the unit Gaussian, mean over its numbers."""
    return (-0.5 - log_deviation + 0.5 * mean.square() + 0.5 * (2 * log_deviation).exp()).mean()
