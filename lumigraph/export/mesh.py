"""Mesh extraction: from a method's signed distance or density if it has one, otherwise from rendered depth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample

from ..camera import Camera
from ..camera.crop import Crop, CropBox
from ..datasets.mesh import Mesh
from ..datasets.scene import Frame, Scene
from ..depth_maps import TSDF, DepthMap, Tolerance, agreed, fused_colours, hidden, measurements, render_depth_maps
from ..errors import LumigraphError
from ..geometry import evenly
from ..method import Method
from ..method.capabilities import HasDensity, HasDistance, HasMesh, can, needs
from ..system.progress import counting, track
from ..system.work import at_work
from .loaded import Loaded
from .options import TEXTURED_FACES, MeshOptions
from .surface import (
    BLOCK,
    Faces,
    Grid,
    Vertices,
    face_normals,
    larger_pieces,
    majority,
    manifold,
    name_cut,
    simplified,
    smoothed,
    vertex_normals,
    zero_level,
)
from .texture import Views, check_room, photographed, rendered, textured

DEFAULT_CELLS = 256  # default, along the longest side of the box
OPEN_BOX = 1.5  # times the box of interest, for rooms and open scenes
MIN_CELLS, MAX_CELLS = 8, 2048  # cells along it that make sense
PROBE_CELLS = 160  # probes along it that locate the surface
SOFTNESS = 2.0  # logarithm of the density over its level at which it is as good as solid, or empty
TRUNCATION_CELLS = 5  # cells from the surface that depth maps are fused over
HIDDEN_CELLS = 2  # cells behind the first surface from which on a picture does not show it
MIN_SHOWN_SHARE = 0.25  # of pictures with masks, that show some of each piece of a closed surface
MIN_LEFT_OUT = 2  # pictures that leave out what none sees, from which on it is empty
CUT_ROUNDS = 30  # rounds of diffusion in which the line where an open surface is cut becomes even
INWARD_CELLS, OUTWARD_CELLS = 1, 2  # cells from the fused surface within which the density decides
ONSET_SHARE = 0.2  # share of a ray's light that is spent in front of the surface
POINTS_PER_CHUNK = 1 << 18  # points
MIN_PIECE = 0.01  # of the largest piece's area, below which a piece is fog
CUT_STRIDE = 16  # pixels that show a surface, of which one is asked for the share outside
OUTSIDE, WAY_OUT = "lies outside the meshed region", "a larger --extent, --box or --sphere holds more"

Way = Literal["distance", "density", "own", "depth"]


def export_mesh(loaded: Loaded, options: MeshOptions = MeshOptions()) -> tuple[Mesh, str]:
    """The mesh of what is loaded, in the frame of exports, and the source of its surface as text."""
    loaded = loaded.still
    why = best_way(loaded.method)[1] if options.way == "auto" else f"{options.way}, as --from says"
    opened, gone = loaded.opened, "The texture is made of renderings" if options.texture else None
    cameras = opened.survey(loaded.cameras["train"])
    photographs = opened.photographs(options.scene, gone) if options.texture or opened.masked else None
    mesh = extract_mesh(loaded.without_floaters(), cameras, options, loaded.crop, photographs)
    return mesh.in_source(loaded.frame), why


@torch.no_grad()
@at_work()
def extract_mesh(
    method: Method,
    cameras: Camera,
    options: MeshOptions = MeshOptions(),
    crop: Crop | None = None,
    photographs: Scene | None = None,
) -> Mesh:
    """Extract the surface in the box of interest or a crop, in the scene's frame; a method's own mesh is whole, unless
    an extent or a crop is given. A warning has the share of the surface outside.

    cameras: the scene's own; what none of them sees is left out, or filled in
    crop:    replaces the box of interest, within the scene's reach
    photographs: the scene whose training split `cameras` are. Pixels that its masks exclude show no
             surface, and a texture has its colours. None for no masks, and a texture of the method's renderings
    Raises LumigraphError for an empty scene, a texture that exceeds memory, and invalid numbers.
    """
    texture = options.texture_size if options.texture else None
    if texture is not None:
        check_room(texture)
    method.eval()
    closed = not method.frame.is_open if options.unseen is None else options.unseen == "close"
    limits = meshed_box(method.frame, options.extent) if crop is None else within_reach(method.frame, crop)
    holds = limits.holds if crop is None else lambda points: limits.holds(points) & crop.holds(points)
    cell = None if options.cell_size is None else options.cell_size / method.frame.to_export.scale
    grid, way = make_grid(limits, cell), best_way(method)[0] if options.way == "auto" else options.way
    faces = TEXTURED_FACES if options.faces is None and texture is not None else options.faces
    whole = crop is None and options.extent is None  # of an own mesh: its size is that of what was measured
    keep = (0.0 if way == "own" else MIN_PIECE) if options.keep is None else options.keep
    made = own_mesh(method, None if whole else holds, keep, options.smooth, faces) if way == "own" else None
    if made is not None and texture is None:
        return made
    depth_maps = render_depth_maps(method.render, cameras, method.frame.background, options.views, options.size)
    sources: list[Views] = [lambda _: rendered(depth_maps)]
    learnt = depth_maps
    if photographs is not None:
        chosen = evenly(range(len(cameras)), options.views)
        learnt = without_masked(depth_maps, photographs, chosen)
        sources.insert(0, lambda spacing: photographed(photographs, cameras, chosen, depth_maps, spacing))
    if made is None:
        shown = torch.cat([x.positions(x.solid)[::CUT_STRIDE] for x in learnt])
        name_cut(float((~holds(shown)).float().sum()) / max(len(shown), 1), OUTSIDE, WAY_OUT)
    elif texture is not None:
        surface = made.vertices, made.faces
        return textured(surface, sources, HIDDEN_CELLS * grid.cell, texture, surface)
    step = max(2, math.ceil(max(grid.shape) / PROBE_CELLS))
    value = from_depth(learnt, grid.cell, closed)
    if way == "distance" and method.learns_from is not Scene:  # of shapes, known where no camera sees it
        value = from_distance(method, grid.cell)
    elif way != "depth":
        if way == "distance":
            own = from_distance(method, grid.cell)
        else:
            level = surface_level(method, learnt, holds) if options.level is None else options.level
            own = from_density(method, level)
        value = near_depth(own, interpolated(value, grid, step))
    vertices, triangles = find_surface(grid, step, holds, value, -1.0 if closed else math.nan)
    if len(triangles):
        points = torch.from_numpy(vertices).float()
        if closed:
            seen_well = ~hidden(points, learnt, Tolerance(2 * grid.cell)).numpy()
            if masked(learnt):
                seen_well &= (measurements(points, learnt)[0] >= MIN_SHOWN_SHARE * len(learnt)).numpy()
        else:
            confirmed = agreed(points, learnt, Tolerance(TRUNCATION_CELLS * grid.cell)).numpy()
            seen_well = majority(confirmed, triangles, CUT_ROUNDS)
            triangles = triangles[seen_well[triangles].all(-1)]
        corners, triangles = manifold(triangles)
        if len(triangles):
            vertices, triangles = larger_pieces(vertices[corners], triangles, keep, seen_well[corners])
    if not len(triangles):
        raise LumigraphError(
            "Nothing inside the box is solid at this density, so there is no surface; train for longer, or "
            "try a lower --level"
        )
    with counting("Smoothing the surface"):
        vertices = smoothed(vertices, triangles, options.smooth)
        detailed = vertices, triangles
        if faces is not None:
            vertices, triangles = simplified(vertices, triangles, faces)
            corners, triangles = manifold(triangles)
            vertices = vertices[corners]
    if texture is not None:
        return textured((vertices, triangles), sources, HIDDEN_CELLS * grid.cell, texture, detailed)
    points, normals = (torch.from_numpy(x).float() for x in (vertices, vertex_normals(vertices, triangles)))
    rgb = fused_colours(points, normals, learnt, Tolerance(3 * grid.cell))
    return Mesh(vertices, triangles, (rgb * 255).round().to(torch.uint8).numpy())


def without_masked(depth_maps: Sequence[DepthMap], photographs: Scene, chosen: Sequence[int]) -> list[DepthMap]:
    """Depth maps of these training cameras, NaN in pixels that the photographs' masks exclude."""
    masks = [photographs.images.mask(int(photographs.splits["train"][i])) for i in chosen]
    return [seen if mask is None else seen.within(mask) for seen, mask in zip(depth_maps, masks, strict=True)]


