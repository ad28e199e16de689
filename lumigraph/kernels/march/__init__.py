"""Ray marching: intervals of rays in occupied cells."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...camera.rays import Samples
from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="rays", outputs=3, differentiable=(), typical=2, compiled=7)


@door
def march(
    origins: Float[Tensor, "ray 3"],
    directions: Float[Tensor, "ray 3"],
    t_near: Float[Tensor, " ray"],
    t_far: Float[Tensor, " ray"],
    occupied: Bool[Tensor, "cascade x y z"],
    density: Float[Tensor, "cascade x y z"],
    step: float,
    growth: float = 0.0,
    stop: float = 0.0,
) -> Samples:
    """Keep the intervals of a fixed lattice whose midpoints lie in occupied cells.

    The lattice starts at t_near (jitter belongs there). With growth 0, t_k = t_near + k step. Otherwise steps are
    constant up to the first lattice point at or beyond t_c = step / growth and geometric from there,
    t_{k+1} = (1 + growth) t_k, so that a step covers a constant angle (Müller 2022, appendix E.1).
    Intervals whose midpoint is at or beyond t_far are dropped.

    Cascade c is a grid of n^3 cells over the cube [-2^c, 2^c]^3; a point belongs to the finest cascade that
    holds it (max |x| < 2^c), and to none outside the last. A grid's index is [cascade, x, y, z].

    occupied: occupancy grid
    density:  estimate for each cell, per scene unit, for early termination: samples behind exp(-sum) < stop are
              dropped, sum that of density times length along kept samples. stop 0 keeps all
    t_near:   >= 0; a ray whose t_far <= t_near has no samples
    Not differentiable.
    """
    cascades, n = occupied.shape[:2]
    require(occupied.numel() > 0 and occupied.shape[2:] == (n, n), f"{tuple(occupied.shape)} are no cubes of cells")
    least = 2.0 ** (cascades - 25)  # a ray's samples are counted in 32 bits
    require(least <= step < math.inf, f"a step of {step} cannot be, where cubes ask for {least:g} at least")
    require(0 <= growth < math.inf and 0 <= stop <= 1, f"growth {growth} and stop {stop} cannot be")
    run = implementation("march", origins)
    return Samples(*run(origins, directions, t_near, t_far, occupied, density, step, growth, stop))


def cases(generator: torch.Generator):
    """Test inputs for all engines, without rays whose samples depend on rounding."""
    for rays, cascades, n, filled, step, growth, stop in [
        (0, 1, 4, 0.5, 0.1, 0.0, 0.0),
        (1, 1, 1, 1.0, 0.2, 0.0, 0.0),
        (24, 1, 8, 0.3, 0.15, 0.0, 0.1),
        (9, 1, 8, 0.0, 0.1, 0.0, 0.0),
        (40, 1, 8, 0.2, 0.15, 0.0, 0.0),
        (24, 2, 6, 0.3, 0.2, 0.0, 0.0),
        (24, 3, 8, 0.3, 0.1, 1 / 8, 0.0),
        (24, 3, 4, 0.5, 0.12, 1 / 16, 0.1),
        (5, 1, 4, 1.0, 0.032, 0.0, 0.0),
    ]:
        yield _steady(*_inputs(rays, cascades, n, filled, step, growth, stop, generator))

    # along the axes, also within the faces of the cubes, where a position of exactly 1.0 is outside the finest
    *_, t_near, t_far, occupied, density, step, growth, stop = _inputs(54, 2, 4, 0.6, 0.17, 0.0, 0.0, generator)
    directions = torch.cat([torch.eye(3), -torch.eye(3)]).repeat(9, 1)
    corners = torch.tensor([-1.0, 0.0, 1.0])
    origins = torch.cartesian_prod(corners, corners).repeat_interleave(6, 0)
    origins = torch.cat([origins, origins[:, :1]], 1)
    yield _steady(origins, directions, t_near, t_far, occupied, density, step, growth, stop)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """size / 64 rays into a cube of 128^3 cells that holds a shell, 1024 steps to its diagonal."""
    rays = size // 64
    place = (torch.arange(128) + 0.5) / 64 - 1
    radius = torch.stack(torch.meshgrid(place, place, place, indexing="ij")).norm(dim=0)
    occupied = ((radius > 0.5) & (radius < 0.6))[None]
    origins = 2.5 * torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
    targets = 0.5 * (2 * torch.rand(rays, 3, generator=generator) - 1)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    t_near = 0.003 * torch.rand(rays, generator=generator)
    density = 20.0 * occupied
    return (
        origins,
        directions,
        t_near,
        torch.full_like(t_near, 5.0),
        occupied,
        density,
        2 * math.sqrt(3) / 1024,
        0,
        1e-4,
    )


def _inputs(rays, cascades, n, filled, step, growth, stop, generator):
    """Rays from inside and outside the cubes, towards them and past them; some with t_far before t_near."""

    def uniform(*shape):
        return torch.rand(shape, generator=generator)

    reach = 2.0 ** (cascades - 1)
    origins = 2 * reach * (2 * uniform(rays, 3) - 1)
    targets = 1.1 * reach * (2 * uniform(rays, 3) - 1)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    t_near = 0.5 * uniform(rays)
    t_far = torch.where(uniform(rays) < 0.3, torch.inf, t_near + reach * (4 * uniform(rays) - 0.5))
    occupied = uniform(cascades, n, n, n) < filled
    density = 8 * uniform(cascades, n, n, n)
    return origins, directions, t_near, t_far, occupied, density, step, growth, stop


def _steady(origins, directions, t_near, t_far, occupied, density, step, growth, stop):
    """The rays that keep their samples when the lattice and `stop` change by more than float32 rounds."""
    from .reference import run

    def samples(nudge):
        rays = origins.double(), directions.double(), t_near.double() + nudge, t_far.double()
        t, _, ray_starts = run(*rays, occupied, density.double(), step, growth, stop * (1 + nudge))
        return t.split(ray_starts.diff().tolist())

    nudged = zip(*(samples(nudge) for nudge in (-3e-5, 0.0, 3e-5)), strict=True)
    keep = [len(a) == len(b) == len(c) and bool(((c - a).abs() < step / 2).all()) for a, b, c in nudged]
    rays = [x[torch.tensor(keep, dtype=torch.bool)] for x in (origins, directions, t_near, t_far)]
    return *rays, occupied, density, step, growth, stop
