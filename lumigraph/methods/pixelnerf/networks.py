"""Features of photographs: a residual network, cut after its third stage, with its stages concatenated.

He et al. 2016 (arXiv 1512.03385), table 1, 34 layers; as an encoder of photographs Yu et al. 2021 (arXiv 2012.02190),
appendix B.1. Modules and tensors are named as in torchvision's ResNet, so that its weights fit.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from ...components.fields.layers import Dense
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
    """Batch normalisation with frozen statistics; scale and shift are trainable."""

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
    """Bilinear upsampling by an integer factor: cell i of the result lies at i / times. The last cells are repeated."""
    x = F.pad(x, (0, 1, 0, 1), mode="replicate")
    height, width = ((n - 1) * times + 1 for n in x.shape[2:])
    x = F.interpolate(x, (height, width), mode="bilinear", align_corners=True)
    return x[:, :, : size[0], : size[1]]


def look_up(
    cells: Float[Tensor, "view row column channel"],
    pixels: Float[Tensor, "view point 2"],
    sizes: Float[Tensor, "view 2"],
) -> Float[Tensor, "view point channel"]:
    """Features at points (x, y) on pictures, bilinear; outside of a picture those at its border. Equal to
    `torch.nn.functional.grid_sample`, in a tenth of its time: a cell's channels are contiguous.

    pixels: pixels' centres lie at +0.5, so that cell (i, j) lies at (2 j + 0.5, 2 i + 0.5)
    sizes:  width and height of each picture, where pictures are padded to one size
    Differentiable in the cells.
    """
    views, rows, columns, _ = cells.shape
    inside = torch.minimum(pixels.clamp_min(0.5), sizes[:, None] - 0.5)
    x, y = ((inside - 0.5) / STRIDE).unbind(-1)
    left, above = (place.floor().clamp(0, max(n - 2, 0)) for place, n in ((x, columns), (y, rows)))
    x, y = x - left, y - above
    first = (torch.arange(views, device=cells.device)[:, None] * rows + above.long()) * columns + left.long()
    right, below = min(1, columns - 1), columns * min(1, rows - 1)
    corners = torch.stack([first, first + right, first + below, first + below + right], -1)
    weights = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], -1)
    found = _Sum.apply(cells.flatten(0, 2), corners.flatten(0, 1), weights.flatten(0, 1))
    return found.unflatten(0, pixels.shape[:2])


class _Sum(torch.autograd.Function):
    """out[i] = sum over k of weights[i, k] rows[index[i, k]]; backwards each row gathers from all its sums."""

    @staticmethod
    def forward(ctx, rows, index, weights):
        ctx.save_for_backward(index, weights)
        ctx.count = len(rows)
        return summed(
            rows, index.flatten(), torch.arange(0, index.numel(), index.shape[1], device=index.device), weights
        )

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        index, weights = ctx.saved_tensors
        index, order = index.flatten().sort(stable=True)
        ends = torch.bincount(index, minlength=ctx.count).cumsum(0)
        begins = F.pad(ends[:-1], (1, 0))
        to_rows = summed(grad.contiguous(), order.div(weights.shape[1], rounding_mode="floor"), begins,
                         weights.flatten()[order])  # fmt: skip
        return to_rows, None, None


def summed(
    rows: Float[Tensor, "row channel"], index: Int[Tensor, " part"], begins: Int[Tensor, " sum"], weights: Tensor
) -> Float[Tensor, "sum channel"]:
    """Weighted sums of rows: sum s takes those of index[begins[s]] up to where the next one begins."""
    if not len(index):
        return rows.new_zeros(len(begins), rows.shape[1])
    return F.embedding_bag(index, rows, begins, mode="sum", per_sample_weights=weights.flatten())


class ResidualNetwork(nn.Module):
    """Yu 2021, figure 4 and appendix B.1: blocks per view, the mean over views, then blocks for all.

    inputs:   width of a point in a view's frame, encoded
    features: width of the view's features there; joined to the input of each of the first blocks
    width:    of all layers
    blocks, joined: number of all blocks, and of those per view

    A feature is joined by a linear layer, and linear layers commute with bilinear interpolation. So `prepared` maps all
    features through these layers once, and points interpolate the results.
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
        """Additions of each cell's features to the inputs of the first blocks, concatenated."""
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
    """x + W2 max(0, W1 max(0, x)); W2 starts small, where the published code has zeros, so the block is nearly the
    identity."""

    def __init__(self, width: int, exact: bool):
        super().__init__()
        self.inner, self.outer = Dense(width, width, relu=True, exact=exact), Dense(width, width, exact=exact)
        nn.init.kaiming_normal_(self.inner.weight)
        nn.init.normal_(self.outer.weight, std=1e-3)

    def forward(self, x: Float[Tensor, "sample width"]) -> Float[Tensor, "sample width"]:
        return x + self.outer(self.inner(F.relu(x))).float()
