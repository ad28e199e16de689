"""CLIP: one embedding space for pictures and captions (Radford et al. 2021, arXiv 2103.00020).

Modules have the names of OpenAI's release and of open_clip, so that their weights load as they are."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize, relu, scaled_dot_product_attention

from ...files.ranges import Width, between

Layers = Annotated[int, between(1, 128)]
MEAN = (0.48145466, 0.4578275, 0.40821073)  # of the pictures' channels, as CLIP was trained
DEVIATION = (0.26862954, 0.26130258, 0.27577711)
INITIAL_SCALE = 2.6593  # log of the inverse temperature 1 / 0.07, section 2.5
MAX_SCALE = 4.6052  # log of 100, section 2.5
EXPANSION = 4  # of a residual block's channels
REDUCTION = 32  # factor from a picture to the places that a residual network pools


@dataclass(frozen=True)
class TransformerSizes:
    """width: of a token; hidden: of the perceptrons; heads: of attention"""

    width: Width
    layers: Layers
    heads: Layers
    hidden: Annotated[int, between(1, 1 << 16)]
    activation: str = "quick_gelu"


@dataclass(frozen=True)
class VisionSizes(TransformerSizes):
    """patch: pixels a side"""

    patch: Annotated[int, between(1, 1024)] = 32


@dataclass(frozen=True)
class ResnetSizes:
    """width: channels of the stem; blocks: of the four stages; heads: of the attention that pools"""

    width: Width
    blocks: tuple[Layers, Layers, Layers, Layers]
    heads: Layers


@dataclass(frozen=True)
class ClipSizes:
    """picture: pixels a side; context: tokens of a caption; embedding: width of the shared space"""

    vision: VisionSizes | ResnetSizes
    text: TransformerSizes
    picture: Annotated[int, between(1, 4096)]
    vocabulary: Annotated[int, between(1, 1 << 24)]
    context: Annotated[int, between(2, 4096)]
    embedding: Width


class QuickGelu(nn.Module):
    """x sigmoid(1.702 x), the activation of OpenAI's weights."""

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.sigmoid(1.702 * x)


ACTIVATIONS = {"quick_gelu": QuickGelu, "gelu": nn.GELU}


def attended(q: Tensor, k: Tensor, v: Tensor, heads: int, causal: bool = False) -> Float[Tensor, "batch token width"]:
    """Multi-head attention (Vaswani 2017, section 3.2.2)."""
    q, k, v = (x.unflatten(-1, (heads, -1)).transpose(1, 2) for x in (q, k, v))
    return scaled_dot_product_attention(q, k, v, is_causal=causal).transpose(1, 2).flatten(2)


