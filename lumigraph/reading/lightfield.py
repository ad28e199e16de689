"""A light field: all rays between two planes, so that a new view needs no geometry (Levoy and Hanrahan 1996).

A ray is where it meets the plane of the cameras, (u, v), and the plane of focus, (s, t). Photographs from a grid of
cameras are samples L(u, v, s, t). A new ray lies between them and is blended; the four blends differ in which.
"""

import itertools

import torch
from jaxtyping import Float
from torch import Tensor

from .camera import pinhole, pixel_centres, rays, room
from .data import psnr, save

GRID, SPACING, SIZE, FOCAL = 7, 0.08, 160, 130.0  # cameras along each side; scene units; pixels
FOCUS = 1.25  # distance of the plane (s, t) from the cameras, scene units
AXES = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # columns right, down, forward: all cameras look along +y
FIRST = torch.tensor([0.0, -0.75, -0.3])  # the middle of the grid
Light = Float[Tensor, "v u height width 3"]
Row = Float[Tensor, " ray"]


def view(u: float, v: float) -> tuple[Float[Tensor, "height width 3"], Row]:
    """Photograph and depth along the axis of a camera that is u to the right and v down from the middle."""
    pose = torch.cat([AXES, (FIRST + u * AXES[:, 0] + v * AXES[:, 1])[:, None]], 1)
    local = pinhole(pixel_centres(SIZE, SIZE), FOCAL, torch.tensor([SIZE / 2, SIZE / 2]))
    rgb, t = room(*rays(local, pose))
    return rgb.view(SIZE, SIZE, 3), t * local[:, 2]


def captured() -> Light:
    """The photographs of the grid."""
    places = (torch.arange(GRID) - (GRID - 1) / 2) * SPACING
    return torch.stack([torch.stack([view(u, v)[0] for u in places.tolist()]) for v in places.tolist()])


def pixel_in(camera: Tensor, own: Tensor, pixel: Row, z: Row | float) -> Row:
    """Coordinate of a point at depth z in another camera: what is z away moves by f (own - camera) / z pixels."""
    return pixel + FOCAL * (own - camera) / z


def linear(light: Light, v: Tensor, u: Tensor, y: Row, x: Row) -> Float[Tensor, "ray 3"]:
    """Bilinear interpolation within the photographs (v, u) at pixels (x, y), whose centres are at one half."""
    x, y = (x - 0.5).clamp(0, SIZE - 1), (y - 0.5).clamp(0, SIZE - 1)
    total = torch.zeros(len(x), 3)
    for i, j in itertools.product((0, 1), repeat=2):
        row, column = (y.long() + i).clamp(max=SIZE - 1), (x.long() + j).clamp(max=SIZE - 1)
        share = (1 - (y - y.long() - i).abs()) * (1 - (x - x.long() - j).abs())
        total += share[:, None] * light[v, u, row, column]
    return total


def blended(light: Light, u: float, v: float, z: Row | float, cameras: bool = True, pixels: bool = True):
    """A new view from (u, v), with every ray sent to the cameras by its depth z.

    cameras, pixels: blend the four cameras around (u, v), and the four pixels in each; else the nearest one
    """
    x, y = pixel_centres(SIZE, SIZE).T
    middle, total = (GRID - 1) / 2, torch.zeros(len(x), 3)
    a, b = u / SPACING + middle, v / SPACING + middle  # place in the grid, in cameras
    for i, j in itertools.product((0, 1), repeat=2) if cameras else [(0, 0)]:
        column, row = (int(a) + j, int(b) + i) if cameras else (round(a), round(b))
        share = (1 - abs(b - row)) * (1 - abs(a - column)) if cameras else 1.0
        own, there = torch.tensor([u, v]), torch.tensor([(column - middle) * SPACING, (row - middle) * SPACING])
        s, t = pixel_in(there[0], own[0], x, z), pixel_in(there[1], own[1], y, z)
        if not pixels:
            s, t = s.floor() + 0.5, t.floor() + 0.5
        total += share * linear(light, torch.tensor(row), torch.tensor(column), t, s)
    return total.view(SIZE, SIZE, 3)


def main() -> None:
    light, (u, v) = captured(), (0.5 * SPACING, -0.5 * SPACING)  # amid four cameras, the hardest place
    truth, depth = view(u, v)
    views = {
        "nearest ray": blended(light, u, v, FOCUS, cameras=False, pixels=False),
        "blended in (s, t)": blended(light, u, v, FOCUS, cameras=False),
        "quadrilinear": blended(light, u, v, FOCUS),  # Levoy and Hanrahan 1996
        "with depth": blended(light, u, v, depth),  # the lumigraph (Gortler 1996): each ray has its own plane
    }
    for name, picture in views.items():
        print(f"{name:18} {psnr(picture, truth):.1f} dB")
    save("lightfield", *views.values(), truth)


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/lumigraph.py` needs no grid of cameras (Buehler 2001): depth comes from stereo,
# and `kernels/blend_views/` gives each photograph a weight by angle, resolution and occlusion. At a depth of a plane,
# `Camera.sheared` is `pixel_in`, and an aperture is a mean over it. `export/light_field.py` writes grids of views.
