"""Perspective views of 360-degree panoramas with poses, so that every method can train on them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import grid_sample

from ..camera.lens import Equirectangular
from ..files import replacing
from ..readers.pictures import stem
from ..system.library import pycolmap
from .folder import MASKS, remove_copies
from .lenses import MODEL
from .photos import Photo
from .photos.copies import save
from .photos.photo import Track

# Right, down and forward of each view in the panorama's axes. Straight down is left out: whoever carries the camera
# is there.
TURNS = {
    name: np.stack([np.cross(down, forward), down, forward], -1).astype(np.float64)
    for name, down, forward in (
        ("front", (0, 1, 0), (0, 0, 1)),
        ("right", (0, 1, 0), (1, 0, 0)),
        ("back", (0, 1, 0), (0, 0, -1)),
        ("left", (0, 1, 0), (-1, 0, 0)),
        ("up", (0, 0, 1), (0, -1, 0)),
    )
}


def side_of(width: int) -> int:
    """Side of a view in pixels, at the panorama's resolution in its centre."""
    return round(width / math.pi)


def views_of(photo: Photo) -> dict[str, str]:
    """Names of a panorama's views, by direction."""
    return {view: f"{stem(photo.name)}_{view}.jpg" for view in TURNS}


def flat_views(
    model: pycolmap.Reconstruction, photos: Sequence[Photo], scene: Path, masks: Path | None, track: Track
) -> tuple[pycolmap.Reconstruction, list[Photo]]:
    """Convert a model of panoramas to a model of perspective views of 90 degrees; write their pictures and masks to a
    scene's folder.

    masks: those of the panoramas, in COLMAP's layout
    """
    placed = {image.name for image in model.images.values() if image.has_pose}
    photos = [photo for photo in photos if photo.name in placed]
    written = [replace(photo, name=name) for photo in photos for name in views_of(photo).values()]
    remove_copies(scene / "images", {view.name for view in written})
    remove_copies(scene / MASKS, {f"{view.name}.png" for view in written})
    for photo in track(photos, "Cutting panoramas", len(photos)):
        for view, picture in cut(photo.path, "RGB").items():
            with replacing(scene / "images" / views_of(photo)[view], "capture") as partial:
                save(picture, partial, ".jpg")
        for view, picture in cut(masks / f"{photo.name}.png", "L").items() if masks and photo.mask else ():
            with replacing(scene / MASKS / f"{views_of(photo)[view]}.png", "capture") as partial:
                save(picture, partial, ".png")
    return flattened(model, photos), written


def cut(path: Path, mode: str) -> dict[str, Image.Image]:
    """Perspective views of a panorama, interpolated. mode: L or RGB"""
    with Image.open(path) as image:
        pixels = torch.from_numpy(np.array(image.convert(mode))).float()
    height, width = pixels.shape[:2]
    pixels = pixels.view(height, width, -1).permute(2, 0, 1)[None]
    around = torch.cat([pixels[..., -1:], pixels, pixels[..., :1]], -1)
    found = {}
    for view in TURNS:
        seen = grid_sample(around, directions(view, width, height), padding_mode="border", align_corners=False)[0]
        found[view] = Image.fromarray(seen.round().clamp(0, 255).byte().permute(1, 2, 0).squeeze(-1).numpy())
    return found


@lru_cache(len(TURNS))
def directions(view: str, width: int, height: int) -> Float[Tensor, "1 side side 2"]:
    """Coordinates of each pixel of a view, from -1 to 1, on a panorama padded by one column on both sides."""
    side = side_of(width)
    step = (torch.arange(side) + 0.5) * 2 / side - 1
    y, x = torch.meshgrid(step, step, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1).view(-1, 3) @ torch.from_numpy(TURNS[view]).float().T
    at, _ = Equirectangular(torch.tensor([[float(width), float(height)]])).project(rays)
    return (2 * (at + torch.tensor([1.0, 0.0])) / torch.tensor([width + 2.0, height]) - 1).view(1, side, side, 2)


def flattened(model: pycolmap.Reconstruction, photos: Sequence[Photo]) -> pycolmap.Reconstruction:
    """The cameras, features and points of a model of panoramas, with the views' common lens."""
    flat, width = pycolmap.Reconstruction(), photos[0].size[0]
    side, lens = side_of(width), Equirectangular(torch.tensor([photos[0].size], dtype=torch.float32))
    flat.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, MODEL, side / 2, side, side))
    by_name = {image.name: image for image in model.images.values() if image.has_pose}
    details: dict[tuple[int, int], tuple[int, int]] = {}  # a panorama and its detail; a view and its detail
    number = 0
    for photo in photos:
        image = by_name[photo.name]
        pixels = np.array([point.xy for point in image.points2D], np.float32).reshape(-1, 2)
        useful = np.array([point.has_point3D() for point in image.points2D], bool)
        rays = lens.unproject(torch.from_numpy(pixels)).double().numpy()
        for view, name in views_of(photo).items():
            number += 1
            x, y, z = (rays @ TURNS[view]).T
            inside = np.flatnonzero(useful & (z > np.abs(x)) & (z > np.abs(y)))
            details |= {(image.image_id, k): (number, i) for i, k in enumerate(inside.tolist())}
            at = (np.stack([x, y], -1)[inside] / z[inside, None] + 1) * side / 2
            turn = pycolmap.Rigid3d(pycolmap.Rotation3d(TURNS[view].T), np.zeros(3))
            flat.add_image_with_trivial_frame(
                pycolmap.Image(name=name, keypoints=at, camera_id=1, image_id=number), turn * image.cam_from_world()
            )
    for point in model.points3D.values():
        seen = [details.get((element.image_id, element.point2D_idx)) for element in point.track.elements]
        track = pycolmap.Track()
        for place in seen:
            if place is not None:
                track.add_element(*place)
        if track.length() > 1:
            flat.add_point3D(point.xyz, track, point.color)
    flat.update_point_3d_errors()
    return flat