class Attention(nn.Module):
    """Self-attention."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.in_proj_weight = nn.Parameter(torch.randn(3 * width, width) * width**-0.5)
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * width))
        self.out_proj = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "batch token width"], causal: bool) -> Float[Tensor, "batch token width"]:
        q, k, v = (x @ self.in_proj_weight.T + self.in_proj_bias).chunk(3, -1)
        return self.out_proj(attended(q, k, v, self.heads, causal))


class AttentionBlock(nn.Module):
    """Pre-norm residual block of attention and perceptron."""

    def __init__(self, s: TransformerSizes):
        super().__init__()
        self.ln_1, self.ln_2, self.attn = nn.LayerNorm(s.width), nn.LayerNorm(s.width), Attention(s.width, s.heads)
        layers = {
            "c_fc": nn.Linear(s.width, s.hidden),
            "gelu": ACTIVATIONS[s.activation](),
            "c_proj": nn.Linear(s.hidden, s.width),
        }
        self.mlp = nn.Sequential(OrderedDict(layers))

    def forward(self, x: Float[Tensor, "batch token width"], causal: bool) -> Float[Tensor, "batch token width"]:
        x = x + self.attn(self.ln_1(x), causal)
        return x + self.mlp(self.ln_2(x))


class Transformer(nn.Module):
    def __init__(self, s: TransformerSizes):
        super().__init__()
        self.resblocks = nn.ModuleList([AttentionBlock(s) for _ in range(s.layers)])

    def forward(self, x: Float[Tensor, "batch token width"], causal: bool) -> Float[Tensor, "batch token width"]:
        for block in self.resblocks:
            x = block(x, causal)
        return x


class VisionTransformer(nn.Module):
    """Vision transformer (Dosovitskiy 2021) with a layer normalisation before its blocks."""

    def __init__(self, s: VisionSizes, picture: int, embedding: int):
        super().__init__()
        deviation = s.width**-0.5
        self.conv1 = nn.Conv2d(3, s.width, s.patch, s.patch, bias=False)
        self.class_embedding = nn.Parameter(torch.randn(s.width) * deviation)
        self.positional_embedding = nn.Parameter(torch.randn((picture // s.patch) ** 2 + 1, s.width) * deviation)
        self.ln_pre, self.transformer, self.ln_post = nn.LayerNorm(s.width), Transformer(s), nn.LayerNorm(s.width)
        self.proj = nn.Parameter(torch.randn(s.width, embedding) * deviation)

    def forward(self, pictures: Float[Tensor, "batch 3 side side"]) -> Float[Tensor, "batch embedding"]:
        patches = self.conv1(pictures).flatten(2).mT
        tokens = torch.cat([self.class_embedding.expand(len(pictures), 1, -1), patches], 1)
        tokens = self.transformer(self.ln_pre(tokens + self.positional_embedding), causal=False)
        return self.ln_post(tokens[:, 0]) @ self.proj


class Bottleneck(nn.Module):
    """Residual block with average pooling instead of strides (Radford 2021, section 2.4)."""

    def __init__(self, inputs: int, planes: int, stride: int):
        super().__init__()
        outputs = planes * EXPANSION
        self.conv1, self.bn1 = nn.Conv2d(inputs, planes, 1, bias=False), nn.BatchNorm2d(planes)
        self.conv2, self.bn2 = nn.Conv2d(planes, planes, 3, padding=1, bias=False), nn.BatchNorm2d(planes)
        self.conv3, self.bn3 = nn.Conv2d(planes, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
        self.avgpool = nn.AvgPool2d(stride)
        parts = {"-1": nn.AvgPool2d(stride), "0": nn.Conv2d(inputs, outputs, 1, bias=False)}
        parts |= {"1": nn.BatchNorm2d(outputs)}
        self.downsample = nn.Sequential(OrderedDict(parts if stride > 1 or inputs != outputs else {}))

    def forward(self, x: Float[Tensor, "batch inputs height width"]) -> Float[Tensor, "batch outputs h w"]:
        y = relu(self.bn1(self.conv1(x)))
        y = self.avgpool(relu(self.bn2(self.conv2(y))))
        return relu(self.bn3(self.conv3(y)) + self.downsample(x))


class AttentionPool(nn.Module):
    """Attention pooling: attention of the mean to all positions (Radford 2021, section 2.4)."""

    def __init__(self, places: int, width: int, heads: int, embedding: int):
        super().__init__()
        self.heads = heads
        self.positional_embedding = nn.Parameter(torch.randn(places + 1, width) * width**-0.5)
        self.q_proj, self.k_proj, self.v_proj = (nn.Linear(width, width) for _ in range(3))
        self.c_proj = nn.Linear(width, embedding)

    def forward(self, x: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch embedding"]:
        tokens = x.flatten(2).mT
        tokens = torch.cat([tokens.mean(1, keepdim=True), tokens], 1) + self.positional_embedding
        q, k, v = self.q_proj(tokens[:, :1]), self.k_proj(tokens), self.v_proj(tokens)
        return self.c_proj(attended(q, k, v, self.heads)[:, 0])


class ModifiedResnet(nn.Module):
    """Residual network with average pooling for strides and attention pooling (Radford 2021, section 2.4)."""

    def __init__(self, s: ResnetSizes, picture: int, embedding: int):
        super().__init__()
        half = s.width // 2
        self.conv1, self.bn1 = nn.Conv2d(3, half, 3, 2, 1, bias=False), nn.BatchNorm2d(half)
        self.conv2, self.bn2 = nn.Conv2d(half, half, 3, 1, 1, bias=False), nn.BatchNorm2d(half)
        self.conv3, self.bn3 = nn.Conv2d(half, s.width, 3, 1, 1, bias=False), nn.BatchNorm2d(s.width)
        self.avgpool = nn.AvgPool2d(2)
        stages, inputs = [], s.width
        for number, blocks in enumerate(s.blocks):
            planes = s.width * 2**number
            outputs = planes * EXPANSION
            later = [Bottleneck(outputs, planes, 1) for _ in range(blocks - 1)]
            stages.append(nn.Sequential(Bottleneck(inputs, planes, 2 if number else 1), *later))
            inputs = outputs
        self.layer1, self.layer2, self.layer3, self.layer4 = stages
        self.attnpool = AttentionPool((picture // REDUCTION) ** 2, inputs, s.heads, embedding)

    def forward(self, pictures: Float[Tensor, "batch 3 side side"]) -> Float[Tensor, "batch embedding"]:
        x = relu(self.bn1(self.conv1(pictures)))
        x = relu(self.bn2(self.conv2(x)))
        x = self.avgpool(relu(self.bn3(self.conv3(x))))
        return self.attnpool(self.layer4(self.layer3(self.layer2(self.layer1(x)))))


class TextTransformer(nn.Module):
    """Causal transformer over the tokens of captions."""

    def __init__(self, s: TransformerSizes, vocabulary: int, context: int):
        super().__init__()
        self.token_embedding = nn.Embedding(vocabulary, s.width)
        nn.init.normal_(self.token_embedding.weight, std=0.02)
        self.positional_embedding = nn.Parameter(torch.randn(context, s.width) * 0.01)
        self.transformer, self.ln_final = Transformer(s), nn.LayerNorm(s.width)

    def states(self, tokens: Int[Tensor, "batch token"]) -> Float[Tensor, "batch token width"]:
        """The last layer's output at each token."""
        embedded = self.token_embedding(tokens) + self.positional_embedding[: tokens.shape[1]]
        return self.ln_final(self.transformer(embedded, causal=True))


