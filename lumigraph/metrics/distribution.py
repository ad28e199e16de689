"""Distances between two sets of pictures: Fréchet distance of features (FID, Heusel et al. 2017, arXiv 1706.08500) and
kernel distance (KID, Bińkowski et al. 2018, arXiv 1801.01401).

Features are of a small network of fixed random weights, which ships as code, or of Inception from a file that the user
has: pt_inception-2015-12-05-6726825d.pth, the port of the network of the published figures.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, interpolate, max_pool2d, relu

from ..errors import LumigraphError
from . import Score
from .lpips import read_weights

Pictures = Float[Tensor, "_ _ _ 3"]
Features = Float[Tensor, "_ feature"]
MIN_PICTURES = 2  # in a set
BATCH = 32  # pictures that go through a network together


@runtime_checkable
class FeatureNetwork(Protocol):
    """Features of pictures. name: as scores state it; definition: as a protocol states it"""

    name: str
    definition: str

    def features(self, pictures: Float[Tensor, "picture 3 height width"]) -> Features:
        """A row of each picture, of values in [0, 1]."""


# Distances


def frechet_distance(a: Features, b: Features) -> float:
    """|m_a - m_b|^2 + tr(C_a + C_b - 2 (C_a C_b)^(1/2)) of Gaussians that fit both sets (Heusel 2017, eq. 6)."""
    (mean_a, cov_a), (mean_b, cov_b) = gaussian(a), gaussian(b)
    values, axes = torch.linalg.eigh(cov_a)
    root = (axes * values.clamp_min(0).sqrt()) @ axes.T
    both = torch.linalg.eigvalsh(root @ cov_b @ root).clamp_min(0).sqrt().sum()
    return max(0.0, float((mean_a - mean_b).square().sum() + cov_a.trace() + cov_b.trace() - 2 * both))


def gaussian(x: Features) -> tuple[Float[Tensor, " feature"], Float[Tensor, "feature feature"]]:
    """Mean and covariance, in double precision."""
    x = x.double()
    return x.mean(0), x.T.cov()


def kernel_distance(a: Features, b: Features) -> float:
    """Unbiased squared maximum mean discrepancy with the kernel (x . y / d + 1)^3 (Bińkowski 2018, section 4), over all
    pairs at once. It may be below zero."""
    a, b = a.double(), b.double()

    def kernel(x: Tensor, y: Tensor) -> Tensor:
        return (x @ y.T / x.shape[1] + 1) ** 3

    def within(x: Tensor) -> Tensor:
        k, n = kernel(x, x), len(x)
        return (k.sum() - k.trace()) / (n * (n - 1))

    return float(within(a) + within(b) - 2 * kernel(a, b).mean())


def distances(real: Pictures, made: Pictures, network: FeatureNetwork) -> list[Score]:
    """FID and KID between two sets of pictures. Raises LumigraphError for sets of fewer than two."""
    if min(len(real), len(made)) < MIN_PICTURES:
        raise LumigraphError(f"FID compares sets, and one has {min(len(real), len(made))} pictures; give two or more")
    a, b = (features_of(x, network) for x in (real, made))
    return [
        Score(f"FID ({network.name})", frechet_distance(a, b), "", "lower", 3),
        Score(f"KID ({network.name})", kernel_distance(a, b), "", "lower", 5),
    ]


@torch.no_grad()
def features_of(pictures: Pictures, network: FeatureNetwork) -> Features:
    parts = pictures.split(BATCH)
    return torch.cat([network.features(part.permute(0, 3, 1, 2).clamp(0, 1).float()) for part in parts])


# The network that ships


RANDOM_SEED = 2022
RANDOM_WIDTHS = 16, 24, 32, 48
RANDOM_SIZE = 64  # pixels across


class RandomFeatures:
    """Means and deviations over the picture of the rectified outputs of four convolutions, each at half the size of the
    one before, with random weights (He 2015) from NumPy's frozen generator. Every second filter has zero mean, so it
    responds to edges and noise alone.

    It is untrained, so it favours no method and no data, and is identical on every machine. It measures colours, edges
    and textures at four scales, not objects. Figures of different sizes of sets, and those of Inception, are not
    comparable with its own. Random networks for evaluation: Naeem 2020, arXiv 2002.09797, section 5.
    """

    name = "random features"
    definition = (
        "4 random convolutions of seed 2022, 64 pixels, means and deviations: 240 features; no published figure"
    )

    def __init__(self) -> None:
        frozen = np.random.RandomState(RANDOM_SEED)  # its stream never changes (NEP 19)
        self.weights, inputs = list[Tensor](), 3
        for width in RANDOM_WIDTHS:
            drawn = frozen.standard_normal((width, inputs, 3, 3)) * np.sqrt(2 / (9 * inputs))
            drawn[1::2] -= drawn[1::2].mean((2, 3), keepdims=True)
            self.weights.append(torch.from_numpy(drawn).float())
            inputs = width

    def features(self, pictures: Float[Tensor, "picture 3 height width"]) -> Features:
        size = (RANDOM_SIZE, RANDOM_SIZE)
        x = 2 * interpolate(pictures, size=size, mode="bilinear", align_corners=False, antialias=True) - 1
        found = []
        for weight in self.weights:
            x = relu(conv2d(x, weight.to(x), padding=1))
            found += [x.mean((2, 3)), x.std((2, 3))]
            x = avg_pool2d(x, 2)
        return torch.cat(found, 1)


# Inception


INCEPTION_SIZE = 299  # pixels across
INCEPTION_EPSILON = 1e-3  # of its batch normalisation
CLASSES = 1008  # rows of its last layer, which tell it from torchvision's, of 1000
ONE, ROW, COLUMN = (1, 1), (1, 7), (7, 1)
THREE, SHORT_ROW, SHORT_COLUMN, FIVE = (3, 3), (1, 3), (3, 1), (5, 5)


class Inception:
    """The 2048 features before the last layer of Inception v3 (Szegedy 2016), as used for FID: TensorFlow's release of
    2015, with averages that leave the border out, and a maximum in the last block.

    weights: by torchvision's names; share: reduction factor of channels, for small networks in tests
    """

    name = "Inception"

    def __init__(self, weights: dict[str, Tensor], where: str = "the weights", share: int = 1):
        self.weights, self.where, self.share = weights, where, share
        last = weights.get("fc.weight")
        if last is not None and len(last) != CLASSES:
            raise LumigraphError(
                f"{where} is an Inception of {len(last)} classes, by which no published FID is computed; use "
                "pt_inception-2015-12-05-6726825d.pth"
            )
        self._fits = True  # while shapes are compared, with nothing computed
        found = self._walk(torch.empty(1, 3, INCEPTION_SIZE, INCEPTION_SIZE, device="meta"))
        self._fits = False
        self.definition = f"Inception of 2015, {found.shape[1]} features, bilinear to 299 pixels"

    def features(self, pictures: Float[Tensor, "picture 3 height width"]) -> Features:
        size = (INCEPTION_SIZE, INCEPTION_SIZE)
        return self._walk(2 * interpolate(pictures, size=size, mode="bilinear", align_corners=False) - 1)

    def _walk(self, x: Tensor) -> Tensor:
        """Features of pictures (picture, 3, 299, 299) in [-1, 1]."""
        at = self._layer
        x = at("Conv2d_1a_3x3", x, 32, THREE, 2, 0)
        x = at("Conv2d_2b_3x3", at("Conv2d_2a_3x3", x, 32, THREE, 1, 0), 64, THREE)
        x = at("Conv2d_3b_1x1", max_pool2d(x, 3, 2), 80)
        x = max_pool2d(at("Conv2d_4a_3x3", x, 192, THREE, 1, 0), 3, 2)
        for letter, pool in (("b", 32), ("c", 64), ("d", 64)):
            x = self._block_35(f"Mixed_5{letter}", x, pool)
        x = self._shrink_17("Mixed_6a", x)
        for letter, width in (("b", 128), ("c", 160), ("d", 160), ("e", 192)):
            x = self._block_17(f"Mixed_6{letter}", x, width)
        x = self._shrink_8("Mixed_7a", x)
        x = self._block_8("Mixed_7b", x, averaged(x))
        x = self._block_8("Mixed_7c", x, max_pool2d(x, 3, 1, 1))
        return x.mean((2, 3))

    def _layer(
        self,
        name: str,
        x: Tensor,
        outputs: int,
        kernel: tuple[int, int] = ONE,
        stride: int = 1,
        padding: int | None = None,
    ) -> Tensor:
        """Convolution, batch normalisation and rectifier. padding: by default as much as keeps the size"""
        weight = self._weight(f"{name}.conv.weight", (outputs // self.share, x.shape[1], *kernel))
        numbers = [self._weight(f"{name}.bn.{n}", weight.shape[:1]) for n in ("weight", "bias", "running_mean")]
        variance = self._weight(f"{name}.bn.running_var", weight.shape[:1])
        around = (kernel[0] // 2, kernel[1] // 2) if padding is None else padding
        x = conv2d(x, weight, None, stride, around)
        gain, bias, mean = numbers
        gain = gain * (variance + INCEPTION_EPSILON).rsqrt()
        return relu(x * gain[:, None, None] + (bias - mean * gain)[:, None, None])

    def _weight(self, name: str, shape: Sequence[int]) -> Tensor:
        """A tensor by name, or a meta tensor to compare shapes. Raises LumigraphError for another architecture."""
        found = self.weights.get(name)
        if self._fits and (found is None or tuple(found.shape) != tuple(shape)):
            fault = f"lacks {name}" if found is None else f"has {name} of shape {tuple(found.shape)}"
            raise LumigraphError(
                f"{self.where} {fault}, where FID's Inception has {tuple(shape)}; use "
                "pt_inception-2015-12-05-6726825d.pth, not another network"
            )
        assert found is not None
        return torch.empty(shape, device="meta") if self._fits else found.float()

    def _chain(self, x: Tensor, *layers: tuple) -> Tensor:
        for name, *about in layers:
            x = self._layer(name, x, *about)
        return x

    def _block_35(self, name: str, x: Tensor, pool: int) -> Tensor:
        five = self._chain(x, (f"{name}.branch5x5_1", 48), (f"{name}.branch5x5_2", 64, FIVE))
        three = f"{name}.branch3x3dbl"
        twice = self._chain(x, (f"{three}_1", 64), (f"{three}_2", 96, THREE), (f"{three}_3", 96, THREE))
        one = self._layer(f"{name}.branch1x1", x, 64)
        return torch.cat([one, five, twice, self._layer(f"{name}.branch_pool", averaged(x), pool)], 1)

    def _shrink_17(self, name: str, x: Tensor) -> Tensor:
        three = f"{name}.branch3x3dbl"
        twice = self._chain(x, (f"{three}_1", 64), (f"{three}_2", 96, THREE), (f"{three}_3", 96, THREE, 2, 0))
        return torch.cat([self._layer(f"{name}.branch3x3", x, 384, THREE, 2, 0), twice, max_pool2d(x, 3, 2)], 1)

    def _block_17(self, name: str, x: Tensor, width: int) -> Tensor:
        seven, twice = f"{name}.branch7x7", f"{name}.branch7x7dbl"
        once = self._chain(x, (f"{seven}_1", width), (f"{seven}_2", width, ROW), (f"{seven}_3", 192, COLUMN))
        again = self._chain(x, (f"{twice}_1", width), (f"{twice}_2", width, COLUMN), (f"{twice}_3", width, ROW))
        again = self._chain(again, (f"{twice}_4", width, COLUMN), (f"{twice}_5", 192, ROW))
        one = self._layer(f"{name}.branch1x1", x, 192)
        return torch.cat([one, once, again, self._layer(f"{name}.branch_pool", averaged(x), 192)], 1)

    def _shrink_8(self, name: str, x: Tensor) -> Tensor:
        three = self._chain(x, (f"{name}.branch3x3_1", 192), (f"{name}.branch3x3_2", 320, THREE, 2, 0))
        seven = f"{name}.branch7x7x3"
        long = self._chain(x, (f"{seven}_1", 192), (f"{seven}_2", 192, ROW), (f"{seven}_3", 192, COLUMN))
        return torch.cat([three, self._layer(f"{seven}_4", long, 192, THREE, 2, 0), max_pool2d(x, 3, 2)], 1)

    def _block_8(self, name: str, x: Tensor, pooled: Tensor) -> Tensor:
        def split(stem: str, y: Tensor) -> list[Tensor]:
            return [self._layer(f"{stem}a", y, 384, SHORT_ROW), self._layer(f"{stem}b", y, 384, SHORT_COLUMN)]

        three = split(f"{name}.branch3x3_2", self._layer(f"{name}.branch3x3_1", x, 384))
        twice = self._chain(x, (f"{name}.branch3x3dbl_1", 448), (f"{name}.branch3x3dbl_2", 384, THREE))
        one, last = self._layer(f"{name}.branch1x1", x, 320), self._layer(f"{name}.branch_pool", pooled, 192)
        return torch.cat([one, *three, *split(f"{name}.branch3x3dbl_3", twice), last], 1)


def averaged(x: Tensor) -> Tensor:
    """Mean of each 3x3 neighbourhood, within the border."""
    return avg_pool2d(x, 3, 1, 1, count_include_pad=False)


def load_inception(path: Path) -> Inception:
    """Inception with the weights of a file, .pth or .safetensors. Raises LumigraphError for another architecture."""
    return Inception(read_weights(path), str(path))
