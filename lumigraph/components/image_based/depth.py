"""Complete depth maps of photographs: by multi-view stereo, measurement, a visual hull, a mesh, or a plane."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.sparse.linalg import spsolve
from torch import Tensor
from torch.nn.functional import interpolate

from ... import kernels
from ...camera import Camera
from ...camera.lens import OpenCV, Pinhole
from ...datasets.images.resize import resized
from ...datasets.mesh import Mesh
from ...datasets.scene import Frame, Photograph, Scene
from ...depth_maps import DepthMap
from ...depth_maps.flat_view import GREY, flat_view
from ...depth_maps.multi_view import multi_view_depth
from ...errors import LumigraphError, LumigraphWarning
from ...files.reading import reading
from ...geometry import evenly
from ..fields.level_set import level_set
from ..sampling.occupancy import visual_hull

Geometry = Literal["stereo", "measured", "hull", "mesh", "plane"]
HULL_CELLS = 64  # of a visual hull, along each side of the box
HULL_VIEWS, HULL_SEEN = 40, 0.5  # photographs that are asked, and share of them inside whose borders a cell must be
HULL_REACH, HULL_BLUR = 4.0, 1.0  # cells that distances from its surface reach, and deviation of their smoothing
FILL_SIDE = 100  # pixels along the longer side of the grid on which gaps are first filled
SWEEPS = 40  # of relaxation at the full size
COLOUR_DEVIATION = 0.06  # of grey, across which depth is less likely to go on
MIN_LINK = 1e-3  # of two neighbouring pixels, whatever their colours
MIN_SURE = 0.002  # share of a photograph's pixels from which on its own depth counts
MIN_PARALLAX = 0.005  # between the farthest two photographs, as a share of the depth, for stereo to mean anything
TRUSTED_SHARE = 0.1  # of all pixels, below which the user is warned
FILLED_CONFIDENCE = 0.1  # of depth that was filled in, where that of sure depth is 1
OPAQUE = 0.5  # alpha above which a pixel shows a surface


@dataclass(frozen=True)
class CompleteDepth:
    """Depth at every pixel of a grid over a photograph, through its own lens.

    distance:   along rays, scene units; infinity for empty space, NaN for untrusted pixels
    confidence: in [0, 1]
    """

    distance: Float[Tensor, "height width"]
    confidence: Float[Tensor, "height width"]


def complete_depths(
    scene: Scene, photographs: Sequence[Photograph], geometry: Geometry, size: int, mesh_file: str, seconds: float
) -> list[CompleteDepth]:
    """Depth of the training photographs. size: largest longer side in pixels; seconds: time for stereo, about"""
    grids = [depth_camera(photograph.camera, size) for photograph in photographs]
    found: list[Float[Tensor, "height width"]]
    if geometry == "stereo":
        found = _stereo(scene, grids, size, seconds)
    elif geometry == "measured":
        scene.layer("depth")
        found = [_measured(scene.photograph(int(i), ("depth",)), grid) for i, grid in _numbered(scene, grids)]
    elif geometry in ("mesh", "hull"):
        hull = hull_surface(scene) if geometry == "hull" else None
        if geometry == "hull" and hull is None:
            raise LumigraphError(
                f"{scene.source} shows no object cut out by alpha, so it has no visual hull; give --geometry stereo"
            )
        corners, faces = (hull.vertices, hull.faces) if hull else proxy_mesh(mesh_file, scene.frame)
        found = [
            mesh_distance(torch.from_numpy(corners).float(), torch.from_numpy(faces).int(), grid) for grid in grids
        ]
    else:
        found = [torch.full(shape(grid), math.nan) for grid in grids]
    alone = typical_inverse_depth(scene, grids, found)
    return [completed(*one, alone) for one in zip(found, photographs, grids, strict=True)]


def _numbered(scene: Scene, grids: Sequence[Camera]) -> list[tuple[int, Camera]]:
    return list(zip(scene.splits["train"].tolist(), grids, strict=True))


def shape(camera: Camera) -> tuple[int, int]:
    """Height and width of one camera's picture."""
    width, height = camera.size[0].tolist()
    return height, width


