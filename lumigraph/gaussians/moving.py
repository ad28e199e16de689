"""Moving clouds: each Gaussian exists for a span of time and moves linearly in it; a motion is many short spans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from ..errors import LumigraphError
from ..system.memory import free_memory
from .cloud import Gaussians, joined

LEVELS = 6  # times that a span is halved at most: 64 spans of the whole
TOLERANCE = 0.1  # error of a span, as a share of a Gaussian's largest deviation
BYTES_PER_STATE = 60  # of a moving Gaussian at one moment, and of what is computed from it


@dataclass(frozen=True)
class MovingGaussians:
    """Gaussians with spans of time: visible for begin <= t < end, with centres at mean + velocity (t - middle).

    cloud:       at the times `middles`
    duration:    seconds
    velocities:  in the frame's units per second
    middles:     seconds of the clock, which starts at 0
    begins, ends: of the spans, seconds
    fades:       deviation in seconds of the opacity's falloff from the middle; infinite for none
    """

    cloud: Gaussians
    duration: float
    velocities: Float[Tensor, "gaussian 3"]
    middles: Float[Tensor, " gaussian"]
    begins: Float[Tensor, " gaussian"]
    ends: Float[Tensor, " gaussian"]
    fades: Float[Tensor, " gaussian"]

    @classmethod
    def still(cls, cloud: Gaussians, duration: float) -> MovingGaussians:
        """Gaussians that stand still all the time."""
        begins = torch.zeros(len(cloud), device=cloud.means.device)
        times = begins, begins, begins + duration, begins + torch.inf
        return cls(cloud, duration, torch.zeros_like(cloud.means, dtype=torch.float32), *times)

    def __len__(self) -> int:
        return len(self.cloud)

    def __getitem__(self, index: slice | Tensor) -> MovingGaussians:
        """The Gaussians that a slice, mask or index tensor picks."""
        tensors = self.velocities, self.middles, self.begins, self.ends, self.fades
        return MovingGaussians(self.cloud[index], self.duration, *(x[index] for x in tensors))

    def transformed(self, similarity: Float[Tensor, "4 4"], far: bool = False) -> MovingGaussians:
        """The same in another frame, x' = M x."""
        turn = similarity[:3, :3].to(self.velocities)
        return replace(self, cloud=self.cloud.transformed(similarity, far), velocities=self.velocities @ turn.T)

    def lasting(self, duration: float) -> MovingGaussians:
        """The same motion stretched to another duration in seconds."""
        times = duration / self.duration
        stretched = {name: getattr(self, name) * times for name in ("middles", "begins", "ends", "fades")}
        return replace(self, velocities=self.velocities / times, duration=duration, **stretched)

    def at(self, time: float) -> Gaussians:
        """The cloud at a time; the duration's end is the moment just before it."""
        last = float(torch.nextafter(torch.tensor(self.duration), torch.tensor(0.0)))
        now = min(max(time, 0.0), last)
        some = self[(self.begins <= now) & (now < self.ends)]
        away = now - some.middles
        opacities = some.cloud.opacities
        if some.fades.isfinite().any():
            seen = opacities.sigmoid() * torch.exp(-0.5 * (away / some.fades).square())
            opacities = torch.where(some.fades.isfinite(), seen.clamp(1e-7, 1 - 1e-7).logit(), opacities)
        return replace(some.cloud, means=some.cloud.means + some.velocities * away[:, None], opacities=opacities)

    @property
    def moving(self) -> int:
        """Number of Gaussians that move or exist for a part of the time."""
        still = (self.velocities == 0).all(1) & (self.begins <= 0) & (self.ends >= self.duration)
        return int((~still).sum())


