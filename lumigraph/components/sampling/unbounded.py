"""Open captures: where a field is asked along a ray that does not end, and what keeps the air clear.

A grid of proposals (Barron 2022) says where, the same number of samples on every ray; rays that gather weight in two
places pay (Barron 2022, eq. 15), what is near a camera is learnt slowly (Philip 2023), and at first rays end where
plane sweeps found that neighbouring photographs agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...camera.rays import Look, Rays
from ...datasets.scene import Frame, Scene
from ...exchange.packing import Stored
from ...files.ranges import NonNegative, between
from ...volume import weights_of
from ..clouds.dense_points import Points, seen_points
from ..training.fog import elsewhere, scaled_by_distance, spread
from ..training.lazy_adam import LazyAdam
from ..training.schedules import falling
from .proposal import Proposal, Proposed, overlooked
from .spaces import Space

CELLS = 96  # along each axis of the grid of proposals
RATES = 0.1, 0.01  # its learning rate, at first and in the end
SWEEPING = 0.1  # share of a budget of seconds that plane sweeps may take
KEPT = 1 << 16  # places known by them that are remembered
KNOWN = 128  # rays of a step that end at one
MARGIN = 0.005  # of evened distances: how exactly a place is known
TAUGHT = 0.5  # share of the budget after which photographs alone say where things are
RAYS = 4096  # rendered at once: what their samples take fits into a cache
LEAST = 5e-4  # share of what a ray sees below which a picture does without a sample

Density = Callable[[Float[Tensor, "sample 3"]], Float[Tensor, " sample"]]
Field = Callable[
    [Float[Tensor, "sample 3"], Float[Tensor, "sample 3"]], tuple[Float[Tensor, " sample"], Float[Tensor, "sample 3"]]
]
# A field in two parts: density with what it remembers of each place, then colour of that along directions.
Geometry = Callable[[Float[Tensor, "sample 3"]], tuple[Float[Tensor, " sample"], Float[Tensor, "sample feature"]]]
Colours = Callable[[Float[Tensor, "seen feature"], Float[Tensor, "seen 3"]], Float[Tensor, "seen 3"]]


@dataclass(frozen=True)
class OpenNumbers:
    """Numbers of a method's Config that open captures are learnt by; objects are not."""

    proposal_samples: Annotated[int, between(4, 1024)] = 64  # of a ray, that say where a field is asked
    samples_per_ray: Annotated[int, between(2, 1024)] = 24  # at which it is
    distortion_weight: NonNegative = 0.01  # of eq. 15 in Barron 2022, where it has the same weight
    depth_weight: NonNegative = 0.03  # of what plane sweeps found, at first; it falls to nothing


