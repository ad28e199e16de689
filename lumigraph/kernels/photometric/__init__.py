"""Photometric difference of two images, as a loss needs it: structural similarity and the mean absolute difference."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="pixels", unit_axes=2, outputs=2, differentiable=(0, 1), typical=1, compiled=4, smooth=(1,))

WINDOW, DEVIATION = 11, 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # (K1 L)^2 and (K2 L)^2 for values up to L = 1


def weights() -> list[float]:
    """The window along one axis: a Gaussian whose sum is 1."""
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    gaussian = torch.exp(-0.5 * (offsets / DEVIATION) ** 2)
    return (gaussian / gaussian.sum()).tolist()


@door
def photometric(
    a: Float[Tensor, "height width channel"], b: Float[Tensor, "height width channel"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Mean structural similarity (Wang 2004, eqs. 13 and 14) and mean |a - b| of two images with values in [0, 1].

        S = (2 m_a m_b + C1) (2 s_ab + C2) / ((m_a^2 + m_b^2 + C1) (s_aa + s_bb + C2))
        m_a = w * a,   s_ab = w * (a b) - m_a m_b      means and (co)variances around a pixel

    w is a Gaussian of 11 x 11 pixels with deviation 1.5; K1 = 0.01, K2 = 0.03. A window stands around every pixel, and
    both images count as zero beyond their border, as in the original loss of 3D Gaussian Splatting (Kerbl 2023, eq. 7).
    (`metrics.ssim` is the score, whose windows lie inside the image.)

    Returns the means of S and of |a - b| over pixels and channels. Both are symmetric, and differentiable in a and b;
    where a = b the slope of |a - b| is zero.
    """
    require(a.numel() > 0, "pictures without pixels are not alike")
    return implementation("photometric", a)(a, b)


def cases(generator: torch.Generator):
    """Test inputs for all engines: images smaller than the window, odd sizes, equal and constant images."""
    for height, width, channels in [(1, 1, 1), (5, 7, 3), (11, 11, 1), (13, 33, 3), (18, 23, 3), (3, 90, 3)]:
        yield _inputs(height, width, channels, generator)
    a, b = _inputs(12, 13, 3, generator)
    yield a, a.clone()
    yield a, torch.rand(a.shape, generator=generator)
    yield a, torch.full_like(a, 0.25)
    yield torch.full_like(a, 0.25), torch.full_like(a, 0.125)
    yield torch.zeros_like(a), b


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A square image of about `size` pixels and its photograph, which gets no gradient."""
    side = max(round(size**0.5), 1)
    a, b = _inputs(side, side, 3, generator)
    return a.requires_grad_(), b


def _inputs(height: int, width: int, channels: int, generator: torch.Generator):
    """A smooth picture and a slightly different one."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    phase = 6 * torch.rand(channels, generator=generator)
    a = 0.5 + 0.4 * (0.4 * x[..., None] + 0.3 * y[..., None] + phase).sin()
    return a, (a + 0.1 * torch.randn(a.shape, generator=generator)).clamp(0, 1)
