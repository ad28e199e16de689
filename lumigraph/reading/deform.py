"""A field that moves: one canonical scene, and a network that bends every moment back to it (Pumarola 2021; Park 2021).

Each photograph of a film shows another moment, so no two agree. But points do not vanish, they move: psi(x, t) = dx
is the way from a point at t to its place in the canonical scene, c(x, t) = c_canonical(x + dx). So all photographs
teach one field.
"""

import math
import time

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from .camera import pinhole_rays
from .data import BOX, photographs, psnr, save, times
from .hashgrid import CELLS, STEPS_ACROSS, centres, field, march, query
from .nerf import encode, rays_of
from .volume import composite, weights

SCENE, SCALE = "procedural:jelly,size=112,views=60", 0.72  # a jelly that sways; SCALE brings it into the box
OCTAVES, TIME_OCTAVES, WIDTH, RAYS, STEPS, RATE = 3, 3, 64, 768, 320, 3e-2
Points = Float[Tensor, "sample 3"]


def window(octaves: int, alpha: float) -> Float[Tensor, " octave"]:
    """Coarse to fine, for a smooth start (Park 2021, eq. 8): w_j = (1 - cos(pi clamp(alpha - j, 0, 1))) / 2"""
    return (1 - torch.cos(math.pi * (alpha - torch.arange(octaves)).clamp(0, 1))) / 2


def network() -> nn.Sequential:
    """psi: points and moments to displacements. Its last layer is near zero: nothing moves yet."""
    inputs = 3 + 6 * OCTAVES + 1 + 2 * TIME_OCTAVES
    last = nn.Linear(WIDTH, 3)
    nn.init.uniform_(last.weight, -1e-4, 1e-4)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), last)


def displacement(psi: nn.Module, x: Points, t: Float[Tensor, " sample"], alpha: float = OCTAVES) -> Points:
    """dx = psi(x, t), from encoded points with windowed octaves and encoded moments."""
    waves = encode(x, OCTAVES)
    waves = torch.cat([waves[:, :3], waves[:, 3:] * window(OCTAVES, alpha).repeat_interleave(6)], 1)
    return psi(torch.cat([waves, encode(t[:, None], TIME_OCTAVES)], 1))


def render(
    net, psi, o: Tensor, d: Tensor, moment: Tensor, occupied: Tensor, alpha: float = OCTAVES, jitter: bool = False
):
    """Rays of moments through the canonical field; also how far its samples moved, weighted by what they show."""
    step = float((BOX[1] - BOX[0]).max()) / STEPS_ACROSS
    t, there = march(o, d, occupied, step, jitter)
    ray = there.nonzero()[:, 0]
    x = o[ray] + t[there][:, None] * d[ray]
    dx = displacement(psi, x, moment[ray], alpha)
    sigma, rgb = query(net, x + dx, d[ray])
    w = weights(torch.zeros_like(t).masked_scatter(there, sigma), torch.full_like(t, step))
    rgb = torch.zeros(*t.shape, 3).masked_scatter(there[..., None], rgb)
    return composite(w, rgb), composite(w, torch.zeros_like(rgb).masked_scatter(there[..., None], dx.detach()), 0.0)


@torch.no_grad()
def occupancy(net: nn.ModuleDict, psi: nn.Module, alpha: float) -> Bool[Tensor, "x y z"]:
    """Cells that hold something at some moment."""
    x, most = centres(), torch.zeros(CELLS**3)
    for moment in torch.rand(4):
        moved = [p + displacement(psi, p, moment.expand(len(p)), alpha) for p in x.split(2**16)]
        most = torch.maximum(most, torch.cat([query(net, p, p)[0] for p in moved]))
    return nn.functional.max_pool3d(most.view(1, 1, CELLS, CELLS, CELLS), 3, 1, 1)[0, 0] > 0.7


def train(net, psi, o: Tensor, d: Tensor, truth: Tensor, moment: Tensor, steps: int = STEPS) -> Tensor:
    """Both networks on the squared error. Returns the occupancy grid."""
    groups = [{"params": net.parameters(), "lr": RATE}, {"params": psi.parameters(), "lr": 0.2 * RATE}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    occupied, begin = torch.ones(CELLS, CELLS, CELLS, dtype=torch.bool), time.perf_counter()
    for step in range(steps):
        share, alpha = step / steps, OCTAVES * min(1.0, 2 * step / steps)
        for group, rate in zip(optimizer.param_groups, (RATE, 0.2 * RATE), strict=True):
            group["lr"] = rate * 0.05**share
        chosen = torch.randint(len(o), (RAYS if step > 50 else RAYS // 4,))
        rgb, _ = render(net, psi, o[chosen], d[chosen], moment[chosen], occupied, alpha, jitter=True)
        loss = (rgb - truth[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 25 == 24 and step > 60:
            occupied = occupancy(net, psi, alpha)
        if step % 40 == 39:
            print(f"step {step + 1:4}   {time.perf_counter() - begin:4.0f} s   loss {loss.item():.4f}")
    return occupied


def film(split: str):
    """Photographs, poses in the box, focal length, and moments."""
    images, poses, focal = photographs(split, SCENE)
    poses[:, :, 3] *= SCALE
    return images, poses, focal, times(split, SCENE)


def main() -> None:
    torch.manual_seed(0)
    images, poses, focal, moments = film("train")
    parts = [rays_of(images[i : i + 1], poses[i : i + 1], focal) for i in range(len(images))]
    moment = torch.cat([moments[i].expand(len(part[0])) for i, part in enumerate(parts)])
    net, psi = field(), network()
    occupied = train(net, psi, *(torch.cat(x) for x in zip(*parts, strict=True)), moment)
    images, poses, focal, moments = film("test")
    shown = []
    for i in (1, len(images) // 2):
        o, d = pinhole_rays(images[i], poses[i], focal)
        with torch.no_grad():
            rgb, dx = render(net, psi, o, d, moments[i].expand(len(o)), occupied)
        rgb, dx = rgb.view(images[i].shape), dx.view(images[i].shape)
        far = dx.norm(dim=2).max()
        print(f"moment {moments[i]:.2f}: {psnr(rgb, images[i]):.1f} dB unseen, moved up to {far:.2f} scene units")
        shown += [images[i], rgb, 0.5 + 2 * dx]
    save("deform", *shown)


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/nerfies/` moves points by rotations as well (SE(3)), keeps them elastic, and has
# a code for each moment; `methods/nsff/` learns flow from frame to frame, `methods/deformable_splatting/` moves
# Gaussians, `methods/humannerf/` bones. `components/fields/deformation.py` holds the network and the window.
