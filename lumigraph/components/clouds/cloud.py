"""Cloud: the Gaussians as parameters of varying number; CloudAdam, their optimizer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit, prange
from torch import Tensor, nn
from torch.nn.functional import normalize

from ...camera import Camera
from ...exchange.codes import morton_order
from ...exchange.packing import Stored, most_important
from ...files.ranges import LearningRate, between
from ...gaussians import Gaussians
from ...gaussians.splatting import splat, view_of
from ...method import Part
from ..training.row_optimizers import RowOptimizer, adam_moments, adam_rate, exchange
from ..training.schedules import falling
from .interval_schedule import short_schedule_lr_scale

NAMES = ("means", "quaternions", "log_scales", "opacities", "harmonics")
FULL_SCHEDULE = 2400  # steps from which on the rates of scales and harmonics are not scaled
REST_BANDS_SCALE = 1 / 20  # of the harmonics' learning rate, beyond the first band


# Learning rates of 3D Gaussian Splatting, graphdeco-inria/gaussian-splatting, arguments/__init__.py; see `RateNumbers`.
MEANS_LR, FINAL_MEANS_LR, SH_LR, OPACITIES_LR, SCALES_LR, QUATERNIONS_LR = 1.6e-4, 1.6e-6, 2.5e-3, 0.05, 5e-3, 1e-3
MOST_HASTE = 1.0  # factor on rates in short runs, where it is no option


@dataclass(frozen=True)
class HasteNumbers:
    """Options of learning rates; these are those of 3D Gaussian Splatting."""

    most_haste: Annotated[float, between(1, 1000)] = 1.0  # largest factor on scales' and colours' rates in short runs


@dataclass(frozen=True)
class RateNumbers:
    """Options of learning rates."""

    means_lr: LearningRate = MEANS_LR  # learning rate of the means at first, times the extent of the cameras
    final_means_lr: LearningRate = FINAL_MEANS_LR  # learning rate of the means at the end of the budget, likewise
    sh_lr: LearningRate = SH_LR  # learning rate of colours; a twentieth of it beyond the first band
    scales_lr: LearningRate = SCALES_LR  # learning rate of log scales
    quaternions_lr: LearningRate = QUATERNIONS_LR  # learning rate of rotations


@runtime_checkable
class GrowingCloud(Protocol):
    """Gaussians that density control may rebuild: a `Cloud`, or a `TensorCloud` of a dictionary's tensors."""

    means: Any
    log_scales: Any
    opacities: Any

    def __len__(self) -> int: ...

    def gaussians(self) -> Gaussians: ...

    def rebuild(self, source: Int[Tensor, " new"], fresh: Bool[Tensor, " new"]) -> None: ...


