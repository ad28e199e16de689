"""A small text-and-image model that learns from captions of procedural scenes: guidance without anybody's weights.

CLIP's architecture and contrastive loss (Radford 2021, section 2.3) at small size. Pictures stand before random
backgrounds, and are perturbed against the model while it learns (Madry 2018), so that its gradients look like things
(Santurkar 2019)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from torch.nn.functional import affine_grid, cross_entropy, grid_sample

from ..color.blending import before
from ..components.guidance.clip import EXPANSION, Clip, ClipSizes, ResnetSizes, TransformerSizes
from ..components.guidance.clip_files import HEAD_WIDTH
from ..components.guidance.tokenizer import Tokenizer
from ..components.guidance.views import backgrounds
from ..files.ranges import BatchSize, Count, LearningRate, NonNegative, Seed, Share, Steps, Width
from ..synthetic import captions
from ..system.progress import track

CONTEXT = 16  # tokens of a caption
TEXT_WIDTH, TEXT_LAYERS = 64, 2
WARMUP = 0.07  # share of the steps in which the learning rate rises
MAX_ZOOM, MAX_SHIFT, MAX_NOISE = 0.2, 0.1, 0.05  # of random crops; deviation of the noise
TRACED_PIXELS = 48  # a side of traced pictures
HELD_OUT_PICTURES = 10  # of each held-out caption
PIXELS = 32  # a side of the model's pictures


@dataclass(frozen=True)
class CaptionNumbers:
    """Numbers of the model and of its training."""

    pictures: Count = 3000  # pictures that are traced to learn from; more generalise better, and take longer
    steps: Steps = 2000  # steps of learning; more recognise more
    batch: BatchSize = 64  # pictures in a step, each the wrong one for all other captions
    width: Width = 16  # channels of the residual network's stem; wider recognises more, and costs time
    embedding: Width = 64  # of the shared space
    learning_rate: LearningRate = 1e-3  # AdamW's learning rate at its highest
    weight_decay: NonNegative = 0.05  # of AdamW
    perturbation: Share = 8 / 255  # largest change of a colour against the model; 0 is faster, its gradients are noise
    perturbed_from: Share = 0.8  # share of the steps after which pictures are perturbed
    seed: Seed = 0


@dataclass(frozen=True)
class Learned:
    """A model, and the share of pictures of held-out pairs that it gives their caption, among those of all pairs."""

    network: Clip
    tokenizer: Tokenizer
    held_out: float


def new_model(n: CaptionNumbers) -> tuple[Clip, Tokenizer]:
    """A model that has learnt nothing, with a token for each word of the captions."""
    words = sorted({word for thing in captions.THINGS for word in captions.caption((thing, thing)).split()})
    tokenizer = Tokenizer.of_words(words, CONTEXT)
    vision = ResnetSizes(n.width, (1, 1, 1, 1), max(1, 8 * EXPANSION * n.width // HEAD_WIDTH))
    text = TransformerSizes(TEXT_WIDTH, TEXT_LAYERS, 2, 4 * TEXT_WIDTH)
    sizes = ClipSizes(vision, text, PIXELS, len(tokenizer.vocabulary), CONTEXT, n.embedding)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(n.seed)
        network = Clip(sizes)
    return network, tokenizer


def learn_captions(n: CaptionNumbers) -> Learned:
    """A model of the captions of procedural scenes."""
    random, generator = np.random.default_rng(n.seed), torch.Generator().manual_seed(n.seed)
    groups = list(captions.training_groups(random, n.pictures))
    traced = torch.from_numpy(captions.pictures(groups, TRACED_PIXELS, n.seed))
    network, tokenizer = new_model(n)
    network.visual.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    tokens = torch.stack([tokenizer([captions.caption(order) for order in (x, x[::-1])]) for x in groups])
    numbers = {things: i for i, things in enumerate(dict.fromkeys(frozenset(x) for x in groups))}
    same = torch.tensor([numbers[frozenset(x)] for x in groups])
    optimizer = torch.optim.AdamW(network.parameters(), n.learning_rate, weight_decay=n.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, n.learning_rate, n.steps, pct_start=WARMUP)
    for step in track(range(n.steps), "Learning captions", n.steps):
        chosen = different(same, n.batch, generator)
        order = torch.randint(2, (len(chosen),), generator=generator)
        pictures = augmented(traced[chosen], PIXELS, generator)
        said = network.of_captions(tokens[chosen, order])
        if n.perturbation and step >= n.perturbed_from * n.steps:
            pictures = perturbed(network, pictures, said.detach(), n.perturbation, generator)
        optimizer.zero_grad()
        loss = contrast(network, pictures, said)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    network.eval().requires_grad_(False)
    return Learned(network, tokenizer, recognised(network, tokenizer, n.seed + 1))


def different(same: Int[Tensor, " picture"], count: int, generator: torch.Generator) -> Int[Tensor, " chosen"]:
    """Random pictures, at most one of each group of things. same: number of each picture's group"""
    order = torch.randperm(len(same), generator=generator)
    first = torch.full((int(same.max()) + 1,), -1)
    first[same[order]] = order  # the last one of each group
    there = first[first >= 0]
    return there[torch.randperm(len(there), generator=generator)[:count]]


