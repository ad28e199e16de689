"""A hypernetwork: networks whose outputs are another network's weights (Ha 2017)."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

TABLE, CALM = 1e-4, 0.1  # of a table's first entries; of what codes change at first, beside what all have in common


class HyperNetwork(nn.Module):
    """One perceptron for each tensor (Sen 2023, section 3.2; as Sitzmann 2020 has it): its last bias is the tensor that
    all instances have in common, and its last layer's weights say how they differ.

    codes:  for each tensor, numbers of the code that it is made of
    width, layers: of the hidden layers
    shapes: of the tensors; the first one is a table, all others are layers without biases
    """

    def __init__(self, codes: Sequence[int], width: int, layers: int, shapes: Sequence[tuple[int, int]]):
        super().__init__()
        self.shapes = tuple(shapes)
        self.hidden, self.last = nn.ModuleList(), nn.ModuleList()
        for number, (code, (rows, columns)) in enumerate(zip(codes, self.shapes, strict=True)):
            widths = [code, *[width] * layers]
            pairs = zip(widths, widths[1:], strict=False)
            self.hidden.append(nn.Sequential(*(x for a, b in pairs for x in (nn.Linear(a, b), nn.ReLU()))))
            last = nn.Linear(width, rows * columns)
            bound = TABLE if number == 0 else math.sqrt(6 / columns)
            nn.init.uniform_(last.bias, -bound, bound)
            nn.init.normal_(last.weight, std=CALM * bound / math.sqrt(width))
            self.last.append(last)

    def forward(self, codes: Sequence[Float[Tensor, "member _"]]) -> list[list[Float[Tensor, "_ _"]]]:
        """Each member's tensors. codes: for each tensor, those of all members"""
        networks = zip(self.hidden, self.last, self.shapes, codes, strict=True)
        made = [last(hidden(code)).unflatten(1, shape).unbind(0) for hidden, last, shape, code in networks]
        return [list(tensors) for tensors in zip(*made, strict=True)]
