"""3-D photographs: neighbouring photographs as one layered panorama with depth, and as a textured mesh of two layers
(Hedman et al. 2017, Casual 3D Photography; Hedman and Kopf 2018, Instant 3D Photography).

Depth maps are made dense, warped into one panorama at their centre, and stitched: each pixel takes one photograph. A
second layer fills disocclusions: seen by other photographs, or extrapolated.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from ...camera import Camera
from ...camera.lens import Equirectangular
from ...datasets.mesh import Mesh, MeshTexture
from ...datasets.scene import Scene
from ...depth_maps import DepthMap
from ...depth_maps.multi_view import multi_view_depth
from ...errors import LumigraphError
from ...geometry import evenly
from ...paths.opening import Opening
from ...system.progress import track
from ..mesh_file import write_mesh
from ..options import Photo3DOptions
from ..page import mesh_page
from .layers import background, mesh_of, texture_of
from .stitching import dense_inverse_depth, drawn, exposures, stitched

MIN_PARALLAX = 0.004  # of the distance between photographs to the median depth; below it there is one place
MIN_SURE = 0.02  # share of pixels of sure depth, below which photographs have no parallax
MARGIN = 0.002  # of the panorama's angles, cut off where single rays of photographs reach farther
MAX_SIDE = 520  # pixels of a panorama, so that a page stays below ten megabytes
MAX_LATITUDE = 80.0  # degrees
TEXELS = 2  # of the texture along each side of a pixel of the panorama
ZOOM = 0.85  # of a page's angle of view to a photograph's, so that borders stay outside
NEAR_SHARE, FAR_SHARE = 0.02, 100.0  # of the distance to the focus: what a page draws
MAX_REACH = 0.15  # of a page's camera from the middle: share of its distance to the focus; farther, edges open wide


@dataclass(frozen=True)
class Photo3D:
    """A 3-D photograph in the scene's frame.

    camera: of the panorama: an Equirectangular lens over what the photographs show
    mesh:   textured, two layers one behind the other; one layer at a constant distance where there is no parallax
    focus:  point that a page's camera looks at; reach: how far that camera moves aside
    angle:  of view, degrees, of the typical photograph's smaller side
    trusted: share of the panorama whose depth neighbours confirmed
    flat:   whether the photographs have no parallax
    """

    camera: Camera
    mesh: Mesh
    focus: Float[Tensor, " 3"]
    reach: float
    angle: float
    trusted: float
    flat: bool


def export_photo3d(scene: Scene, path: Path, title: str, options: Photo3DOptions = Photo3DOptions()) -> Photo3D:
    """Write a 3-D photograph as a page (.html) or a textured mesh (.glb). title: of a page whose options have none"""
    found = photo3d(scene, options)
    if path.suffix.lower() == ".html":
        write_page(path, found, options.title or title)
    else:
        up = scene.frame.to_source.rotation[:, 2].numpy()
        write_mesh(path, found.mesh.in_source(scene.frame), up, origin=scene.frame.origin if options.origin else None)
    return found


@torch.no_grad()
def photo3d(scene: Scene, options: Photo3DOptions = Photo3DOptions()) -> Photo3D:
    """A 3-D photograph of the training photographs."""
    numbers = evenly(scene.splits["train"].tolist(), options.views)
    if len(numbers) < 2:
        raise LumigraphError(
            f"{scene.source} has one photograph; a 3-D photograph needs two or more, beside each other"
        )
    maps = depth_of(scene, numbers, options.size)
    positions = torch.cat([seen.camera.position for seen in maps])
    sure = torch.cat([seen.depth[seen.solid] for seen in maps])
    spread = float((positions - positions.mean(0)).norm(dim=-1).max())
    share = sum(float(seen.solid.float().mean()) for seen in maps) / len(maps)
    distance = float(sure.median()) if len(sure) else scene.frame.near * 4
    flat = share < MIN_SURE or 2 * spread < MIN_PARALLAX * distance
    blind = [scene.names[number] for number, seen in zip(numbers, maps, strict=True) if not seen.solid.any()]
    if flat:
        inverse = [torch.full_like(seen.depth, 1 / distance) for seen in maps]
    elif blind:
        raise LumigraphError(
            f"{scene.source}: {', '.join(blind)} shares too little with the others for any depth; a 3-D photograph "
            "needs neighbouring photographs, so name a folder of those alone, or train a method for a walk around"
        )
    else:
        inverse = [dense_inverse_depth(seen) for seen in track(maps, "Filling depth", len(maps))]
    camera = panorama_camera(maps)
    gains = exposures(maps, inverse)
    layers = [drawn(seen, each, gain, camera) for seen, each, gain in zip(maps, inverse, gains, strict=True)]
    front, label = stitched(layers, camera)
    back = None if flat else background(front, layers)
    pictures = [scene.photograph(number) for number in numbers]
    colours = texture_of(front, back, label, pictures, gains, camera, TEXELS)
    vertices, faces, uv = mesh_of(front, back, camera)
    mesh = Mesh(vertices, faces, np.zeros((len(vertices), 3), np.uint8), MeshTexture(uv, colours))
    forward = camera.pose[0, :, 2]
    focus = camera.position[0] + front.depth[front.known].median() * forward
    height = scene.cameras[numbers[0]]
    reach = min(spread, MAX_REACH * float((focus - camera.position[0]).norm()))
    return Photo3D(camera, mesh, focus, reach, angle_of(height), share, flat)


def write_page(path: Path, photo: Photo3D, title: str) -> None:
    """A page whose camera follows the pointer or a phone's tilt, as far aside as the photographs were taken."""
    position, focus = photo.camera.position[0], photo.focus
    away = float((focus - position).norm())
    opening = Opening(
        title,
        background=(0.0, 0.0, 0.0),
        position=tuple(position.tolist()),
        target=tuple(focus.tolist()),
        angle=ZOOM * photo.angle,
        near=NEAR_SHARE * away,
        far=FAR_SHARE * away,
        nearest=away / 2,
        farthest=2 * away,
        lowest=178.0,
        inward=True,
    )
    mesh_page(path, photo.mesh, opening, photo.reach)