def contrast(
    network: Clip, pictures: Float[Tensor, "pair 3 size size"], said: Float[Tensor, "pair embedding"]
) -> Tensor:
    """The symmetric contrastive loss (Radford 2021, figure 3). said: embedding of each picture's caption"""
    logits = network.scale * network.of_pictures(pictures) @ said.T
    own = torch.arange(len(pictures), device=logits.device)
    return 0.5 * (cross_entropy(logits, own) + cross_entropy(logits.T, own))


def perturbed(
    network: Clip,
    pictures: Float[Tensor, "pair 3 size size"],
    said: Float[Tensor, "pair embedding"],
    most: float,
    generator: torch.Generator,
) -> Float[Tensor, "pair 3 size size"]:
    """Pictures changed against the model by one step from a random start (Wong 2020). most: change of a colour"""
    start = most * (2 * torch.rand(pictures.shape, generator=generator) - 1)
    changed = (pictures + start).requires_grad_()
    (gradient,) = torch.autograd.grad(contrast(network, changed, said), changed)
    away = (changed.detach() + 1.25 * most * gradient.sign() - pictures).clamp(-most, most)
    return (pictures + away).clamp(0, 1)


def augmented(
    rgba: UInt8[Tensor, "picture side side 4"], size: int, generator: torch.Generator
) -> Float[Tensor, "picture 3 size size"]:
    """Pictures before random backgrounds, mirrored, cropped, brighter or darker, with noise."""
    count = len(rgba)
    rgb = before_random(rgba, generator)
    turn = torch.zeros(count, 2, 3)
    zoom = 1 + MAX_ZOOM * (2 * torch.rand(count, generator=generator) - 1)
    mirror = 2.0 * torch.randint(2, (count,), generator=generator) - 1
    turn[:, 0, 0], turn[:, 1, 1] = zoom * mirror, zoom
    turn[:, :, 2] = MAX_SHIFT * (2 * torch.rand(count, 2, generator=generator) - 1)
    grid = affine_grid(turn, [count, 3, size, size], align_corners=False)
    x = grid_sample(rgb, grid, padding_mode="reflection", align_corners=False)
    noise = torch.randn(x.shape, generator=generator) * torch.rand(count, 1, 1, 1, generator=generator)
    return (x + MAX_NOISE * noise).clamp(0, 1)


def before_random(
    rgba: UInt8[Tensor, "picture side side 4"], generator: torch.Generator
) -> Float[Tensor, "picture 3 side side"]:
    """Pictures before random backgrounds: plain, or those of Dream Fields."""
    x = rgba.float() / 255
    plain = torch.rand(len(x), 3, 1, 1, generator=generator)
    behind = torch.where(
        torch.rand(len(x), 1, 1, 1, generator=generator) < 0.5, plain, backgrounds(len(x), x.shape[1], generator)
    )
    return before(x[..., :3], x[..., 3], behind.movedim(1, -1)).movedim(-1, 1)


@torch.no_grad()
def recognised(network: Clip, tokenizer: Tokenizer, seed: int) -> float:
    """Share of pictures of held-out pairs whose caption is the best among those of all pairs."""
    pairs = captions.pairs()
    shown = [pair for pair in captions.held_out() for _ in range(HELD_OUT_PICTURES)]
    traced = torch.from_numpy(captions.pictures(shown, network.sizes.picture, seed))
    pictures = before_random(traced, torch.Generator().manual_seed(seed))
    said = network.of_captions(tokenizer([captions.caption(pair) for pair in pairs]))
    best = (network.of_pictures(pictures) @ said.T).argmax(-1)
    return float((best == torch.arange(len(captions.held_out())).repeat_interleave(HELD_OUT_PICTURES)).float().mean())
