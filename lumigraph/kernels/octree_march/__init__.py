"""Rendering an octree: traversal, harmonics and compositing in one (Yu 2021, arXiv 2103.14024, section 4)."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require
from ..octree_cells import Tree, check, picture, shell, some_rays, some_tree, steady

FACTS = Facts(unit="rays", outputs=3, differentiable=(3, 4), typical=3, compiled=4, smooth=(7,))


@door
def octree_march(
    origins: Float[Tensor, "ray 3"],
    directions: Float[Tensor, "ray 3"],
    tree: Tree,
    density: Float[Tensor, " row"],
    harmonics: Float[Tensor, "row basis 3"],
    near: float = 0.0,
    stop: float = 0.0,
) -> tuple[Float[Tensor, "ray 3"], Float[Tensor, " ray"], Float[Tensor, " ray"]]:
    """Accumulate the cells that a ray crosses (see `octree_cells`), each constant inside (section 4.1):

        c_i = sigmoid(sum_lm Y_lm(d) harmonics_i,lm),    tau_i = density_i (t_{i+1} - t_i)
        C = sum_i T_i (1 - exp(-tau_i)) c_i,    T_i = exp(-sum_{j<i} tau_j)

    origins, directions, near: in units of the cube, which is [0, 1]^3; directions of unit length
    tree:      trusted to be unchanged since `of` or `part`
    density:   per side of the cube, never negative
    harmonics: 1, 4, 9 or 16 coefficients of each colour, in the order of `spherical_harmonics`
    stop:      early termination: cells behind this transmittance get weight 0 and no gradient

    Returns colour (ray, 3), the accumulated distance to the middles of intervals (ray,), opacity (ray,).
    All three are differentiable in density and harmonics.
    """
    check(tree, density, near, stop)
    require(harmonics.shape[1] in (1, 4, 9, 16), f"{harmonics.shape[1]} coefficients are no whole bands up to four")
    return implementation("octree_march", origins)(origins, directions, tree, density, harmonics, near, stop)


def cases(generator: torch.Generator):
    """Test inputs for all engines: empty space, haze and walls, cells of several sizes, terminated rays."""
    for rays, depth, share, bands, dense, near, stop in [
        (0, 1, 1.0, 1, 1.0, 0.0, 0.0),
        (1, 1, 1.0, 2, 2.0, 0.0, 0.0),
        (9, 2, 0.0, 3, 1.0, 0.0, 0.0),
        (30, 3, 0.6, 2, 8.0, 0.1, 0.1),
        (20, 2, 0.8, 4, 300.0, 0.0, 1e-4),
        (5, 6, 0.5, 3, 20.0, 0.0, 0.0),
        (40, 2, 0.7, 1, 0.0, 0.3, 0.0),
        (6, 2, 0.6, 2, 3.0, 0.0, 0.0),
    ]:
        yield _inputs(some_tree(depth, share, generator), rays, bands, dense, near, stop, generator)
    tree = some_tree(3, 0.5, generator)
    yield _inputs(tree.part(torch.arange(tree.count - 1, -1, -3)), 20, 1, 5.0, 0.0, 0.0, generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """The rays and the tree of `octree_cells`, with three bands of harmonics."""
    tree = shell(7)
    origins, directions = picture(size // 16)
    density = 400 * torch.rand(tree.count, generator=generator)
    harmonics = torch.randn(tree.count, 9, 3, generator=generator)
    return origins, directions, tree, density.requires_grad_(), harmonics.requires_grad_(), 0.0, 1e-3


def _inputs(tree: Tree, rays: int, bands: int, dense: float, near: float, stop: float, generator: torch.Generator):
    density = dense * torch.rand(tree.count, generator=generator)
    origins, directions = some_rays(rays, generator)
    origins, directions, *_ = steady(origins, directions, tree, density, near, stop)
    return origins, directions, tree, density, torch.randn(tree.count, bands**2, 3, generator=generator), near, stop