def masked(depth_maps: Sequence[DepthMap]) -> bool:
    """True if some of them have unmeasured pixels."""
    return any(bool(seen.depth.isnan().any()) for seen in depth_maps)


def own_mesh(method: Method, holds: Holds | None, keep: float, smooth: int, faces: int | None) -> Mesh:
    """The method's own mesh, whole or within a region, with its own colours; see `extract_mesh`."""
    made = needs(method, HasMesh).mesh()
    kept = np.ones(len(made.faces), bool)
    if holds is not None:
        kept = holds(torch.from_numpy(made.vertices).float()).numpy()[made.faces].all(-1)
        areas = np.linalg.norm(face_normals(made.vertices, made.faces), axis=-1)
        name_cut(areas[~kept].sum() / max(areas.sum(), 1e-30), OUTSIDE, WAY_OUT)
    corners, triangles = manifold(made.faces[kept])
    if not len(triangles):
        raise LumigraphError("No part of the mesh lies inside the box; give a larger --extent, or another box")
    vertices = made.vertices[corners]
    vertices, triangles = larger_pieces(vertices, triangles, keep, np.ones(len(vertices), bool))
    with counting("Smoothing the surface"):
        places = cKDTree(made.vertices)
        colours = made.colours[places.query(vertices)[1]]
        vertices = smoothed(vertices, triangles, smooth)
        if faces is not None and len(triangles) > faces:
            vertices, triangles = simplified(vertices, triangles, faces)
            corners, triangles = manifold(triangles)
            vertices = vertices[corners]
            colours = made.colours[places.query(vertices)[1]]
    return Mesh(vertices, triangles, colours)


