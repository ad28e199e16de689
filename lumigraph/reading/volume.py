"""Volume rendering: light through fog. All of radiance fields rests on one equation (Max 1995).

A ray passes density sigma(t), and colour c(t) glows there. With the transmittance T(t) = exp(-int_0^t sigma), the share
of light that arrives from t,

    C = int T(t) sigma(t) c(t) dt                                                                           (Max, eq. 5)
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .camera import look_at, pinhole, pixel_centres, rays
from .data import save

Samples = Float[Tensor, "ray sample"]


def weights(sigma: Samples, delta: Samples) -> Samples:
    """Share of each sample in its pixel's colour: w_i = T_i alpha_i (Max 1995, eq. 9).

    sigma: density per scene unit, constant within each interval
    delta: length of the interval, scene units
    """
    tau = sigma * delta  # optical thickness
    alpha = 1 - torch.exp(-tau)  # light that the interval stops
    before = torch.cumsum(tau, 1) - tau
    T = torch.exp(-before)  # light that arrives at it: T_i = exp(-sum_{j<i} tau_j) = prod_{j<i} (1 - alpha_j)
    return T * alpha


def composite(w: Samples, rgb: Float[Tensor, "ray sample 3"], background: float | Tensor = 1.0):
    """Colour of each ray before a background: C = sum_i w_i c_i + (1 - sum_i w_i) b."""
    return (w[..., None] * rgb).sum(1) + (1 - w.sum(1, keepdim=True)) * background


def expected_depth(w: Samples, t: Samples) -> Float[Tensor, " ray"]:
    """Mean distance that the light comes from: sum_i w_i t_i / sum_i w_i."""
    return (w * t).sum(1) / w.sum(1).clamp_min(1e-6)


def slab(sigma: float, thickness: float) -> float:
    """Opacity of an even slab in closed form, 1 - exp(-sigma d): the sum above gives it exactly, for any samples."""
    return 1 - math.exp(-sigma * thickness)


def cloud(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Density of a made-up cloud: a ball whose edge eleven waves have frayed."""
    edge = 0.75 - points.norm(dim=-1)
    generator = torch.Generator().manual_seed(4)
    for octave in (3.0, 6.0, 12.0, 24.0):
        axes = octave * torch.nn.functional.normalize(torch.randn(3, 3, generator=generator), dim=1)
        edge = edge + 0.45 / octave * (points @ axes.T + octave).sin().prod(-1) * 3
    return 30 * edge.clamp_min(0)


def lit_cloud(size: int, samples: int) -> Float[Tensor, "height width 3"]:
    """The cloud before a dusk sky. A second, short integral towards the sun gives each point's light."""
    pose = look_at(torch.tensor([0.0, -2.6, 0.3]), torch.zeros(3))
    o, d = rays(pinhole(pixel_centres(size, size), 1.25 * size, torch.tensor([size / 2, size / 2])), pose)
    t = torch.linspace(1.5, 3.7, samples + 1)
    middle, delta = (t[1:] + t[:-1]) / 2, (t[1:] - t[:-1]).expand(len(o), -1)
    points = o[:, None] + middle[:, None] * d[:, None]
    sigma = cloud(points)
    sun = torch.nn.functional.normalize(torch.tensor([-0.6, -0.35, 0.7]), dim=0)
    shade = sum(cloud(points + 0.07 * (k + 0.5) * sun) * 0.07 for k in range(8))
    light = torch.exp(-0.25 * torch.as_tensor(shade))[..., None]
    rgb = light * torch.tensor([1.0, 0.93, 0.82]) + (1 - light) * torch.tensor([0.33, 0.38, 0.52])
    horizon, zenith = torch.tensor([[0.93, 0.70, 0.55], [0.25, 0.42, 0.68]])
    sky = torch.lerp(horizon, zenith, (2 * d[:, 2:] + 0.5).clamp(0, 1))
    return composite(weights(sigma, delta), rgb, sky).view(size, size, 3)


def main() -> None:
    for count in (1, 4, 16, 64):
        delta = torch.full((1, count), 2.0 / count, dtype=torch.float64)
        even = float(weights(torch.full_like(delta, 0.7), delta).sum())
        print(f"{count:3} samples   opacity of the slab {even:.6f}   error {even - slab(0.7, 2):+.0e}")
    save("volume", *(lit_cloud(160, samples) for samples in (4, 16, 96)))


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/volume.py` composites rays of unequal numbers of samples, packed end to end;
# `kernels/composite/` has the same sum as an equation in PyTorch and as loops for CPUs and GPUs that stop where T is
# small and return the gradient without storing T. `benchmarks/compositing.py` measures it against fog in closed form.