@torch.no_grad()
def fitted(
    states: Callable[[float], Gaussians], duration: float, tolerance: float = TOLERANCE, levels: int = LEVELS
) -> MovingGaussians:
    """A motion as spans of linear motion, ordered by Gaussian and time. Static Gaussians have one span.

    states:    the cloud at times from 0 to 1, always of the same Gaussians in the same order
    tolerance: largest error of a span, of positions and of the ends of axes by rotation and scale, as a share of the
               Gaussian's largest deviation. Spans are halved, at most `levels` times, until they meet it
    Opacities and colours are those of the first moment.
    Raises LumigraphError where the states are of different Gaussians, or take more memory than is free.
    """
    count = 2 << levels
    shares = [i / count for i in range(count + 1)]
    first = states(0.0)
    moves = torch.zeros(len(first), dtype=torch.bool, device=first.means.device)
    for share in shares[1:]:
        now = states(share)
        if len(now) != len(first):
            raise LumigraphError("The Gaussians are not the same at every moment, so they have no motion to write")
        for name in ("means", "quaternions", "log_scales"):
            moves |= (getattr(now, name) != getattr(first, name)).any(1)
    rows = moves.nonzero()[:, 0]
    if (needed := BYTES_PER_STATE * len(rows) * len(shares)) > free_memory():
        raise LumigraphError(
            f"The motion of {len(rows):,} Gaussians takes {needed / 1e9:.1f} GB; train with a smaller --max-gaussians"
        )
    kept: dict[str, list[Tensor]] = {"means": [], "quaternions": [], "log_scales": []}
    for share in shares:
        now = states(share)[rows]
        for name, values in kept.items():
            values.append(getattr(now, name))
    track = {name: torch.stack(values) for name, values in kept.items()}
    track["quaternions"] = normalize(track["quaternions"], dim=-1)
    source, begin, end = spans(track, tolerance, levels)
    source, begin, end = (x.to(rows.device) for x in (source, begin, end))
    ends = track["means"][begin, source], track["means"][end, source]
    middle = (begin + end) // 2
    moving = replace(
        first[rows[source]],
        means=(ends[0] + ends[1]) / 2,
        quaternions=track["quaternions"][middle, source],
        log_scales=track["log_scales"][middle, source],
    )
    still, unit = first[~moves], duration / count
    begins = torch.cat([torch.zeros(len(still), device=rows.device), begin * unit])
    stops = torch.cat([torch.full((len(still),), duration, device=rows.device), end * unit])
    velocities = torch.cat([torch.zeros_like(still.means), (ends[1] - ends[0]) / ((end - begin) * unit)[:, None]])
    fades = torch.full_like(begins, torch.inf)
    return MovingGaussians(joined([still, moving]), duration, velocities, (begins + stops) / 2, begins, stops, fades)


def spans(
    track: dict[str, Float[Tensor, "moment gaussian _"]], tolerance: float, levels: int
) -> tuple[Int[Tensor, " span"], Int[Tensor, " span"], Int[Tensor, " span"]]:
    """Gaussian, first and last moment of each span, ordered by Gaussian and time."""
    count = len(track["means"]) - 1
    found: list[tuple[Tensor, int, int]] = []
    pending: Sequence[tuple[Tensor, int, int]] = [(torch.arange(track["means"].shape[1]), 0, count)]
    for level in range(levels + 1):
        halves = []
        for some, begin, end in pending:
            fits = span_errors(track, some, begin, end) <= tolerance
            fits |= level == levels
            found.append((some[fits], begin, end))
            if len(left := some[~fits]):
                middle = (begin + end) // 2
                halves += [(left, begin, middle), (left, middle, end)]
        pending = halves
    source = torch.cat([some for some, _, _ in found])
    firsts = torch.cat([torch.full_like(some, first) for some, first, _ in found])
    lasts = torch.cat([torch.full_like(some, last) for some, _, last in found])
    order = torch.argsort(source * (count + 1) + firsts)
    return source[order], firsts[order], lasts[order]


def span_errors(
    track: dict[str, Float[Tensor, "moment gaussian _"]], some: Int[Tensor, " some"], begin: int, end: int
) -> Float[Tensor, " some"]:
    """Largest error of a span of some Gaussians, in largest deviations: distance of positions from a straight line, and
    movement of the ends of axes."""
    means, quaternions, log_scales = (track[name][begin : end + 1, some] for name in track)
    share = torch.linspace(0, 1, end - begin + 1, device=means.device)[:, None, None]
    off = (means - means[:1] - share * (means[-1:] - means[:1])).norm(dim=-1).amax(0)
    middle = (end - begin) // 2
    cosine = (quaternions * quaternions[middle]).sum(-1).abs().clamp(max=1)
    scales = log_scales[middle].exp()
    large, small = scales.amax(-1), scales.amin(-1)
    turned = 2 * torch.acos(cosine).amax(0) * (1 - small / large)
    grown = (log_scales - log_scales[middle]).abs().amax(-1).amax(0)
    return off / large + turned + grown
