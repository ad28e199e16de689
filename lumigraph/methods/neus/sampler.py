"""Sections of rays around the surface of a distance field, and samples of the field around its box."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera.rays import Rays, Samples
from ...components.fields.spaces import Box, Contraction
from ...components.sampling.hierarchical_sampler import RayNumbers
from ...components.sampling.occupancy import MaskNumbers, OccupancyMask
from ...components.sampling.sampling import inverse_transform, stratified
from ...method import Field, Pass, Sampler
from ...method.sampler import RayCodes
from ...volume import weights_of
from .fields import NeuSField

FIRST_SHARPNESS = 64.0  # s of the first round of up-sampling, per scene unit; each round doubles it
MIN_LIGHT = 1e-3  # of a ray's light that leaves the box: with less, nothing is evaluated behind it
TYPICAL_SECTIONS = 6  # that matter of a ray, of a typical photograph with alpha
MAX_GROWTH = 1.2  # factor by which rays may grow from one step to the next
MIN_SHARE, MAX_SHARE = 0.25, 4.0  # of the first step's rays, in later ones
NETWORK_CHUNK, TABLE_CHUNK = 512, 4096  # rays that are rendered at once, so that activations fit into memory or cache


class SectionSampler(Sampler):
    """Places evenly along each ray through the box, then where the distance falls through zero: each round finds the
    weights that a fixed s gives, and draws more places by them (Wang 2021, section E.2). Sections lie between two
    places. All of this is without gradients; those that matter are evaluated once more, in their middle.

    space:            the box in which the distance holds
    numbers:          places of a ray, even ones and those of all rounds, and rays of a step
    rounds:           of up-sampling
    samples_per_step: sections of a step that the number of rays follows; 0: always as many rays
    weight_threshold: weight of a section below which it is left out; 0 for none
    around:           space of the field around the box, and the samples of a ray in it; None where nothing is
    """

    rays_per_step: Tensor

    def __init__(
        self,
        space: Box,
        numbers: RayNumbers,
        mask: MaskNumbers,
        rounds: int,
        samples_per_step: int,
        weight_threshold: float,
        around: tuple[Contraction, int] | None = None,
        rays_per_chunk: int = TABLE_CHUNK,
    ):
        super().__init__()
        self.space, self.numbers, self.rounds, self.around = space, numbers, rounds, around
        self.weight_threshold, self.rays_per_chunk = weight_threshold, rays_per_chunk
        self.samples_per_step = samples_per_step
        self.register_buffer("rays_per_step", torch.tensor(numbers.rays_per_step))
        self.is_open = around is not None  # type: ignore[misc]  # of an instance
        self.empty = OccupancyMask(mask.occupancy_resolution)

    @property
    def batch_size(self) -> int:  # type: ignore[override]
        return int(self.rays_per_step)

    @property
    def expected_rays(self) -> float:  # type: ignore[override]
        return max(self.numbers.rays_per_step, self.samples_per_step / TYPICAL_SECTIONS)

    def sample(
        self, rays: Rays, field: Field, code: RayCodes | None = None, generator: torch.Generator | None = None
    ) -> list[Pass]:
        """One pass, with the colours of its samples. Features: the distance's gradient, the mask of samples inside the
        box, and the Laplacian where it is known."""
        assert isinstance(field, NeuSField)
        samples, light = self.sections(rays, field, generator)
        points, directions = samples.along(rays)
        surface = field.shape.surface(points)
        slope = (surface.gradient * directions).sum(-1)
        thickness = field.thickness(surface.distance, slope, samples.length)
        density, rgb = thickness / samples.length, field.shape.shade(points, surface, directions)
        if generator is not None:
            self.evaluated = len(samples)
        inside = torch.ones(len(samples), dtype=torch.bool, device=points.device)
        features = surface.gradient, inside, *([] if surface.laplacian is None else [surface.laplacian])
        if field.outside is None or self.around is None:
            return [Pass("samples", samples, density, features, directions, rgb=rgb, evaluated=len(samples))]
        behind = self.beyond(rays, light, generator)
        further = behind.along(rays)
        density_behind, rgb_behind = field.outside(*further)
        both, order = in_order(samples, behind)
        features = (*(padded(x, len(behind))[order] for x in features),)
        density, rgb, directions = (
            torch.cat(pair)[order] for pair in ((density, density_behind), (rgb, rgb_behind), (directions, further[1]))
        )
        return [Pass("samples", both, density, features, directions, rgb=rgb, evaluated=len(both))]

    @torch.no_grad()
    def sections(
        self, rays: Rays, field: NeuSField, generator: torch.Generator | None
    ) -> tuple[Samples, Float[Tensor, " ray"]]:
        """Sections that matter, and the light that passes all of them."""
        n, device = self.numbers, rays.origins.device
        near, far = self.space.interval(rays)
        t = torch.lerp(near[:, None], far[:, None], stratified(len(rays), n.coarse_samples, generator, device))
        spacing = (far - near) / n.coarse_samples
        distance = self.distance(field, rays, t, spacing)
        for k in range(self.rounds):
            weights = section_weights(field, t, distance, FIRST_SHARPNESS * 2**k)
            again = stratified(len(rays), n.fine_samples // self.rounds, generator, device)
            again = inverse_transform(t, weights, again)
            t, order = torch.cat([t, again], -1).sort(-1)
            distance = torch.cat([distance, self.distance(field, rays, again, spacing)], -1).gather(-1, order)
        weights = section_weights(field, t, distance, None)
        kept = (weights >= self.weight_threshold) & (t[:, 1:] > t[:, :-1])
        return Samples.rows(t[:, :-1], t[:, -1]).keep(kept.flatten()), 1 - weights.sum(-1)

    def distance(
        self, field: NeuSField, rays: Rays, t: Float[Tensor, "ray place"], spacing: Float[Tensor, " ray"]
    ) -> Float[Tensor, "ray place"]:
        """Signed distance at points on rays; in empty space its placeholder is the distance between equal steps, so
        that it falls no faster than a distance does."""
        points = (rays.origins[:, None] + t[..., None] * rays.directions[:, None]).view(-1, 3)
        there = self.empty.may_hold(points)
        if there is None:
            return field.shape.distance(points).view(t.shape)
        asked = there.nonzero()[:, 0]
        found = spacing[:, None].expand(t.shape).reshape(-1)
        return found.index_copy(0, asked, field.shape.distance(points.index_select(0, asked))).view(t.shape)

    @torch.no_grad()
    def beyond(self, rays: Rays, light: Float[Tensor, " ray"], generator: torch.Generator | None) -> Samples:
        """Samples behind the box, linear in disparity; a ray that misses it starts at its closest point to the centre.
        None for rays without transmittance."""
        assert self.around is not None
        space, count = self.around
        near, far = self.space.interval(rays)
        closest = -(rays.origins * rays.directions).sum(-1)
        first = torch.where(far > near, far, closest.clamp_min(space.near))
        last = torch.full_like(first, space.far)
        t = space.distance(stratified(len(rays), count, generator, rays.origins.device), rays, first, last)
        t[:, 0] = first
        return Samples.rows(t, last).keep((light > MIN_LIGHT).repeat_interleave(count))

    def after_step(self, method: object, step: int) -> None:
        """Set the next step's number of rays, as s grows and fewer sections of each matter."""
        if self.samples_per_step:
            rays, first = int(self.rays_per_step), self.numbers.rays_per_step
            wanted = rays * self.samples_per_step / max(self.evaluated, 1)
            self.rays_per_step.fill_(int(min(max(wanted, MIN_SHARE * first), MAX_GROWTH * rays, MAX_SHARE * first)))