def depth_of(scene: Scene, numbers: list[int], size: int) -> list[DepthMap]:
    """Depth maps of photographs: measured ones if the scene has them, else by multi-view stereo."""
    if "depth" not in scene.layers:
        splits = scene.splits | {"train": torch.tensor(numbers)}
        return multi_view_depth(replace(scene, splits=splits), size)
    maps = []
    for number in numbers:
        photograph = scene.photograph(number, ["depth"])
        small = photograph.reduced(max(1, round(max(photograph.rgb.shape[:2]) / size)))
        maps.append(DepthMap.measured(small.camera, small.extra["depth"], small.rgb))
    return maps


def panorama_camera(maps: list[DepthMap]) -> Camera:
    """Camera at the photographs' centre with their common view and resolution."""
    poses = torch.cat([seen.camera.pose for seen in maps])
    place = poses[:, :, 3].mean(0)
    forward = normalize(poses[:, :, 2].sum(0), dim=0)
    down = poses[:, :, 1].sum(0)
    down = normalize(down - (down @ forward) * forward, dim=0)
    pose = torch.stack([torch.linalg.cross(down, forward), down, forward, place], 1)
    longitudes, latitudes, angles = [], [], []
    for seen in maps:
        pixels = seen.camera.pixels()
        directions = seen.camera.rays(pixels).directions @ pose[:, :3]
        longitudes.append(torch.atan2(directions[:, 0], directions[:, 2]))
        latitudes.append(torch.asin(directions[:, 1].clamp(-1, 1)))
        lens = seen.camera.lens
        angles.append(float(lens.solid_angle(pixels, lens.unproject(pixels)).median().sqrt()))
    step = float(np.median(angles))
    ends = torch.tensor([MARGIN, 1 - MARGIN])
    left, right = torch.cat([x[:: max(1, len(x) // 50_000)] for x in longitudes]).quantile(ends).tolist()
    top, bottom = torch.cat([x[:: max(1, len(x) // 50_000)] for x in latitudes]).quantile(ends).tolist()
    limit = float(np.radians(MAX_LATITUDE))
    top, bottom = max(top, -limit), min(bottom, limit)
    step = max(step, max(right - left, bottom - top) / MAX_SIDE)
    width, height = int((right - left) / step) + 1, int((bottom - top) / step) + 1
    whole = torch.tensor([[2 * np.pi / step, np.pi / step]], dtype=torch.float32)
    lens = Equirectangular(whole, torch.tensor([[-left / step, -top / step]], dtype=torch.float32))
    return Camera(pose[None], lens, torch.tensor([[width, height]]))


def angle_of(camera: Camera) -> float:
    """Degrees that a photograph shows along its smaller side."""
    width, height = camera.size[0].tolist()
    middle = torch.tensor(
        [[0.0, height / 2], [width, height / 2]] if width < height else [[width / 2, 0], [width / 2, height]]
    )
    directions = normalize(camera.lens.unproject(middle), dim=-1)
    return float(torch.rad2deg((directions[0] @ directions[1]).clamp(-1, 1).acos()))
