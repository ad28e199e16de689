"""Distillation on points: a field learns another one's density and colour at random places (as Reiser 2021, KiloNeRF,
section 3.2), which is quicker than by pictures: every place is a lesson of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import unit
from ...system.progress import track
from ..fields.teacher import Teacher
from ..sampling.spaces import Space
from .schedules import held

STEPS = 240
POINTS_PER_RAY = 8  # of a step of a coordinate network: as many points are learnt from
POOL = 16  # times as many places as a step learns from: the teacher is asked about these alone
CELL = 1 / 16  # of the coordinates: a length over which densities are compared by what they stop
CLEAR = 1 / 2  # the same where the teacher holds nothing: a little fog there is much along a ray
NOTHING = 0.01  # optical thickness of CELL up to which that is so
SOLID = 8.0  # and from which on all is solid alike
FINAL = 0.1  # of the learning rates, at the end
START = 0.3  # share of the steps before they fall

Field = Callable[
    [Float[Tensor, "point 3"], Float[Tensor, "point 3"]], tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]
]


def distil(
    field: Field,
    held_by: Teacher,
    space: Space,
    optimizers: Sequence[torch.optim.Optimizer],
    points: int,
    chance: torch.Generator,
    device: torch.device | str = "cpu",
) -> None:
    """Teach a field what another one holds.

        L = mean (log(1 + sigma d) - log(1 + sigma' d))^2 + mean a' |c - c'|^2,    a' = 1 - exp(-sigma' d)

    over places near surfaces, before them and anywhere, colours along the way from a camera that sees the place.
    d is CELL of the coordinates, or CLEAR where the teacher holds nothing; where it is solid, it is enough to be solid
    too. The optimizers go at the rates that they have, which fall.
    points: that a step learns from
    """
    places = held_by.places(space, POOL * points, chance)
    directions, rgb, seen = glances(held_by, places, chance)
    length = CELL / space.stretch(places)
    thickness = (held_by.density(places) * length).clamp_max(SOLID)
    length = torch.where(thickness > NOTHING, length, length * (CLEAR / CELL))
    lessons = [x.to(device) for x in (places, directions, rgb, seen, thickness, length)]
    rates = [(group, group["lr"]) for optimizer in optimizers for group in optimizer.param_groups]
    with torch.enable_grad():
        for step in track(range(STEPS), "Teaching points", STEPS):
            for group, rate in rates:
                group["lr"] = rate * held(1.0, FINAL, step, step / STEPS, START)
            chosen = torch.randint(len(places), (points,), generator=chance).to(device)
            place, direction, colour, sees, wanted, d = (x[chosen] for x in lessons)
            density, found = field(place, direction)
            off = torch.log1p(density * d) - torch.log1p(wanted)
            dense = torch.where(wanted < SOLID, off, off.clamp_max(0)).square().mean()
            weight = sees * -torch.expm1(-wanted)
            coloured = (weight[:, None] * (found - colour).square()).mean()
            for optimizer in optimizers:
                optimizer.zero_grad(set_to_none=True)
            (dense + coloured).backward()
            for optimizer in optimizers:
                optimizer.step()
    for optimizer in optimizers:
        optimizer.zero_grad(set_to_none=True)


@torch.no_grad()
def glances(
    held_by: Teacher, places: Float[Tensor, "point 3"], chance: torch.Generator
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3"], Float[Tensor, " point"]]:
    """For each place the direction from a random camera, the colour from there, and whether (0 or 1) it is seen."""
    directions, rgb, seen = torch.zeros_like(places), torch.full_like(places, 0.5), torch.zeros(len(places))
    camera = torch.randint(len(held_by.depth_maps), (len(places),), generator=chance)
    for i, depth_map in enumerate(track(held_by.depth_maps, "Asking the teacher", len(held_by.depth_maps))):
        own = (camera == i).nonzero()[:, 0]
        directions[own] = unit(places[own] - depth_map.camera.position)
        own = own[depth_map.sees(places[own], edge=None)]
        seen[own], rgb[own] = 1.0, held_by.glance(places[own], depth_map)
    return directions, rgb, seen
