"""Depth maps in one panorama: made dense, drawn from its middle, and one photograph chosen for each pixel."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.sparse.linalg import cg
from torch import Tensor

from ... import kernels
from ...camera import Camera
from ...depth_maps import DepthMap

COLOUR_EDGE = 0.06  # difference of colour over which smoothness of depth falls to 1 / e
DATA_WEIGHT = 10.0  # of known inverse depth against smoothness
SOLVER_STEPS = 250
MAX_HOLE = 4  # pixels from a known pixel, up to which an unknown one takes its depth
CUT = 1.08  # ratio of depths of neighbouring pixels from which on there is an edge between two surfaces
AGREEING = 0.04  # of log depth, within which two photographs show one surface
GUESSED_COST, LONELY_COST, FAR_COST, NOT_SEEN_COST = 25, 60, 15, 100  # of pixels of a photograph, see `stitched`
SEAM, MIN_SEAM, SEAM_EDGE = 60.0, 15, 20.0  # cost of a change of photograph; at edges of grey; levels of an edge


@dataclass(frozen=True)
class PanoramaLayer:
    """A layer of a panorama.

    depth: distance from its centre; known: where there is a surface; sure: where neighbours confirmed the depth
    """

    depth: Float[Tensor, "height width"]
    rgb: Float[Tensor, "height width 3"]
    known: Bool[Tensor, "height width"]
    sure: Bool[Tensor, "height width"]


def dense_inverse_depth(seen: DepthMap) -> Float[Tensor, "height width"]:
    """Dense inverse depth, an edge-aware smooth interpolation of the known one.

    The minimum of w sum (x - d)^2 over known pixels + sum exp(-|difference of colour| / e) (x_i - x_j)^2 over pairs
    """
    height, width = seen.depth.shape
    known = seen.solid.numpy()
    inverse = np.where(known, 1 / np.where(known, seen.depth.numpy(), 1), 0)
    scale = np.median(inverse[known])
    rgb, number = seen.rgb.numpy(), np.arange(height * width).reshape(height, width)
    matrix = sparse.csr_array((height * width, height * width))
    for axis in (0, 1):
        apart = np.abs(np.diff(rgb, axis=axis)).sum(-1).reshape(-1)
        weight = np.exp(-apart / COLOUR_EDGE) + 1e-4
        i, j = (np.take(number, range(k, number.shape[axis] - 1 + k), axis).reshape(-1) for k in (0, 1))
        rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
        matrix = matrix + sparse.csr_array(
            (np.concatenate([weight, weight, -weight, -weight]), (rows, columns)), matrix.shape
        )
    data = DATA_WEIGHT * known.reshape(-1)
    matrix = matrix + sparse.diags_array(data)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    start = inverse[tuple(nearest)].reshape(-1) / scale
    jacobi = sparse.diags_array(1 / matrix.diagonal())
    found, _ = cg(matrix, data * inverse.reshape(-1) / scale, start, rtol=1e-4, maxiter=SOLVER_STEPS, M=jacobi)
    least = inverse[known].min() / scale
    return torch.from_numpy(np.maximum(found, least) * scale).float().view(height, width)


def exposures(maps: list[DepthMap], inverse: list[Tensor]) -> list[Float[Tensor, " 3"]]:
    """Exposure gains of photographs to match the central one, from their overlap.

    Each is the median ratio of colours at reliable points of the central photograph.
    """
    middle = maps[len(maps) // 2]
    points, colours = middle.positions(), middle.rgb[middle.solid]
    gains = []
    for seen in maps:
        if seen is middle or not len(points):
            gains.append(torch.ones(3))
            continue
        pixels, valid = seen.project(points)[:2]
        inside = seen.inside(pixels, valid)
        its = seen.at_pixels(seen.rgb, pixels)[inside]
        fair = ((its > 0.05) & (its < 0.95)).all(-1)
        ratio = colours[inside][fair] / its[fair]
        gains.append(ratio.median(0).values.clamp(0.5, 2) if len(ratio) > 100 else torch.ones(3))
    return gains


def drawn(
    seen: DepthMap, inverse: Float[Tensor, "height width"], gain: Float[Tensor, " 3"], panorama: Camera
) -> PanoramaLayer:
    """A photograph's surfaces seen from the panorama's centre, cut at edges of depth."""
    height, width = inverse.shape
    rays = seen.camera.rays(seen.camera.pixels())
    places = rays.origins + rays.directions / inverse.view(-1, 1)
    columns, rows = (int(x) for x in panorama.size[0])
    corners, apart = on_panorama(places, panorama)
    faces = grid_faces(1 / inverse, torch.ones_like(inverse, dtype=torch.bool))
    across = apart[faces]
    faces = faces[across.amax(1) - across.amin(1) < 0.25 * float(panorama.lens.size[0, 0])]  # type: ignore[attr-defined]
    attributes = torch.cat([seen.rgb.reshape(-1, 3) * gain, seen.solid.reshape(-1, 1).float()], 1)
    values, depth, number = kernels.rasterize_mesh(corners, attributes, faces, (columns, rows))
    known = number >= 0
    return PanoramaLayer(
        torch.where(known, depth, torch.inf), values[..., :3].clamp(0, 1), known, known & (values[..., 3] > 0.5)
    )


def on_panorama(
    places: Float[Tensor, "point 3"], panorama: Camera
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
    """Homogeneous pixels for `kernels.rasterize_mesh`, and columns. Depth is distance from the panorama's centre."""
    local = (places - panorama.position) @ panorama.pose[0, :, :3]
    pixels, _ = panorama.lens.project(local)
    distance = local.norm(dim=-1, keepdim=True)
    return torch.cat([pixels * distance, distance], 1), pixels[:, 0]


