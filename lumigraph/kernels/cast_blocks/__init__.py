"""Ray casting: the first surface along rays through hashed blocks of signed distances."""

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from .._operation import Facts, door, implementation, require
from ..block_hash import VOXELS, new_table, random_blocks
from ..fuse_depth import UNCOLOURED

FACTS = Facts(unit="rays", outputs=3, differentiable=(), typical=2, compiled=2)


@door
def cast_blocks(
    origins: Float[Tensor, "ray 3"],
    directions: Float[Tensor, "ray 3"],
    t_near: Float[Tensor, " ray"],
    t_far: Float[Tensor, " ray"],
    voxels: Float[Tensor, "block 512 5"],
    blocks: Int32[Tensor, "block 3"],
    table: Int32[Tensor, " slot"],
    voxel: float,
    step: float,
) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 3"], Float[Tensor, "ray 3"]]:
    """Distance, normal and colour where each ray first crosses the zero level from outside (Nießner 2013, sec. 5).

        t_k = t_near + k step < t_far      D(t_k) >= 0 > D(t_k+1)      t = t_k + step D(t_k) / (D(t_k) - D(t_k+1))

    with the first such k. D is trilinear between the eight voxels around a point, unknown where one of them has no
    block or no weight. Engines skip the t_k in missing blocks. The distance is infinite without a surface. The normal
    is the unit gradient of D, or the reversed ray direction where D is unknown or flat. The colour is interpolated
    between those of the eight voxels that have one; grey where none has.

    voxels, blocks: as in `fuse_depth`; table: of the blocks (`block_hash`). Trusted
    Not differentiable.
    """
    require(voxel > 0 and step > 0, f"voxel {voxel} and step {step} cannot be")
    given = voxels, blocks, table, voxel, step
    with torch.no_grad():
        return implementation("cast_blocks", origins)(origins, directions, t_near, t_far, *given)


def a_ball(count: int, reach: int, generator: torch.Generator):
    """Voxels, blocks and table of a ball around the origin, for tests: truncated distances, with some holes."""
    blocks = random_blocks(count, reach, generator)
    axis = torch.arange(8)
    places = 8 * blocks[:, None] + torch.cartesian_prod(axis, axis, axis).int()
    distance = ((places.float() + torch.tensor([0.13, 0.21, 0.08])).norm(dim=-1) - 6 * reach) / 4
    colours = 0.1 + 0.8 * torch.rand(*distance.shape, 3, generator=generator)
    unpainted = torch.rand(distance.shape, generator=generator) < 0.2
    colours = torch.where(unpainted[..., None], UNCOLOURED, colours)
    weight = (torch.rand(distance.shape, generator=generator) < 0.98).float()
    voxels = torch.cat([distance.clamp(-1, 1)[..., None], weight[..., None], colours], -1)
    assert voxels.shape[1] == VOXELS
    return voxels, blocks, new_table(blocks)


def cases(generator: torch.Generator):
    """Test inputs for all engines: no ray, no block, rays past all blocks, from inside, along the axes."""
    for rays, count, reach, step in [(0, 9, 2, 0.1), (5, 0, 2, 0.1), (40, 60, 2, 0.11), (30, 40, 2, 0.25)]:
        yield _inputs(rays, count, reach, step, generator)
    origins, directions, *rest = _inputs(6, 8, 1, 0.1, generator)
    directions = torch.cat([torch.eye(3), -torch.eye(3)])
    yield _steady(-1.3 * directions + 0.017, directions, *rest)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Rays into a ball of 4096 blocks, a sixteenth of `size`."""
    return _inputs(size // 16, 4096, 8, 0.1, generator, steady=False)


def _inputs(rays, count, reach, step, generator, steady=True):
    voxels, blocks, table = a_ball(count, reach, generator)
    side = 0.1 * 8 * reach  # half of the cube that the blocks may be in
    origins = 2.2 * side * torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
    origins[::5] *= 0.2
    targets = 1.2 * side * (2 * torch.rand(rays, 3, generator=generator) - 1)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    t_near = 0.3 * torch.rand(rays, generator=generator)
    given = origins, directions, t_near, torch.full((rays,), 4.0 * side), voxels, blocks, table, 0.1, step
    return _steady(*given) if steady else given


def _steady(origins, directions, t_near, t_far, voxels, blocks, table, voxel, step):
    """The inputs without rays whose surface changes when they move by 1e-5."""
    run, steady = implementation("cast_blocks", origins), torch.ones(len(origins), dtype=torch.bool)
    rest = t_far, voxels, blocks, table, voxel, step
    found = run(origins, directions, t_near, *rest)
    for shift in (-1e-5, 1e-5):
        other = run(origins + shift, directions, t_near - shift, *rest)
        near = ((found[0] - other[0]).abs() < 1e-3) | (found[0] == other[0])
        steady &= near & ((found[1] - other[1]).abs() < 1e-2).all(-1) & ((found[2] - other[2]).abs() < 1e-2).all(-1)
    return origins[steady], directions[steady], t_near[steady], t_far[steady], *rest[1:]