def depth_camera(camera: Camera, size: int) -> Camera:
    """The camera of a photograph's depth map."""
    return camera.resized(min(1.0, size / int(camera.size.max())))


def flattened(photograph: Photograph) -> Photograph:
    """A photograph through a lens that `kernels.blend_views` supports: others are resampled to a pinhole."""
    if type(photograph.camera.lens) in (Pinhole, OpenCV):
        return photograph
    view = flat_view(photograph, max(photograph.rgb.shape[:2]))
    lens = Pinhole(view.intrinsics.diagonal()[None, :2], view.intrinsics[None, :2, 2])
    height, width = view.trust.shape
    camera = Camera(view.pose[None], lens, torch.tensor([[width, height]]), image_index=photograph.camera.image_index)
    return Photograph(camera, view.rgb, mask=view.trust > 0.99)


def _stereo(scene: Scene, grids: Sequence[Camera], size: int, seconds: float) -> list[Float[Tensor, "height width"]]:
    """Consistent depth of neighbouring photographs, NaN elsewhere."""
    if len(grids) < 2:
        raise LumigraphError(
            f"{scene.source} has {len(grids)} photograph to learn from, and stereo needs two; add photographs, or "
            "give --geometry plane"
        )
    maps = multi_view_depth(scene, size, seconds, len(grids))
    by_number = {int(seen.camera.image_index[0]): seen for seen in maps if seen.camera.image_index is not None}
    found = []
    for number, grid in _numbered(scene, grids):
        seen = by_number.get(number)
        found.append(torch.full(shape(grid), math.nan) if seen is None else resampled(seen, grid))
    known = torch.cat([x[x.isfinite()] for x in found])
    position = torch.cat([grid.position for grid in grids])
    span = float(torch.cdist(position, position).max())
    if len(known) and span < MIN_PARALLAX * float(known.median()):
        found = [torch.full_like(x, math.nan) for x in found]  # without a baseline every depth agrees
    share = float(torch.cat([x.isfinite().flatten() for x in found]).float().mean())
    if share == 0:
        warnings.warn(
            f"Stereo finds no depth in {scene.source}: its photographs were taken from one place, do not overlap or "
            "show nothing to match; a plane stands for the scene, so move between photographs",
            LumigraphWarning,
            stacklevel=3,
        )
    elif share < TRUSTED_SHARE:
        warnings.warn(
            f"Stereo is sure of the depth of {100 * share:.1f} % of the pixels of {scene.source}, and the rest is "
            "interpolated; photograph plain surfaces from more places",
            LumigraphWarning,
            stacklevel=3,
        )
    return found


def resampled(seen: DepthMap, grid: Camera) -> Float[Tensor, "height width"]:
    """A depth map of the same position resampled to another lens: the nearest pixel's distance; NaN outside."""
    pixels, valid = seen.camera.project(grid.rays(grid.pixels()).at(torch.ones(int(grid.size.prod()))))
    inside = seen.inside(pixels, valid)
    return torch.where(inside, seen.at_pixels(seen.depth, pixels), torch.nan).view(shape(grid))


def _measured(photograph: Photograph, grid: Camera) -> Float[Tensor, "height width"]:
    """A photograph's depth layer, resampled to its depth map's pixels, each by the nearest."""
    depth = photograph.extra["depth"].numpy()
    return torch.from_numpy(resized(depth, shape(grid)[::-1], "plain", ~np.isnan(depth)))


