"""Fog whose colour is known in closed form, and how near `volume.composite` comes to it. For tests and benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lumigraph.camera.rays import Samples
from lumigraph.volume import composite

LENGTH = 2.0  # of the ray
RED, BLUE = torch.tensor([[0.9, 0.3, 0.1], [0.1, 0.4, 0.8]], dtype=torch.float64)
RULES = {"midpoint": 0.5, "left end": 0.0}  # where in its interval a sample is asked; NeRF asks at the left end


@dataclass(frozen=True)
class Medium:
    """What lies along a ray.

    density: sigma(t), (n,) to (n,)
    rgb:     c(t), (n,) to (n, 3)
    seen:    colour of the ray, (3,), when all of the density is multiplied by a scale; differentiable in it
    """

    name: str
    density: Callable[[Tensor], Tensor]
    rgb: Callable[[Tensor], Tensor]
    seen: Callable[[Tensor], Tensor]


def homogeneous(sigma: float = 1.5) -> Medium:
    """C = c (1 - exp(-sigma L))"""
    return Medium(
        "homogeneous slab",
        lambda t: torch.full_like(t, sigma),
        lambda t: RED.expand(len(t), 3),
        lambda scale: RED * -torch.expm1(-scale * sigma * LENGTH),
    )


def exponential_ramp(a: float = 0.2, b: float = 1.5) -> Medium:
    """sigma = a exp(b t), and a colour that goes from red to blue as the optical thickness u goes from 0 to U.

    C = integral_0^U exp(-u) c(u) du,   U = a (exp(b L) - 1) / b,   c(u) = red + (blue - red) u / U
      = red (1 - exp(-U)) + (blue - red) (1 - (1 + U) exp(-U)) / U
    """
    rise = torch.tensor(b * LENGTH, dtype=torch.float64).expm1()

    def seen(scale: Tensor) -> Tensor:
        U = scale * a * rise / b
        return RED * -torch.expm1(-U) + (BLUE - RED) * (1 - (1 + U) * torch.exp(-U)) / U

    return Medium(
        "exponential ramp",
        lambda t: a * torch.exp(b * t),
        lambda t: RED + (BLUE - RED) * (torch.expm1(b * t) / rise)[:, None],
        seen,
    )


def two_slabs(edge: float, name: str, near: float = 0.5, far: float = 2.5) -> Medium:
    """Red fog as far as the edge, denser blue fog behind: C = red (1 - T) + T blue (1 - T'), each T = exp(-sigma d)."""

    def seen(scale: Tensor) -> Tensor:
        first, second = scale * near * edge, scale * far * (LENGTH - edge)
        return RED * -torch.expm1(-first) + torch.exp(-first) * BLUE * -torch.expm1(-second)

    return Medium(
        name,
        lambda t: torch.where(t < edge, near, far).double(),
        lambda t: torch.where((t < edge)[:, None], RED, BLUE),
        seen,
    )


# A third of the way lies at a third of a sample, whatever power of two the number of samples is, or at two thirds.
MEDIA = [
    homogeneous(),
    two_slabs(LENGTH / 2, "two slabs, edge between samples"),
    two_slabs(LENGTH / 3, "two slabs, edge within a sample"),
    exponential_ramp(),
]


def errors(
    medium: Medium, n: int, rule: str, dtype: torch.dtype = torch.float64, device: str = "cpu"
) -> tuple[float, float]:
    """Of n samples of equal length: the largest error of a channel, and of its derivative in the density's scale."""
    edges = torch.linspace(0, LENGTH, n + 1, dtype=torch.float64)
    at = edges[:-1] + RULES[rule] * edges.diff()
    start, end, rgb = (x.to(device, dtype) for x in (edges[:-1], edges[1:], medium.rgb(at)))
    samples = Samples(start, end, torch.tensor([0, n], device=device))

    def composited(scale: Tensor) -> Tensor:
        return composite(samples, (scale * medium.density(at)).to(start), rgb).rgb[0].to(scale)

    colour, slope = value_and_derivative(composited)
    exact, exact_slope = value_and_derivative(medium.seen)
    return float((colour - exact).abs().max()), float((slope - exact_slope).abs().max())


def value_and_derivative(colour: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Of the three channels, at scale 1."""
    scale = torch.ones((), dtype=torch.float64, requires_grad=True)
    value = colour(scale)
    return value.detach(), torch.stack([torch.autograd.grad(x, scale, retain_graph=True)[0] for x in value])


def order(steps: Sequence[float], found: Sequence[float]) -> float:
    """The p of error ~ step^p: the slope of the straight line through their logarithms."""
    x, y = torch.tensor(steps, dtype=torch.float64).log(), torch.tensor(found, dtype=torch.float64).log()
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x * x).sum())
