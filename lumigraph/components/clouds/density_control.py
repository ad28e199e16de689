"""Density control: two strategies that change the number and the places of Gaussians.

The method calls its strategy after every step. It may `rebuild` the cloud, and keeps in buffers what a resume needs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ...gaussians import Gaussians
from ...geometry import to_matrix
from .cloud import Cloud, CloudAdam

FAINT = 0.005  # opacity below which a Gaussian is as good as none (both papers)


class AdaptiveDensity(nn.Module):
    """Clone small Gaussians with a large gradient, split large ones, prune faint ones (Kerbl 2023, section 5).

    grad_threshold: mean length of the loss's gradient in a footprint's centre, in half pictures, above which a
                    Gaussian is cloned or split
    small:          largest deviation, as a share of the extent, up to which it is cloned rather than split
    """

    grows: ClassVar[tuple[str, ...]] = ("pulls", "sightings")
    pulls: Tensor
    sightings: Tensor

    def __init__(self, count: int, grad_threshold: float, small: float = 0.01):
        super().__init__()
        self.grad_threshold, self.small = grad_threshold, small
        self.register_buffer("pulls", torch.zeros(count))
        self.register_buffer("sightings", torch.zeros(count))

    def begin(self, count: int) -> None:
        """Set the gradients seen so far to zero, for a cloud of `count` Gaussians."""
        self.pulls, self.sightings = self.pulls.new_zeros(count), self.sightings.new_zeros(count)

    def prune(self, keep: Bool[Tensor, " gaussian"]) -> None:
        """Forget the gradients of Gaussians that are no longer there."""
        self.pulls, self.sightings = self.pulls[keep], self.sightings[keep]

    @torch.no_grad()
    def note(self, pull: Float[Tensor, "gaussian 2"], shown: Bool[Tensor, " gaussian"], size: tuple[int, int]) -> None:
        """Add one step's gradient in the footprints' centres, given per pixel."""
        half = pull.new_tensor(size) / 2
        self.pulls += (pull * half).norm(dim=-1)
        self.sightings += shown

    @torch.no_grad()
    def refine(self, cloud: Cloud, optimizer: CloudAdam, extent: float, most: int, generator: torch.Generator) -> bool:
        """Clone, split and prune. Returns whether the cloud had to stay smaller than it wanted to be."""
        pulled = self.pulls / self.sightings.clamp_min(1)
        wanted = (pulled > self.grad_threshold).nonzero()[:, 0]
        faint = cloud.opacities.sigmoid() < FAINT
        wanted = wanted[~faint[wanted]]
        room = max(most - int((~faint).sum()), 0)
        full = len(wanted) > room
        if full:  # the largest gradients first
            wanted = wanted[pulled[wanted].argsort(descending=True)[:room]].sort().values
        large = cloud.log_scales[wanted].exp().amax(-1) > self.small * extent
        kept = (~faint).nonzero()[:, 0]
        source = torch.cat([kept, wanted])
        fresh = torch.arange(len(source), device=source.device) >= len(kept)
        halves = torch.zeros(len(cloud), dtype=torch.bool, device=source.device)
        halves[wanted[large]] = True
        split = halves[source]  # the original of a split is the other half
        cloud.rebuild(optimizer, source, fresh | split)
        scatter(cloud, split, generator)
        self.begin(len(cloud))
        return full

    @torch.no_grad()
    def reset_opacity(self, cloud: Cloud, optimizer: CloudAdam) -> None:
        """Clamp opacities to twice the pruning threshold (section 5.2); those that the photographs need grow again."""
        cloud.opacities.clamp_(max=float(torch.tensor(2 * FAINT).logit()))
        state = optimizer.state[cloud.opacities]
        for moment in ("mean", "square"):
            state[moment].zero_()
        state["last"].fill_(float(state["step"]))


@torch.no_grad()
def scatter(cloud: Cloud, split: Bool[Tensor, " gaussian"], generator: torch.Generator) -> None:
    """Move the two halves of each split Gaussian to random places within it, 1.6 times smaller (section 5.2)."""
    some = cloud.gaussians()[split]
    offset = torch.randn(len(some), 3, generator=generator).to(some.means.device) * some.log_scales.exp()
    cloud.means[split] += (rotations(some) @ offset[:, :, None])[:, :, 0]
    cloud.log_scales[split] -= float(torch.tensor(1.6).log())


class MarkovChain(nn.Module):
    """The cloud as samples of a distribution: noise moves it, faint ones become copies of others (Kheradmand 2024).

    noise: of a step, in units of the means' learning rate (section 3.1 and the authors' release)
    """

    def __init__(self, noise: float = 5e5):
        super().__init__()
        self.noise = noise

    @torch.no_grad()
    def explore(self, cloud: Cloud, rate: float, generator: torch.Generator) -> None:
        """Add noise to the means of nearly transparent Gaussians, along their own axes (eqs. 8 and 9)."""
        opacity = cloud.opacities.sigmoid()
        loose = (opacity < 0.1).nonzero()[:, 0]  # the gate below is under 1e-4 for all others
        some = cloud.gaussians()[loose]
        gate = torch.sigmoid(100 * (FAINT - opacity[loose]))
        shake = torch.randn(len(loose), 3, generator=generator).to(some.means.device) * gate[:, None]
        frame = rotations(some)
        along = frame.mT @ (self.noise * rate * shake)[:, :, None]
        cloud.means[loose] += (frame @ (along * (2 * some.log_scales).exp()[:, :, None]))[:, :, 0]

    @torch.no_grad()
    def refine(self, cloud: Cloud, optimizer: CloudAdam, count: int, generator: torch.Generator) -> None:
        """Make faint Gaussians copies of opaque ones, and add copies until there are `count` (section 3.2)."""
        opacity = cloud.opacities.sigmoid()
        living = (opacity > FAINT) & cloud.log_scales.isfinite().all(-1)
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
        cloud.rebuild(optimizer, source, touched)
        some = cloud.gaussians()[touched]
        shared = shared_out(some, copies[touched])
        cloud.opacities[touched], cloud.log_scales[touched] = shared.opacities, shared.log_scales


def shared_out(gaussians: Gaussians, copies: Int[Tensor, " gaussian"]) -> Gaussians:
    """Opacity and size of each of n copies that together look as the one they replace (Kheradmand 2024, eq. 10).

    Opacity o' = 1 - (1 - o)^(1/n);
    scale times o / sum_{i=1..n} sum_{k<i} binomial(i - 1, k) (-1)^k o'^(k+1) / sqrt(k + 1).
    """
    opacity, most = gaussians.opacities.double().sigmoid(), 51  # more copies than that are taken for so many
    n = copies.clamp(max=most).double()
    single = 1 - (1 - opacity) ** (1 / n)
    total = torch.zeros_like(single)
    for i in range(1, int(n.max()) + 1 if len(n) else 0):
        row, binomial = torch.zeros_like(single), 1.0
        for k in range(i):
            row += binomial * (-1) ** k / (k + 1) ** 0.5 * single ** (k + 1)
            binomial *= (i - 1 - k) / (k + 1)
        total += torch.where(i <= n, row, 0)
    scales = gaussians.log_scales + (opacity / total).clamp_min(1e-6).log().float()[:, None]
    return replace(gaussians, opacities=single.clamp(FAINT, 1 - 1e-6).logit().float(), log_scales=scales)


def sample_by(weights: Float[Tensor, " gaussian"], count: int, generator: torch.Generator) -> Int[Tensor, " count"]:
    """Random numbers of Gaussians with repetition, in proportion to the weights. Any number of them may take part."""
    edges = weights.double().cumsum(0)
    drawn = torch.rand(count, generator=generator, dtype=torch.float64) * float(edges[-1])
    return torch.searchsorted(edges, drawn.to(edges.device)).clamp(max=len(weights) - 1)


def rotations(gaussians: Gaussians) -> Float[Tensor, "gaussian 3 3"]:
    return to_matrix(gaussians.quaternions)
