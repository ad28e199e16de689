"""Small baked volumes made by formulas, and what rays see of them, worked out without leaps and without levels."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from solids import Distance, ball, painted, together, torus

from lumigraph import kernels
from lumigraph.camera.rays import Rays
from lumigraph.exchange.baked import Atlas, Octree, ViewNetwork

SOLID = 60.0  # density per scene unit


def things() -> Distance:
    return together(ball(0.35, (0.1, -0.1, 0.15)), torus(0.65, 0.14))


def centres(corner: torch.Tensor, side: float, count: int) -> torch.Tensor:
    """Middles of the cells of a cube, (count, count, count, 3)."""
    steps = (torch.arange(count) + 0.5) * side / count
    return torch.stack(torch.meshgrid(*(low + steps for low in corner), indexing="ij"), -1)


@cache
def octree(levels: int = 5, bands: int = 3) -> Octree:
    """Divided wherever one of its finest cells has anything, and a fog in one large cell of the second level."""
    low, size, generator = torch.full((3,), -1.0), 2.0, torch.Generator().manual_seed(4)
    distance, count = things(), 2**levels
    solid = (distance(centres(low, size, count).reshape(-1, 3)) < 0).reshape(count, count, count)
    child, density, harmonics, corners, nodes = [], [], [], [(0, 0, 0)], 1
    for level in range(1, levels + 1):
        side, below = 2 ** (levels - level), []
        for corner in corners:
            number = len(child)
            child.append(torch.zeros(2, 2, 2, dtype=torch.int32))
            density.append(torch.zeros(2, 2, 2))
            colours = 0.25 * torch.randn(2, 2, 2, bands**2, 3, generator=generator)
            for x, y, z in torch.cartesian_prod(*[torch.arange(2)] * 3).tolist():
                a, b, c = (2 * corner[0] + x, 2 * corner[1] + y, 2 * corner[2] + z)
                some = solid[a * side : (a + 1) * side, b * side : (b + 1) * side, c * side : (c + 1) * side]
                middle = low + size / 2**level * (torch.tensor([a, b, c]) + 0.5)
                colours[x, y, z, 0] = 3 * torch.logit(painted(middle), 0.05)
                if level < levels and some.any():
                    child[number][x, y, z] = nodes - number
                    nodes += 1
                    below.append((a, b, c))
                elif some.any():
                    density[number][x, y, z] = SOLID * (1 + float(torch.rand((), generator=generator)))
                elif level == 3 and (a, b, c) == (7, 7, 7):
                    density[number][x, y, z] = 1.5
            harmonics.append(colours)
        corners = below
    return Octree(torch.stack(child), torch.stack(density), torch.stack(harmonics), low, size)


def lookup(tree: Octree, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Density and harmonics of the cells around points."""
    place = ((points - tree.low) / tree.size).clamp(0, 1 - 1e-6)
    node, index = torch.zeros(len(points), dtype=torch.long), None
    done = torch.zeros(len(points), dtype=torch.bool)
    found = torch.zeros(len(points), dtype=torch.long)
    while not done.all():
        place = 2 * place
        index = place.long().clamp(0, 1)
        place = place - index
        cell = 8 * node + 4 * index[:, 0] + 2 * index[:, 1] + index[:, 2]
        found = torch.where(done, found, cell)
        below = tree.child.long().flatten()[cell]
        done |= below == 0
        node = torch.where(done, node, node + below)
    return tree.density.flatten()[found], tree.harmonics.flatten(0, 3)[found]


def octree_seen(tree: Octree, rays: Rays, levels: int, background: torch.Tensor) -> torch.Tensor:
    """Colours of rays: between any two of the finest grid's planes a ray is in one cell."""
    planes = tree.low[:, None] + tree.size * torch.arange(2**levels + 1) / 2**levels
    t = ((planes - rays.origins[..., None]) / rays.directions[..., None]).flatten(1).clamp_min(0).sort(1).values
    begin, length = t[:, :-1], t.diff()
    points = rays.origins[:, None] + (begin + length / 2)[..., None] * rays.directions[:, None]
    inside = ((points > tree.low) & (points < tree.low + tree.size)).all(-1)
    density, harmonics = lookup(tree, points.reshape(-1, 3))
    basis = kernels.spherical_harmonics(rays.directions, int(tree.harmonics.shape[-2] ** 0.5))
    rgb = torch.einsum("rsbc,rb->rsc", harmonics.view(*points.shape[:2], *harmonics.shape[1:]), basis).sigmoid()
    tau = density.view(points.shape[:2]) * inside * length
    return blended(tau, rgb, background)


