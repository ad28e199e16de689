"""Likelihood of a small patch of colours under a flow of photographs' patches (Niemeyer 2022, section 3.4).

A normalising flow: an exact density, learnt by making patches into Gaussian noise and counting how much each step
stretches them. The paper's learnt from millions of photographs; this one learns for seconds, from the user's own.
"""

from __future__ import annotations

import math
import time

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...color.blending import before
from ...datasets.scene import Scene

SIDE = 8  # pixels along a patch's side (section 3.4)
COUPLINGS, WIDTH = 4, 96  # steps of the flow, and neurons of the two layers in each
PATCHES = 1 << 14  # that it learns from
SIZES = (1, 2, 4)  # times that photographs are reduced
BATCH, RATE = 512, 2e-3
GRAIN = 2 / 255  # deviation of noise on patches: colours are whole numbers, and a density of those has no bound
STIFF = 1.5  # bound of each coupling's log scale


class Coupling(nn.Module):
    """Affine coupling: half of the numbers, scaled and shifted by functions of the other half (Dinh 2017, section
    3.2)."""

    def __init__(self, width: int):
        super().__init__()
        half = width // 2
        last = nn.Linear(WIDTH, 2 * half)
        nn.init.zeros_(last.weight)  # at first it does nothing
        nn.init.zeros_(last.bias)
        self.network = nn.Sequential(nn.Linear(half, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), last)

    def forward(self, x: Float[Tensor, "patch number"]) -> tuple[Tensor, Float[Tensor, " patch"]]:
        """Transformed patches, with their halves exchanged, and the log determinant."""
        kept, moved = x.chunk(2, -1)
        raw, shift = self.network(kept).chunk(2, -1)
        log_scale = STIFF * torch.tanh(raw / STIFF)
        return torch.cat([moved * log_scale.exp() + shift, kept], -1), log_scale.sum(-1)


class PatchFlow(nn.Module):
    """Normalising flow of patches: whitening, rotation to a random basis, coupling layers.

    mean, whiten: of the training patches
    stretched:    log determinant of whitening
    """

    mean: Tensor
    whiten: Tensor
    stretched: Tensor

    def __init__(self):
        super().__init__()
        count = 3 * SIDE**2
        self.register_buffer("mean", torch.zeros(count))
        self.register_buffer("whiten", torch.eye(count))
        self.register_buffer("stretched", torch.tensor(0.0))
        self.couplings = nn.ModuleList(Coupling(count) for _ in range(COUPLINGS))
        self.requires_grad_(False)

    def forward(self, patches: Float[Tensor, "patch side side 3"]) -> Float[Tensor, " patch"]:
        """Negative log likelihood of each patch in nats a number, of sRGB-encoded colours."""
        x = (patches.flatten(1) - self.mean) @ self.whiten
        stretched = self.stretched.expand(len(x))
        for coupling in self.couplings:
            x, log_scale = coupling(x)
            stretched = stretched + log_scale
        nats = 0.5 * x.square().sum(-1) + 0.5 * x.shape[1] * math.log(2 * math.pi) - stretched
        return nats / x.shape[1]

    def learn(self, scene: Scene, steps: int, generator: torch.Generator, seconds: float = math.inf) -> None:
        """Learn from patches of the training photographs in several sizes, for some steps, or at most some seconds."""
        begin = time.perf_counter()
        known = photographed(scene, generator).to(self.mean)
        centred = known.flatten(1) - known.flatten(1).mean(0)
        variance, axes = torch.linalg.eigh(centred.T @ centred / len(centred))
        deviation = (variance.clamp_min(0) + GRAIN**2).sqrt()
        turned, _ = torch.linalg.qr(torch.randn(len(axes), len(axes), generator=generator).to(axes))
        self.mean.copy_(known.flatten(1).mean(0))
        self.whiten.copy_(axes / deviation @ turned)
        self.stretched.copy_(-deviation.log().sum())
        self.requires_grad_(True)
        optimizer = torch.optim.Adam(self.parameters(), RATE)
        for _ in range(steps):
            if time.perf_counter() - begin > seconds:
                break
            drawn = torch.randint(len(known), (BATCH,), generator=generator)
            grain = GRAIN * torch.randn(BATCH, SIDE, SIDE, 3, generator=generator)
            optimizer.zero_grad()
            with torch.enable_grad():
                self(known[drawn.to(known.device)] + grain.to(known)).mean().backward()
            optimizer.step()
        optimizer.zero_grad()
        self.requires_grad_(False)


def backdrops(count: int, generator: torch.Generator) -> Float[Tensor, "patch 3"]:
    """A random colour behind each patch where photographs have alpha."""
    return torch.rand(count, 3, generator=generator)


def photographed(scene: Scene, generator: torch.Generator) -> Float[Tensor, "patch side side 3"]:
    """Random patches of the training photographs, each photograph in several sizes; each patch of photographs with
    alpha is before a random colour."""
    train, found = scene.splits["train"].tolist(), []
    for index in train:
        shot = scene.photograph(index)
        for factor in SIZES:
            if min(shot.camera.size[0].tolist()) < SIDE * factor:
                continue
            small = shot.reduced(factor)
            height, width = small.rgb.shape[:2]
            each = math.ceil(PATCHES / (len(train) * len(SIZES)))
            y = torch.randint(height - SIDE + 1, (each,), generator=generator)
            x = torch.randint(width - SIDE + 1, (each,), generator=generator)
            steps = torch.arange(SIDE)
            pixels = (y[:, None] + steps)[:, :, None], (x[:, None] + steps)[:, None]
            alpha = None if small.alpha is None else small.alpha[pixels]
            found.append(before(small.rgb[pixels], alpha, backdrops(each, generator)[:, None, None]))
    return torch.cat(found)
