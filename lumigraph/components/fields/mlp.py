"""A small multilayer perceptron as a module."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels


class MLP(nn.Module):
    """`kernels.perceptron` with weights of its own: MLP(inputs, hidden, ..., outputs)."""

    def __init__(self, *widths: int):
        super().__init__()
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(b, a)) for a, b in pairwise(widths))
        for weight in self.weights:
            nn.init.kaiming_uniform_(weight, nonlinearity="relu")

    def forward(self, x: Float[Tensor, "sample input"]) -> Float[Tensor, "sample output"]:
        return kernels.perceptron(x, *self.weights)
