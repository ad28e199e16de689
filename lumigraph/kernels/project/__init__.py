"""Projection of 3D Gaussians to 2D Gaussians on a picture (splatting)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="gaussians", outputs=5, differentiable=(0, 1, 2, 3, 4), typical=5, compiled=5, smooth=(5, 6))

MIN_ALPHA = 1 / 255  # what adds less than this to a pixel is nothing
MAX_ALPHA = 0.99  # no Gaussian hides more than this of what is behind it (Kerbl 2023, appendix C)


@dataclass(frozen=True)
class View:
    """Camera with a flat picture, as tensors; not differentiated.

    rotation:   world to camera; +x right, +y down, +z forward
    eye:        the camera's position in the world
    focal, centre: pixels
    distortion: k1 k2 p1 p2 k3 k4 k5 k6, as `lens.OpenCV`
    limits:     x_low, x_high, y_low, y_high on the plane z = 1, where the lens is valid; it is linear beyond
    size:       (width, height) in pixels
    near:       near plane distance
    """

    rotation: Float[Tensor, "3 3"]
    eye: Float[Tensor, " 3"]
    focal: Float[Tensor, " 2"]
    centre: Float[Tensor, " 2"]
    distortion: Float[Tensor, " 8"]
    limits: Float[Tensor, " 4"]
    size: tuple[int, int]
    near: float

    def to(self, device: torch.device | str) -> View:
        names = ("rotation", "eye", "focal", "centre", "distortion", "limits")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})

    def numbers(self) -> Float[Tensor, " 31"]:
        """All fields in a row: rotation by rows, eye, focal, centre, distortion, limits, size, near."""
        parts = self.rotation.reshape(9), self.eye, self.focal, self.centre, self.distortion, self.limits
        return torch.cat([*parts, self.eye.new_tensor([*self.size, self.near])])


@door
def project(
    means: Float[Tensor, "gaussian 3"],
    quaternions: Float[Tensor, "gaussian 4"],
    scales: Float[Tensor, "gaussian 3"],
    opacities: Float[Tensor, " gaussian"],
    harmonics: Float[Tensor, "gaussian coefficient 3"],
    view: View,
    bands: int = 4,
    blur: float = 0.3,
    compensate: bool = False,
) -> tuple[
    Float[Tensor, "gaussian 2"],
    Float[Tensor, "gaussian 3"],
    Float[Tensor, " gaussian"],
    Float[Tensor, "gaussian 3"],
    Float[Tensor, " gaussian"],
]:
    """Each Gaussian's footprint by local affine approximation, and its view-dependent colour (Zwicker 2002; Kerbl
    2023).

        p = R (mean - eye)      u = lens(p_x / p_z, p_y / p_z)      J = du / dp
        Sigma = Q diag(scale)^2 Q^T      C = J R Sigma R^T J^T + blur I
        colour = max(0, 1/2 + sum_k Y_k(d) h_k)      d = (mean - eye) / |mean - eye|

    Where p_x / p_z or p_y / p_z is outside the view's limits, the lens is extrapolated linearly, and J is that of the
    limit: so neither a lens's fold nor a Gaussian beside the eye has an unbounded footprint.

    quaternions: (w, x, y, z) of any length but zero
    scales:      standard deviations, world units
    bands:       of the harmonics in use, squared at most as many as there are coefficients
    blur:        square pixels added to each footprint, so that none falls between pixels
    compensate:  multiply opacity by sqrt(det(C - blur I) / det C), so that the blur adds no light (Yu 2024, eq. 9)

    Returns centres (N, 2) in pixels, conics (N, 3): entries xx, xy, yy of C^-1, depths p_z (N,), colours (N, 3) and
    opacities (N,). All are zero for a Gaussian that adds less than 1/255 to every pixel, or whose centre is within
    `near`. Differentiable in all five tensors.
    """
    require(1 <= bands <= 4 and bands**2 <= harmonics.shape[1], f"{bands} bands are not there, or more than 4")
    require(min(view.size) > 0, f"a picture cannot have {view.size[0]} x {view.size[1]} pixels")
    return implementation("project", means)(
        means, quaternions, scales, opacities, harmonics, view, bands, blur, compensate
    )


def cases(generator: torch.Generator):
    """Test clouds for all engines: ordinary ones, and every degenerate Gaussian."""
    for count, bands, compensate in [(0, 1, False), (1, 4, False), (40, 3, False), (33, 4, True), (17, 1, True)]:
        yield _cloud(count, bands, compensate, generator)
    inputs = list(_cloud(40, 2, True, generator, bent=True))
    yield tuple(inputs)
    means, quaternions, scales, opacities, *_ = (x.clone() if torch.is_tensor(x) else x for x in inputs)
    means[0:4] = torch.tensor(
        [[0.1, 0.2, -4.5], [0.0, 0.0, -3.0], [0.3, 0.1, -2.995], [9.0, 1.0, -2.5]]
    )  # behind, beside
    scales[4:8] = torch.tensor([2.0, 2.0, 1e-5])  # discs seen from their edges
    scales[8:12] = torch.tensor([1.0, 1e-5, 1e-5])  # needles
    scales[12:15], scales[15:18] = 20.0, 1e-4  # huge, tiny
    quaternions[18:20] *= 100
    opacities[20:23] = torch.tensor([0.0, 0.003, 1.0])
    yield means, quaternions, scales, opacities, *inputs[4:]
    yield means, quaternions, scales, opacities, *inputs[4:8], False
    means, quaternions, _, *others = _cloud(60, 2, True, generator)
    scales = torch.exp(2 * torch.randn(60, 3, generator=generator) - 4)  # long and thin, on a large picture
    yield means, quaternions, scales, *others[:2], some_view(True, (1600, 1200)), *others[3:]
    *tensors, view, _, blur, _ = _cloud(20, 4, False, generator)
    yield *tensors, view, 2, blur, False  # two bands are not in use yet


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A trained cloud's typical numbers, three bands of harmonics beyond the first."""
    *tensors, view, bands, blur, compensate = _cloud(size // 8, 4, False, generator)
    return *(x.requires_grad_() for x in tensors), view, bands, blur, compensate


def _cloud(count: int, bands: int, compensate: bool, generator: torch.Generator, bent: bool = False):
    """A cloud around the origin, seen from a distance of 3."""

    def normal(*shape):
        return torch.randn(shape, generator=generator)

    means, quaternions = 0.6 * normal(count, 3), normal(count, 4)
    scales = torch.exp(normal(count, 3) - 2.5)
    opacities = torch.rand(count, generator=generator)
    return (
        means,
        quaternions,
        scales,
        opacities,
        0.4 * normal(count, bands**2, 3),
        some_view(bent),
        bands,
        0.3,
        compensate,
    )


def some_view(bent: bool = False, size: tuple[int, int] = (70, 45)) -> View:
    """A camera at distance 3 from the origin, slightly rotated; with lens distortion if `bent`."""
    angle = 0.3
    rotation = torch.tensor(
        [[math.cos(angle), 0.0, -math.sin(angle)], [0.0, 1.0, 0.0], [math.sin(angle), 0.0, math.cos(angle)]]
    )
    distortion = torch.tensor([-0.2, 0.05, 0.01, -0.02, 0.01, 0.02, 0.0, 0.01]) * bent
    width, height = size
    focal, centre = torch.tensor([1.1 * width, 1.2 * width]), torch.tensor([0.48 * width, 0.53 * height])
    limits = torch.tensor([-0.5 * width, 0.6 * width, -0.6 * height, 0.6 * height]) / focal[[0, 0, 1, 1]]
    return View(rotation, rotation.T @ torch.tensor([0.0, 0.0, -3.0]), focal, centre, distortion, limits, size, 0.01)
