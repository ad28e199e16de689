"""Stereo: depth from two photographs side by side, z = b f / d.

A point is d pixels further left in the right picture than in the left one: the disparity. Near things move more. After
rectification the other pixel lies in the same row, so depth is a search along rows (Hirschmüller 2008).
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize, pad

from .camera import pinhole, pixel_centres, project
from .data import layer, photographs, save

SCENE = "procedural:room,depth,size=224,views=40"  # a hand-held walk through a room, in metres
FIRST, SECOND, DISPARITIES = 12, 13, 40
P1, P2 = 4, 24  # penalties of a disparity that changes by one pixel along a path, and by more
PATHS = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]  # (dx, dy)
Grey = Float[Tensor, "height width"]
Costs = Int[Tensor, "height width disparity"]


def rectified(image: Float[Tensor, "height width 3"], pose: Tensor, rotation: Float[Tensor, "3 3"], focal: float):
    """The photograph of a camera turned about its centre (Fusiello 2000): depth does not matter, for o stays."""
    height, width = image.shape[:2]
    centre = torch.tensor([width / 2, height / 2])
    plane = (pixel_centres(width, height) - centre) / focal
    rays = torch.cat([plane, torch.ones(len(plane), 1)], 1) @ rotation.T  # in the world
    pixels = project(rays @ pose[:, :3], focal, centre)  # in the photograph
    at = (2 * pixels / torch.tensor([width, height]) - 1).view(1, height, width, 2)
    return grid_sample(image.permute(2, 0, 1)[None], at, align_corners=False)[0].permute(1, 2, 0)


def shared_rotation(left: Float[Tensor, "3 4"], right: Float[Tensor, "3 4"]) -> Float[Tensor, "3 3"]:
    """Axes of both rectified cameras: +x along the baseline, +z as near to both gazes as that allows."""
    x = normalize(right[:, 3] - left[:, 3], dim=0)
    gaze = left[:, 2] + right[:, 2]
    z = normalize(gaze - (gaze @ x) * x, dim=0)
    return torch.stack([x, torch.linalg.cross(z, x), z], 1)


def signature(picture: Grey) -> Bool[Tensor, "bit height width"]:
    """Census transform (Zabih and Woodfill 1994): for each neighbour, one if it is darker. No brightness changes it."""
    height, width = picture.shape
    row, column = torch.arange(height), torch.arange(width)
    neighbours = [(x, y) for y in range(-2, 3) for x in range(-3, 4) if (x, y) != (0, 0) and abs(x) + abs(y) < 5]
    return torch.stack(
        [picture[(row + y).clamp(0, height - 1)][:, (column + x).clamp(0, width - 1)] < picture for x, y in neighbours]
    )


def census_costs(left: Grey, right: Grey, count: int) -> Costs:
    """Bits in which (x, y) on the left and (x - d, y) on the right differ; half of all beyond the border."""
    bits, others = signature(left), signature(right)
    costs = torch.full((*left.shape, count), len(bits) // 3)
    for d in range(count):
        costs[:, d:, d] = (bits[:, :, d:] ^ others[:, :, : left.shape[1] - d]).sum(0)
    return costs


def along(costs: Costs, dx: int, dy: int) -> Costs:
    """Costs along one path (eq. 13): a disparity pays for itself, and for having changed on the way.

    L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + P1, min_k L(q, k) + P2) - min_k L(q, k),   q = p - (dx, dy)
    """
    if dy == 0:
        return along(costs.transpose(0, 1), dy, dx).transpose(0, 1)
    if dy < 0:
        return along(costs.flip(0), dx, 1).flip(0)
    L = costs.clone()
    for y in range(1, len(costs)):
        x = torch.arange(costs.shape[1]) - dx
        inside = ((x >= 0) & (x < len(x)))[:, None]
        before = L[y - 1][x.clamp(0, len(x) - 1)]
        least = before.amin(1, keepdim=True)
        beside = pad(before, (1, 1), value=2**20)
        options = [before, beside[:, :-2] + P1, beside[:, 2:] + P1, (least + P2).expand_as(before)]
        L[y] += torch.where(inside, torch.stack(options).amin(0) - least, 0)
    return L


def disparity(costs: Costs) -> Grey:
    """The cheapest disparity of eight paths' sum, between pixels by the slopes on both sides of it."""
    total = sum(along(costs, dx, dy) for dx, dy in PATHS)
    assert isinstance(total, Tensor)
    best, last = total.argmin(2), costs.shape[2] - 1
    a, least, b = (total.gather(2, (best + k).clamp(0, last)[..., None])[..., 0] for k in (-1, 0, 1))
    slope = 2 * (torch.maximum(a, b) - least)
    inner = (best > 0) & (best < last) & (slope > 0)
    return best + torch.where(inner, (a - b) / slope.clamp_min(1), 0)


def main() -> None:
    images, poses, focal = photographs("train", SCENE)
    left, right = poses[FIRST], poses[SECOND]
    pair = (FIRST, SECOND) if (right[:, 3] - left[:, 3]) @ left[:, 0] > 0 else (SECOND, FIRST)
    left, right = (poses[i] for i in pair)
    rotation, baseline = shared_rotation(left, right), float((right[:, 3] - left[:, 3]).norm())
    pictures = [rectified(images[i], poses[i], rotation, focal) for i in pair]
    grey = [(255 * picture.mean(2)).round() for picture in pictures]
    found = disparity(census_costs(*grey, DISPARITIES))
    z = baseline * focal / found.clamp_min(0.5)  # similar triangles: d / f = b / z
    height, width = z.shape
    rays = pinhole(pixel_centres(width, height), focal, torch.tensor([width / 2, height / 2]))
    truth = layer("depth", "train", SCENE)[pair[0]]
    turned = rectified(truth[..., None].expand(-1, -1, 3), left, rotation, focal)[..., 0] * rays[:, 2].view(z.shape)
    known = torch.isfinite(turned) & (turned > 0)
    known[:, :DISPARITIES] = False  # which the right picture does not show
    error = ((z - turned).abs() / turned)[known]
    print(
        f"baseline {baseline:.3f}, focal length {focal:.0f} px, disparities {found.min():.1f} to {found.max():.1f} px"
    )
    print(f"median depth error {100 * error.median():.1f} %, beyond 10 % at {100 * (error > 0.1).float().mean():.0f} %")
    nearest, inside = turned[known].quantile(0.02), (pictures[0].amax(2) > 0)[..., None]
    shown = [torch.where(inside, nearest / x[..., None], 0).expand(-1, -1, 3) for x in (z, turned)]
    save("stereo", *pictures, *shown)


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/depth_maps/stereo.py` adds the absolute difference of greys, penalties that fall at
# edges, the left-right check, filling of what one picture does not show, and optical flow for the last tenth of a
# pixel. `kernels/census_cost/` and `kernels/semi_global/` are its loops; `kernels/plane_sweep/` takes many photographs.
