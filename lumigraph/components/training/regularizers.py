"""Against fog: what keeps rays from filling the air before a camera with what other photographs do not see."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera.rays import Samples
from ...kernels import distortion


def normalized_distance(t: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Distances t as t / (1 + t): what is near counts for more than what is far, and the horizon is at 1."""
    return t / (1 + t)


def distortion_loss(samples: Samples, weights: Float[Tensor, " sample"]) -> Float[Tensor, ""]:
    """How far apart along its ray the weight of what a ray sees lies, mean of all rays (Barron 2022, eq. 15)."""
    start, end = normalized_distance(samples.t_start), normalized_distance(samples.t_end)
    return distortion(weights, 0.5 * (start + end), end - start, samples.ray_starts).mean()


def depth_loss(
    samples: Samples, weights: Float[Tensor, " sample"], distance: Float[Tensor, " ray"], margin: float
) -> Float[Tensor, ""]:
    """The share of rays that does not end where something is known to be, mean of all rays: light that is stopped too
    early or too late, or not at all (as Deng 2022 supervises depth; linear, for what is known may be wrong).

    distance: along each ray to what is known to be there
    margin:   how far off counts as there, in normalized_distance distances, beside half a sample's own length
    """
    start, end = normalized_distance(samples.t_start), normalized_distance(samples.t_end)
    known = normalized_distance(distance)[samples.ray_index]
    there = (start - margin < known) & (known < end + margin)
    return 1 - (weights * there).sum() / len(distance)


def near_thickness(
    samples: Samples, density: Float[Tensor, " sample"], until: Float[Tensor, " ray"]
) -> Float[Tensor, " ray"]:
    """Optical thickness of what lies on each ray before a distance. Yang 2023, eq. 5, has the mean density of a ray's
    first samples instead, which depends on how finely it is sampled."""
    ray = samples.ray_index
    thickness = density * ((until[ray] - samples.t_start).clamp_min(0)).minimum(samples.length)
    return torch.zeros_like(until).index_add(0, ray, thickness)


class _Scaled(torch.autograd.Function):
    @staticmethod
    def forward(ctx, scale, *values):
        ctx.save_for_backward(scale)
        return values

    @staticmethod
    def backward(ctx, *grads):
        (scale,) = ctx.saved_tensors
        return None, *(g * scale.view(-1, *[1] * (g.ndim - 1)) for g in grads)


def scale_gradients(t: Float[Tensor, " sample"], *values: Float[Tensor, sample * _]) -> tuple[Tensor, ...]:
    """The same values of samples at distances t, whose gradients count min(1, t^2) (Philip 2023, eq. 7).

    As many rays pass a place near a camera as the inverse square of its distance says, and all of one photograph:
    without this, learning would be fastest where least is known.
    """
    return _Scaled.apply(t.square().clamp(max=1), *values)


def cauchy(density: Float[Tensor, " sample"], rays: int) -> Tensor:
    """Sum of log(1 + 2 sigma^2) along a ray, mean of all (Hedman 2021, section 4.2; Fridovich-Keil 2022, eq. 4)."""
    return torch.log1p(2 * density.square()).sum() / max(rays, 1)