def best_way(method: Method) -> tuple[Way, str]:
    """Best surface source of a method, with the reason."""
    if can(method, HasDistance):
        return "distance", "the signed distance, whose zero level is the surface that was learnt"
    if can(method, HasDensity):
        return "density", "the density, which is finer than depth from pictures; there is no signed distance"
    if can(method, HasMesh):
        return "own", "the mesh that the method makes itself; there is no signed distance and no density at points"
    return "depth", "rendered depth, fused; there is no signed distance and no density at points"


def meshed_box(frame: Frame, times: float | None) -> CropBox:
    """Box of interest scaled about its centre, within the cube of the scene's reach."""
    low, high = torch.tensor(frame.bounds)
    half = 0.5 * (high - low) * ((1.0 if not frame.is_open else OPEN_BOX) if times is None else times)
    middle = 0.5 * (low + high)
    return upright(torch.stack([middle - half, middle + half]).clamp(-frame.reach, frame.reach))


def within_reach(frame: Frame, crop: Crop) -> CropBox:
    """Axis-aligned box around a crop, within the cube of the scene's reach. Raises LumigraphError for one outside."""
    corners = torch.tensor(crop.bounds).clamp(-frame.reach, frame.reach)
    if not (corners[1] > corners[0]).all():
        raise LumigraphError(
            "The crop lies outside the scene, so there is nothing to mesh; `lumigraph info` shows the scene's bounds"
        )
    return upright(corners)


def upright(corners: Float[Tensor, "2 3"]) -> CropBox:
    (a, b, c), (d, e, f) = corners.tolist()
    return CropBox((a, b, c), (d, e, f))


def make_grid(box: CropBox, cell: float | None) -> Grid:
    """Cubes over a box and a little around it. Raises LumigraphError for cubes too small or too large."""
    longest = max(b - a for a, b in zip(box.lower, box.upper, strict=True))
    if cell is None:
        cell = longest / DEFAULT_CELLS
    if not longest / MAX_CELLS <= cell <= longest / MIN_CELLS:
        raise LumigraphError(
            f"Cells of {cell / longest:.3g} times the longest side of the box make no mesh; give "
            f"--cell-size something from 1/{MAX_CELLS} to 1/{MIN_CELLS} of it"
        )
    return Grid.around(box.lower, box.upper, cell, 1.5)


Value = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]
Holds = Callable[[Float[Tensor, "point 3"]], Bool[Tensor, " point"]]


