"""A small CLIP trained on captions of procedural scenes: guidance without downloaded weights.

CLIP's architecture and contrastive loss (Radford 2021, section 2.3) at small size. Pictures have random backgrounds and
adversarial perturbations (Madry 2018), so that the model's gradients look like objects (Santurkar 2019). An auxiliary
head classifies the objects of a picture; it is dropped after training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn
from torch.nn.functional import affine_grid, cross_entropy, grid_sample

from ..components.guidance.clip import EXPANSION, Clip, ClipSizes, ResnetSizes, TransformerSizes
from ..components.guidance.clip_files import HEAD_WIDTH
from ..components.guidance.tokenizer import Tokenizer
from ..components.guidance.views import backgrounds
from ..files.ranges import BatchSize, Count, LearningRate, NonNegative, Seed, Share, Steps, Width
from ..method import seeded
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

    pictures: Count = 6000  # pictures that are traced to learn from; more generalise better, and take longer
    steps: Steps = 6000  # steps of learning; more recognise more
    batch: BatchSize = 32  # pictures of a step, compared with their captions and as many others
    width: Width = 24  # channels of the residual network's stem; wider recognises more, and costs time
    embedding: Width = 64  # of the shared space
    learning_rate: LearningRate = 2e-3  # AdamW's learning rate at its highest
    weight_decay: NonNegative = 0.05  # of AdamW
    things_weight: NonNegative = 2.0  # weight of the loss that names each thing of a picture; 0: off
    perturbation: Share = 8 / 255  # largest change of a colour against the model; 0 is faster, its gradients are noise
    perturbed_from: Share = 0.8  # share of the steps after which pictures are perturbed
    distorted: Share = 0.5  # pictures of other colours or in pieces, for each of the batch; captions learn to tell them
    seed: Seed = 0


@dataclass(frozen=True)
class Learned:
    """Trained model, and its accuracy: share of held-out pictures whose own caption scores best of all pairs."""

    network: Clip
    tokenizer: Tokenizer
    held_out: float


def new_model(n: CaptionNumbers) -> tuple[Clip, Tokenizer]:
    """An untrained model, with a token for each word of the captions."""
    words = sorted({word for thing in captions.THINGS for word in captions.caption((thing, thing)).split()})
    tokenizer = Tokenizer.of_words(words, CONTEXT)
    vision = ResnetSizes(n.width, (1, 1, 1, 1), max(1, 8 * EXPANSION * n.width // HEAD_WIDTH))
    text = TransformerSizes(TEXT_WIDTH, TEXT_LAYERS, 2, 4 * TEXT_WIDTH)
    sizes = ClipSizes(vision, text, PIXELS, len(tokenizer.vocabulary), CONTEXT, n.embedding)
    with seeded(n.seed):
        network = Clip(sizes)
    return network, tokenizer


def learn_captions(n: CaptionNumbers) -> Learned:
    """Train a model on captions of procedural scenes.

    Three measures make it learn shapes beside colours: each picture is also contrasted with captions of no picture in
    the batch; an auxiliary linear head, dropped afterwards, classifies its objects; backgrounds gradually become
    textured.
    """
    random, generator = np.random.default_rng(n.seed), torch.Generator().manual_seed(n.seed)
    groups = list(captions.training_groups(random, n.pictures))
    traced = torch.from_numpy(captions.pictures(groups, TRACED_PIXELS, n.seed))
    network, tokenizer = new_model(n)
    network.visual.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    with seeded(n.seed):
        head = nn.Linear(n.embedding, len(captions.THINGS))
    distinct = {frozenset(group): group for group in groups}
    numbers = {things: i for i, things in enumerate(distinct)}
    same = torch.tensor([numbers[frozenset(group)] for group in groups])
    tokens = torch.stack([tokenizer([captions.caption(x) for x in (y, y[::-1])]) for y in distinct.values()])
    short = torch.tensor([len(x) < 3 for x in distinct])
    there = torch.tensor([[thing in x for thing in captions.THINGS] for x in distinct])
    optimizer = torch.optim.AdamW(
        [*network.parameters(), *head.parameters()], n.learning_rate, weight_decay=n.weight_decay
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, n.learning_rate, n.steps, pct_start=WARMUP)
    for step in track(range(n.steps), "Learning captions", n.steps):
        chosen = different(same, n.batch, generator)
        own = same[chosen]
        others = short.clone()
        others[own] = False
        others = others.nonzero()[:, 0]
        shown = torch.cat([own, others[torch.randperm(len(others), generator=generator)[: n.batch]]])
        order = torch.randint(2, (len(shown),), generator=generator)
        pictures = augmented(traced[chosen], PIXELS, generator, step / n.steps)
        said = network.of_captions(tokens[shown, order])
        if n.perturbation and step >= n.perturbed_from * n.steps:
            pictures = perturbed(network, pictures, said.detach(), n.perturbation, generator)
        optimizer.zero_grad()
        wrong = distorted(pictures[: round(n.distorted * len(pictures))], generator)
        seen = network.of_pictures(torch.cat([pictures, wrong]))
        things = thing_loss(network.scale * head(seen[: len(pictures)]), there[own])
        loss = contrast(network, seen, said, len(pictures)) + n.things_weight * things
        loss.backward()
        optimizer.step()
        schedule.step()
    network.eval().requires_grad_(False)
    return Learned(network, tokenizer, recognised(network, tokenizer, n.seed + 1))


def different(same: Int[Tensor, " picture"], count: int, generator: torch.Generator) -> Int[Tensor, " chosen"]:
    """Random pictures, at most one of each group of objects. same: group number of each picture

    Groups are sampled in proportion to their size. Sampled evenly, groups of three objects, of which there are most,
    would fill the batch, and their shapes are the smallest.
    """
    order = torch.randperm(len(same), generator=generator)[: 2 * count]
    last = torch.full((int(same.max()) + 1,), -1)
    last[same[order]] = order
    there = last[last >= 0]
    return there[torch.randperm(len(there), generator=generator)[:count]]


def contrast(
    network: Clip, seen: Float[Tensor, "picture embedding"], said: Float[Tensor, "caption embedding"], count: int
) -> Tensor:
    """The symmetric contrastive loss (Radford 2021, figure 3) of embeddings.

    seen: of pictures, then of pictures without a caption
    said: of captions, then of captions without a picture; the first `count` of both are pairs
    """
    logits = network.scale * seen @ said.T
    own = torch.arange(count, device=logits.device)
    return 0.5 * (cross_entropy(logits[:count], own) + cross_entropy(logits[:, :count].T, own))


def distorted(
    pictures: Float[Tensor, "picture 3 side side"], generator: torch.Generator
) -> Float[Tensor, "picture 3 side side"]:
    """Negative examples: pictures with permuted or inverted colour channels; a quarter of them instead cut into
    quarters that are permuted, a quarter rotated by 90 degrees.

    Without them a model may take a colour that no object has, such as cyan, for any of them.
    """
    count, half = len(pictures), pictures.shape[-1] // 2
    channels = torch.stack([torch.randperm(3, generator=generator) for _ in range(count)])
    inverted = torch.rand(count, 3, 1, 1, generator=generator) < 0.5
    inverted[(channels == torch.arange(3)).all(1)] = True
    recoloured = pictures.gather(1, channels[:, :, None, None].expand_as(pictures))
    recoloured = torch.where(inverted, 1 - recoloured, recoloured)
    cut, lying = torch.roll(pictures, (half, half), (2, 3)), torch.rot90(pictures, 1, (2, 3))
    kind = torch.randint(4, (count, 1, 1, 1), generator=generator)
    return torch.where(kind == 0, cut, torch.where(kind == 1, lying, recoloured))


def thing_loss(logits: Float[Tensor, "picture thing"], there: Bool[Tensor, "picture thing"]) -> Tensor:
    """Cross entropy of each object in a picture against absent objects.

    Absent objects that would form a held-out pair with a present one are excluded, so that those are not learnt as
    wrong.
    """
    never = torch.zeros(2 * [len(captions.THINGS)])
    for pair in captions.held_out():
        a, b = map(captions.THINGS.index, pair)
        never[a, b] = never[b, a] = 1
    picture, thing = there.nonzero(as_tuple=True)
    beside = there[picture].float()
    beside[torch.arange(len(picture)), thing] = 0
    return cross_entropy(logits[picture].masked_fill(beside + beside @ never > 0, -torch.inf), thing)


def perturbed(
    network: Clip,
    pictures: Float[Tensor, "picture 3 size size"],
    said: Float[Tensor, "caption embedding"],
    most: float,
    generator: torch.Generator,
) -> Float[Tensor, "picture 3 size size"]:
    """Adversarial pictures: one gradient step from a random start (Wong 2020). most: largest change of a colour"""
    start = most * (2 * torch.rand(pictures.shape, generator=generator) - 1)
    changed = (pictures + start).requires_grad_()
    (gradient,) = torch.autograd.grad(contrast(network, network.of_pictures(changed), said, len(changed)), changed)
    away = (changed.detach() + 1.25 * most * gradient.sign() - pictures).clamp(-most, most)
    return (pictures + away).clamp(0, 1)


def augmented(
    rgba: UInt8[Tensor, "picture side side 4"], size: int, generator: torch.Generator, textured: float = 0.5
) -> Float[Tensor, "picture 3 size size"]:
    """Pictures mirrored, cropped, over random backgrounds, with noise. textured: share of textured backgrounds"""
    count = len(rgba)
    turn = torch.zeros(count, 2, 3)
    zoom = 1 + MAX_ZOOM * (2 * torch.rand(count, generator=generator) - 1)
    mirror = 2.0 * torch.randint(2, (count,), generator=generator) - 1
    turn[:, 0, 0], turn[:, 1, 1] = zoom * mirror, zoom
    turn[:, :, 2] = MAX_SHIFT * (2 * torch.rand(count, 2, generator=generator) - 1)
    grid = affine_grid(turn, [count, 4, size, size], align_corners=False)
    x = grid_sample(premultiplied(rgba), grid, align_corners=False)
    x = before_random(x, generator, textured)
    noise = torch.randn(x.shape, generator=generator) * torch.rand(count, 1, 1, 1, generator=generator)
    return (x + MAX_NOISE * noise).clamp(0, 1)


def premultiplied(rgba: UInt8[Tensor, "picture side side 4"]) -> Float[Tensor, "picture 4 side side"]:
    """Pictures in [0, 1] with colours multiplied by alpha."""
    x = rgba.movedim(-1, 1).float() / 255
    return torch.cat([x[:, :3] * x[:, 3:], x[:, 3:]], 1)


def before_random(
    rgba: Float[Tensor, "picture 4 side side"], generator: torch.Generator, textured: float = 0.5
) -> Float[Tensor, "picture 3 side side"]:
    """Premultiplied pictures over random backgrounds: plain, or for a share textured as in Dream Fields."""
    behind = torch.rand(len(rgba), 3, 1, 1, generator=generator).expand(len(rgba), 3, *rgba.shape[2:]).clone()
    chosen = torch.randperm(len(rgba), generator=generator)[: round(textured * len(rgba))]
    if len(chosen):
        behind[chosen] = backgrounds(len(chosen), rgba.shape[-1], generator)
    return rgba[:, :3] + (1 - rgba[:, 3:]) * behind


@torch.no_grad()
def recognised(network: Clip, tokenizer: Tokenizer, seed: int) -> float:
    """Accuracy: share of held-out pictures whose own caption scores best among those of all pairs."""
    pairs = captions.pairs()
    shown = [pair for pair in captions.held_out() for _ in range(HELD_OUT_PICTURES)]
    traced = torch.from_numpy(captions.pictures(shown, network.sizes.picture, seed))
    pictures = before_random(premultiplied(traced), torch.Generator().manual_seed(seed))
    said = network.of_captions(tokenizer([captions.caption(pair) for pair in pairs]))
    best = (network.of_pictures(pictures) @ said.T).argmax(-1)
    return float((best == torch.arange(len(captions.held_out())).repeat_interleave(HELD_OUT_PICTURES)).float().mean())
