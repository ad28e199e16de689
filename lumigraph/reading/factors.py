"""TensoRF: a voxel grid as a sum of products of planes and lines (Chen et al. 2022).

A grid of n^3 numbers is large, and most of it repeats. A matrix of low rank is a few columns times a few rows. In the
same way a grid is a few planes times a few lines: n^2 numbers for each component, not n^3.
"""

import time

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import grid_sample, softplus

from .camera import pinhole_rays
from .data import BOX, photographs, psnr, save
from .hashgrid import CELLS, centres, directional, march
from .nerf import rays_of
from .volume import composite, weights

MODES = (1, 2, 0), (0, 2, 1), (0, 1, 2)  # the two axes of a plane, and that of the line beside it
DENSITY_COMPONENTS, COLOUR_COMPONENTS, FEATURES = 8, 16, 16  # R of each kind; outputs of B
NODES = 96  # along the longest side
RAYS, STEPS, STEPS_ACROSS, RATES = 1024, 300, 128, (0.03, 3e-3)
Points = Float[Tensor, "sample 3"]
Factor = nn.ParameterList | list[Tensor]


def plane(nodes: Float[Tensor, "component a b"], places: Float[Tensor, "sample 2"]) -> Float[Tensor, "sample _"]:
    """Bilinear interpolation at places in [0, 1]^2, whose first coordinate runs along the first axis of the nodes."""
    at = (2 * places - 1).flip(1)[None, None]  # grid_sample wants (column, row) in [-1, 1]
    return grid_sample(nodes[None], at, align_corners=True, padding_mode="border")[0, :, 0].T


def line(nodes: Float[Tensor, "component n"], places: Float[Tensor, " sample"]) -> Float[Tensor, "sample _"]:
    """Linear interpolation along a line: a plane one column wide."""
    return plane(nodes[:, :, None], torch.stack([places, torch.zeros_like(places)], 1))


def products(points: Points, planes: Factor, lines: Factor) -> Float[Tensor, "sample product"]:
    """Each component's product at points in the unit cube: P_yz(y, z) l_x(x), P_xz(x, z) l_y(y), P_xy(x, y) l_z(z),
    one after the other (eqs. 3 and 4)."""
    found = [
        plane(p, points[:, [a, b]]) * line(v, points[:, beside])
        for p, v, (a, b, beside) in zip(planes, lines, MODES, strict=True)
    ]
    return torch.cat(found, 1)


def factors(components: int, nodes: list[int], size: float) -> nn.ModuleList:
    """Three planes and three lines of random numbers."""
    planes = [size * torch.randn(components, nodes[a], nodes[b]) for a, b, _ in MODES]
    lines = [size * torch.randn(components, nodes[beside]) for *_, beside in MODES]
    return nn.ModuleList([nn.ParameterList(planes), nn.ParameterList(lines)])


def field() -> nn.ModuleDict:
    side = BOX[1] - BOX[0]
    nodes, inputs = [round(NODES * x) for x in (side / side.max()).tolist()], FEATURES + 9
    return nn.ModuleDict(
        {
            "density": factors(DENSITY_COMPONENTS, nodes, 0.1),
            "colour": factors(COLOUR_COMPONENTS, nodes, 0.1),
            "basis": nn.Linear(3 * COLOUR_COMPONENTS, FEATURES, bias=False),  # B of eq. 6
            "network": nn.Sequential(nn.Linear(inputs, 48), nn.ReLU(), nn.Linear(48, 3)),  # S of eq. 7
        }
    )


def density(net: nn.ModuleDict, points: Points) -> Float[Tensor, " sample"]:
    """sigma(x) = softplus(sum of all products) (eq. 5), scaled so that solid things take few steps to learn."""
    cube = (points - BOX[0]) / (BOX[1] - BOX[0])
    return 25 * softplus(products(cube, *net["density"]).sum(1) - 5)


def colour(net: nn.ModuleDict, points: Points, d: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 3"]:
    """c(x, d) = S(B A(x), d), A(x) being the products (eqs. 6 and 7)."""
    cube = (points - BOX[0]) / (BOX[1] - BOX[0])
    return net["network"](torch.cat([net["basis"](products(cube, *net["colour"])), directional(d)], 1)).sigmoid()


def render(net: nn.ModuleDict, o: Tensor, d: Tensor, occupied: Tensor, jitter: bool = False) -> Float[Tensor, "ray 3"]:
    """Density everywhere that is not empty; colour only where a sample has a weight."""
    step = float((BOX[1] - BOX[0]).max()) / STEPS_ACROSS
    t, there = march(o, d, occupied, step, jitter)
    ray = there.nonzero()[:, 0]
    points = o[ray] + t[there][:, None] * d[ray]
    w = weights(torch.zeros_like(t).masked_scatter(there, density(net, points)), torch.full_like(t, step))
    seen = w[there] > 1e-3
    rgb = torch.zeros(len(points), 3).masked_scatter(seen[:, None], colour(net, points[seen], d[ray[seen]]))
    return composite(w, torch.zeros(*t.shape, 3).masked_scatter(there[..., None], rgb))


@torch.no_grad()
def occupancy(net: nn.ModuleDict) -> Tensor:
    """Cells with density, and their neighbours."""
    sigma = torch.cat([density(net, some) for some in centres().split(2**16)]).view(1, 1, CELLS, CELLS, CELLS)
    return nn.functional.max_pool3d(sigma, 3, 1, 1)[0, 0] > 0.5


def train(net: nn.ModuleDict, o: Tensor, d: Tensor, truth: Tensor, steps: int = STEPS) -> Tensor:
    """Squared error, with the paper's two rates, for factors and for networks (section 5). Returns the grid."""
    occupied = torch.ones(CELLS, CELLS, CELLS, dtype=torch.bool)
    parts = [[net["density"], net["colour"]], [net["basis"], net["network"]]]
    groups = [{"params": [x for module in part for x in module.parameters()]} for part in parts]
    optimizer, begin = torch.optim.Adam(groups, betas=(0.9, 0.99)), time.perf_counter()
    for step in range(steps):
        for group, rate in zip(optimizer.param_groups, RATES, strict=True):
            group["lr"] = rate * 0.1 ** (step / steps)
        chosen = torch.randint(len(o), (RAYS if step > 40 else RAYS // 4,))
        loss = (render(net, o[chosen], d[chosen], occupied, jitter=True) - truth[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 20 == 19:
            occupied = occupancy(net)
        if step % 40 == 39:
            print(f"step {step + 1:4}   {time.perf_counter() - begin:4.0f} s   loss {loss.item():.4f}")
    return occupied


def main() -> None:
    torch.manual_seed(0)
    net = field()
    occupied = train(net, *rays_of(*photographs()))
    images, poses, focal = photographs("test")
    pictures = []
    with torch.no_grad():
        for image, pose in zip(images[:3], poses, strict=False):
            pictures.append(render(net, *pinhole_rays(image, pose, focal), occupied).view(image.shape))
    print(f"{psnr(torch.stack(pictures), images[:3]):.1f} dB on photographs that it has not seen")
    save("factors", *(x for pair in zip(images, pictures, strict=False) for x in pair))


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/tensorf/` adds CP (lines alone), nodes that multiply while it learns, an L1
# norm that empties the grid, a box that shrinks to the object, and truncation to fewer components after training.
# `kernels/factor_grid/` interpolates planes and lines in one loop, and keeps no product in memory.