def from_depth(depth_maps: Sequence[DepthMap], cell: float, closed: bool) -> Value:
    """A function of points: 0 at the surface of the fused depth maps, 1 well inside, -1 well outside.

    Empty space includes points outside most pictures' silhouettes, and points outside two if no camera sees them.
    closed: points hidden from all cameras count as solid, rather than as unknown (NaN)
    """
    fused = TSDF(depth_maps, Tolerance(TRUNCATION_CELLS * cell))
    some_masked = masked(depth_maps)

    def value(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        distance, _, pictured = fused(points)
        found = torch.where(distance.isnan() & closed, torch.where(pictured, 1.0, -1.0), -distance)
        if not some_masked:
            return found
        measured, left_out = measurements(points, depth_maps)
        empty = (left_out > measured) | (distance.isnan() & (left_out >= MIN_LEFT_OUT))
        return torch.where(empty, -1.0 if closed else math.nan, found)

    return value


def from_distance(method: Method, cell: float) -> Value:
    """A function of points: 0 where the signed distance is, 1 well inside, -1 well outside."""

    def value(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        distance = needs(method, HasDistance).distance(points.to(method.device)).cpu().float()
        return (-distance / (TRUNCATION_CELLS * cell)).clamp(-1, 1)

    return value


def from_density(method: Method, level: float) -> Value:
    """A function of points: 0 where the density is at its level, 1 well inside, -1 well outside.

    It is linear in the logarithm of density, which changes evenly where density grows by orders of magnitude in a cell.
    """

    def value(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        density = needs(method, HasDensity).density(points.to(method.device)).cpu().float()
        return ((density.clamp_min(1e-30) / level).log() / SOFTNESS).clamp(-1, 1)

    return value


def near_depth(own: Value, depth: Value) -> Value:
    """A function of points: a field's own value within a few cells of the visible surface, elsewhere that of the
    cameras' depth. This removes cavities inside objects, where the field had no supervision, and transparent fog."""
    inward, outward = INWARD_CELLS / TRUNCATION_CELLS, OUTWARD_CELLS / TRUNCATION_CELLS

    def value(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        seen = depth(points)
        return own(points).maximum(seen - inward).minimum(seen + outward)

    return value


def surface_level(method: Method, depth_maps: Sequence[DepthMap], holds: Holds) -> float:
    """Density level of the surface, found from the field itself, for any unit and sharpness.

    At the rendered depth half of a ray's light is stopped; the median density there is known. But fields begin at the
    surface and grow behind it, without supervision. On an exponential ramp the accumulated optical thickness is
    proportional to the density, so a share q is stopped where it is log(1 - q) / log(1 / 2) as large.
    """
    found = torch.cat([x.positions(x.solid & (x.opacity > 0.9) & (x.facing > 0.3)) for x in depth_maps])
    found = found[holds(found)]
    if not len(found):
        raise LumigraphError(
            "No camera sees a surface inside the box, so there is nothing to make a mesh of; train for "
            "longer, or give the density at which it is solid as --level"
        )
    found = found[:: max(1, len(found) // POINTS_PER_CHUNK)]
    at_depth = float(needs(method, HasDensity).density(found.to(method.device)).median())
    return at_depth * math.log(1 - ONSET_SHARE) / math.log(0.5)


def at_probes(value: Value, grid: Grid, step: int) -> Float[Tensor, "i j k"]:
    """A function at each step-th corner along each axis."""
    corners = grid.every(step)
    batches = grid.points(corners.reshape(-1, 3)).split(POINTS_PER_CHUNK)
    found = [value(x) for x in track(batches, "Looking for the surface", len(batches))]
    return torch.cat(found).reshape(corners.shape[:3])


def interpolated(value: Value, grid: Grid, step: int) -> Value:
    """A function that is evaluated at probes only, and interpolated between them."""
    probed = at_probes(value, grid, step)
    low, span = torch.tensor(grid.low), step * grid.cell * (torch.tensor(probed.shape) - 1)

    def between(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        place = (2 * (points - low) / span - 1).flip(-1)[None, None, None]
        return grid_sample(probed[None, None], place, padding_mode="border", align_corners=True).flatten()

    return between


def find_surface(grid: Grid, step: int, holds: Holds, value: Value, beyond: float) -> tuple[Vertices, Faces]:
    """Coarse to fine: probes find the blocks that may contain the surface, and those are marched.

    step:   corners of the grid from one probe to the next
    holds:  mask of points inside the meshed region
    beyond: value outside of it: -1 closes the surface there, NaN leaves it open
    """

    def inside(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        return torch.where(holds(points), value(points), beyond)

    probed = at_probes(inside, grid, step).nan_to_num(nan=-1.0).numpy()
    near = ndimage.maximum_filter(np.abs(probed) < 1, 3)
    near |= ndimage.maximum_filter(probed, 3) * ndimage.minimum_filter(probed, 3) < 0
    shape = tuple(-(-n // BLOCK) for n in grid.shape)
    active = np.zeros(shape, bool)
    active[tuple((np.argwhere(near) * step // BLOCK).clip(max=np.array(shape) - 1).T)] = True
    middles = [((np.arange(n) + 0.5) * BLOCK / step).astype(int) for n in shape]
    middles = [middle.clip(max=n - 1) for middle, n in zip(middles, probed.shape, strict=True)]
    elsewhere = np.where(probed[np.ix_(*middles)] > 0, 1.0, -1.0)
    return zero_level(grid, inside, active, elsewhere)