class Cloud(Part):
    """The tensors of `Gaussians` as parameters.

    view_bits: a bit for each photograph in which a Gaussian was visible, see `view_count`
    extent:    of the cameras, in scene units
    optimizer: updates the parameters, and is resized with them; None before training
    source:    former index of each Gaussian, if `rebuild` has changed them since `follow_rebuilds`; else None
    """

    grows: ClassVar[tuple[str, ...]] = (*NAMES, "view_bits")  # a saved one may be of another size

    means: nn.Parameter
    quaternions: nn.Parameter
    log_scales: nn.Parameter
    opacities: nn.Parameter
    harmonics: nn.Parameter
    view_bits: Tensor
    extent: Tensor
    optimizer: CloudAdam | None = None
    source: Int[Tensor, " gaussian"] | None = None

    def __init__(self, gaussians: Gaussians, rates: RateNumbers = RateNumbers(), most_haste: float = MOST_HASTE):
        super().__init__()
        self.rates, self.most_haste = rates, most_haste
        self.antialiased = gaussians.antialiased
        for name in NAMES:
            setattr(self, name, nn.Parameter(getattr(gaussians, name).clone()))
        self.register_buffer("view_bits", torch.zeros(len(gaussians), dtype=torch.int64))
        self.register_buffer("extent", torch.tensor(1.0))

    def __len__(self) -> int:
        return len(self.means)

    def gaussians(self) -> Gaussians:
        """The cloud; differentiable in the parameters."""
        return Gaussians(**{name: getattr(self, name) for name in NAMES}, antialiased=self.antialiased)

    def set_extent(self, cameras: Camera) -> None:
        """Set the extent: 1.1 times the radius of the cameras around their mean."""
        positions = cameras.position
        self.extent.fill_(1.1 * float((positions - positions.mean(0)).norm(dim=-1).max()))

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c = self.rates
        columns = [1.0] * 3 + [REST_BANDS_SCALE] * (3 * self.harmonics.shape[1] - 3)
        groups = [
            {"name": "means", "params": [self.means], "lr": c.means_lr},
            {"params": [self.quaternions], "lr": c.quaternions_lr},
            {"name": "scales", "params": [self.log_scales], "lr": c.scales_lr},
            {"params": [self.opacities], "lr": OPACITIES_LR},
            {"name": "harmonics", "params": [self.harmonics], "lr": c.sh_lr, "columns": columns},
        ]
        self.optimizer = CloudAdam(groups)
        return [self.optimizer]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        """Exponential decay of the means' rate (section 7.1), in extents of the cameras; the others are constant, but
        higher for scales and harmonics in short runs."""
        c = self.rates
        scale = short_schedule_lr_scale(step, progress, FULL_SCHEDULE, self.most_haste)
        means = float(self.extent) * falling(c.means_lr, c.final_means_lr, progress)
        return {"means": means, "scales": scale * c.scales_lr, "harmonics": scale * c.sh_lr}

    @torch.no_grad()
    def replace(self, gaussians: Gaussians) -> None:
        """Replace the cloud, with fresh moments."""
        self.source = None
        for name in NAMES:
            exchange(self, name, getattr(gaussians, name).detach().clone(), self.optimizer)
        self.view_bits = self.view_bits.new_zeros(len(gaussians))

    @torch.no_grad()
    def rebuild(self, source: Int[Tensor, " new"], fresh: Bool[Tensor, " new"]) -> None:
        """Make Gaussian i a copy of source[i]; the optimizer's moments of the fresh ones are zero.

        One operation for all of density control: a clone is an index twice, a pruned Gaussian a missing index.
        """
        assert self.optimizer is not None
        for name in NAMES:
            old = getattr(self, name)
            state = self.optimizer.state.get(old, {})
            if state:
                for moment in ("mean", "square", "last"):
                    state[moment] = state[moment][source]
                    state[moment][fresh] = state["step"] if moment == "last" else 0
            exchange(self, name, old.data[source], self.optimizer, state)
        self.view_bits = self.view_bits[source]
        self.source = source if self.source is None else self.source[source]

    def prune(self, keep: Bool[Tensor, " gaussian"]) -> None:
        """Keep the Gaussians of a mask, with their moments."""
        source = keep.nonzero()[:, 0]
        self.rebuild(source, torch.zeros_like(source, dtype=torch.bool))

    def record_view(self, image_index: Int[Tensor, " 1"], visible: Bool[Tensor, " gaussian"]) -> None:
        """Record the Gaussians that were visible in a photograph."""
        self.view_bits = with_view(self.view_bits, image_index, visible)

    @property
    def view_count(self) -> Int[Tensor, " gaussian"]:
        """Number of photographs in which each Gaussian was visible."""
        return view_count(self.view_bits)

    def storage(self) -> dict[str, Stored]:
        """Storage: positions need the most bits; harmonics beyond degree 0 are vector-quantised."""
        scaled = dict.fromkeys(("quaternions", "log_scales", "opacities"), Stored("scaled"))
        harmonics = Stored("coded", plain=3)
        return {"means": Stored("scaled", 16), **scaled, "harmonics": harmonics, "view_bits": Stored("nothing")}


class CloudAdam(RowOptimizer):
    """Adam (Kingma and Ba 2015) that skips rows of exactly zero gradient, and catches up later.

    Most Gaussians are not visible in most pictures. Adam would still move them, by their remaining momentum, for steps
    after each time they were visible; skipping that (as LazyAdam does) makes those that few photographs show ten times
    slower. Here a row that returns after n steps has its moments decayed n times, and takes at once the total step of
    its momentum over the n steps of its expected absence: (1 - b1^n) / (1 - b1) times a step.
    Each group holds one parameter (row, ...); its "columns", if given, multiply the rate of each column.
    """

    def __init__(self, groups, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15):
        super().__init__(groups, {"lr": 0.0, "betas": betas, "eps": eps, "columns": None})

    def moments(self, p):
        return adam_moments(p) | {"last": torch.zeros(len(p), device=p.device)}  # step at which each row was moved

    def update(self, p, grad, state, group):
        state["step"] += 1
        (b1, b2), t = group["betas"], float(state["step"])
        width = math.prod(p.shape[1:])
        rate, columns = adam_rate(group, t), _factors(p.device, *group["columns"] or [1.0] * width)
        given = p, grad.contiguous(), state["mean"], state["square"]
        values, slope, mean, square = (x.detach().view(-1, width) for x in given)
        tensors = values, slope, mean, square, state["last"]
        if p.is_cuda:
            from ...kernels._row_optimizers import cloud_adam

            cloud_adam(*tensors, columns, t, rate, (b1, b2), group["eps"])
        else:
            numbers = np.float32(t), _powers(b1), _powers(b2), np.float32(group["eps"])
            _rows_cpu(*(x.numpy() for x in (*tensors, rate * columns)), *numbers)