class Clip(TextTransformer):
    """Embeddings of pictures and of captions, both of unit length."""

    def __init__(self, sizes: ClipSizes):
        super().__init__(sizes.text, sizes.vocabulary, sizes.context)
        self.sizes, vision = sizes, sizes.vision
        tower = ModifiedResnet if isinstance(vision, ResnetSizes) else VisionTransformer
        self.visual = tower(vision, sizes.picture, sizes.embedding)  # type: ignore[arg-type]
        self.text_projection = nn.Parameter(torch.randn(sizes.text.width, sizes.embedding) * sizes.text.width**-0.5)
        self.logit_scale = nn.Parameter(torch.tensor(INITIAL_SCALE))

    def of_pictures(self, rgb: Float[Tensor, "batch 3 side side"]) -> Float[Tensor, "batch embedding"]:
        """Embeddings of sRGB pictures in [0, 1], of the model's input size."""
        mean, deviation = (rgb.new_tensor(x)[:, None, None] for x in (MEAN, DEVIATION))
        return normalize(self.visual((rgb - mean) / deviation), dim=-1)

    def of_captions(self, tokens: Int[Tensor, "batch token"]) -> Float[Tensor, "batch embedding"]:
        """Embeddings of captions, at their end token, whose number is the largest."""
        last = self.states(tokens)[torch.arange(len(tokens), device=tokens.device), tokens.argmax(-1)]
        return normalize(last @ self.text_projection, dim=-1)

    @property
    def scale(self) -> Tensor:
        """Inverse temperature of the contrastive loss."""
        return self.logit_scale.clamp_max(MAX_SCALE).exp()
