"""Colours of texels from pictures whose cameras are known: visibility, the best views, exposure, blending."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from ...camera import Camera
from ...datasets.scene import Scene
from ...depth_maps import DepthMap
from ...figures import to_bytes
from ...geometry import unit
from ...system.threads import processors
from ..surface import Faces, Vertices, face_normals
from . import loops
from .atlas import Texels

RANKS = 6  # views of a texel that are blended
SHARPNESS = 2.0  # exponent of a view's score in its weight: larger is sharper, with harder transitions
FEATHER_PIXELS = 12.0  # from an edge of surface, picture or mask, over which trust grows to 1
METHOD_TOLERANCES = 3.0  # tolerances in front of the mesh, at which the method's own depth is something else's
DIAGONAL = 1.415  # pixels to a diagonal neighbour, up to which interpolation mixes another surface in
MIN_COSINE = 0.1  # between the normal and the way to the camera
MIN_OPACITY = 0.98  # of a pixel whose colour is the surface's alone
OUTLIER_SIGMA = 0.1  # distance of a colour from the blended one at which its weight is 0.6 times as large
BLEND_ROUNDS = 3
GAIN_TEXELS = 200_000  # that exposures are compared on
GAIN_ROUNDS, GAIN_SIGMA, GAIN_RIDGE = 4, 0.1, 0.02  # robust least squares of log colours; pull towards no gain
DARK, BRIGHT = 20, 235  # between which colours are compared
SEEN_TEXELS, NEIGHBOURS = 100_000, 8  # seen texels that unseen ones take their colours from
CHUNK_TEXELS = 1 << 19


@dataclass(frozen=True)
class PosedPicture:
    """A picture of the surface.

    camera:  a batch of one, of the picture's size
    trusted: pixels of the scene, rather than of a mask or a background
    seen:    the method's rendering of the same camera, in any size, for occlusion by other surfaces
    """

    camera: Camera
    rgb: UInt8[Tensor, "height width 3"]
    trusted: Bool[Tensor, "height width"]
    seen: DepthMap


def rendered(depth_maps: Sequence[DepthMap]) -> Iterator[PosedPicture]:
    """The method's own renderings."""
    for seen in depth_maps:
        yield PosedPicture(seen.camera, to_bytes(seen.rgb), seen.opacity >= MIN_OPACITY, seen)


def photographed(
    scene: Scene, cameras: Camera, chosen: Sequence[int], depth_maps: Sequence[DepthMap], spacing: float
) -> Iterator[PosedPicture]:
    """Photographs of the training split, reduced as long as their pixels are at most as large as texels.

    cameras: of this split, as the method refined them; chosen: those that the depth maps are of
    spacing: scene units from a texel to the next
    """
    for i, seen in zip(chosen, depth_maps, strict=True):
        photograph = replace(scene.photograph(int(scene.splits["train"][i])), camera=cameras[i].to("cpu"))
        footprint = pixel_angle(photograph.camera) * float(seen.depth[seen.solid].median())  # NaN without a surface
        photograph = photograph.reduced(int(max(1.0, np.nan_to_num(spacing / footprint, nan=1.0))))
        trusted = torch.ones(photograph.rgb.shape[:2], dtype=torch.bool) if photograph.mask is None else photograph.mask
        if photograph.alpha is not None:
            trusted = trusted & (photograph.alpha >= MIN_OPACITY)
        yield PosedPicture(photograph.camera, to_bytes(photograph.rgb), trusted, seen)


def pixel_angle(camera: Camera) -> float:
    """Angle across a pixel in the middle of the picture, radians."""
    middle = 0.5 * camera.size.float()
    there = camera.rays(torch.cat([middle, middle + torch.tensor([[1.0, 0.0]])])).directions.double()
    return float(torch.linalg.cross(there[0], there[1]).norm())


@dataclass(frozen=True)
class TexelColours:
    """The best views' colours of each texel, in no order. A score of 0 is no view."""

    colours: UInt8[np.ndarray, "texel rank 3"]
    scores: Float[np.ndarray, "texel rank"]
    views: Int[np.ndarray, "texel rank"]

    @property
    def known(self) -> Bool[np.ndarray, " texel"]:
        return self.scores.max(1) > 0


