"""Depth fusion: many noisy depth pictures make one clean surface (Curless and Levoy 1996; Newcombe 2011).

Each voxel keeps a running mean of one number: how far it lies before the surface, cut off at a truncation. Errors of
single pictures cancel; the surface is where the mean changes sign.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from .camera import pinhole_rays, project
from .data import BOX, layer, photographs, save
from .nerf import span

VOXEL, TRUNCATION, NOISE = 1 / 64, 4 / 64, 0.02  # scene units; NOISE: deviation of each measured distance
Volume = tuple[Float[Tensor, " voxel"], Float[Tensor, " voxel"], Float[Tensor, "voxel 3"]]  # D, W, colour


def voxel_centres() -> tuple[Float[Tensor, "voxel 3"], tuple[int, int, int]]:
    """Middles of all voxels of the box, z fastest, and their number along each axis."""
    nx, ny, nz = (round(n) for n in ((BOX[1] - BOX[0]) / VOXEL).tolist())
    place = torch.cartesian_prod(torch.arange(nx), torch.arange(ny), torch.arange(nz))
    return BOX[0] + VOXEL * (place + 0.5), (nx, ny, nz)


def empty(count: int) -> Volume:
    """Voxels that no picture has shown."""
    return torch.ones(count), torch.zeros(count), torch.zeros(count, 3)


def sample(values: Float[Tensor, "height width channel"], pixels: Float[Tensor, "point 2"], mode: str = "bilinear"):
    """Values of a picture at pixels, whose centres are at one half."""
    at = (2 * pixels / torch.tensor([values.shape[1], values.shape[0]]) - 1)[None, None]
    return grid_sample(values.permute(2, 0, 1)[None], at, mode, "border", align_corners=False)[0, :, 0].T


def fuse(volume: Volume, points: Float[Tensor, "voxel 3"], depth: Tensor, rgb: Tensor, pose: Tensor, focal: float):
    """Integrate one depth picture (Curless and Levoy 1996, eqs. 3 and 4).

        d = min((depth - |p - o|) / truncation, 1)        D <- (W D + d) / (W + 1)        W <- W + 1

    for voxels in the picture that are not far behind the surface, d >= -1: there, something else may be.
    """
    D, W, colour = volume
    height, width = depth.shape
    local = (points - pose[:, 3]) @ pose[:, :3]
    pixels = project(local, focal, torch.tensor([width / 2, height / 2]))
    inside = (local[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < torch.tensor([width, height])).all(1)
    smooth, nearest = (sample(depth[..., None], pixels, mode)[:, 0] for mode in ("bilinear", "nearest"))
    edge = ~((smooth - nearest).abs() < 0.03 * nearest)  # between two surfaces lies none
    surface = torch.where(edge, nearest, smooth)
    d = (surface - (points - pose[:, 3]).norm(dim=1)) / TRUNCATION
    seen = inside & surface.isfinite() & (d >= -1)
    share = torch.where(seen, 1 / (W + 1), 0)
    D = D + torch.where(seen, share * (d.clamp(max=1) - D), 0)
    near = (seen & (d < 1))[:, None]
    colour = torch.where(near, colour + share[:, None] * (sample(rgb, pixels) - colour), colour)
    return D, W + seen.float(), colour


def trilinear(grid: Float[Tensor, "channel x y z"], x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
    """Values between voxel centres."""
    at = (2 * (x - BOX[0]) / (BOX[1] - BOX[0]) - 1).flip(-1).view(1, -1, 1, 1, 3)
    found = grid_sample(grid[None], at, padding_mode="border", align_corners=False)
    return found.view(len(grid), -1).T.view(*x.shape[:-1], -1)


def cast(volume: Volume, shape: tuple[int, int, int], o: Tensor, d: Tensor):
    """First change of sign along each ray: distance, normal, colour, and a mask of rays that meet the surface."""
    known = torch.where(volume[1] > 0, volume[0], 1).view(1, *shape)
    near, far = span(o, d)
    t = near + 0.5 * VOXEL * torch.arange(int((far - near).amax() / (0.5 * VOXEL)) + 1)
    D = trilinear(known, o[:, None] + t[..., None] * d[:, None])[..., 0]
    crossing = (D[:, :-1] > 0) & (D[:, 1:] <= 0) & (t[:, 1:] < far)
    hit, i = crossing.any(1), crossing.int().argmax(1, keepdim=True)
    a, b = D.gather(1, i), D.gather(1, i + 1)
    where = (t.gather(1, i) + 0.5 * VOXEL * a / (a - b).clamp_min(1e-6))[:, 0]  # the zero of a straight line
    x = o + where[:, None] * d
    e = VOXEL * torch.eye(3)
    slope = torch.cat([trilinear(known, x + e[k]) - trilinear(known, x - e[k]) for k in range(3)], 1)
    return where, normalize(slope, dim=1), trilinear(volume[2].T.reshape(3, *shape), x), hit


def main() -> None:
    torch.manual_seed(0)
    images, poses, focal = photographs()
    depth = layer("depth")
    depth = depth + NOISE * torch.randn(depth.shape)
    points, shape = voxel_centres()
    volume, after = empty(len(points)), {}
    for k in range(len(images)):
        volume = fuse(volume, points, depth[k], images[k], poses[k], focal)
        if k + 1 in (1, len(images)):
            after[k + 1] = volume
    image, pose = photographs("test")[0][0], photographs("test")[1][0]
    truth = layer("depth", "test")[0].flatten()
    shown = [image]
    for count, fused in after.items():
        t, normals, rgb, hit = cast(fused, shape, *pinhole_rays(image, pose, focal))
        both = hit & truth.isfinite()
        error = (t - truth)[both].abs()
        share = 100 * both.sum() / truth.isfinite().sum()
        print(f"{count:3} depth pictures: {share:3.0f} % seen, {error.median():.4f} off")
        shown += [torch.where(hit[:, None], x, 1).view(image.shape) for x in (0.5 + 0.5 * normals, rgb)]
    save("tsdf", *shown)


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/kernels/fuse_depth/` fuses blocks of 8^3 voxels that exist only near surfaces, found by
# hash (`kernels/block_hash/`), with a weight for each pixel; `kernels/cast_blocks/` casts rays through them.
# `methods/tsdf_fusion.py` is the method, `lumigraph export mesh` its triangles, and `lumigraph track` finds the poses.
