"""Networks of SRN: layers that a hypernetwork makes of a code, the learnt ray marcher, the pixel generator."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import layer_norm

HYPER_SCALE = 0.1  # of the hypernetwork's last weights at first, of those that He 2015 draws
GRADIENT_LIMIT = 10.0  # of the marcher's state, at each step and in each number

Layer = tuple[Float[Tensor, "_ _ _"], Float[Tensor, "_ 1 _"]]  # weights (member, output, input), and biases
Features = Float[Tensor, "member ray feature"]


def perceptron(*widths: int, normalised: bool = True) -> nn.Sequential:
    """Linear layers, each with layer normalisation and ReLU but for the last one, unless that is `normalised` too."""
    layers = [x for a, b in pairwise(widths) for x in (nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU())]
    return nn.Sequential(*(layers if normalised else layers[:-2]))


class SceneHyperNetwork(nn.Module):
    """Psi: codes to the layers of Phi, each by a perceptron of its own (Sitzmann 2019, section 3.3, eq. 5).

    widths: of Phi, inputs first
    hidden: hidden layers of a perceptron, each as wide as the code
    """

    def __init__(self, code: int, widths: tuple[int, ...], hidden: int):
        super().__init__()
        self.widths = widths
        self.layers = nn.ModuleList(
            perceptron(*[code] * (hidden + 1), a * b + b, normalised=False) for a, b in pairwise(widths)
        )
        for layer in self.layers:
            last = layer[-1]  # type: ignore[index]
            nn.init.kaiming_normal_(last.weight, nonlinearity="relu")
            with torch.no_grad():
                last.weight.mul_(HYPER_SCALE)

    def forward(self, codes: Float[Tensor, "member code"]) -> list[Layer]:
        made = []
        for layer, (a, b) in zip(self.layers, pairwise(self.widths), strict=True):
            weights, biases = layer(codes).split([a * b, b], -1)
            made.append((weights.unflatten(-1, (b, a)), biases[:, None]))
        return made


def scene_features(layers: list[Layer], points: Float[Tensor, "member ray 3"]) -> Features:
    """Phi(x): features of points of each member's scene (eq. 1), by layers with normalisation and ReLU."""
    x = points
    for weights, biases in layers:
        x = layer_norm(torch.baddbmm(biases, x, weights.transpose(1, 2)), [weights.shape[1]]).relu()
    return x


class RayMarcher(nn.Module):
    """An LSTM that finds each ray's surface (algorithm 1): from the features Phi it predicts the next step's length.

    (h, c)_i+1 = LSTM(Phi(x_i), (h, c)_i),    d_i+1 = d_i + w . h_i+1 + b,    x_i+1 = o + d_i+1 r
    """

    def __init__(self, features: int, state: int, steps: int):
        super().__init__()
        self.steps = steps
        self.cell, self.length = nn.LSTMCell(features, state), nn.Linear(state, 1)
        nn.init.kaiming_normal_(self.cell.weight_ih)
        nn.init.orthogonal_(self.cell.weight_hh)
        for bias in (self.cell.bias_ih, self.cell.bias_hh):
            nn.init.zeros_(bias)
            nn.init.ones_(bias[state : 2 * state])  # of the forget gate: it remembers at first

    def forward(
        self,
        layers: list[Layer],
        origins: Float[Tensor, "member ray 3"],
        directions: Float[Tensor, "member ray 3"],
        start: Float[Tensor, "member ray"],
    ) -> Float[Tensor, "member ray"]:
        """Distances along rays, from those at which they start."""
        distance, state = start, None
        for _ in range(self.steps):
            seen = scene_features(layers, origins + distance[..., None] * directions)
            state = self.cell(seen.flatten(0, 1), state)
            if state[0].requires_grad:
                state[0].register_hook(lambda x: x.clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT))
            distance = distance + self.length(state[0]).view_as(distance)
        return distance
