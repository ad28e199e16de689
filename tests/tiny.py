"""A scene of twelve small pictures and a method that learns it in seconds, for tests of what lies around them."""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import lumigraph.methods
from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.datasets.images import ImageStore, Layer, LayerSource
from lumigraph.datasets.scene import Frame, Scene
from lumigraph.datasets.skeleton import BonePose, Skeleton
from lumigraph.datasets.tracks import BoxTrack
from lumigraph.run import Run, build

SIZE, FOCAL, DISTANCE = 24, 32.0, 3.0
# Boxes around a half and a quarter of the ball, for methods that need some.
HALF, QUARTER = ("half", (0.7, 1.3, 1.3), (0.35, 0.0, 0.0)), ("quarter", (0.7, 0.65, 1.3), (-0.35, 0.33, 0.0))
TRACKS = tuple(
    BoxTrack(name, "piece", size, (0.0,), (place,), ((1.0, 0.0, 0.0, 0.0),)) for name, size, place in (HALF, QUARTER)
)
# Two bones through the ball, of which the upper one bends, for methods of bodies.
JOINTS, STRAIGHT = ((0.0, 0.0, -0.4), (0.0, 0.0, 0.0)), (1.0, 0.0, 0.0, 0.0)
REST, POSE = BonePose(JOINTS, (STRAIGHT, (0.98, 0.2, 0.0, 0.0))), BonePose(JOINTS, (STRAIGHT,) * 2)
SKELETON = Skeleton(("lower", "upper"), (-1, 0), REST, (0.0,), (POSE,))

# What a user would do by putting a file into lumigraph/methods/.
if (folder := str(Path(__file__).parent / "methods")) not in lumigraph.methods.__path__:
    lumigraph.methods.__path__.append(folder)


# What is learnt from, by kind: the module and the function that make the smallest there is.
DATASETS = {
    "Scene": ("tiny", "scene"),
    "Shapes": ("tiny_shapes", "shapes"),
    "Collection": ("tiny_collection", "collection"),
    "BlockWorld": ("tiny_world", "world"),
    "Words": ("tiny_words", "words"),
}


def dataset(kind: type) -> Any:
    """The smallest dataset of a kind."""
    module, function = DATASETS[kind.__name__]
    return getattr(importlib.import_module(module), function)()


def poses(count: int = 12) -> torch.Tensor:
    """Cameras around the origin, looking at it, z upwards."""
    angle = torch.arange(count) * (2 * math.pi / count)
    height = 0.4 + 0.3 * torch.sin(3 * angle)
    out = torch.stack([height.cos() * angle.cos(), height.cos() * angle.sin(), height.sin()], -1)
    right = torch.stack([-angle.sin(), angle.cos(), 0 * angle], -1)
    return torch.stack([right, torch.linalg.cross(-out, right), -out, DISTANCE * out], -1)


def ball(pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Depth along the pixels' rays of a ball of radius 0.6, infinite beside it, and where they meet it."""
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    directions = torch.stack([(x - SIZE / 2) / FOCAL, (y - SIZE / 2) / FOCAL, torch.ones_like(x)], -1)
    directions = torch.nn.functional.normalize(directions, dim=-1) @ pose[:, :3].T
    origin = pose[:, 3]
    b = directions @ origin
    under = b * b - (origin @ origin - 0.36)
    depth = -b - under.clamp_min(0).sqrt()
    return torch.where(under > 0, depth, torch.inf), origin + depth[..., None] * directions


def picture(pose: torch.Tensor) -> np.ndarray:
    """The ball, whose colour is where its surface points; RGBA bytes."""
    depth, surface = ball(pose)
    rgba = torch.cat([0.5 + surface / 1.2, torch.ones(SIZE, SIZE, 1)], -1) * depth.isfinite()[..., None]
    return (rgba.clamp(0, 1) * 255).byte().numpy()


def scene(count: int = 12) -> Scene:
    """Nobody may change it; what tests change is a copy, by `replace`."""
    return made(count, SIZE, FOCAL)


@cache
def made(count: int, size: int, focal: float) -> Scene:
    pose, index = poses(count), torch.arange(count)
    lens = Pinhole(torch.full((count, 2), focal), torch.full((count, 2), size / 2))
    cameras = Camera(pose, lens, torch.full((count, 2), size), image_index=index)
    frame = Frame(near=0.1, background=(1.0, 1.0, 1.0), has_alpha=True, image_count=count, tracks=TRACKS)
    frame = replace(frame, skeleton=SKELETON)
    splits = {"train": index[index % 4 != 0], "test": index[index % 4 == 0]}
    images = ImageStore.from_arrays([picture(p) for p in pose])
    planes = [LayerSource(partial(lambda p: ball(p)[0].numpy(), p)) for p in pose]
    depth = Layer(images, planes, np.dtype(np.float32), 1, "distance")
    names = [f"ball_{i}" for i in range(count)]
    return Scene(cameras, images, frame, splits, names, "in memory", layers={"depth": depth})


@cache
def stranger() -> Scene:
    """A scene that no method is developed with: three photographs in different light before an opaque far background;
    depth with two of three columns unknown."""
    known, random = scene(), np.random.default_rng(0)
    gains = random.uniform(0.4, 1.2, 3)
    pictures = [(known.images[i].numpy()[..., :3] * np.roll(gains, i % 3)).astype(np.uint8) for i in range(len(known))]
    images = ImageStore.from_arrays(pictures)
    holes = np.where(np.arange(SIZE) % 3 == 1, 1.0, np.nan).astype(np.float32)
    planes = [LayerSource(partial(lambda p: ball(p)[0].numpy() * holes, p)) for p in known.cameras.pose]
    depth = Layer(images, planes, np.dtype(np.float32), 1, "distance")
    frame = replace(known.frame, has_alpha=False, background=(0.0, 0.0, 0.0), reach=64.0, near=0.01, train_count=3)
    splits = known.splits | {"train": known.splits["train"][[0, 4, 8]]}
    return replace(known, images=images, frame=frame, splits=splits, layers={"depth": depth})


def method(frame: Frame | None = None, seed: int = 0, **config):
    kind = lumigraph.methods.find("voxel-grid")
    return build(kind, frame or scene().frame, kind.Config(**config), torch.device("cpu"), seed)


def new_run(folder: Path, **config) -> Run:
    made = scene()
    return Run.create(folder, method(made.frame, **config), made)


def write_blender(folder: Path, count: int = 12) -> Path:
    """The same scene as files, in the layout of the Blender data sets."""
    folder.mkdir(parents=True)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    for split in ("train", "test"):
        frames = []
        for i, pose in enumerate(poses(count)):
            if (i % 4 == 0) != (split == "test"):
                continue
            Image.fromarray(picture(pose)).save(folder / f"{split}_{i}.png")
            matrix = torch.eye(4)
            matrix[:3] = torch.cat([pose[:, :3] @ flip, pose[:, 3:]], 1)
            frames.append({"file_path": f"./{split}_{i}", "transform_matrix": matrix.tolist()})
        about = {"camera_angle_x": 2 * math.atan(SIZE / 2 / FOCAL), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(about))
    return folder