def blended(tau: torch.Tensor, rgb: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
    light = torch.exp(-torch.nn.functional.pad(tau.cumsum(1), (1, 0)))
    return ((light[:, :-1] - light[:, 1:])[..., None] * rgb).sum(1) + light[:, -1:] * background


@cache
def atlas(count: int = 48, block: int = 8, network: bool = True) -> Atlas:
    """Blocks of a cube of voxels, those that hold anything."""
    low, side, voxel = torch.tensor([-0.9, -0.85, -0.95]), 1.8, 1.8 / count
    points = centres(low, side, count)
    distance = things()(points.reshape(-1, 3)).view(count, count, count)
    alpha = 1 - torch.exp(-SOLID * voxel * torch.sigmoid(-distance / voxel * 4))
    alpha = torch.where(alpha > 0.01, alpha, 0)[..., None]
    features = 0.5 + 0.5 * torch.sin(torch.cat([4 * points, 7 * points[..., :1]], -1))
    whole = torch.cat([alpha * (0.6 * painted(points)), alpha, alpha * features], -1)
    whole = torch.nn.functional.pad((255 * whole).byte().movedim(-1, 0), (1,) * 6).movedim(0, -1)
    index, values = torch.full((count // block,) * 3, -1, dtype=torch.int32), []
    for corner in torch.cartesian_prod(*[torch.arange(count // block)] * 3):
        x, y, z = (corner * block).tolist()
        some = whole[x : x + block + 2, y : y + block + 2, z : z + block + 2]
        if some.any():
            index[tuple(corner)] = len(values)
            values.append(some)
    return Atlas(index, torch.stack(values), low, voxel, block, shades() if network else None)


def shades() -> ViewNetwork:
    """A network of random weights that adds strong colours, changing with direction."""
    generator = torch.Generator().manual_seed(5)
    sizes = [(34, 16), (16, 16), (16, 3)]
    weights = tuple(torch.randn(a, b, generator=generator) * a**-0.5 * 1.5 for a, b in sizes)
    biases = tuple(0.3 * torch.randn(b, generator=generator) - (1.0 if b == 3 else 0) for _, b in sizes)
    return ViewNetwork(weights, biases)


def open_atlas() -> Atlas:
    """The same in contracted coordinates: most of it lies beyond the unit ball."""
    made = atlas()
    return replace(made, low=torch.full((3,), -2.0), voxel=4 / 48, contracted=True)


def dense(made: Atlas) -> torch.Tensor:
    """All voxels of the grid, in [0, 1]: (8, x, y, z)."""
    block, shape = made.block, [made.block * n for n in made.index.shape]
    whole = torch.zeros(*shape, 8)
    for corner in (made.index >= 0).nonzero():
        x, y, z = (corner * block).tolist()
        whole[x : x + block, y : y + block, z : z + block] = (
            made.values[made.index[tuple(corner)], 1:-1, 1:-1, 1:-1].float() / 255
        )
    return whole.movedim(-1, 0)


def atlas_seen(made: Atlas, rays: Rays, near: float, background: torch.Tensor) -> torch.Tensor:
    """Colours of rays: every step of one voxel from where they enter, interpolated between eight voxels."""
    whole = dense(made)
    size = torch.tensor(whole.shape[1:])
    enter, leave = rays.through_box(torch.stack([made.low, made.low + size * made.voxel]))
    if made.contracted:
        t = curved(rays, near, made.voxel)
    else:
        steps = int((leave - enter).max() / made.voxel) + 1
        t = enter.clamp_min(near)[:, None] + (torch.arange(steps) + 0.5) * made.voxel
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    if made.contracted:
        points = contract(points)
    points = (points - made.low) / made.voxel / size * 2 - 1
    grid = points.flip(-1)[None, None]
    kept = ((points > -1) & (points < 1)).all(-1, keepdim=True)
    found = torch.nn.functional.grid_sample(whole[None], grid, align_corners=False)[0, :, 0].movedim(0, -1) * kept
    light = torch.nn.functional.pad((1 - found[..., 3]).cumprod(1), (1, 0), value=1.0)
    total = (light[:, :-1, None] * found).sum(1)
    colour, left = total[:, :3], light[:, -1:]
    if made.network:
        colour = colour + (1 - left) * network_of(made.network, rays.directions, colour, total[:, 4:])
    return colour + left * background


def contract(points: torch.Tensor) -> torch.Tensor:
    """Barron 2022, eq. 10."""
    radius = points.norm(dim=-1, keepdim=True).clamp_min(1)
    return (2 - 1 / radius) / radius * points


def curved(rays: Rays, near: float, voxel: float, fine: int = 10) -> torch.Tensor:
    """Distances along rays, a voxel of contracted coordinates from each to the next, counted in much smaller steps."""
    t = near + torch.cat([torch.arange(0, 8, voxel / fine), 8 / (1 - torch.arange(1, 500) / 500)])
    path = contract(rays.origins[:, None] + t[:, None] * rays.directions[:, None])
    gone = torch.nn.functional.pad(path.diff(dim=1).norm(dim=-1).cumsum(1), (1, 0))
    wanted = (torch.arange(int(gone[:, -1].max() / voxel)) * voxel).expand(len(gone), -1)
    # As the march does, half of a straight step ahead of the first.
    wanted = wanted + torch.stack([torch.as_tensor(np.interp(near + voxel / 2, t, x)) for x in gone])[:, None].float()
    after = torch.searchsorted(gone, wanted.contiguous()).clamp(1, len(t) - 1)
    least, most = gone.gather(1, after - 1), gone.gather(1, after)
    share = ((wanted - least) / (most - least).clamp_min(1e-9)).clamp(0, 1)
    return torch.lerp(t[after - 1], t[after], share)


def network_of(made: ViewNetwork, directions, colours, features) -> torch.Tensor:
    angles = (2.0 ** torch.arange(4)[:, None] * directions[:, None]).flatten(1)
    x = torch.cat([directions, angles.sin(), angles.cos(), colours, features], 1)
    for i, (weights, biases) in enumerate(zip(made.weights, made.biases, strict=True)):
        x = x @ weights + biases
        x = x.relu() if i < 2 else x.sigmoid()
    return x
