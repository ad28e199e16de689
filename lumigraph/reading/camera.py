"""A camera is a function from pixels to rays. A lens is the part of it that knows no position.

A camera looks along +z; +x is right and +y is down. The centre of the first pixel is at (0.5, 0.5).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .data import save

Pixels = Float[Tensor, "pixel 2"]
Vectors = Float[Tensor, "pixel 3"]


def pixel_centres(width: int, height: int) -> Pixels:
    """Centres of all pixels, row by row."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1).view(-1, 2)


def pinhole(pixels: Pixels, focal: float, centre: Float[Tensor, " 2"]) -> Vectors:
    """Unit directions of a pinhole: the point (x, y, 1) with (u, v) = f (x, y) + c, at length one."""
    plane = (pixels - centre) / focal  # (x, y) = ((u, v) - c) / f
    return torch.nn.functional.normalize(torch.cat([plane, torch.ones(len(plane), 1)], 1), dim=1)


def project(points: Vectors, focal: float, centre: Float[Tensor, " 2"]) -> Pixels:
    """Pixels of points in the camera's frame: (u, v) = f (x, y) / z + c."""
    return focal * points[:, :2] / points[:, 2:] + centre


def radial(pixels: Pixels, focal: float, centre: Float[Tensor, " 2"], k1: float, k2: float) -> Vectors:
    """Unit directions of a lens with radial distortion (Brown 1971): r' = r (1 + k1 r^2 + k2 r^4) on the plane z = 1.

    The pixel gives r'; Newton's method gives r.
    """
    plane = (pixels - centre) / focal
    bent = plane.norm(dim=1)  # r'
    r = bent.clone()
    for _ in range(20):
        error = r * (1 + k1 * r**2 + k2 * r**4) - bent
        r = r - error / (1 + 3 * k1 * r**2 + 5 * k2 * r**4)  # the slope dr'/dr
    return pinhole(plane * (r / bent.clamp_min(1e-9))[:, None], 1.0, torch.zeros(2))


def fisheye(pixels: Pixels, focal: float, centre: Float[Tensor, " 2"]) -> Vectors:
    """Unit directions of an equidistant fisheye: r = f theta, the angle from the axis (Kannala and Brandt 2006, k = 0).

    It has no plane: a pinhole never reaches 90 degrees, this lens looks backwards.
    """
    plane = (pixels - centre) / focal
    theta = plane.norm(dim=1, keepdim=True)
    return torch.cat([plane / theta.clamp_min(1e-9) * theta.sin(), theta.cos()], 1)


def equirectangular(pixels: Pixels, width: int, height: int) -> Vectors:
    """Unit directions of a panorama: longitude across, latitude down. The middle looks along +z."""
    longitude = 2 * math.pi * (pixels[:, 0] / width - 0.5)
    latitude = math.pi * (pixels[:, 1] / height - 0.5)
    level = latitude.cos()
    return torch.stack([level * longitude.sin(), latitude.sin(), level * longitude.cos()], 1)


def rays(directions: Vectors, pose: Float[Tensor, "3 4"]) -> tuple[Vectors, Vectors]:
    """Origins and directions in the world. pose = [R | o], camera-to-world: d_world = R d, and all rays begin at o."""
    return pose[:, 3].expand_as(directions), directions @ pose[:, :3].T


def pinhole_rays(image: Float[Tensor, "height width 3"], pose: Float[Tensor, "3 4"], focal: float):
    """Rays through all pixels of a photograph, from its pose and focal length."""
    height, width = image.shape[:2]
    return rays(pinhole(pixel_centres(width, height), focal, torch.tensor([width / 2, height / 2])), pose)


def look_at(position: Float[Tensor, " 3"], target: Float[Tensor, " 3"]) -> Float[Tensor, "3 4"]:
    """Pose of a camera at a position that looks at a target, in a world where +z is up."""
    forward = torch.nn.functional.normalize(target - position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    return torch.stack([right, torch.linalg.cross(forward, right), forward, position], 1)


# A world to look at: a tiled room with three balls, without any file.

BALLS = torch.tensor([[0.0, 0.3, -0.6, 0.4], [-0.7, 0.6, -0.7, 0.3], [0.65, 0.5, -0.75, 0.25]])  # centre, radius
PAINT = torch.tensor([[0.85, 0.25, 0.2], [0.95, 0.75, 0.25], [0.2, 0.45, 0.75]])


def room(origins: Vectors, directions: Vectors) -> tuple[Vectors, Float[Tensor, " pixel"]]:
    """Colour and distance of the first surface of the cube [-1, 1]^3, seen from inside, and of the balls in it."""
    slow = torch.where(directions.abs() < 1e-9, 1e-9, directions)
    t = ((directions.sign() - origins) / slow).amin(1)  # the first of the walls x, y, z = +-1 that the ray leaves by
    points = origins + t[:, None] * directions
    tiles = ((points * 2.999).floor().sum(1) % 2)[:, None]
    colour = (0.55 + 0.3 * tiles) * (0.8 + 0.2 * points)
    for (x, y, z, radius), paint in zip(BALLS.tolist(), PAINT, strict=True):
        away = origins - torch.tensor([x, y, z])  # |o + t d - c|^2 = r^2 is t^2 + 2 b t + c = 0
        b, c = (away * directions).sum(1), away.square().sum(1) - radius**2
        near = -b - (b * b - c).clamp_min(0).sqrt()
        hit = (b * b > c) & (near > 0) & (near < t)
        normal = (away + near[:, None] * directions) / radius
        shade = 0.55 + 0.45 * (normal @ torch.tensor([-0.4, -0.5, 0.77])).clamp_min(0)
        stripes = 0.8 + 0.2 * (10 * normal[:, 2:]).sin().sign()
        colour = torch.where(hit[:, None], shade[:, None] * stripes * paint, colour)
        t = torch.where(hit, near, t)
    return colour, t


def main() -> None:
    size, pose = 256, look_at(torch.tensor([0.1, -0.75, -0.2]), torch.tensor([0.0, 0.6, -0.5]))
    pixels, centre = pixel_centres(size, size), torch.tensor([size / 2, size / 2])
    wide = pixel_centres(2 * size, size)
    views = {
        "pinhole, 90 degrees": pinhole(pixels, size / 2, centre),
        "barrel distortion": radial(pixels, size / 2, centre, 0.12, 0.02),
        "fisheye, 180 degrees": fisheye(pixels, size / math.pi, centre),
        "panorama, 360 degrees": equirectangular(wide, 2 * size, size),
    }
    pictures = []
    for name, directions in views.items():
        colour, t = room(*rays(directions, pose))
        print(f"{name:22} sees {float(t.min()):.2f} to {float(t.max()):.2f} scene units away")
        pictures.append(colour.view(size, -1, 3))
    save("camera", *pictures)


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/camera/lens.py` adds tangential distortion, thin prisms, stereo panoramas and the fold
# beyond which a distorted picture repeats, so that every pixel of a real lens has one ray or none.
# `lumigraph/camera/camera.py` holds many cameras as one batch; `camera/rays.py` adds each pixel's footprint.
# Both keep the convention of this file, which OpenCV and COLMAP share; `readers/` convert all others to it.
