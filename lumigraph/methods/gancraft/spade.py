"""The label-to-picture network that makes pseudo truth (SPADE; Park et al. 2019, arXiv 1903.07291), and the adversary
that looks at pictures beside their labels (CC-FPSE; Liu et al. 2019, arXiv 1910.06809)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, instance_norm, interpolate, l1_loss, normalize, one_hot

from .networks import Pictures, StyleEncoder, rectified

Codes = Float[Tensor, "picture code"]
LEVELS = (2, 3, 4)  # of the adversary's pyramid, at which it decides


def convolution(inputs: int, outputs: int) -> nn.Conv2d:
    """A 3x3 convolution with replicated borders."""
    return nn.Conv2d(inputs, outputs, 3, 1, 1, padding_mode="replicate")


def pooled(labels: Pictures, like: Pictures) -> Pictures:
    """Means of label maps over the pixels of other pictures."""
    height, width = like.shape[-2:]
    return adaptive_avg_pool2d(labels, (height, width))


class Spade(nn.Module):
    """Normalisation whose scale and shift are convolutions of the label map (Park 2019, eq. 1 to 3), and of the style.

    The style has to come after the normalisation, which takes from each channel what is the same at all pixels.
    """

    def __init__(self, channels: int, labels: int, code: int, hidden: int):
        super().__init__()
        self.shared, self.style = convolution(labels, hidden), nn.Linear(code, hidden, bias=False)
        self.modulation = convolution(hidden, 2 * channels)

    def forward(self, x: Pictures, labels: Pictures, code: Codes) -> Pictures:
        of_both = self.shared(pooled(labels, x)) + self.style(code)[..., None, None]
        scale, shift = self.modulation(rectified(of_both)).chunk(2, 1)
        return instance_norm(x) * (1 + scale) + shift


class SpadeBlock(nn.Module):
    """Residual block of two convolutions, each after a `Spade` (Park 2019, figure 4)."""

    def __init__(self, inputs: int, outputs: int, labels: int, code: int, hidden: int):
        super().__init__()
        self.norms = nn.ModuleList(Spade(n, labels, code, hidden) for n in (inputs, outputs))
        self.convolutions = nn.ModuleList([convolution(inputs, outputs), convolution(outputs, outputs)])
        self.beside = nn.Conv2d(inputs, outputs, 1, bias=False) if inputs != outputs else nn.Identity()

    def forward(self, x: Pictures, labels: Pictures, code: Codes) -> Pictures:
        y = x
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            y = convolution(rectified(norm(y, labels, code)))
        return self.beside(x) + y


class LabelPainter(nn.Module):
    """Pictures in [-1, 1] from label maps and a style code; its encoder finds the code of a picture.

    widths: channels from the coarsest resolution on, each twice as fine as the one before
    """

    def __init__(
        self, labels: int, code: int, widths: Sequence[int], hidden: int, encoder_size: int, encoder_width: int
    ):
        super().__init__()
        self.encoder = StyleEncoder(encoder_size, encoder_width, code)
        self.first = convolution(labels, widths[0])
        self.blocks = nn.ModuleList(SpadeBlock(a, b, labels, code, hidden) for a, b in pairwise([widths[0], *widths]))
        self.out = convolution(widths[-1], 3)

    def forward(self, labels: Pictures, code: Codes) -> Pictures:
        """labels: one channel for each, 1 where it is"""
        steps, code = (
            len(self.blocks) - 1,
            normalize(code, dim=-1),
        )  # as the field's `StyleNetwork` does: none runs away
        height, width = (n >> steps for n in labels.shape[-2:])
        x = self.first(adaptive_avg_pool2d(labels, (height, width)))
        for k, block in enumerate(self.blocks):
            x = block(interpolate(x, size=[n >> steps - k for n in labels.shape[-2:]]), labels, code)
        return self.out(rectified(x)).tanh()


class SpectralConvolution(nn.Conv2d):
    """Convolution whose weights have a spectral norm of 1, W / (u^T W v), by power iteration (Miyato 2018, eq. 8)."""

    u: Tensor

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1):
        super().__init__(inputs, outputs, kernel, stride, kernel // 2)
        self.register_buffer("u", normalize(torch.randn(outputs), dim=0))

    @torch.no_grad()
    def iterate(self) -> None:
        """One step towards the first singular vector."""
        weights = self.weight.flatten(1)
        self.u = normalize(weights @ normalize(self.u @ weights, dim=0), dim=0)

    def forward(self, x: Pictures) -> Pictures:
        norm = (self.u @ self.weight.flatten(1)).norm()  # u^T W v, for v is along u^T W
        return self._conv_forward(x, self.weight / norm, self.bias)


class Adversary(nn.Module):
    """Features of pictures, and logits of patches at three resolutions: a feature pyramid whose features are compared
    with those of the labels there (Liu 2019, section 3.2). Weights have a spectral norm of 1."""

    def __init__(self, labels: int, width: int):
        super().__init__()
        widths, lateral = [width << min(k, 3) for k in range(5)], 2 * width
        self.down = nn.ModuleList(SpectralConvolution(a, b, 3, 2) for a, b in pairwise([3, *widths]))
        self.lateral = nn.ModuleList(SpectralConvolution(b, lateral, 1) for b in widths[1:])
        self.last = nn.ModuleList(SpectralConvolution(lateral, lateral, 3) for _ in LEVELS)
        self.score, self.label = SpectralConvolution(lateral, 1, 1), SpectralConvolution(labels, lateral, 1)

    def iterate(self) -> None:
        """One power iteration for the spectral norms of all weights, once a step."""
        for module in self.modules():
            if isinstance(module, SpectralConvolution):
                module.iterate()

    def features(self, pictures: Pictures) -> list[Pictures]:
        """Features from fine to coarse, each half as large as the one before. pictures: in [-1, 1]"""
        found = []
        for layer in self.down:
            pictures = rectified(layer(pictures))
            found.append(pictures)
        return found

    def forward(self, pictures: Pictures, labels: Pictures) -> Float[Tensor, "picture logit"]:
        """Logits of the patches of each picture. labels: one channel for each"""
        return self.logits(self.features(pictures), labels)

    def logits(self, features: Sequence[Pictures], labels: Pictures) -> Float[Tensor, "picture logit"]:
        """Logits of patches, from the features of pictures."""
        embedded, logits = self.label(labels), []
        x = self.lateral[-1](features[-1])
        for level, last in zip(reversed(LEVELS), self.last, strict=True):
            beside = features[level - 1]
            x = interpolate(x, size=beside.shape[-2:], mode="bilinear") + self.lateral[level - 2](beside)
            y = rectified(last(x))
            logits.append(self.score(y)[:, 0] + (y * pooled(embedded, y)).sum(1))
        return torch.cat([x.flatten(1) for x in logits], -1)


def halves(features: Sequence[Tensor], count: int) -> tuple[list[Tensor], list[Tensor]]:
    """Features of the first `count` pictures, and of the others."""
    return [x[:count] for x in features], [x[count:] for x in features]


def perceptual(fake: Sequence[Pictures], real: Sequence[Pictures]) -> Tensor:
    """Mean absolute difference of features, over all layers."""
    return torch.stack([l1_loss(a, b.detach()) for a, b in zip(fake, real, strict=True)]).mean()


def channels(labels: Int[Tensor, "picture height width"], count: int, smooth: int = 0) -> Pictures:
    """One-hot channels of labels.

    smooth: diameter of the majority filter, pixels; 0 for none
    """
    found = one_hot(labels, count).movedim(-1, 1).float()
    if smooth > 1:
        radius = smooth // 2
        common = avg_pool2d(found, 2 * radius + 1, 1, radius, count_include_pad=False).argmax(1)
        found = one_hot(common, count).movedim(-1, 1).float()
    return found
