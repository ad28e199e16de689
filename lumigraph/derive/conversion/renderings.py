"""Training pictures for a student without photographs: renderings of its teacher, as a Scene."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from ...camera import Camera
from ...datasets.images import ImageStore
from ...datasets.scene import Scene
from ...geometry import evenly, look_at
from ...method import Method
from ...system.progress import track
from ..compression.measure import bytes_of

MAX_VIEWS, MIN_VIEWS = 80, 8  # pictures, and however short the time
MAX_SIDE = 400  # pixels of their longer side
NEIGHBOUR_SHARE = 1 / 3  # position of an additional camera, as a share of the way to the nearest neighbour


@torch.no_grad()
def rendered_scene(teacher: Method, cameras: Camera, source: str, seconds: float) -> Scene:
    """A Scene whose photographs are what a teacher shows from its cameras, and from others between them.

    seconds: that rendering may take, about
    """
    some = evenly(range(len(cameras)), MAX_VIEWS // 2)
    own = Camera.cat([cameras[i] for i in some])
    both = own if len(own) < 2 else Camera.cat([own, between(own)])
    both = both.resized(min(1.0, MAX_SIDE / int(both.size.max())))
    affordable = MAX_VIEWS if seconds == float("inf") else int(seconds / seconds_of_one(teacher, both[0]))
    chosen = evenly(range(len(both)), max(affordable, MIN_VIEWS))
    frame, pictures = teacher.frame, []
    for i in track(chosen, "Rendering what to learn from", len(chosen)):
        pictures.append(bytes_of(teacher.render(both[i]).cpu(), frame.background if frame.has_alpha else None))
    index = torch.arange(len(chosen))
    names = [f"{i:03d}" for i in chosen]
    return Scene(both[torch.tensor(chosen)], ImageStore.from_arrays(pictures), frame, {"train": index}, names, source)


def between(cameras: Camera) -> Camera:
    """For each camera another one on the way to its nearest neighbour, which looks in between as well."""
    apart = torch.cdist(cameras.position, cameras.position).fill_diagonal_(torch.inf)
    other = apart.argmin(-1)

    def mixed(values: torch.Tensor) -> torch.Tensor:
        return torch.lerp(values, values[other], NEIGHBOUR_SHARE)

    pose = look_at(mixed(cameras.position), mixed(cameras.forward), -mixed(cameras.pose[:, :, 1]))
    return replace(cameras, pose=pose)


def seconds_of_one(teacher: Method, camera: Camera) -> float:
    """Seconds per rendered picture, without compilation of kernels."""
    teacher.render(camera.resized(min(1.0, 32 / int(camera.size.max()))))
    begin = time.perf_counter()
    teacher.render(camera)
    return max(time.perf_counter() - begin, 1e-6)
