"""Adaptive density control: clone, split and prune (Kerbl 2023, section 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...exchange.packing import Stored
from ...files.ranges import NonNegative, Steps
from ...geometry import to_matrix
from .addition import Step, TrainingViews
from .cloud import Cloud, GrowingCloud
from .density_control import PRUNE_OPACITY, DensityControl, RefineNumbers

MAX_CLONED_SCALE = 0.01  # deviation, of the extent, up to which a Gaussian is cloned and not split
SPLIT_FACTOR = 1.6  # by which the halves of a split Gaussian are smaller, section 5.2
RECOVERY_INTERVALS = 3  # opacity_reset_intervals that must follow a reset, or the pictures stay dim
NEARLY_FULL = 0.99  # of the cap


@dataclass(frozen=True)
class AdaptiveNumbers:
    """A Config's numbers of adaptive density control."""

    densify_grad_threshold: NonNegative = 2e-4  # positional gradient above which Gaussians are added, 5.2; lower: more
    opacity_reset_interval: Steps = 3000  # steps between opacity resets, section 5.2


class AdaptiveDensity(DensityControl):
    """Clone small Gaussians with a large gradient, split large ones, prune faint ones.

    The gradient is the mean length of the loss's gradient in a footprint's centre, in half pictures.
    positional_gradient_sum: of these lengths since the last change
    visible_count:           number of steps since then in which each Gaussian was visible
    ramp:                    power of the budget's share with which the cap rises
    """

    grows: ClassVar[tuple[str, ...]] = ("positional_gradient_sum", "visible_count")
    ramp: ClassVar[float] = 1.0
    positional_gradient_sum: Tensor
    visible_count: Tensor

    def __init__(self, refine: RefineNumbers, numbers: AdaptiveNumbers, count: int):
        super().__init__(refine)
        self.numbers = numbers
        for name in self.grows:
            self.register_buffer(name, torch.zeros(count))

    def begin_cloud(self, cloud: Cloud, views: TrainingViews, chance: torch.Generator) -> None:
        super().begin_cloud(cloud, views, chance)
        for name in self.grows:
            setattr(self, name, getattr(self, name).new_zeros(len(cloud)))

    def follow(self, source: Int[Tensor, " gaussian"]) -> None:
        for name in self.grows:
            setattr(self, name, getattr(self, name)[source])

    def storage(self) -> dict[str, Stored]:
        return dict.fromkeys(self.grows, Stored("nothing"))

    @torch.no_grad()
    def finish(self, step: Step) -> None:
        progress, cloud, number = step.progress, step.learnt, step.number
        if progress >= self.refining.refine_until:
            return
        self.note(step)
        steps = number / max(progress, 1e-6)  # of the whole budget
        if step.due:
            cap = self.current_cap(cloud, progress, steps)
            full = self.refine(cloud, float(cloud.extent), cap, step.refining)
            if full and len(cloud) >= NEARLY_FULL * self.max_count(cloud, steps):
                self.warn_full(cloud, steps)
        every = self.numbers.opacity_reset_interval
        if number and number % every == 0 and step.full_size and steps - number >= RECOVERY_INTERVALS * every:
            self.reset_opacity(cloud)

    def note(self, step: Step) -> None:
        """Follow a step, for the next change."""
        picture = step.picture
        height, width = picture.opacity.shape
        assert picture.centres.grad is not None
        self.record(picture.centres.grad, picture.opacities > 0, (width, height))

    def current_cap(self, cloud: Cloud, progress: float, steps: float = 0.0) -> int:
        """Cap at this share of a budget of `steps` steps: with `cap_ramp` it rises until `refine_until`."""
        first, cap = int(self.initial_count), self.max_count(cloud, steps)
        if not self.refining.cap_ramp:
            return cap
        share = min(1.0, progress / self.refining.refine_until) ** self.ramp
        return min(cap, int(first + share * max(cap - first, 0)))

    @torch.no_grad()
    def record(
        self, gradient: Float[Tensor, "gaussian 2"], visible: Bool[Tensor, " gaussian"], size: tuple[int, int]
    ) -> None:
        """Add one step's gradient of the footprints' centres, per pixel."""
        half = gradient.new_tensor(size) / 2
        self.positional_gradient_sum += (gradient * half).norm(dim=-1)
        self.visible_count += visible

    @torch.no_grad()
    def refine(self, cloud: GrowingCloud, extent: float, cap: int, generator: torch.Generator) -> bool:
        """Clone, split and prune. Returns whether the cap prevented some clones or splits."""
        gradient = self.positional_gradient_sum / self.visible_count.clamp_min(1)
        kept = (~(cloud.opacities.sigmoid() < PRUNE_OPACITY)).nonzero()[:, 0]
        wanted = kept[gradient[kept] > self.numbers.densify_grad_threshold]
        chosen = largest(wanted, gradient, cap - len(kept))
        large = cloud.log_scales[chosen].exp().amax(-1) > MAX_CLONED_SCALE * extent
        split, _ = add_copies(cloud, kept, chosen, chosen[large])
        scatter(cloud, split, generator)
        for name in self.grows:
            getattr(self, name).zero_()
        return len(chosen) < len(wanted)

    @torch.no_grad()
    def reset_opacity(self, cloud: Cloud) -> None:
        """Clamp opacities to twice the pruning threshold (section 5.2); those that the photographs need grow again."""
        cloud.opacities.clamp_(max=float(torch.tensor(2 * PRUNE_OPACITY).logit()))
        assert cloud.optimizer is not None
        state = cloud.optimizer.state[cloud.opacities]
        for moment in ("mean", "square"):
            state[moment].zero_()
        state["last"].fill_(float(state["step"]))


def largest(rows: Int[Tensor, " candidate"], score: Float[Tensor, " gaussian"], room: int) -> Int[Tensor, " chosen"]:
    """The rows, or the `room` of them with the largest score, in their order."""
    return rows if len(rows) <= room else rows[score[rows].argsort(descending=True)[: max(room, 0)]].sort().values


@torch.no_grad()
def add_copies(
    cloud: GrowingCloud, kept: Int[Tensor, " kept"], copied: Int[Tensor, " copied"], divided: Int[Tensor, " divided"]
) -> tuple[Bool[Tensor, " new"], Bool[Tensor, " new"]]:
    """Rebuild a cloud of the rows that are kept, and copies behind them. Returns masks of both halves of divided rows,
    whose moments are zero, and of the copies."""
    source = torch.cat([kept, copied])
    fresh = torch.arange(len(source), device=source.device) >= len(kept)
    halved = torch.zeros(len(cloud), dtype=torch.bool, device=source.device)
    halved[divided] = True
    halves = halved[source]  # the original is the other half
    cloud.rebuild(source, fresh | halves)
    return halves, fresh


@torch.no_grad()
def scatter(cloud: GrowingCloud, split: Bool[Tensor, " gaussian"], generator: torch.Generator) -> None:
    """Move the two halves of each split Gaussian to random samples of it, and scale them by 1 / 1.6 (section 5.2)."""
    some = cloud.gaussians()[split]
    offset = torch.randn(len(some), 3, generator=generator).to(some.means.device) * some.log_scales.exp()
    cloud.means[split] += (to_matrix(some.quaternions) @ offset[:, :, None])[:, :, 0]
    cloud.log_scales[split] -= float(torch.tensor(SPLIT_FACTOR).log())
