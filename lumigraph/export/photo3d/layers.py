"""The second layer behind edges, the texture of both, and their triangles."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, pad

from ...camera import Camera
from ...datasets.scene import Photograph
from .stitching import CUT, PanoramaLayer, grid_faces

BAND = 0.04  # of the panorama's width: how far the second layer reaches behind the first one's edges
WINDOW = 4  # bands around a pixel whose farthest surface decides whether it is foreground
OVERLAP = 2  # pixels by which it reaches under what lies beside
BEHIND = 1.002  # factor of its distance there, so that the first layer is drawn before it
MIN_BEHIND = 1.1  # factor of distance from which on another photograph's surface is one behind


def background(front: PanoramaLayer, layers: list[PanoramaLayer]) -> PanoramaLayer:
    """Background layer: surfaces behind the depth edges of the first layer.

    A pixel is foreground if it lies well in front of its surroundings, and occludes something if it is near an edge.
    There the nearest surface behind it in any photograph is taken, and otherwise a smooth extrapolation.
    """
    height, width = front.depth.shape
    band = max(round(BAND * width), 3)
    inverse = 1 / front.depth
    farthest = ndimage.minimum_filter(inverse.numpy(), 2 * WINDOW * band + 1)
    foreground = inverse > CUT * torch.from_numpy(farthest)
    edge = torch.zeros_like(foreground)
    for axis in (0, 1):
        one, other = (inverse.narrow(axis, k, inverse.shape[axis] - 1) for k in (0, 1))
        jump = torch.maximum(one, other) > CUT * torch.minimum(one, other)
        edge.narrow(axis, 0, jump.shape[axis]).logical_or_(jump)
        edge.narrow(axis, 1, jump.shape[axis]).logical_or_(jump)
    away = torch.from_numpy(ndimage.distance_transform_edt(~edge.numpy()))
    hidden = foreground & (away < band)
    depth, rgb = front.depth.clone(), front.rgb.clone()
    seen = torch.zeros_like(hidden)
    limit = 1 / torch.from_numpy(farthest) * MIN_BEHIND  # beyond what is seen around, it is an error
    nearest = torch.full_like(depth, torch.inf)
    for layer in layers:
        behind = hidden & layer.sure & (layer.depth > MIN_BEHIND * front.depth) & (layer.depth < limit)
        closer = behind & (layer.depth < nearest)
        nearest = torch.where(closer, layer.depth, nearest)
        rgb[closer] = layer.rgb[closer]
        seen |= closer
    depth = torch.where(seen, nearest, depth)
    known = (~foreground & front.known) | seen
    values = torch.cat([1 / depth[..., None], rgb], -1)
    smooth = push_pull(values, known)
    values = torch.where(known[..., None], values, smooth)
    beside = torch.from_numpy(ndimage.binary_dilation(hidden.numpy(), iterations=OVERLAP)) & ~foreground
    depth = torch.where(beside, front.depth, 1 / values[..., 0].clamp_min(1e-9)).maximum(BEHIND * front.depth)
    return PanoramaLayer(depth, values[..., 1:], hidden | beside, seen)


def push_pull(values: Float[Tensor, "height width channel"], known: Bool[Tensor, "height width"]) -> Tensor:
    """Fill unknown pixels by push-pull: means over ever larger blocks, then back to finer ones (Gortler 1996,
    section 3.4)."""
    levels = []
    weight = known.float()[None, None]
    total = values.movedim(-1, 0)[None] * weight
    while max(weight.shape[-2:]) > 1:
        levels.append((total, weight))
        sides = [n % 2 for n in weight.shape[-2:]]
        total, weight = (avg_pool2d(pad(x, (0, sides[1], 0, sides[0])), 2) * 4 for x in (total, weight))
        scale = weight.clamp(max=1) / weight.clamp_min(1e-9)
        total, weight = total * scale, weight * scale
    result = total / weight.clamp_min(1e-9)
    for total, weight in reversed(levels):
        larger = interpolate(result, size=weight.shape[-2:], mode="bilinear", align_corners=False)
        result = total + (1 - weight.clamp(max=1)) * larger
    return result[0].movedim(0, -1)


def mesh_of(
    front: PanoramaLayer, back: PanoramaLayer | None, panorama: Camera
) -> tuple[Float[np.ndarray, "vertex 3"], Int[np.ndarray, "face 3"], Float[np.ndarray, "vertex 2"]]:
    """Vertices in the scene's frame, triangles, and places in the texture, whose upper half is the first layer's."""
    height, width = front.depth.shape
    rays = panorama.rays(panorama.pixels())
    share = panorama.pixels() / panorama.size[0]
    halves = 1 if back is None else 2
    vertices, faces, places, count = [], [], [], 0
    for number, layer in enumerate([front] if back is None else [front, back]):
        triangles = grid_faces(layer.depth, layer.known, CUT if number == 0 else math.inf)
        used, index = torch.unique(triangles, return_inverse=True)
        vertices.append((rays.origins + layer.depth.reshape(-1, 1) * rays.directions)[used])
        places.append((share[used] + torch.tensor([0.0, number])) / torch.tensor([1.0, halves]))
        faces.append(index + count)
        count += len(used)
    return torch.cat(vertices).numpy(), torch.cat(faces).int().numpy(), torch.cat(places).numpy()


def texture_of(
    front: PanoramaLayer,
    back: PanoramaLayer | None,
    label: Int[Tensor, "height width"],
    photographs: list[Photograph],
    gains: list[Float[Tensor, " 3"]],
    panorama: Camera,
    texels: int,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Texture of the first layer, interpolated in the photographs, at a number of texels along each side of a pixel;
    below it that of the second layer."""
    fine = panorama.resized(texels)
    rows, columns = (int(x) for x in fine.size[0].flip(0))
    depth = interpolate(front.depth[None, None], (rows, columns), mode="nearest")[0, 0]
    chosen = interpolate(label[None, None].float(), (rows, columns), mode="nearest")[0, 0].long()
    colours = (
        interpolate(front.rgb.movedim(-1, 0)[None], (rows, columns), mode="bilinear")[0].movedim(0, -1).contiguous()
    )
    rays = fine.rays(fine.pixels())
    places = (rays.origins + depth.view(-1, 1) * rays.directions).view(rows, columns, 3)
    for number, (photograph, gain) in enumerate(zip(photographs, gains, strict=True)):
        mine = chosen == number
        pixels, valid = photograph.camera.project(places[mine])[:2]
        size = photograph.camera.size[0]
        inside = valid & ((pixels >= 0) & (pixels < size)).all(-1)
        found = grid_sample(
            photograph.rgb.movedim(-1, 0)[None], (pixels / size * 2 - 1)[None, None], align_corners=False
        )
        colours[mine] = torch.where(inside[:, None], found[0, :, 0].T * gain, colours[mine])
    parts = [colours]
    if back is not None:
        parts.append(interpolate(back.rgb.movedim(-1, 0)[None], (rows, columns), mode="bilinear")[0].movedim(0, -1))
    return (torch.cat(parts).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
