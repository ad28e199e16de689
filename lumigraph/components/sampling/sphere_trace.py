"""Sphere tracing (Hart 1996): first intersections of rays with the zero level of a function, differentiable."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...camera.rays import Rays

Distance = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]  # positive outside

MIN_COSINE = 0.02  # between ray and normal at which the slope of the function along a ray is cut off, for gradients


@dataclass(frozen=True)
class March:
    """Parameters of ray marching, in scene units.

    max_steps:   evaluations of the function along one ray
    min_step:    shortest step; thinner objects may be missed
    max_step:    longest step, for functions that are no distances. With `min_step` it gives equal steps
    step_scale:  share of the value to step; below 1 for a function with a slope above 1
    refinements: evaluations that refine a crossing (regula falsi)
    """

    max_steps: int = 128
    min_step: float = 2e-3
    max_step: float = math.inf
    step_scale: float = 1.0
    refinements: int = 6


@dataclass(frozen=True)
class Crossings:
    """First intersection of each ray.

    t:       distance along the ray, infinity without one
    hit:     rays that cross from positive to negative inside the box, or are negative at their entry
    closest: distance along the ray of the least value, also for rays without an intersection
    """

    t: Float[Tensor, " ray"]
    hit: Bool[Tensor, " ray"]
    closest: Float[Tensor, " ray"]


def sphere_trace(
    distance: Distance, rays: Rays, box: Float[Tensor, "2 3"], march: March | None = None, near: float = 0.0
) -> Crossings:
    """First intersections of rays with distance(x) = 0 in a box.

    Finished rays leave the batch. With gradients enabled, `t` is differentiable in the rays and in everything that
    `distance` depends on, by implicit differentiation (Niemeyer 2020, eq. 10; Yariv 2020, eq. 3):

        dt = -df / (grad f . d)     at the intersection, grad f and d constant

    near: start of rays, as distance
    """
    with torch.no_grad():
        t, hit, inside, closest = _first_crossings(distance, rays, box, march or March(), near)
    if torch.is_grad_enabled() and len(rows := (hit & ~inside).nonzero()[:, 0]):
        t = t.index_put((rows,), with_gradient(distance, rays[rows], t[rows]))
    return Crossings(t, hit, closest)


def _first_crossings(
    distance: Distance, rays: Rays, box: Float[Tensor, "2 3"], march: March, near: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Distance, hit, hit at the start, and distance of the least value, of each ray."""
    enter, leave = rays.through_box(box)
    enter = enter.clamp_min(near)
    t, closest = torch.full_like(enter, torch.inf), enter.clone()
    least = torch.full_like(enter, torch.inf)
    hit, inside = (torch.zeros_like(enter, dtype=torch.bool) for _ in range(2))
    row = (enter < leave).nonzero()[:, 0]
    place, end, going = enter[row], leave[row], rays[row]
    before, value_before, brackets = place, torch.zeros_like(place), []
    for step in range(march.max_steps):
        if not len(row):
            break
        value = distance(going.at(place))
        better = value < least[row]
        least[row[better]], closest[row[better]] = value[better], place[better]
        crossed = value < 0
        if step == 0:
            inside[row] = crossed
            t[row[crossed]] = place[crossed]
        elif bool(crossed.any()):
            found = row, before, place, value_before, value
            brackets.append([x[crossed] for x in found])
        hit[row] |= crossed
        before, value_before = place, value
        place = torch.minimum(place + (march.step_scale * value).clamp(march.min_step, march.max_step), end)
        stays = ~crossed & (before < end)
        row, end, place, before, value_before = (x[stays] for x in (row, end, place, before, value_before))
        going = going[stays]
    if brackets:
        rows, a, b, at_a, at_b = (torch.cat(x) for x in zip(*brackets, strict=True))
        t[rows] = regula_falsi(distance, rays[rows], a, b, at_a, at_b, march.refinements)
    return t, hit, inside, closest


def regula_falsi(
    distance: Distance, rays: Rays, a: Tensor, b: Tensor, at_a: Tensor, at_b: Tensor, count: int
) -> Float[Tensor, " ray"]:
    """Crossing between a, where the value is positive, and b, where it is negative, by the Illinois algorithm."""

    def secant() -> Tensor:
        return a + (b - a) * (at_a / (at_a - at_b).clamp_min(1e-12))

    side = torch.zeros_like(a)
    for _ in range(count):
        middle = secant()
        value = distance(rays.at(middle))
        outside = value >= 0
        # An end that stays twice has its value halved, or it would stay for ever where the function is convex.
        at_b = torch.where(outside, torch.where(side > 0, at_b / 2, at_b), value)
        at_a = torch.where(outside, value, torch.where(side < 0, at_a / 2, at_a))
        a, b = torch.where(outside, middle, a), torch.where(outside, b, middle)
        side = torch.where(outside, 1.0, -1.0)
    return secant()


def with_gradient(distance: Distance, rays: Rays, t: Float[Tensor, " ray"]) -> Float[Tensor, " ray"]:
    """The same distances with the gradient of the level set: t - (f - f0) / (grad f . d)."""
    points = rays.at(t)
    points = points if points.requires_grad else points.requires_grad_()
    value = distance(points)
    (gradient,) = torch.autograd.grad(value.sum(), points, retain_graph=True)
    slope = (gradient * rays.directions.detach()).sum(-1)  # negative, for rays enter
    slope = torch.minimum(slope, -MIN_COSINE * gradient.norm(dim=-1).clamp_min(1e-9))
    return t - (value - value.detach()) / slope
