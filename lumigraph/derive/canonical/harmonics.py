"""Real spherical harmonics of any band, their rotation, and moments of shapes in them by direction and radius.
Rotations, evenly spread or random."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import to_matrix

MAX_RADIUS = 2.2  # spreads from the mean; hardly anything lies beyond
PHI, PSI = math.sqrt(2.0), 1.533751168755204288118041  # psi^4 = psi + 4


def harmonics(directions: Float[Tensor, "*point 3"], bands: int) -> Float[Tensor, "*point basis"]:
    """Real harmonics of bands 0 to `bands` - 1, orthonormal on the sphere, order (l, m) with m from -l to l.

    directions: unit length
    K_lm q_lm(z) times the real or imaginary part of (x + i y)^|m|, q by the three-term recursion (Sloan 2013, sec. 2).
    Unlike `kernels.spherical_harmonics` there are as many bands as one likes.
    """
    x, y, z = directions.unbind(-1)
    values: dict[tuple[int, int], Tensor] = {}
    real, imaginary, top = torch.ones_like(x), torch.zeros_like(x), 1.0
    for m in range(bands):
        before, here = torch.zeros_like(z), torch.full_like(z, top)
        for degree in range(m, bands):
            norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m))
            scaled = norm * (math.sqrt(2) if m else 1.0) * here
            values[degree, m] = scaled * real
            values[degree, -m] = scaled * imaginary if m else values[degree, 0]
            here, before = ((2 * degree + 1) * z * here - (degree + m) * before) / (degree + 1 - m), here
        real, imaginary, top = x * real - y * imaginary, x * imaginary + y * real, -(2 * m + 1) * top
    return torch.stack([values[degree, m] for degree in range(bands) for m in range(-degree, degree + 1)], -1)


def band(degree: int) -> slice:
    """Slice of the coefficients of a band."""
    return slice(degree**2, (degree + 1) ** 2)


def turning(rotations: Float[Tensor, "*rotation 3 3"], bands: int) -> list[Float[Tensor, "*rotation _ _"]]:
    """Wigner's matrices D of each band: harmonics(R x) = D(R) harmonics(x), so that rotation maps coefficients f to D
    f. Least squares over sufficiently many directions."""
    generator = torch.Generator().manual_seed(0)
    some = torch.randn(4 * (2 * bands - 1), 3, generator=generator, dtype=torch.float64).to(rotations)
    some = some / some.norm(dim=-1, keepdim=True)
    before = harmonics(some, bands)
    after = harmonics(torch.einsum("...ij,pj->...pi", rotations, some), bands)
    inverse = [torch.linalg.pinv(before[:, band(degree)].double()).to(before) for degree in range(bands)]
    return [(inverse[degree] @ after[..., band(degree)]).mT for degree in range(bands)]


def shells(distances: Float[Tensor, "*point"], count: int) -> Float[Tensor, "*point shell"]:
    """Weight of each point in each shell: bells about equidistant radii from 0 to MAX_RADIUS."""
    step = MAX_RADIUS / (count - 1)
    radii = step * torch.arange(count, dtype=distances.dtype, device=distances.device)
    return (-0.5 * ((distances[..., None] - radii) / (0.7 * step)).square()).exp()


def directions_and_distances(
    points: Float[Tensor, "*point 3"],
) -> tuple[Float[Tensor, "*point 3"], Float[Tensor, "*point"]]:
    distances = points.norm(dim=-1)
    return points / distances.clamp_min(1e-9)[..., None], distances


def moments(
    points: Float[Tensor, "*some point 3"], weights: Float[Tensor, "*some point"], count: int, bands: int
) -> Float[Tensor, "*some shell basis"]:
    """Integrals of a density times each shell times each harmonic: f = sum_i w_i s(|x_i|) Y(x_i / |x_i|).

    Turned with the points: moments(R x) are D(R) moments(x), to rounding.
    """
    directions, distances = directions_and_distances(points)
    parts = weights[..., None] * shells(distances, count)
    return parts.mT @ harmonics(directions, bands)


def spread(count: int) -> Float[Tensor, "rotation 3 3"]:
    """Evenly spread rotations over SO(3): super-Fibonacci spirals (Alexa 2022)."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    t = s / count
    inner, outer = t.sqrt(), (1 - t).sqrt()
    alpha, beta = 2 * math.pi * s / PHI, 2 * math.pi * s / PSI
    return to_matrix(torch.stack([inner * alpha.sin(), inner * alpha.cos(), outer * beta.sin(), outer * beta.cos()], 1))


def near(degrees: float) -> Float[Tensor, "rotation 3 3"]:
    """The identity, and rotations by an angle about the 26 directions to the neighbours of a cube among cubes."""
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    axes = torch.nn.functional.normalize(torch.cartesian_prod(steps, steps, steps), dim=-1)
    half = 0.5 * math.radians(degrees)
    return to_matrix(torch.cat([torch.full((27, 1), math.cos(half), dtype=torch.float64), math.sin(half) * axes], 1))


def random(count: int, generator: torch.Generator) -> Float[Tensor, "rotation 3 3"]:
    """Uniformly random rotations."""
    return to_matrix(torch.randn(count, 4, generator=generator, dtype=torch.float64))


def nearest_rotation(matrices: Float[Tensor, "*matrix 3 3"]) -> Float[Tensor, "*matrix 3 3"]:
    """The rotation nearest to each matrix in the sense of least squares (Kabsch 1976): U diag(1, 1, +-1) V^T."""
    u, _, vt = torch.linalg.svd(matrices)
    sign = torch.linalg.det(u @ vt)
    return torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], -1) @ vt