def first_surface(
    camera: Camera, vertices: Vertices, faces: Faces
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """The first triangle along each pixel's ray, -1 for none, and the distance to it, for any lens."""
    width, height = camera.size[0].tolist()
    pixels, valid = camera.project(torch.from_numpy(vertices).to(camera.pose))
    corners = torch.where(valid[:, None], pixels, torch.nan).numpy().astype(np.float64)[faces]
    normals = face_normals(vertices, faces)
    offsets = (normals * (vertices[faces[:, 0]] - camera.position[0].numpy())).sum(-1)
    directions = camera.rays(camera.pixels()).directions.view(height, width, 3).numpy()
    face, depth = np.full((height, width), -1, np.int32), np.full((height, width), np.inf, np.float32)
    loops.first_faces(corners, normals, offsets, directions, face, depth)
    return face, depth


def trust(
    view: PosedPicture, depth: Float[np.ndarray, "height width"], tolerance: float
) -> Float[np.ndarray, "height width"]:
    """Weight of each pixel's colour, from 0 to 1: small near the edges of surface, picture and mask, 0 beyond them.

    depth:     of the mesh
    tolerance: between neighbouring depths of one surface, scene units
    """
    height, width = depth.shape
    rows = (np.arange(height) + 0.5) * view.seen.depth.shape[0] / height
    columns = (np.arange(width) + 0.5) * view.seen.depth.shape[1] / width
    method = view.seen.surface_depth.numpy()[rows.astype(int)[:, None], columns.astype(int)]
    good = view.trusted.numpy() & np.isfinite(depth) & ~(method < depth - METHOD_TOLERANCES * tolerance)
    with np.errstate(invalid="ignore"):  # infinity less infinity
        steps = ndimage.maximum_filter(depth, 3) - ndimage.minimum_filter(depth, 3) > tolerance
    padded = np.pad(good & ~steps, 1)
    inward = ndimage.distance_transform_edt(padded)[1:-1, 1:-1]
    return np.where(good, ((inward - DIAGONAL) / FEATHER_PIXELS).clip(loops.EDGE_TRUST, 1), 0).astype(np.float32)


def collected(
    texels: Texels,
    surface: tuple[Vertices, Faces],
    points: Float[np.ndarray, "texel 3"],
    normals: Float[np.ndarray, "texel 3"],
    views: Iterable[PosedPicture],
    tolerance: float,
) -> TexelColours:
    """Colours of the best views of each texel, by cosine, resolution and trust.

    tolerance: distance between a texel and the first surface of a pixel, scene units, beyond which it is hidden
    """
    colours = np.zeros((len(texels), RANKS, 3), np.uint8)
    scores, numbers = np.zeros((len(texels), RANKS), np.float32), np.zeros((len(texels), RANKS), np.int32)
    vertices, faces = surface
    for number, view in enumerate(views):
        face, depth = first_surface(view.camera, vertices, faces)
        trusted = trust(view, depth, tolerance)
        there = np.zeros(len(faces), bool)
        there[face[face >= 0]] = True
        chosen = np.flatnonzero(there[texels.face])
        where, facing = torch.from_numpy(points[chosen]), torch.from_numpy(normals[chosen])
        pixels, valid = view.camera.project(where)
        back = view.camera.position - where
        away, cosine = back.norm(dim=-1), (unit(back) * facing).sum(-1)
        good = valid & (cosine > MIN_COSINE)
        quality = torch.where(good, cosine / (away * pixel_angle(view.camera) / texels.spacing).square(), 0.0)
        given = chosen, pixels.numpy(), away.numpy(), (quality * cosine).numpy()
        picture = view.rgb.contiguous().numpy(), depth, trusted
        loops.collect(*given, *picture, tolerance, number, colours, scores, numbers)
    return TexelColours(colours, scores, numbers)


def gains(samples: TexelColours) -> Float[np.ndarray, "view 3"]:
    """Log gain of each view and channel that equalises overlapping views by robust least squares

    min over g of  sum w (log c_i + g_i - log c_j - g_j)^2 + ridge |g|^2

    over pairs of views i, j of texels, with Geman and McClure's weights w.
    """
    count = int(samples.views.max()) + 1
    some = samples.known[:: max(1, len(samples.scores) // GAIN_TEXELS)]
    stride = slice(None, None, max(1, len(samples.scores) // GAIN_TEXELS))
    colours, scores, views = (x[stride][some] for x in (samples.colours, samples.scores, samples.views))
    found = np.zeros((count, 3))
    pairs = [(a, b) for a in range(RANKS) for b in range(a)]
    first, second = (np.concatenate([views[:, pair[k]] for pair in pairs]) for k in (0, 1))
    one, other = (np.concatenate([colours[:, pair[k]] for pair in pairs]) for k in (0, 1))
    both = np.concatenate([(scores[:, a] > 0) & (scores[:, b] > 0) for a, b in pairs])
    middling = ((one > DARK) & (one < BRIGHT) & (other > DARK) & (other < BRIGHT)).all(-1)
    first, second, one, other = (x[both & middling] for x in (first, second, one, other))
    if not len(first):
        return found
    difference = np.log(one) - np.log(other)
    for _ in range(GAIN_ROUNDS):
        left = difference + found[first] - found[second]
        weight = 1 / (1 + (left / GAIN_SIGMA) ** 2) ** 2
        for k in range(3):
            matrix = np.zeros((count, count))
            w, d = weight[:, k], difference[:, k]
            for row, column, sign in ((first, first, 1), (second, second, 1), (first, second, -1), (second, first, -1)):
                matrix += sign * np.bincount(row * count + column, w, count * count).reshape(count, count)
            target = np.bincount(second, w * d, count) - np.bincount(first, w * d, count)
            ridge = GAIN_RIDGE * max(float(np.trace(matrix)) / count, 1e-12)
            found[:, k] = np.linalg.solve(matrix + ridge * np.eye(count), target)
    return found


def blended(samples: TexelColours, gain: Float[np.ndarray, "view 3"]) -> Float[np.ndarray, "texel 3"]:
    """The mean of each texel's views, in [0, 1], weighted by their scores' power; views that disagree count less.

    A texel that no view sees is 0.
    """
    found = np.zeros((len(samples.scores), 3), np.float32)
    factors = np.exp(gain).astype(np.float32) / 255
    for first in range(0, len(found), CHUNK_TEXELS):
        part = slice(first, first + CHUNK_TEXELS)
        scores = samples.scores[part]
        colours = samples.colours[part] * factors[samples.views[part]]
        weights = (scores / np.maximum(scores.max(1, keepdims=True), 1e-30)) ** SHARPNESS
        share = weights
        for _ in range(BLEND_ROUNDS):
            mean = (share[..., None] * colours).sum(1) / np.maximum(share.sum(1), 1e-30)[:, None]
            away = np.square(colours - mean[:, None]).sum(-1)
            share = weights * np.exp(-0.5 * away / OUTLIER_SIGMA**2)
        found[part] = mean.clip(0, 1)
    return found


def spread_to_unseen(
    colours: Float[np.ndarray, "texel 3"], points: Float[np.ndarray, "texel 3"], known: Bool[np.ndarray, " texel"]
) -> Float[np.ndarray, "texel 3"]:
    """Colours with those of invisible texels replaced by the mean of the nearest visible ones, weighted by 1 /
    distance."""
    if known.all():
        return colours
    there = np.flatnonzero(known)
    there = there[:: max(1, len(there) // SEEN_TEXELS)]
    if not len(there):
        return np.full_like(colours, 0.5)
    away, near = cKDTree(points[there]).query(points[~known], min(NEIGHBOURS, len(there)), workers=processors())
    away, near = (x.reshape(len(x), -1) for x in (away, near))
    share = (1 / np.maximum(away, 1e-12)).astype(np.float32)
    found = colours.copy()
    found[~known] = (colours[there][near] * share[..., None]).sum(1) / share.sum(1, keepdims=True)
    return found
