"""Networks of occupancy networks: encoders of points, voxels and pictures; a decoder with conditional batch norm."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.layers import FIRST_DEVIATION, ResNetLayers

VOXELS = 32  # voxels a side that the encoder of voxels takes


def of_cloud(
    block: Any, x: Float[Tensor, "member point some"], whole: Float[Tensor, "member others"]
) -> Float[Tensor, "member point output"]:
    """Layers on the features of points and of their whole cloud, which are multiplied once for each cloud."""
    inner = joined(block.first, x.relu(), whole.relu())
    return joined(block.shortcut, x, whole) + block.second(inner.relu())


def joined(
    layer: nn.Linear, x: Float[Tensor, "member point some"], whole: Float[Tensor, "member others"]
) -> Float[Tensor, "member point output"]:
    """A layer of [x, whole], where `whole` is the same for all points of a member."""
    width = x.shape[-1]
    once = F.linear(whole, layer.weight[:, width:], layer.bias)
    return F.linear(x, layer.weight[:, :width]) + once[:, None]


class PointEncoder(nn.Module):
    """PointNet with residual layers, each followed by max pooling over points, concatenated to them (appendix A)."""

    def __init__(self, code: int, width: int, layers: int = 5):
        super().__init__()
        self.first = nn.Linear(3, 2 * width)
        self.layers = nn.ModuleList(ResNetLayers(2 * width, width) for _ in range(layers))
        self.last = nn.Linear(width, code)

    def forward(self, points: Float[Tensor, "member point 3"]) -> Float[Tensor, "member code"]:
        x = self.first(points)
        whole = x[:, 0, :0]  # the first layer sees single points
        for layer in self.layers:
            x = of_cloud(layer, x, whole)
            whole = x.amax(1)
        return self.last(whole.relu())


class VoxelEncoder(nn.Module):
    """Convolutions of 3^3, after the first one with stride 2, and a linear layer (appendix A)."""

    def __init__(self, code: int, width: int):
        super().__init__()
        widths = [max(width >> 4, 4), *(max(width >> k, 4) for k in (3, 2, 1, 0))]
        self.first = nn.Conv3d(1, widths[0], 3, padding=1)
        pairs = zip(widths, widths[1:], strict=False)
        self.halving = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1, stride=2) for a, b in pairs)
        self.last = nn.Linear(widths[-1] * (VOXELS >> len(self.halving)) ** 3, code)

    def forward(self, voxels: Float[Tensor, "member x y z"]) -> Float[Tensor, "member code"]:
        x = self.first(voxels[:, None])
        for layer in self.halving:
            x = layer(x.relu())
        return self.last(x.flatten(1).relu())


class WholePictureEncoder(nn.Module):
    """A small residual network of pictures in grey, in place of the paper's ResNet-18 with weights of ImageNet."""

    def __init__(self, code: int, width: int):
        super().__init__()
        widths = [max(width >> k, 4) for k in (3, 2, 1, 0)]
        self.first = nn.Conv2d(1, widths[0], 5, padding=2, stride=2)
        pairs = [*zip(widths, widths[1:], strict=False)]
        self.halving = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1, stride=2) for a, b in pairs)
        self.residual = nn.ModuleList(nn.Conv2d(b, b, 3, padding=1) for _, b in pairs)
        self.last = nn.Linear(16 * widths[-1], code)

    def forward(self, pictures: Float[Tensor, "member height width"]) -> Float[Tensor, "member code"]:
        x = self.first(1 - pictures[:, None])  # the white background is 0
        for halve, residual in zip(self.halving, self.residual, strict=True):
            x = halve(x.relu())
            x = x + residual(x.relu())
        return self.last(F.adaptive_avg_pool2d(x.relu(), 4).flatten(1))


class ConditionalNorm(nn.Module):
    """gamma(c) (x - mean) / sqrt(variance + eps) + beta(c), by means over all points of a step (appendix A)."""

    mean: Tensor
    variance: Tensor

    def __init__(self, code: int, width: int):
        super().__init__()
        self.gamma, self.beta = nn.Linear(code, width), nn.Linear(code, width)
        for layer, bias in ((self.gamma, 1.0), (self.beta, 0.0)):
            nn.init.normal_(layer.weight, std=FIRST_DEVIATION)
            nn.init.constant_(layer.bias, bias)
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("variance", torch.ones(width))

    def forward(
        self, x: Float[Tensor, "member point width"], code: Float[Tensor, "member code"]
    ) -> Float[Tensor, "member point width"]:
        normal = F.batch_norm(x.flatten(0, 1), self.mean, self.variance, training=self.training).view_as(x)
        return torch.addcmul(self.beta(code)[:, None], self.gamma(code)[:, None], normal)


class ConditionalBlock(nn.Module):
    """x + W_1 relu(n_1(W_0 relu(n_0(x, c)), c))."""

    def __init__(self, code: int, width: int):
        super().__init__()
        self.norms = nn.ModuleList(ConditionalNorm(code, width) for _ in range(2))
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)
        nn.init.normal_(self.second.weight, std=FIRST_DEVIATION)

    def forward(
        self, x: Float[Tensor, "member point width"], code: Float[Tensor, "member code"]
    ) -> Float[Tensor, "member point width"]:
        inner = self.first(self.norms[0](x, code).relu())
        return x + self.second(self.norms[1](inner, code).relu())


class OccupancyDecoder(nn.Module):
    """Logit of occupancy at points under a code: residual blocks with conditional batch normalisation (appendix A).

    octaves: of waves that encode points; 0 for the points alone
    """

    def __init__(self, code: int, width: int, blocks: int, octaves: int):
        super().__init__()
        self.encoding = FrequencyEncoding(3, octaves)
        self.first = nn.Linear(self.encoding.width, width)
        self.blocks = nn.ModuleList(ConditionalBlock(code, width) for _ in range(blocks))
        self.norm, self.last = ConditionalNorm(code, width), nn.Linear(width, 1)

    def forward(
        self, points: Float[Tensor, "member point 3"], code: Float[Tensor, "member code"]
    ) -> Float[Tensor, "member point"]:
        x = self.first(self.encoding(points.flatten(0, 1))).view(*points.shape[:2], -1)
        for block in self.blocks:
            x = block(x, code)
        return self.last(self.norm(x, code).relu())[..., 0]
