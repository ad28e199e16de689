"""A single image file as a scene: a picture on a wall, and a frontal camera that sees exactly that picture.

The camera has two shots, one masked to training pixels, the other to held-out ones: a random half. So the held-out
pixels are scored like any held-out view.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from ..camera import Camera
from ..camera.lens import Pinhole
from ..datasets.scene import Photograph
from ..errors import LumigraphError
from .capture import Capture, Shot
from .pictures import IMAGE_SUFFIXES, check_downscale, read_image, reduced, upright_size

DEFAULT_MAX_SIDE = 512  # pixels of the longer side of the picture
MIN_SIDE = 16  # pixels; the windows of SSIM are 11 wide
CAMERA_DISTANCE = 2.0  # where the longer side of the picture is 2
BOX_THICKNESS = 0.05  # of the box around the picture
# Right is +x, down is -z, forward is +y.
CAMERA_POSE = np.array([[1.0, 0, 0, 0], [0, 0, 1, -CAMERA_DISTANCE], [0, -1, 0, 0]])
SPLIT_SEED = 0  # of the held-out pixels


def recognises(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES


def read(path: Path, downscale: int | None = None) -> Capture:
    """The picture in the plane y = 0, upright, centred at the origin, its longer side from -1 to 1.

    downscale: how many times to reduce it; None reduces to at most 512 pixels
    Raises LumigraphError for files that are no image and for pictures that are very small.
    """
    check_downscale(downscale)
    whole = upright_size({1: path})
    size = width, height = reduced(whole, downscale or math.ceil(max(whole) / DEFAULT_MAX_SIDE))
    if min(size) < MIN_SIDE:
        raise LumigraphError(
            f"{path} is {width}x{height} pixels to learn from, and {MIN_SIDE} a side are the least; "
            f"name a larger picture{' or a smaller --downscale' if size != whole else ''}"
        )
    pixels = read_image(path, True, size)
    held_out = np.random.default_rng(SPLIT_SEED).permutation(width * height).reshape(height, width) % 2 == 1
    longest = max(size)
    lens = Pinhole(torch.full((1, 2), CAMERA_DISTANCE * longest / 2), torch.tensor([[width / 2, height / 2]]))
    shots = [
        Shot(name, CAMERA_POSE, lens, size, pixels, mask, split=split)
        for name, split, mask in (("held-out", "test", held_out), ("learnt", "train", ~held_out))
    ]
    corner = (width / longest, BOX_THICKNESS, height / longest)
    return Capture(str(path), shots, bounds=((-corner[0], -corner[1], -corner[2]), corner), reach=1.0)


def photograph(path: Path) -> Photograph:
    """The picture with its alpha and a frontal camera, as evidence for a prior."""
    shot = read(path).shots[0]
    assert isinstance(shot.image, np.ndarray)
    pixels = torch.from_numpy(shot.image.astype(np.float32) / 255)
    height, width = pixels.shape[:2]
    camera = Camera(torch.from_numpy(CAMERA_POSE).float()[None], shot.lens, torch.tensor([[width, height]]))
    return Photograph(camera, pixels[..., :3], pixels[..., 3] if pixels.shape[-1] == 4 else None)
