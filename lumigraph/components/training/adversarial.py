"""Adversarial training: non-saturating loss, R1, and the discriminator of StyleGAN2 (Karras et al. 2020, arXiv
1912.04958), with the layers of equalised learning rate that its generator has as well."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv2d, leaky_relu, linear, pixel_shuffle, softplus

SLOPE, GAIN = 0.2, math.sqrt(2)  # of the leaky rectifier, which keeps a variance of one
DEVIATION_GROUP = 4  # pictures over which the minibatch deviation is taken (Karras 2018, section 3)
MIN_PICTURE_SIDE = 4  # pixels across, at which the discriminator decides
EPSILON = 1e-8

Pictures = Float[Tensor, "picture _ _ _"]
Logits = Float[Tensor, " picture"]


# Losses


def generator_loss(fake: Float[Tensor, "*logits"]) -> Tensor:
    """-log sigmoid(D(G(z))), the non-saturating loss (Goodfellow 2014, section 3). fake: logits of generated ones"""
    return softplus(-fake).mean()


def discriminator_loss(real: Float[Tensor, "*real"], fake: Float[Tensor, "*fake"]) -> Tensor:
    """-log sigmoid(D(x)) - log(1 - sigmoid(D(G(z)))) (Goodfellow 2014, eq. 1)."""
    return softplus(-real).mean() + softplus(fake).mean()


def r1_penalty(logits: Float[Tensor, "*logits"], pictures: Sequence[Tensor]) -> Tensor:
    """Half the squared gradient of the logits by real pictures, on average (Mescheder 2018, eq. 9, with gamma 1).

    pictures: (picture, ...) each, inputs of the logits that require gradients
    """
    gradients = torch.autograd.grad(logits.sum(), pictures, create_graph=True)
    return 0.5 * torch.stack([x.square().flatten(1).sum(1) for x in gradients]).sum(0).mean()


def lazy_adam(parameters: Iterable[nn.Parameter], rate: float, interval: int, **options) -> torch.optim.Adam:
    """Adam for lazy regularisation with a term every `interval` steps (Karras 2020, appendix B).

    Its rate is multiplied by c = n / (n + 1), its betas are (0, 0.99^c).
    """
    c = interval / (interval + 1)
    return torch.optim.Adam(list(parameters), rate * c, betas=(0.0, 0.99**c), eps=1e-8, **options)


@torch.no_grad()
def follow(average: nn.Module, network: nn.Module, keep: float) -> None:
    """Exponential moving average of a network's parameters. keep: share kept in a step; buffers are copied"""
    for a, p in zip(average.parameters(), network.parameters(), strict=True):
        a.lerp_(p, 1 - keep)
    for mine, theirs in zip(average.buffers(), network.buffers(), strict=True):
        mine.copy_(theirs)


# Layers


class EqualisedLinear(nn.Module):
    """y = c W x + b with W of the standard normal distribution and c = rate / sqrt(inputs) (Karras 2018, section 4.1).

    rate: relative learning rate
    bias: its initial value
    """

    def __init__(self, inputs: int, outputs: int, rate: float = 1.0, bias: float = 0.0):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs) / rate)
        self.bias = nn.Parameter(torch.full((outputs,), bias / rate))
        self.scale, self.rate = rate / math.sqrt(inputs), rate

    def forward(self, x: Float[Tensor, "*batch input"]) -> Float[Tensor, "*batch output"]:
        return linear(x, self.scale * self.weight, self.rate * self.bias)


class EqualisedConvolution(nn.Module):
    """Zero-padded convolution with weights as those of `EqualisedLinear`."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, bias: bool = True):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, kernel, kernel))
        self.bias = nn.Parameter(torch.zeros(outputs)) if bias else None
        self.scale, self.padding = 1 / math.sqrt(inputs * kernel**2), kernel // 2

    def forward(self, x: Pictures) -> Pictures:
        return conv2d(x, self.scale * self.weight, self.bias, padding=self.padding)


def rectified(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Leaky ReLU of x times sqrt(2)."""
    return GAIN * leaky_relu(x, SLOPE)


def halved(x: Pictures) -> Pictures:
    """Pictures of half the size, by the separable filter 1 3 3 1 (Karras 2020)."""
    line = x.new_tensor([1.0, 3.0, 3.0, 1.0]) / 8
    weights = (line[:, None] * line).expand(x.shape[1], 1, 4, 4)
    return conv2d(x, weights, stride=2, padding=1, groups=x.shape[1])