class Unbounded(nn.Module):
    """What a method asks an open capture through; it holds `None` instead for an object.

    seen, seen_from: places on surfaces, and the camera that each was found from
    """

    grows: ClassVar[tuple[str, ...]] = ("seen", "seen_from")
    seen: Tensor
    seen_from: Tensor

    def __init__(self, space: Space, numbers: OpenNumbers):
        super().__init__()
        self.numbers, self.progress = numbers, 1.0
        self.proposal = Proposal(space, CELLS, numbers.proposal_samples, numbers.samples_per_ray)
        for name in self.grows:
            self.register_buffer(name, torch.zeros(0, 3))

    @staticmethod
    def bytes_of(frame: Frame, learning: bool) -> int:
        """What the grid of proposals takes, with its gradient and moments while it learns."""
        return 4 * CELLS**3 * (4 if learning else 1) * (frame.reach > 1)

    def begin(self, scene: Scene, seconds: float, generator: torch.Generator) -> None:
        """Look for places on surfaces by plane sweeps. seconds: of the whole budget, a share of which that may take"""
        if not self.numbers.depth_weight:
            return
        found = some(seen_points(scene, SWEEPING * seconds), generator)
        self.seen, self.seen_from = (x.to(self.seen) for x in (found.positions, found.origins))
        sparse = self.seen[:0] if scene.points is None else scene.points.to(self.seen)
        if len(places := torch.cat([self.seen, sparse])):
            self.proposal.begin(places)

    def begin_at(self, points: Float[Tensor, "point 3"], origins: Float[Tensor, "point 3"]) -> None:
        """Begin with places on surfaces that are known, and the camera that each is seen from."""
        self.seen, self.seen_from = (x[:: max(1, len(x) // KEPT)].to(self.seen) for x in (points, origins))
        if len(self.seen):
            self.proposal.begin(self.seen)

    def before_step(self, progress: float) -> None:
        """progress: share of the budget spent, in [0, 1]"""
        self.progress = progress
        self.proposal.anneal(1.0 if len(self.seen) else progress)

    def look(self, field: Field, rays: Rays) -> Look:
        """What a field has along rays."""
        samples = self.proposal.places(rays)
        return Look("samples", samples, *field(*samples.along(rays)))

    def glance(self, geometry: Geometry, colours: Colours, rays: Rays) -> Look:
        """The same for pictures, of a field in two parts: the second one is asked only where it is seen.

        What is left out has at most LEAST of a ray's weight, and what lies behind it gets that. Without gradients.
        """
        samples = self.proposal.places(rays)
        points, directions = samples.along(rays)
        density, features = geometry(points)
        kept = weights_of(samples, density) > LEAST
        seen = kept.nonzero()[:, 0]
        features = features.t().index_select(1, seen).t()  # a feature of all samples after another, as networks give it
        rgb = colours(features, directions.index_select(0, seen))
        return Look("samples", samples.keep(kept), density.index_select(0, seen), rgb)

    def learn(self, field: Field, rays: Rays, jitter: Float[Tensor, "ray 2"]) -> tuple[Look, Proposed]:
        """The same while it learns, and what was proposed. jitter: as for `Proposal.sample`"""
        proposed = self.proposal.sample(rays, jitter)
        samples = proposed.samples
        density, rgb = scaled_by_distance(samples.t, *field(*samples.along(rays)))
        return Look("samples", samples, density, rgb), proposed

    def terms(
        self, density_at: Density, proposed: Proposed, density: Float[Tensor, " sample"], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """What rays cost beside their colours, by name.

        density:    that a field found at what was proposed
        density_at: the field, for some more rays, whose ends are known; `generator` draws them
        """
        weights = weights_of(proposed.samples, density)
        terms = {"proposal": overlooked(proposed, weights)}
        if self.numbers.distortion_weight:
            terms["distortion"] = self.numbers.distortion_weight * spread(proposed.samples, weights)
        weight = self.numbers.depth_weight * (1 - self.progress / TAUGHT)
        if weight > 0 and len(self.seen):
            error, missed = self._elsewhere(density_at, generator)
            terms["depth"] = weight * error
            terms["proposal"] = terms["proposal"] + missed * (KNOWN / len(proposed.edges))
        return terms

    def _elsewhere(self, density_at: Density, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """`elsewhere` of some rays whose ends are known, and what the grid of proposals missed of them."""
        chosen = torch.randint(len(self.seen), (KNOWN,), generator=generator).to(self.seen.device)
        origins, ways = self.seen_from[chosen], self.seen[chosen] - self.seen_from[chosen]
        distance = ways.norm(dim=-1)
        rays = Rays(origins, ways / distance[:, None], torch.zeros_like(distance))
        proposed = self.proposal.sample(rays, torch.rand(KNOWN, 2, generator=generator).to(distance))
        samples = proposed.samples
        (density,) = scaled_by_distance(samples.t, density_at(samples.along(rays)[0]))
        weights = weights_of(samples, density)
        return elsewhere(samples, weights, distance, MARGIN), overlooked(proposed, weights)

    @staticmethod
    def storage() -> dict[str, Stored]:
        """How a method that holds one as "unbounded" has it stored: rays are sampled by the grid."""
        return {
            "unbounded.proposal.grid.values": Stored("half"),
            "unbounded.seen": Stored("nothing"),
            "unbounded.seen_from": Stored("nothing"),
        }

    def optimizer(self) -> torch.optim.Optimizer:
        """Of the grid of proposals; its group is named "proposal"."""
        return LazyAdam([{"params": [self.proposal.grid.values], "name": "proposal"}], RATES[0])

    @staticmethod
    def rate(progress: float) -> float:
        """The learning rate of that group."""
        return falling(*RATES, progress)


def some(points: Points, generator: torch.Generator) -> Points:
    """At most KEPT of points, drawn at random."""
    if len(points.positions) <= KEPT:
        return points
    chosen = torch.randperm(len(points.positions), generator=generator)[:KEPT]
    return Points(*(x[chosen] for x in (points.positions, points.colours, points.sizes, points.origins)))


def unbounded(frame: Frame, space: Space, numbers: OpenNumbers) -> Unbounded | None:
    """An `Unbounded` for an open capture, none for an object."""
    return Unbounded(space, numbers) if frame.reach > 1 else None


def rays_of(samples: int, numbers: OpenNumbers) -> int:
    """Rays of a step that asks about so many samples."""
    return max(1, math.ceil(samples / numbers.samples_per_ray))