def hull_surface(scene: Scene, cells: int = HULL_CELLS) -> Mesh | None:
    """Visual hull of photographs with alpha, its stairs smoothed (Gortler 1996, sec. 3.2.1); None without one.

    cells: of a grid over [-1, 1]^3, along each axis
    """
    solid = visual_hull(scene, cells).numpy()
    centres = (np.arange(cells) + 0.5) * 2 / cells - 1
    for axis, (low, high) in enumerate(zip(*scene.frame.bounds, strict=True)):
        solid[(slice(None),) * axis + ((centres < low) | (centres > high),)] = False
    places = torch.from_numpy(2 / cells * (np.argwhere(solid) + 0.5) - 1).float()
    views = scene.cameras[torch.tensor(evenly(scene.splits["train"].tolist(), HULL_VIEWS))]
    seen = torch.stack([views[i].locate(places)[1] for i in range(len(views))]).float().mean(0)
    solid[solid] = (seen >= HULL_SEEN).numpy()  # a place outside the pictures is in no silhouette
    if not scene.frame.has_alpha or scene.frame.times is not None or not solid.any():
        return None
    away = (distance_transform_edt(solid) - distance_transform_edt(~solid)).clip(-HULL_REACH, HULL_REACH)
    values = gaussian_filter(away, HULL_BLUR) - math.sqrt(3) / 2  # by which `visual_hull` is too large
    return level_set(values, np.full(3, 1 / cells - 1), 2 / cells) if (values > 0).any() else None


def proxy_mesh(file: str, frame: Frame) -> tuple[Float[Tensor, "vertex 3"], Tensor]:
    """Vertices in the scene's frame and faces of a mesh in the frame of the photographs."""
    if not file:
        raise LumigraphError("--geometry mesh needs a mesh in the frame of the photographs; name it by --mesh-file")
    with reading(file, "cannot be read as a mesh of triangles", "export it once more"):
        mesh: Any = trimesh.load(Path(file).expanduser(), force="mesh", process=False)
        if not len(mesh.faces):
            raise ValueError("it has none")
    vertices = torch.from_numpy(np.asarray(mesh.vertices, np.float32))
    matrix = frame.to_source.inverse.matrix.float()
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], torch.from_numpy(np.asarray(mesh.faces, np.int32))


def mesh_distance(vertices: Tensor, faces: Tensor, camera: Camera) -> Float[Tensor, "height width"]:
    """Distance to the first triangle along each pixel's ray, infinity where there is none."""
    width, height = camera.size[0].tolist()
    pixels, valid = camera.project(vertices)
    away = (vertices - camera.position).norm(dim=-1)
    faces = faces[valid[faces.long()].all(-1)]
    corners = torch.cat([pixels * away[:, None], away[:, None]], -1)
    _, distance, number = kernels.rasterize_mesh(corners, away[:, None], faces, (width, height))
    return torch.where(number >= 0, distance, torch.inf)


def typical_inverse_depth(
    scene: Scene, grids: Sequence[Camera], found: Sequence[Float[Tensor, "height width"]]
) -> float:
    """Optimal single plane, 1 / z = (1 / near + 1 / far) / 2 (Chai 2000, eq. 10), over known depth."""
    known = [
        grid.cosines()[depth.isfinite()] * depth[depth.isfinite()] for depth, grid in zip(found, grids, strict=True)
    ]
    depth = torch.cat(known)
    if not len(depth) and scene.points is not None and len(scene.points):
        depth = torch.cat([(scene.points - grid.position) @ grid.forward[0] for grid in grids])
    depth = depth[depth > scene.frame.near]
    if not len(depth):
        depth = torch.stack([grid.position[0].norm() for grid in grids]).clamp_min(2 * scene.frame.near)
    near, far = np.quantile(depth.numpy(), (0.02, 0.98))
    return float(0.5 / near + 0.5 / far)