@lru_cache
def _factors(device: torch.device, *columns: float) -> Float[Tensor, " column"]:
    """Factors of the columns' rates, cached on their device."""
    return torch.tensor(columns, device=device)


@lru_cache
def _powers(base: float, count: int = 1 << 14) -> np.ndarray:
    """Table of base^n until it underflows, faster than a power."""
    return (base ** np.arange(count)).astype(np.float32)


@njit(parallel=True, fastmath=True, cache=True)
def _rows_cpu(p, grad, mean, square, last, rates, t, powers1, powers2, eps):
    one, width = np.float32(1), p.shape[1]
    b1, b2 = powers1[1], powers2[1]
    for i in prange(len(p)):
        size = np.float32(0)
        for j in range(width):
            size += abs(grad[i, j])
        if size > 0:
            away = min(np.int64(t - last[i]), len(powers1) - 1)
            kept1, kept2 = powers1[away], powers2[away]
            far = (one - kept1) / (one - b1)
            last[i] = t
            for j in range(width):
                g = grad[i, j]
                mean[i, j] = kept1 * mean[i, j] + (one - b1) * g
                square[i, j] = kept2 * square[i, j] + (one - b2) * g * g
                p[i, j] -= far * rates[j] * mean[i, j] / (np.sqrt(square[i, j]) + eps)


VIEW_BITS = 62  # bits of a row; further photographs share them, which may only lower the count
MIN_VIEWS = {1: 3, 4: 6}  # index of a coefficient, and the view count from which it and those beyond are learnt


def with_view(
    bits: Int[Tensor, " gaussian"], image_index: Int[Tensor, " 1"], visible: Bool[Tensor, " gaussian"]
) -> Int[Tensor, " gaussian"]:
    """View bits with one more photograph. A row is a bit set over photographs."""
    return bits | visible.long() << image_index % VIEW_BITS


def view_count(bits: Int[Tensor, " gaussian"]) -> Int[Tensor, " gaussian"]:
    """Population count of the bits: of 2, then 4, then 8 neighbours at once, and these summed by a multiplication."""
    pairs = bits - (bits >> 1 & 0x5555555555555555)
    fours = (pairs & 0x3333333333333333) + (pairs >> 2 & 0x3333333333333333)
    eights = fours + (fours >> 4) & 0x0F0F0F0F0F0F0F0F
    return eights * 0x0101010101010101 >> 56


@torch.no_grad()
def zero_unobserved_sh(harmonics: Float[Tensor, "gaussian coefficient 3"], bits: Int[Tensor, " gaussian"]) -> None:
    """Set harmonics to zero, in place, where a Gaussian's view count is too low to determine them: they would be
    arbitrary in other directions."""
    if not harmonics.is_cuda:
        _zero_unobserved_cpu(harmonics.detach().numpy(), bits.numpy(), np.array([*MIN_VIEWS.items()]))
        return
    for first, fewest in MIN_VIEWS.items():
        harmonics[view_count(bits) < fewest, first:] = 0


@njit(parallel=True, cache=True)
def _zero_unobserved_cpu(harmonics, bits, limits):
    enough = limits[-1, 1]
    for i in prange(len(bits)):
        left, count = bits[i], 0
        while left != 0 and count < enough:
            left, count = left & (left - 1), count + 1
        for k in range(len(limits)):
            if count < limits[k, 1]:
                harmonics[i, limits[k, 0] :] = 0


def picture_share(cloud: Gaussians, camera: Camera, near: float) -> Float[Tensor, " gaussian"]:
    """Derivative of a picture's brightness with respect to that of each Gaussian."""
    grey = torch.zeros(len(cloud), 1, 3, device=cloud.means.device, requires_grad=True)
    with torch.enable_grad():
        seen = splat(replace(cloud, harmonics=grey), view_of(camera, near), 1)
        (gain,) = torch.autograd.grad(seen.rgb.sum(), grey)
    return gain[:, 0].mean(-1)


def thinned(
    cloud: Gaussians, importance: Float[Tensor, " gaussian"], share: float
) -> tuple[Gaussians, Int[Tensor, " kept"]]:
    """The cloud pruned by a share of its Gaussians, the least important ones, and indices of the others, in Morton
    order, where neighbours are similar, with rotations as quaternions with w >= 0."""
    kept = most_important(importance, 1 - share).nonzero()[:, 0]
    kept = kept[torch.from_numpy(morton_order(cloud.means[kept].detach().cpu().numpy()))]
    upright = normalize(cloud.quaternions, dim=-1)
    upright = torch.where(upright[:, :1] < 0, -upright, upright)
    return replace(cloud, quaternions=upright)[kept], kept
