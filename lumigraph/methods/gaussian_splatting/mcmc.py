"""Density control as Markov chain Monte Carlo: relocation, growth and noise (Kheradmand 2024, arXiv 2404.09591)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...components.clouds.addition import Step
from ...components.clouds.cloud import Cloud
from ...components.clouds.density_control import PRUNE_OPACITY, DensityControl, RefineNumbers
from ...files.ranges import NonNegative
from ...gaussians import Gaussians
from ...geometry import to_matrix

NOISE_SCALE = 5e5  # times the means' learning rate (section 3.1 and the authors' release)
MAX_NOISE_OPACITY = 0.1  # above it the gate of the noise is below 1e-4
GROWTH_FACTOR = 1.05  # of the number of Gaussians at each change (section 3.2)
LAST_RELOCATION = 0.9  # share of the budget after which none is relocated or added, so that those there converge
MAX_COPIES = 51  # of one Gaussian at a change; more are computed as so many
OPACITY_REGULARIZATION = 0.01  # weight of the mean opacity, for mcmc (Kheradmand 2024, eq. 11)
SCALE_REGULARIZATION = 0.01  # weight of the mean scale in extents, for mcmc (eq. 11)


@dataclass(frozen=True)
class McmcNumbers:
    """A Config's numbers of the strategy mcmc."""

    joining_per_step: NonNegative = 0.0  # Gaussians that mcmc adds for each step, if 5 % a time would be fewer


class MarkovChain(DensityControl):
    """The cloud as samples of a distribution: noise moves it, and faint Gaussians become copies of others."""

    def __init__(self, refine: RefineNumbers, numbers: McmcNumbers):
        super().__init__(refine)
        self.numbers = numbers

    def regularize(self, step: Step) -> None:
        """Regularisers of opacity and scale (eq. 11)."""
        whole = step.whole
        step.terms["opacity"] = OPACITY_REGULARIZATION * whole.opacities.sigmoid().mean()
        step.terms["scale"] = SCALE_REGULARIZATION / float(step.learnt.extent) * whole.log_scales.exp().mean()

    @torch.no_grad()
    def finish(self, step: Step) -> None:
        cloud, generator = step.learnt, step.refining
        if step.due and step.progress < LAST_RELOCATION:
            count = wanted = len(cloud)
            if step.progress < self.refining.refine_until:
                joined = int(self.initial_count) + step.number * self.numbers.joining_per_step
                wanted = int(max(GROWTH_FACTOR * count, joined))
            if wanted > max(cap := self.max_count(cloud), count) and cap < self.allowed():
                self.warn_full(cloud)
            self.refine(cloud, min(wanted, max(cap, count)), generator)
        assert cloud.optimizer is not None
        self.explore(cloud, cloud.optimizer.param_groups[0]["lr"], generator)

    @torch.no_grad()
    def explore(self, cloud: Cloud, rate: float, generator: torch.Generator) -> None:
        """Add noise to the means of nearly transparent Gaussians, along their own axes (eqs. 8 and 9)."""
        opacity = cloud.opacities.sigmoid()
        faint = (opacity < MAX_NOISE_OPACITY).nonzero()[:, 0]
        some = cloud.gaussians()[faint]
        gate = torch.sigmoid(100 * (PRUNE_OPACITY - opacity[faint]))
        noise = torch.randn(len(faint), 3, generator=generator).to(some.means.device) * gate[:, None]
        frame = to_matrix(some.quaternions)
        along = frame.mT @ (NOISE_SCALE * rate * noise)[:, :, None]
        cloud.means[faint] += (frame @ (along * (2 * some.log_scales).exp()[:, :, None]))[:, :, 0]

    @torch.no_grad()
    def refine(self, cloud: Cloud, count: int, generator: torch.Generator) -> None:
        """Make faint Gaussians copies of opaque ones, and add copies until there are `count` (section 3.2)."""
        opacity = cloud.opacities.sigmoid()
        living = (opacity > PRUNE_OPACITY) & cloud.log_scales.isfinite().all(-1)
        if not living.any():
            return
        dead = (~living).nonzero()[:, 0]
        joining = max(count - len(cloud), 0)
        chosen = sample_by(torch.where(living, opacity, 0), len(dead) + joining, generator)
        source = torch.arange(len(cloud), device=chosen.device)
        source[dead] = chosen[: len(dead)]
        source = torch.cat([source, chosen[len(dead) :]])
        copies = torch.bincount(source, minlength=len(cloud))[source]
        touched = copies > 1
        cloud.rebuild(source, touched)
        some = cloud.gaussians()[touched]
        shared = shared_out(some, copies[touched])
        cloud.opacities[touched], cloud.log_scales[touched] = shared.opacities, shared.log_scales


def shared_out(gaussians: Gaussians, copies: Int[Tensor, " gaussian"], min_opacity: float | None = None) -> Gaussians:
    """Opacity and scale of each of n copies that together render like the original (Kheradmand 2024, eq. 10).

    Opacity o' = 1 - (1 - o)^(1/n);
    scale times o / sum_{i=1..n} sum_{k<i} binomial(i - 1, k) (-1)^k o'^(k+1) / sqrt(k + 1).
    """
    opacity = gaussians.opacities.double().sigmoid()
    n = copies.clamp(max=MAX_COPIES).double()
    single = 1 - (1 - opacity) ** (1 / n)
    if min_opacity is not None:  # so that scales are those of the opacities that result
        single = single.clamp(min_opacity, 1 - 1e-6)
    total = torch.zeros_like(single)
    for i in range(1, int(n.max()) + 1 if len(n) else 0):
        row, binomial = torch.zeros_like(single), 1.0
        for k in range(i):
            row += binomial * (-1) ** k / (k + 1) ** 0.5 * single ** (k + 1)
            binomial *= (i - 1 - k) / (k + 1)
        total += torch.where(i <= n, row, 0)
    scales = gaussians.log_scales + (opacity / total).clamp_min(1e-6).log().float()[:, None]
    least = PRUNE_OPACITY if min_opacity is None else min_opacity
    return replace(gaussians, opacities=single.clamp(least, 1 - 1e-6).logit().float(), log_scales=scales)


def sample_by(weights: Float[Tensor, " gaussian"], count: int, generator: torch.Generator) -> Int[Tensor, " count"]:
    """Indices of Gaussians drawn with repetition, in proportion to the weights, of which there may be any number."""
    edges = weights.double().cumsum(0)
    drawn = torch.rand(count, generator=generator, dtype=torch.float64) * float(edges[-1])
    return torch.searchsorted(edges, drawn.to(edges.device)).clamp(max=len(weights) - 1)