def section_weights(
    field: NeuSField, t: Float[Tensor, "ray place"], distance: Float[Tensor, "ray place"], sharpness: float | None
) -> Float[Tensor, "ray section"]:
    """Weights of the sections between points on rays. The slope is the steeper of a section and the previous one, so
    that one that begins just inside has weight too, limited to a distance's slope."""
    length = t[:, 1:] - t[:, :-1]
    slope = (distance[:, 1:] - distance[:, :-1]) / length.clamp_min(1e-6)
    before = torch.nn.functional.pad(slope[:, :-1], (1, 0))
    slope = slope.minimum(before).clamp(-1, 0 if sharpness else 1)
    middle = 0.5 * (distance[:, 1:] + distance[:, :-1])
    thickness = field.thickness(middle, slope, length, sharpness)
    samples = Samples.rows(t[:, :-1], t[:, -1])
    return weights_of(samples, (thickness / length.clamp_min(1e-6)).flatten()).view(length.shape)


def in_order(first: Samples, second: Samples) -> tuple[Samples, Tensor]:
    """Samples of each ray followed by others of it, and their numbers among all of the first and all of the second."""
    order = torch.cat([first.ray_index, second.ray_index]).argsort(stable=True)
    start, end = (torch.cat(pair)[order] for pair in ((first.t_start, second.t_start), (first.t_end, second.t_end)))
    return Samples(start, end, first.ray_starts + second.ray_starts), order


def padded(values: Tensor, count: int) -> Tensor:
    """Rows padded with zeros."""
    return torch.cat([values, values.new_zeros(count, *values.shape[1:])])
