"""Light probes of any method: spherical harmonics of radiance around grid points, and octahedral distance maps.

A probe renders the six faces of a cube. Pixels are decoded to linear light, so that irradiance is the sum of light, and
weighted by their solid angle.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Pinhole
from ..composition import Placed, compose
from ..depth_maps import DepthMap, Tolerance, hidden, render_depth_maps
from ..errors import LumigraphError
from ..geometry import Similarity, Vector
from ..light.probes import FREE, MATTER, UNSEEN, ProbeGrid, lattice, octahedral, projected, write_probes
from ..light.probes.storage import MAX_PROBES
from ..method import Method
from ..method.capabilities import HasLooks, can
from ..system.progress import track
from ..system.work import at_work
from .film import light_of
from .loaded import Loaded
from .options import ProbesOptions
from .probes_page import probes_page

LONGEST_SIDE_PROBES = 8  # probes along the longest side of the box, where no spacing is given
MAP_SIDE = 14  # texels along a side of an octahedral map, without its border
DEPTH_SHARPNESS = 50  # exponent of the cosine lobe that distances are averaged over (Majercik 2019)
FAR_DIAGONALS = 1.5  # length at which distances are cut, in diagonals of a cell
CLOSE_SHARE = 0.2  # of the shortest step: a surface within it is close to a probe
ENCLOSED_SHARE = 0.5  # of all directions: with close surfaces in more of them a probe is in matter
SEEN_TOLERANCE = Tolerance(per_distance=0.02)  # behind a surface, within which a camera still sees a probe
MIN_SURFACE_OPACITY = 0.5

# Axes of the cube's faces: right, down, forward.
FACES = torch.tensor(
    [
        [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
        [[0, 1, 0], [0, 0, -1], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    ],
    dtype=torch.float32,
).mT


def grid_of(
    box: tuple[Vector, Vector], spacing: float | None = None, counts: tuple[int, int, int] | None = None
) -> tuple[Tensor, Tensor, tuple[int, int, int]]:
    """First probe, steps along the three axes, and counts of a grid whose cells fill a box, in the scene's frame.

    Probes are in the middles of cells, so that none lies in a room's walls. Raises LumigraphError for too many.
    """
    low, high = torch.tensor(box)
    extent = high - low
    if counts is None:
        spacing = spacing or float(extent.max()) / LONGEST_SIDE_PROBES
        x, y, z = (max(1, math.ceil(side / spacing - 1e-6)) for side in extent.tolist())
        counts = x, y, z
    if not 1 <= math.prod(counts) <= MAX_PROBES:
        raise LumigraphError(
            f"A grid of {' x '.join(map(str, counts))} probes is none that a file holds; give --counts or --spacing "
            f"for 1 to {MAX_PROBES:,} probes"
        )
    steps = extent / torch.tensor(counts)
    return low + steps / 2, steps, counts


def export_probes(loaded: Loaded, path: Path, options: ProbesOptions = ProbesOptions()) -> ProbeGrid:
    """Write the probes of what is loaded, in a box or its crop, and the page of the options; returns the probes."""
    method, crop = loaded.still.without_floaters(), loaded.crop
    box = loaded.frame.bounds if crop is None else crop.bounds
    grid = bake_probes(method, loaded.photographers, box, options)
    origin = loaded.frame.origin if options.origin else None
    write_probes(path, grid, None if origin is None else origin.to_json())
    if options.page is not None:
        probes_page(options.page, method, loaded.camera(options.view), grid, loaded.opened.title, options.mesh)
    return grid


@torch.no_grad()
@at_work()
def bake_probes(
    method: Method, cameras: Camera | None, box: tuple[Vector, Vector], options: ProbesOptions = ProbesOptions()
) -> ProbeGrid:
    """Probes inside a box of the scene's frame, in the frame of exports.

    cameras: of the photographs, which determine free space; None without photographs
    Raises LumigraphError if no probe is free, or all are in empty space.
    """
    method.eval()
    to_export, order, face_size = method.frame.to_export, options.order, options.resolution
    spacing = None if options.spacing is None else options.spacing / to_export.scale
    first, steps, counts = grid_of(box, spacing, options.counts)
    places = first + lattice(counts) * steps
    far = FAR_DIAGONALS * float(steps.norm())
    around = [cube_camera(torch.zeros(3), face, face_size) for face in FACES]
    rays = [camera.rays(camera.pixels()) for camera in around]
    directions = torch.cat([x.directions for x in rays])
    angles = torch.cat([x.radius for x in rays]) ** 2  # proportional to solid angles
    lobes = octahedral_lobes(to_export.directions(directions), angles)
    near, all_around = nearby(method), to_export.directions(directions)
    light, moments, enclosed, solid = [], [], [], False
    for place in track(places, "Probes", len(places)):
        seen = [near.render(cube_camera(place, face, face_size).to(method.device)).cpu() for face in FACES]
        light.append(projected(all_around, torch.cat([light_of(x).reshape(-1, 3) for x in seen]), angles, order))
        opacity, depth = (torch.cat([getattr(x, name).flatten() for x in seen]) for name in ("opacity", "depth"))
        depth = depth.nan_to_num(far, far, far).clamp(0, far)
        surface = opacity > MIN_SURFACE_OPACITY
        solid |= bool(surface.any())
        close = surface & (depth < CLOSE_SHARE * float(steps.min()))
        enclosed.append(float(angles[close].sum() / angles.sum()) > ENCLOSED_SHARE)
        mean, squared = (opacity * x + (1 - opacity) * beyond for x, beyond in ((depth, far), (depth**2, far**2)))
        moments.append(torch.stack([lobes @ mean, lobes @ squared]))
    if not solid:
        raise LumigraphError("No probe sees any matter in that region; give --box where the scene is, or train longer")
    state = torch.where(torch.tensor(enclosed), MATTER, FREE)
    if cameras is not None:
        state[unseen(near, places, cameras) & (state == FREE)] = UNSEEN
    if not (state == FREE).any():
        raise LumigraphError(
            "All probes lie in matter or where no camera looks; give a finer --spacing or another --box"
        )
    mean, squared = torch.stack(moments, 1).view(2, len(places), MAP_SIDE, MAP_SIDE)
    unit = to_export.scale
    return ProbeGrid(
        to_export.points(first),
        unit * to_export.directions(torch.diag(steps)),
        counts,
        torch.stack(light),
        octahedral.bordered(unit * mean),
        octahedral.bordered(unit**2 * squared),
        state,
        unit * far,
        to_export.directions(torch.tensor([[0.0, 0.0, 1.0]]))[0],
    )


def nearby(method: Method) -> Method:
    """The method with near distance 0, so that a probe sees close surfaces."""
    if not can(method, HasLooks):
        return method
    return compose(method.frame, [Placed(method, Similarity.make(1.0))]).to(method.device)


def cube_camera(place: Float[Tensor, " 3"], face: Float[Tensor, "3 3"], size: int) -> Camera:
    """The camera of one face of the cube around a place."""
    pose = torch.cat([face, place[:, None]], -1)[None]
    lens = Pinhole(torch.full((1, 2), size / 2), torch.full((1, 2), size / 2))
    return Camera(pose, lens, torch.full((1, 2), size))


def octahedral_lobes(directions: Float[Tensor, "ray 3"], angles: Float[Tensor, " ray"]) -> Float[Tensor, "texel ray"]:
    """Shares of rays in each texel: a cosine lobe times the solid angle, of sum 1."""
    cosine = octahedral.texel_directions(MAP_SIDE) @ directions.T
    weight = cosine.clamp_min(0) ** DEPTH_SHARPNESS * angles
    return weight / weight.sum(-1, keepdim=True)


def unseen(method: Method, places: Float[Tensor, "probe 3"], cameras: Camera) -> Tensor:
    """Mask of positions occluded in all cameras whose pictures contain them."""
    maps = render_depth_maps(method.render, cameras, method.frame.background)
    return hidden(places, maps, SEEN_TOLERANCE) & in_pictures(places, maps)


def in_pictures(places: Float[Tensor, "probe 3"], maps: Sequence[DepthMap]) -> Tensor:
    """Mask of positions inside some picture, occluded or not."""
    found = torch.zeros(len(places), dtype=torch.bool)
    for seen in maps:
        pixels, valid, _ = seen.project(places)
        found |= seen.inside(pixels, valid)
    return found
