"""The network of PixelNeRF: residual blocks over points as each view sees them, joined by features of its picture."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from ...components.fields.dense import Dense


class ResidualNetwork(nn.Module):
    """Yu 2021, figure 4 and appendix B.1: blocks per view, the mean over views, then blocks for all.

    inputs:   width of a point in a view's frame, encoded
    features: width of what the view's picture has there; joined to the input of each of the first blocks
    width:    of all layers
    blocks, joined: in all, and how many are per view

    A feature is joined by a linear layer, and linear layers commute with bilinear interpolation. So `prepared` takes a
    whole map of features through these layers once, and points look up what they give.
    """

    def __init__(
        self, inputs: int, features: int, width: int = 512, blocks: int = 5, joined: int = 3, exact: bool = False
    ):
        super().__init__()
        self.first = Dense(inputs, width, exact=exact)
        self.join = Dense(features, joined * width, exact=exact)
        self.blocks = nn.ModuleList(ResidualBlock(width, exact) for _ in range(blocks))
        self.last = Dense(width, 4, exact=exact)
        self.joined = joined
        for layer in (self.first, self.join):
            nn.init.kaiming_normal_(layer.weight)

    def prepared(self, features: Float[Tensor, "view row column feature"]) -> Float[Tensor, "view row column joins"]:
        """What each cell's features add to the inputs of the first blocks, end to end."""
        return self.join(features.flatten(0, 2)).float().unflatten(0, features.shape[:3])

    def forward(
        self, points: Float[Tensor, "view point input"], joins: Float[Tensor, "view point joins"]
    ) -> Float[Tensor, "point 4"]:
        """Raw colour and density."""
        views = len(points)
        x = self.first(points.flatten(0, 1)).float()
        parts = joins.flatten(0, 1).chunk(self.joined, -1)
        for number, block in enumerate(self.blocks):
            if number < self.joined:
                x = x + parts[number]
            x = block(x)
            if number + 1 == self.joined:
                x = x.unflatten(0, (views, -1)).mean(0)
        return self.last(F.relu(x)).float()


class ResidualBlock(nn.Module):
    """x + W2 max(0, W1 max(0, x)); at first nearly x alone: W2 begins small, where the published code has zeros."""

    def __init__(self, width: int, exact: bool):
        super().__init__()
        self.inner, self.outer = Dense(width, width, relu=True, exact=exact), Dense(width, width, exact=exact)
        nn.init.kaiming_normal_(self.inner.weight)
        nn.init.normal_(self.outer.weight, std=1e-3)

    def forward(self, x: Float[Tensor, "sample width"]) -> Float[Tensor, "sample width"]:
        return x + self.outer(self.inner(F.relu(x))).float()
