"""Baking: a trained field becomes an octree, which is drawn without any network (Yu et al. 2021, PlenOctrees).

What a network answers can be asked beforehand. Most of space is empty or alike, so the answers fit a tree: a cube has
eight children or is a leaf; a leaf has one density and one colour, which change with direction as harmonics.
"""

import time

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .camera import pinhole_rays
from .data import BOX, photographs, psnr, save
from .hashgrid import field, picture, query, train
from .nerf import rays_of, span
from .volume import composite, weights

FIELD_STEPS, DEPTH, SAMPLES = 300, 7, 8  # levels: 2^7 cells along the longest side; directions asked in each cell
THRESHOLD, ALIKE = 1.0, 0.02  # density of an empty cell; difference of colours (and opacities) of equal ones
Y0, Y1 = 0.28209479, 0.48860251  # constants of the first two bands of spherical harmonics
Cells = Int[Tensor, "cell 3"]


def harmonics(d: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Y(d) of two bands: a constant, and a slope along each axis."""
    x, y, z = d.unbind(-1)
    return torch.stack([Y0 + 0 * x, -Y1 * y, Y1 * z, -Y1 * x], -1)


def project(rgb: Float[Tensor, "cell direction 3"], d: Float[Tensor, "direction 3"]) -> Float[Tensor, "cell 4 3"]:
    """Coefficients k of logit(c(d)) = sum_k Y_k(d) k, by least squares over the directions (section 3.1)."""
    return torch.linalg.pinv(harmonics(d)) @ rgb.clamp(0.01, 0.99).logit()


@torch.no_grad()
def baked(net, depth: int = DEPTH) -> tuple[Cells, Float[Tensor, " cell"], Float[Tensor, "cell 4 3"]]:
    """Finest cells with density, their densities and harmonics, from the field at their middles."""
    n = 2**depth
    size = float((BOX[1] - BOX[0]).max()) / n
    place = torch.cartesian_prod(*(torch.arange(round(x / size)) for x in (BOX[1] - BOX[0]).tolist()))
    middle = BOX[0] + size * (place + 0.5)
    sigma = torch.cat([query(net, x, x)[0] for x in middle.split(2**16)])
    kept = sigma > THRESHOLD
    d = torch.nn.functional.normalize(torch.randn(SAMPLES, 3), dim=1)
    parts = [torch.stack([query(net, x, a.expand_as(x))[1] for a in d], 1) for x in middle[kept].split(2**15)]
    return place[kept], sigma[kept], project(torch.cat(parts), d)


def tree(cells: Cells, sigma: Tensor, k: Tensor, depth: int = DEPTH) -> tuple[Int[Tensor, "node 8"], Tensor, Tensor]:
    """Children of each node: 0 is empty, n > 0 is node n, and -1 - r is the leaf r, with its table of leaves.

    From below: eight equal leaves become one that is twice as large; where they differ, their parent is a node.
    """
    leaves_sigma, leaves_k = [sigma], [k]
    values, count, nodes = -1 - torch.arange(len(cells)), len(cells), list[Tensor]()
    size = float((BOX[1] - BOX[0]).max()) / 2**depth
    for level in range(depth):
        parent, group = torch.unique(cells // 2, dim=0, return_inverse=True)
        child = (cells % 2) @ torch.tensor([4, 2, 1])
        children = torch.zeros(len(parent), 8, dtype=torch.long)
        children[group, child] = values
        full = (children < 0).all(1)
        rows = -1 - children[full]
        s, c = torch.cat(leaves_sigma)[rows], torch.cat(leaves_k)[rows]
        opacity = 1 - torch.exp(-s * size * 2**level)
        spread = (Y0 * c[:, :, 0]).sigmoid()
        alike = ((spread.amax(1) - spread.amin(1)).amax(1) < ALIKE) & (opacity.amax(1) - opacity.amin(1) < ALIKE)
        alike &= level < depth - 1
        merged = full.nonzero()[alike, 0]
        leaves_sigma, leaves_k = [*leaves_sigma, s[alike].mean(1)], [*leaves_k, c[alike].mean(1)]
        values = torch.zeros(len(parent), dtype=torch.long)
        values[merged] = -1 - count - torch.arange(len(merged))
        count += len(merged)
        inner = torch.ones(len(parent), dtype=torch.bool)
        inner[merged] = False
        values[inner] = sum(map(len, nodes)) + torch.arange(1, int(inner.sum()) + 1)
        nodes, cells = [*nodes, children[inner]], parent
    table = torch.cat(nodes)  # the root was made last; it is to be number 0, so all are counted backwards
    table = torch.where(table > 0, len(table) - table, table).flip(0)
    return table, torch.cat(leaves_sigma), torch.cat(leaves_k)


def leaf(children: Int[Tensor, "node 8"], place: Cells, depth: int = DEPTH) -> tuple[Tensor, Tensor]:
    """Descent to the leaf at each finest cell: its entry in the tree, and its side in finest cells."""
    node, value, size = (torch.full_like(place[:, 0], x) for x in (0, 1, 2**depth))
    for level in range(depth):
        x, y, z = (place >> (depth - 1 - level) & 1).T
        inner = value > 0
        value = torch.where(inner, children[node, 4 * x + 2 * y + z], value)
        size = torch.where(inner, size // 2, size)
        node = value.clamp_min(0)
    return value, size


def march(children: Tensor, o: Tensor, d: Tensor, depth: int = DEPTH):
    """Rows of leaves along rays (-1: empty) and lengths within them: each step goes to the leaf's nearest wall."""
    n, size = 2**depth, float((BOX[1] - BOX[0]).max()) / 2**depth
    o, inverse = (o - BOX[0]) / size, 1 / torch.where(d.abs() < 1e-9, 1e-9, d)  # in finest cells
    near, far = (t[:, 0] / size for t in span(size * o + BOX[0], d))
    t, found = near.clamp_min(0) + 1e-4, []
    while bool((alive := t < far).any()):
        x = o + t[:, None] * d
        place = x.floor().long().clamp(0, n - 1)
        value, side = leaf(children, place, depth)
        low = place // side[:, None] * side[:, None]
        wall = low + torch.where(d > 0, side[:, None], 0)
        end = ((wall - o) * inverse).amin(1).maximum(t).minimum(far)
        found.append((torch.where(alive & (value < 0), -1 - value, -1), torch.where(alive, end - t, 0) * size))
        t = torch.where(alive, end + 1e-4, t)
    rows, lengths = zip(*found, strict=True)
    return torch.stack(rows, 1), torch.stack(lengths, 1)


def draw(children: Tensor, sigma: Tensor, k: Tensor, o: Tensor, d: Tensor) -> Float[Tensor, "ray 3"]:
    """Colours of rays before white: the sum of `volume.py` over the leaves that they cross."""
    rows, lengths = march(children, o, d)
    density = torch.where(rows >= 0, sigma[rows.clamp_min(0)], 0)
    w = weights(density, lengths)
    ray, step = (w > 1e-3).nonzero().T
    rgb = torch.zeros(*w.shape, 3)
    rgb[ray, step] = (harmonics(d)[ray][..., None] * k[rows[ray, step]]).sum(1).sigmoid()
    return composite(w, rgb)


def main() -> None:
    torch.manual_seed(0)
    net = field()
    occupied = train(net, *rays_of(*photographs()), steps=FIELD_STEPS)
    cells, sigma, k = baked(net)
    children, sigma, k = tree(cells, sigma, k)
    used = int((children < 0).sum())
    print(f"{len(cells)} cells with density became {used} leaves below {len(children)} nodes")
    (image, *_), (pose, *_), focal = photographs("test")
    begin = time.process_time()
    asked = picture(net, occupied, image, pose, focal)
    middle = time.process_time()
    with torch.no_grad():
        drawn = draw(children, sigma, k, *pinhole_rays(image, pose, focal)).view(asked.shape)
    end = time.process_time()
    print(f"field  {psnr(asked, image):.1f} dB, {middle - begin:.2f} processor seconds")
    print(f"octree {psnr(drawn, image):.1f} dB, {end - middle:.2f} processor seconds")
    save("bake", image, asked, drawn, 0.5 + 2 * (drawn - asked))


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/plenoctrees/` trains harmonics in the first place, keeps cells by their weight
# in photographs, and trains the leaves on. `kernels/octree_cells/` walks the same tree, `kernels/octree_march/` draws
# it, `octree.html` of `lumigraph export web` does so in a browser. `methods/snerg/` bakes into blocks with a network.