def completed(
    depth: Float[Tensor, "height width"], photograph: Photograph, grid: Camera, alone: float
) -> CompleteDepth:
    """Fill in unknown depth. The result minimises

        sum_known (s - s_0)^2 + sum_neighbours w (s - s')^2,    w = exp(-(grey - grey')^2 / 2 0.06^2)

    of s = 1 / z, which is linear in the pixel on a plane (as Levin 2004 for colours).
    alone: 1 / z of a photograph without known depth
    """
    picture = torch.cat([photograph.rgb, photograph.rgb.new_ones(*photograph.rgb.shape[:2], 2)], -1)
    if photograph.alpha is not None:
        picture[..., 3] = photograph.alpha
    if photograph.mask is not None:
        picture[..., 4] = photograph.mask
    small = interpolate(picture.movedim(-1, 0)[None], depth.shape, mode="area")[0]
    grey, alpha, trust = torch.einsum("chw,c->hw", small[:3], torch.tensor(GREY)), small[3], small[4]
    solid = (alpha > OPAQUE) & ~depth.isposinf()
    known, cosine = solid & depth.isfinite(), grid.cosines().clamp_min(1e-3)
    inverse = torch.where(known, 1 / (depth * cosine), 0)
    if known.float().mean() < MIN_SURE:
        known, inverse = torch.zeros_like(known), torch.full_like(inverse, alone)
    elif not known.all():
        inverse = _filled(inverse, known, solid, grey)
    distance = torch.where(solid, 1 / (inverse.clamp_min(1e-6) * cosine), torch.inf)
    distance = torch.where(trust > 0.99, distance, torch.nan)
    return CompleteDepth(distance, torch.where(known, 1.0, FILLED_CONFIDENCE))


def _filled(inverse: Tensor, known: Bool[Tensor, "height width"], solid: Tensor, grey: Tensor) -> Tensor:
    """Solve on a coarse grid, then relax on the fine one."""
    scale = min(1.0, FILL_SIDE / max(inverse.shape))
    coarse = tuple(max(2, round(side * scale)) for side in inverse.shape)
    stacked = torch.stack([inverse * known, known.float(), solid.float(), grey])
    total, count, room, shade = interpolate(stacked[None], coarse, mode="area")[0]
    right, down = links(shade, room > 0)
    index = np.arange(total.numel()).reshape(coarse)
    a = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    b = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    w = torch.cat([right.flatten(), down.flatten()]).double().numpy()
    links_ = sparse.coo_array((w, (a, b)), (total.numel(),) * 2).tocsr()
    links_ = links_ + links_.T
    weight = count.double().numpy().ravel()
    matrix = sparse.diags_array(links_.sum(0) + weight + 1e-9) - links_
    mean = float(total.sum() / count.sum())
    found = spsolve(matrix.tocsc(), total.double().numpy().ravel() + 1e-9 * mean)
    start = interpolate(torch.from_numpy(found).float().view(1, 1, *coarse), inverse.shape, mode="bilinear")[0, 0]
    return relaxed(torch.where(known, inverse, start), known, *links(grey, solid))


def links(grey: Tensor, solid: Tensor) -> tuple[Tensor, Tensor]:
    """Weights w of pixels with their right neighbours, and with those below."""

    def between(a: Tensor, b: Tensor, both: Tensor) -> Tensor:
        return (torch.exp(-((a - b) ** 2) / (2 * COLOUR_DEVIATION**2)) + MIN_LINK) * both

    right = between(grey[:, 1:], grey[:, :-1], solid[:, 1:] & solid[:, :-1])
    return right, between(grey[1:], grey[:-1], solid[1:] & solid[:-1])


def relaxed(values: Tensor, known: Tensor, right: Tensor, down: Tensor) -> Tensor:
    """Jacobi sweeps: unknown values become the weighted means of their neighbours."""
    total = torch.full_like(values, 1e-9)
    total[:, 1:] += right
    total[:, :-1] += right
    total[1:] += down
    total[:-1] += down
    for _ in range(SWEEPS):
        sums = 1e-9 * values
        sums[:, 1:] += right * values[:, :-1]
        sums[:, :-1] += right * values[:, 1:]
        sums[1:] += down * values[:-1]
        sums[:-1] += down * values[1:]
        values = torch.where(known, values, sums / total)
    return values
