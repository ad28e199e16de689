"""Against fog: what keeps rays from filling the air before a camera with what other photographs do not see."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...kernels import distortion
from ...rays import Samples
from ...volume import weights_of


def spread(samples: Samples, density: Float[Tensor, " sample"]) -> Float[Tensor, ""]:
    """How far apart along its ray the weight of what a ray sees lies, mean of all rays (Barron 2022, eq. 15).

    Distances t count as t / (1 + t), so that a metre near the camera counts for more than one on the horizon.
    """
    start, end = (t / (1 + t) for t in (samples.t_start, samples.t_end))
    weights = weights_of(samples, density)
    return distortion(weights, 0.5 * (start + end), end - start, samples.ray_starts).mean()


class _Scaled(torch.autograd.Function):
    @staticmethod
    def forward(ctx, scale, *values):
        ctx.save_for_backward(scale)
        return values

    @staticmethod
    def backward(ctx, *grads):
        (scale,) = ctx.saved_tensors
        return None, *(g * scale.view(-1, *[1] * (g.ndim - 1)) for g in grads)


def scaled_by_distance(
    density: Float[Tensor, " sample"], rgb: Float[Tensor, "sample 3"], t: Float[Tensor, " sample"]
) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample 3"]]:
    """The same values, whose gradients count min(1, t^2) (Philip 2023, eq. 7).

    As many samples of as many rays lie in a place near a camera as the inverse square of the distance says, and all of
    one photograph: learning would be fastest where least is known.
    """
    return _Scaled.apply(t.square().clamp(max=1), density, rgb)
