"""Instant-NGP: most of the network becomes a table of numbers, looked up by a hash (Müller et al. 2022).

A network spends its time on multiplications that are the same everywhere. A table holds the scene where it is, a tiny
network reads it, and a coarse grid of what is empty says where not to look at all.
"""

import time

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from .camera import pinhole_rays
from .data import BOX, photographs, psnr, save
from .nerf import rays_of, span
from .volume import composite, weights

LEVELS, FEATURES, ENTRIES = 8, 2, 2**15  # L, F and T of table 1, smaller
COARSEST, FINEST = 16, 256  # N_min and N_max: cells per axis of the first and the last level
PRIMES = 1, 2_654_435_761, 805_459_861
CELLS, STEPS_ACROSS = 64, 128  # of the occupancy grid, per axis; marching steps along the box's longest side
RAYS, RATE, STEPS = 1024, 2e-2, 600
Points = Float[Tensor, "sample 3"]


def resolutions(levels: int, coarsest: int, finest: int) -> list[int]:
    """N_l = floor(N_min b^l), with b such that the last level has N_max (eqs. 2 and 3)."""
    b = (finest / coarsest) ** (1 / max(levels - 1, 1))
    return [int(coarsest * b**level + 1e-9) for level in range(levels)]


def row(corner: Int[Tensor, "*batch 3"], n: int, entries: int) -> Int[Tensor, "*batch"]:
    """Row of a grid's corner in its level of the table: its number where all fit, else its hash (eq. 4)."""
    x, y, z = corner.unbind(-1)
    if (n + 1) ** 3 <= entries:
        return x + (n + 1) * y + (n + 1) ** 2 * z
    return (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % entries


def encode(points: Points, tables: list[Tensor], sizes: list[int]) -> Float[Tensor, "sample _"]:
    """Trilinear interpolation of every level's eight corners, end to end (section 3). points: in the unit cube"""
    corners = torch.cartesian_prod(*[torch.arange(2)] * 3)
    found = []
    for table, n in zip(tables, sizes, strict=True):
        cell = (points.detach() * n).long().clamp(0, n - 1)
        within = (points * n - cell)[:, None]
        share = torch.where(corners == 1, within, 1 - within).prod(-1)  # (sample, 8): they add up to one
        rows = row(cell[:, None] + corners, n, len(table))
        found.append((share[..., None] * table[rows]).sum(1))
    return torch.cat(found, 1)


def directional(d: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample 9"]:
    """Directions as products up to degree two: all that spherical harmonics of three bands can say."""
    x, y, z = d.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 1)


def field() -> nn.ModuleDict:
    """Tables that start almost empty, and two small networks (section 5.4)."""
    sizes = resolutions(LEVELS, COARSEST, FINEST)
    tables = [nn.Parameter(1e-4 * (2 * torch.rand(min((n + 1) ** 3, ENTRIES), FEATURES) - 1)) for n in sizes]
    return nn.ModuleDict(
        {
            "tables": nn.ParameterList(tables),
            "density": nn.Sequential(nn.Linear(LEVELS * FEATURES, 32), nn.ReLU(), nn.Linear(32, 16)),
            "colour": nn.Sequential(nn.Linear(16 + 9, 32), nn.ReLU(), nn.Linear(32, 3)),
        }
    )


def query(net: nn.ModuleDict, points: Points, d: Float[Tensor, "sample 3"]):
    """Density per scene unit, the exponential of the first feature, and colour."""
    low, high = BOX
    cube = (points - low) / (high - low).max()
    features = net["density"](encode(cube, list(net["tables"]), resolutions(LEVELS, COARSEST, FINEST)))
    inside = ((points > low) & (points < high)).all(1)
    sigma = torch.exp(features[:, 0].clamp(max=8)) * inside
    return sigma, net["colour"](torch.cat([features, directional(d)], 1)).sigmoid()


# Empty space


def centres() -> Points:
    """A point in the middle of each cell of the occupancy grid over the box."""
    place = (torch.cartesian_prod(*[torch.arange(CELLS)] * 3) + 0.5) / CELLS
    return torch.lerp(BOX[0], BOX[1], place)


@torch.no_grad()
def occupancy(net: nn.ModuleDict, step: float, stop: float = 0.03) -> Bool[Tensor, "x y z"]:
    """Cells in which a step stops more than three percent of the light, at either of two random places."""
    middle, cell, most = centres(), (BOX[1] - BOX[0]) / CELLS, torch.zeros(CELLS**3)
    for _ in range(2):
        near = middle + (torch.rand_like(middle) - 0.5) * cell
        parts = [query(net, some, some)[0] for some in near.split(2**16)]
        most = torch.maximum(most, torch.cat(parts))
    return (1 - torch.exp(-most * step) > stop).view(CELLS, CELLS, CELLS)


def march(o: Tensor, d: Tensor, occupied: Bool[Tensor, "x y z"], step: float, jitter: bool):
    """Steps of one length along each ray through the box, and a mask of those that lie in occupied cells."""
    near, far = span(o, d)
    count = int(((far - near).amax() / step).ceil().clamp_min(1))
    start = near + step * (torch.rand_like(near) if jitter else 0.5)
    t = start + step * torch.arange(count)
    place = (o[:, None] + t[..., None] * d[:, None] - BOX[0]) / (BOX[1] - BOX[0])
    x, y, z = (place * CELLS).long().clamp(0, CELLS - 1).unbind(-1)
    return t, (t < far) & occupied[x, y, z]


def render(net: nn.ModuleDict, o: Tensor, d: Tensor, occupied: Tensor, background: float | Tensor = 1.0, jitter=False):
    """Colours and opacities of rays: the field is asked only where a step lies in an occupied cell."""
    step = float((BOX[1] - BOX[0]).max()) / STEPS_ACROSS
    t, there = march(o, d, occupied, step, jitter)
    ray = there.nonzero()[:, 0]
    sigma, rgb = torch.zeros_like(t), torch.zeros(*t.shape, 3)
    some_sigma, some_rgb = query(net, o[ray] + t[there][:, None] * d[ray], d[ray])
    sigma, rgb = sigma.masked_scatter(there, some_sigma), rgb.masked_scatter(there[..., None], some_rgb)
    w = weights(sigma, torch.full_like(t, step))
    return composite(w, rgb, background), w.sum(1)


def picture(net: nn.ModuleDict, occupied: Tensor, image: Tensor, pose: Tensor, focal: float):
    """Rendering of a whole camera, some rays at a time."""
    o, d = pinhole_rays(image, pose, focal)
    with torch.no_grad():
        parts = [render(net, a, b, occupied)[0] for a, b in zip(o.split(4096), d.split(4096), strict=True)]
    return torch.cat(parts).view(image.shape)


def train(net: nn.ModuleDict, o: Tensor, d: Tensor, truth: Tensor, steps: int = STEPS) -> Bool[Tensor, "x y z"]:
    """Adam on the squared error; the occupancy grid follows the field every 25 steps. Returns the grid."""
    optimizer = torch.optim.Adam(net.parameters(), RATE, betas=(0.9, 0.99), eps=1e-15)
    step_length = float((BOX[1] - BOX[0]).max()) / STEPS_ACROSS
    occupied = torch.ones(CELLS, CELLS, CELLS, dtype=torch.bool)
    begin = time.perf_counter()
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = RATE * 0.05 ** max(0.0, (step / steps - 0.3) / 0.7)
        chosen = torch.randint(len(o), (RAYS if step > 75 else RAYS // 4,))
        rgb, _ = render(net, o[chosen], d[chosen], occupied, jitter=True)
        loss = (rgb - truth[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 25 == 24 and step > 50:
            occupied = occupancy(net, step_length)
        if step % 50 == 49:
            filled = 100 * float(occupied.float().mean())
            spent = time.perf_counter() - begin
            print(f"step {step + 1:4}   {spent:4.0f} s   loss {loss.item():.4f}   {filled:.0f} % filled")
    return occupied


def main() -> None:
    torch.manual_seed(0)
    net = field()
    occupied = train(net, *rays_of(*photographs()))
    images, poses, focal = photographs("test")
    pictures = [picture(net, occupied, image, pose, focal) for image, pose in zip(images[:3], poses, strict=False)]
    print(f"{psnr(torch.stack(pictures), images[:3]):.1f} dB on photographs that it has not seen")
    save("hashgrid", *(x for pair in zip(images, pictures, strict=False) for x in pair))


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/instant_ngp.py` is this file with a Huber loss, random backgrounds, poses and
# exposures that are learnt, and scenes without bounds. `kernels/hash_encode/` blends eight corners without storing
# them, and scatters gradients without two threads in one place; `kernels/march/` walks through nested grids;
# `components/sampling/occupancy_sampler.py` keeps the grid, and chooses the number of rays by the samples they have.