def grid_faces(
    depth: Float[Tensor, "height width"], known: Bool[Tensor, "height width"], cut: float = CUT
) -> Int[Tensor, "face 3"]:
    """Triangles between neighbouring pixels, none across an edge of depth or with an unknown corner.

    cut: ratio of depths from which on there is an edge
    """
    height, width = depth.shape
    number = torch.arange(height * width).view(height, width)
    a, b, c, d = (number[i : height - 1 + i, j : width - 1 + j].reshape(-1) for i in (0, 1) for j in (0, 1))
    faces = torch.cat([torch.stack([a, c, b], 1), torch.stack([b, c, d], 1)])
    corners = depth.reshape(-1)[faces]
    whole = known.reshape(-1)[faces].all(1) & (corners.amax(1) < cut * corners.amin(1))
    return faces[whole]


def stitched(layers: list[PanoramaLayer], panorama: Camera) -> tuple[PanoramaLayer, Int[Tensor, "height width"]]:
    """One layer from those of all photographs, and the photograph of each pixel.

    Costs are high for a surface that others do not show (LONELY), for guessed depth, distant photographs and empty
    pixels. Seams cost less at edges. Labels are found by the paths of `kernels.semi_global` with one penalty for any
    change.
    """
    depth = torch.stack([layer.depth for layer in layers])
    known, sure = (torch.stack([getattr(layer, name) for layer in layers]) for name in ("known", "sure"))
    rgb = torch.stack([layer.rgb for layer in layers])
    log = torch.where(known, depth.clamp_max(1e9).log(), torch.nan)
    costs = []
    for i in range(len(layers)):
        agrees = ((log - log[i]).abs() < AGREEING) & known & (sure | ~sure[i])
        support = agrees.sum(0) / known.sum(0).clamp_min(1)
        cost = (
            LONELY_COST * (1 - support) + GUESSED_COST * ~sure[i] + FAR_COST * abs(2 * i / max(len(layers) - 1, 1) - 1)
        )
        costs.append(torch.where(known[i], cost, NOT_SEEN_COST))
    volume = torch.stack(costs, -1).round().to(torch.uint8)
    guide = (torch.where(known[..., None], rgb, 0).sum(0) / known.sum(0).clamp_min(1)[..., None]).mean(-1)
    guide = (guide * 255).round().clamp(0, 255).to(torch.uint8)
    seams = (SEAM * torch.exp(-torch.arange(256) / SEAM_EDGE)).clamp_min(MIN_SEAM).to(torch.uint8)
    label = kernels.semi_global(volume, guide, seams, int(SEAM), 0)[0].round().long().clamp(0, len(layers) - 1)
    index = label[None]
    known, sure, depth = (x.gather(0, index)[0] for x in (known, sure, depth))
    rgb = rgb.gather(0, index[..., None].expand(-1, -1, -1, 3))[0]
    depth, rgb, known = filled(depth, rgb, known)
    depth = torch.from_numpy(ndimage.median_filter(depth.numpy(), 3))
    return PanoramaLayer(depth, rgb, known, sure), label


def filled(
    depth: Float[Tensor, "height width"], rgb: Float[Tensor, "height width 3"], known: Bool[Tensor, "height width"]
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
    """Depth and colour of the nearest known pixel for unknown ones; a mask of those close to a known one."""
    away, at = ndimage.distance_transform_edt(~known.numpy(), return_indices=True)
    row, column = torch.from_numpy(at).long()
    return depth[row, column], rgb[row, column], torch.from_numpy(away <= MAX_HOLE)