def doubled(x: Pictures) -> Pictures:
    """Pictures of twice the size, by the separable filter 1 3 3 1 (Karras 2020)."""
    lines = x.new_tensor([[1.0, 3.0, 0.0], [0.0, 3.0, 1.0]]) / 4
    weights = torch.einsum("ay,bx->abyx", lines, lines).reshape(1, 4, 1, 3, 3)
    weights = weights.expand(x.shape[1], 4, 1, 3, 3).flatten(0, 1)
    return pixel_shuffle(conv2d(x, weights, padding=1, groups=x.shape[1]), 2)


# Discriminator


class DiscriminatorBlock(nn.Module):
    """Residual block of two convolutions, the second at half the size (Karras 2020, figure 7c)."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.first = EqualisedConvolution(inputs, inputs)
        self.second = EqualisedConvolution(inputs, outputs)
        self.beside = EqualisedConvolution(inputs, outputs, 1, bias=False)

    def forward(self, x: Pictures) -> Pictures:
        y = rectified(self.second(halved(rectified(self.first(x)))))
        return (y + self.beside(halved(x))) / GAIN


def with_deviation(x: Pictures, group: int = DEVIATION_GROUP) -> Pictures:
    """Minibatch deviation channel: the mean deviation of features within groups of pictures (Karras 2018, section 3).

    Groups are as large as divides the number of pictures.
    """
    count = len(x)
    size = next(n for n in range(min(group, count), 0, -1) if count % n == 0)
    spread = (x.view(size, count // size, *x.shape[1:]).var(0, unbiased=False) + EPSILON).sqrt()
    means = spread.mean((1, 2, 3)).repeat(size)
    return torch.cat([x, means[:, None, None, None].expand(-1, 1, *x.shape[2:])], 1)


class Mapping(nn.Module):
    """Mapping network: fully connected layers from normalised codes and labels (Karras 2020; labels as in Karras 2020b,
                     ADA).

    code:  numbers of a code; 0 for none
    label: numbers of a label, embedded in `width` numbers; 0 for none
    rate:  relative learning rate
    """

    def __init__(self, code: int, label: int, width: int, layers: int, rate: float = 0.01):
        super().__init__()
        self.embedding = EqualisedLinear(label, width) if label else None
        inputs = code + (width if label else 0)
        widths = [inputs, *[width] * layers]
        self.layers = nn.ModuleList(EqualisedLinear(a, b, rate) for a, b in pairwise(widths))

    def forward(
        self, code: Float[Tensor, "picture code"] | None, label: Float[Tensor, "picture label"] | None = None
    ) -> Float[Tensor, "picture width"]:
        parts = [] if code is None else [normalised(code)]
        if self.embedding is not None:
            parts.append(normalised(self.embedding(label)))
        x = torch.cat(parts, -1)
        for layer in self.layers:
            x = rectified(layer(x))
        return x


def normalised(x: Float[Tensor, "*batch number"]) -> Float[Tensor, "*batch number"]:
    """Rows of a mean square of one."""
    return x * (x.square().mean(-1, keepdim=True) + EPSILON).rsqrt()


class Discriminator(nn.Module):
    """Residual blocks down to 4x4 pixels, minibatch deviation, and a logit (Karras 2020). With labels, the logit is the
    product of features and the mapped label (Miyato 2018).

    channels: of a picture
    widths:   channels at each size, the largest first and 4x4 last; so the size is 4 * 2^(len(widths) - 1)
    label:    numbers of a label; 0 for none
    layers:   of the label's mapping
    """

    def __init__(self, channels: int, widths: Sequence[int], label: int = 0, layers: int = 8):
        super().__init__()
        self.first = EqualisedConvolution(channels, widths[0], 1)
        self.blocks = nn.ModuleList(DiscriminatorBlock(a, b) for a, b in pairwise(widths))
        last = widths[-1]
        self.convolution = EqualisedConvolution(last + 1, last)
        self.dense = EqualisedLinear(last * MIN_PICTURE_SIDE**2, last)
        self.mapping = Mapping(0, label, last, layers) if label else None
        self.logit = EqualisedLinear(last, last if label else 1)

    def forward(self, pictures: Pictures, label: Float[Tensor, "picture label"] | None = None) -> Logits:
        x = rectified(self.first(pictures))
        for block in self.blocks:
            x = block(x)
        x = rectified(self.convolution(with_deviation(x)))
        x = self.logit(rectified(self.dense(x.flatten(1))))
        if self.mapping is None:
            return x[:, 0]
        return (x * normalised(self.mapping(None, label))).sum(-1) / math.sqrt(x.shape[-1])


def widths_of(size: int, base: int, most: int) -> list[int]:
    """Channels at each size from `size` pixels down to 4x4: base / size, at most `most` (Karras 2020)."""
    return [min(base // n, most) for n in (size >> k for k in range(int(math.log2(size // MIN_PICTURE_SIDE)) + 1))]
