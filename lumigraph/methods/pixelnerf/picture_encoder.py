"""Features of photographs: a residual network, cut after its third stage, whose stages are laid upon one another.

He et al. 2016 (arXiv 1512.03385), table 1, 34 layers; as an encoder of photographs Yu et al. 2021 (arXiv 2012.02190),
appendix B.1. Modules and tensors are called as in torchvision's ResNet, so that its weights fit.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from ...errors import LumigraphError
from ...metrics.lpips import read_weights

STRIDE = 2  # pixels from one cell of the features to the next
GROUPS = 8  # of channels that are normalised together, where statistics are each picture's own


class PictureEncoder(nn.Module):
    """Pictures (view, 3, height, width) in [0, 1] become features (view, height / 2, width / 2, `width`).

    widths: channels of the stem and of the three stages
    blocks: of each stage
    pool:   whether the stem halves the resolution a second time, as published
    frozen: normalise by statistics that come with weights of others, instead of by each picture's own. Statistics of
            the batch, as published, would be those of two or three photographs here, and others when it is used

    Cell (row i, column j) is centred on the pixel of row 2 i and column 2 j, counted from 0: kernels are odd and padded
    by half, so every stride keeps the first pixel's centre where it was.
    """

    def __init__(
        self,
        widths: tuple[int, int, int, int] = (64, 64, 128, 256),
        blocks: tuple[int, int, int] = (3, 4, 6),
        pool: bool = True,
        frozen: bool = False,
    ):
        super().__init__()
        self.width, self.pool = sum(widths), pool
        self.conv1 = nn.Conv2d(3, widths[0], 7, stride=2, padding=3, bias=False)
        self.bn1 = norm(widths[0], frozen)
        before, strides = widths[0], (1, 2, 2)
        for i, (width, count, stride) in enumerate(zip(widths[1:], blocks, strides, strict=True), 1):
            if not pool and i == 1:
                stride = 2  # the stage makes up for the pooling: features are as coarse, and found with more care
            stage = [EncoderBlock(width if j else before, width, 1 if j else stride, frozen) for j in range(count)]
            setattr(self, f"layer{i}", nn.Sequential(*stage))
            before = width

    def forward(self, pictures: Float[Tensor, "view 3 height width"]) -> Float[Tensor, "view row column feature"]:
        x = F.relu(self.bn1(self.conv1(2 * pictures - 1)))
        levels, size = [x], x.shape[2:]
        if self.pool:
            x = F.max_pool2d(x, 3, stride=2, padding=1)
        for i, times in enumerate((2, 4, 8), 1):
            x = getattr(self, f"layer{i}")(x)
            levels.append(finer(x, times, size))
        return torch.cat([level.permute(0, 2, 3, 1) for level in levels], -1)

    def load(self, path: Path) -> None:
        """Take the weights of torchvision's resnet34, from a file. Raises LumigraphError where they do not fit."""
        found, own = read_weights(path), self.state_dict()
        for name, value in own.items():
            if name not in found:
                raise LumigraphError(f"{path} lacks {name}; give the weights of torchvision's resnet34")
            if found[name].shape != value.shape:
                shapes = f"{tuple(found[name].shape)}, and the encoder's {tuple(value.shape)}"
                raise LumigraphError(
                    f"{path}: {name} is {shapes}; give the weights of torchvision's resnet34 with --preset paper"
                )
        self.load_state_dict({name: found[name] for name in own})


class EncoderBlock(nn.Module):
    """Two convolutions beside a shortcut (He 2016, figure 2)."""

    def __init__(self, inputs: int, width: int, stride: int, frozen: bool):
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 3, stride, padding=1, bias=False)
        self.bn1 = norm(width, frozen)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = norm(width, frozen)
        self.downsample = None
        if stride > 1 or inputs != width:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, width, 1, stride, bias=False), norm(width, frozen))

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)))


class Frozen(nn.Module):
    """Batch normalisation by statistics that stay as they are; scale and shift are learnt on."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, width: int):
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))
        self.register_buffer("running_mean", torch.zeros(width))
        self.register_buffer("running_var", torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias)


def norm(width: int, frozen: bool) -> nn.Module:
    return Frozen(width) if frozen else nn.GroupNorm(min(GROUPS, width), width)


def finer(x: Float[Tensor, "view channel _ _"], times: int, size: torch.Size) -> Float[Tensor, "view channel _ _"]:
    """Features between cells, so many to one: cell i of the result lies at i / times. The last ones are held."""
    x = F.pad(x, (0, 1, 0, 1), mode="replicate")
    height, width = ((n - 1) * times + 1 for n in x.shape[2:])
    x = F.interpolate(x, (height, width), mode="bilinear", align_corners=True)
    return x[:, :, : size[0], : size[1]]
