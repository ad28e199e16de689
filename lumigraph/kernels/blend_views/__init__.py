"""Blending of photographs by rays: the unstructured lumigraph's weights at points of a surface."""

import math

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="pixels", outputs=2, differentiable=(), typical=2, compiled=2)

MIN_PENALTY = 1e-6  # added to a penalty, so that a weight is finite where the penalty is zero
NOTHING = 1e8  # distance from which on a depth map shows no surface
UNSEEN = 1e30  # penalty of a photograph that does not see a point
BEHIND_DEPTH = 1e-6  # third coordinate up to which a point is behind a photograph


@door
def blend_views(
    points: Float[Tensor, "pixel 3"],
    eyes: Float[Tensor, "pixel 3"],
    focal: float,
    pictures: UInt8[Tensor, "view rows columns channel"],
    depths: Float[Tensor, "view depth_rows depth_columns"],
    sizes: Int[Tensor, "view 4"],
    poses: Float[Tensor, "view 3 4"],
    lenses: Float[Tensor, "view 13"],
    count: int,
    resolution_weight: float,
    hidden_weight: float,
    tolerance: float,
    border: float,
) -> tuple[Float[Tensor, "pixel channel"], Float[Tensor, " pixel"]]:
    """Colours of surface points X as seen from D (Buehler 2001, sections 4 and 5), from the `count` photographs of
    least penalty, and the largest of their shares of view (0 where no photograph sees the point).

        p = |d - c| (1 + hidden_weight h) + resolution_weight max(0, (|X - C| / f_C) / (|X - D| / f_D) - 1)
        h = min(max(0, min_j | |X - C| - t_j | / |X - C| - tolerance), 1)
        w = v max(0, 1 - p / p_last) / (p + MIN_PENALTY),    colour = sum w colour_C / sum w

    for a photograph taken at C with the focal length f_C: d and c are unit directions from D and from C to X, so that
    |d - c| is their angle; t_j the four pixels of the photograph's depth map around X, so that h is 0 unless another
    surface is seen there, and 0 where one t_j is NOTHING or more: what is seen past an object is its edge; p_last the
    next larger penalty, so that weights are continuous. v falls from 1 to 0 over the share `border` of a picture along
    its sides. Both terms of p vanish as D comes to C: there the photograph alone counts (epipole consistency).

    focal:    f_D in pixels
    pictures: colours, maybe with alpha, filled up to one size
    depths:   along rays; 0 where the photograph is not to be used
    sizes:    (width, height) of each picture, then of each depth map
    poses:    world-to-camera; lenses: focal (2), centre (2), distortion (8) of `camera.lens.OpenCV`, and the largest
              radius on the plane z = 1 that it is valid for
    Not differentiable.
    """
    require(len(pictures) > 0 and count > 0 and border > 0, "blend_views needs a photograph, a count and a border")
    tallest = torch.tensor([*pictures.shape[1:3], *depths.shape[1:3]], device=sizes.device)[[1, 0, 3, 2]]
    require(bool(((sizes > 0) & (sizes <= tallest)).all()), "sizes do not fit the pictures and depth maps")
    run = implementation("blend_views", points)
    weights = resolution_weight, hidden_weight, tolerance, border
    with torch.no_grad():
        return run(points, eyes, focal, pictures, depths, sizes, poses, lenses, count, *weights)


def cases(generator: torch.Generator):
    """Test inputs for all engines: one photograph and many, distortion, points behind, unknown depth."""
    for pixels, views, count, distortion in [(0, 2, 1, 0.0), (1, 1, 4, 0.0), (60, 7, 3, 0.1), (33, 5, 8, 0.0)]:
        yield _inputs(pixels, views, count, distortion, generator)
    points, eyes, focal, pictures, depths, *others = _inputs(40, 6, 2, 0.1, generator)
    yield -points, eyes, focal, pictures, depths, *others  # behind all photographs
    yield points, eyes, focal, pictures, 0 * depths, *others
    away = depths.clone()
    away[::2] = 1e9  # nothing is there, as these photographs have it
    yield points, eyes, focal, pictures, away, *others


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """`size` pixels, a photograph for every eight of them at most, the best four of eight blended."""
    return _inputs(size, 8, 4, 0.05, generator, side=max(8, round((size / 8) ** 0.5)))


def _inputs(pixels, views, count, distortion, generator, side=19):
    """A row of cameras that look along z, with random photographs, and points ahead of them."""

    def uniform(*shape):
        return torch.rand(shape, generator=generator)

    points = torch.tensor([-1.5, -1.0, 3.0]) + torch.tensor([3.0, 2.0, 1.5]) * uniform(pixels, 3)
    eyes = (torch.tensor([0.07, 0.02, 0.3]) + 0.1 * uniform(1, 3)).expand(pixels, 3).contiguous()
    pictures = torch.randint(256, (views, side, side + 2, 3 + views % 2), generator=generator).byte()
    depths = 3 + 2 * uniform(views, 6, 8)
    depths[uniform(views, 6, 8) < 0.1] = 0
    sizes = torch.tensor([[side + 2, side, 8, 6]]).repeat(views, 1)
    sizes[1::3] = torch.tensor([side - 2, side - 1, 7, 5])
    poses = torch.eye(3, 4).repeat(views, 1, 1)
    poses[:, :2, 3] = 1.2 * (uniform(views, 2) - 0.5)
    lenses = torch.zeros(views, 13)
    lenses[:, :2], lenses[:, 2:4] = side * (0.7 + 0.2 * uniform(views, 1)), side * (0.5 + 0.05 * uniform(views, 2))
    lenses[:, 4:12], lenses[:, 12] = distortion * (uniform(views, 8) - 0.5), math.tan(math.radians(25))
    return points, eyes, 1.1 * side, pictures, depths, sizes, poses, lenses, count, 0.05, 5.0, 0.05, 0.1
