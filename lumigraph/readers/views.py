"""Scenes with other training photographs: fewer, for few-view experiments; all; or all at several sizes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..camera import Camera
from ..datasets.images import ImageSource, LayerSource, load
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..metrics import WINDOW


def with_fewer_views(scene: Scene, views: int) -> Scene:
    """The scene with `views` photographs in its "train" split, spread evenly over the cameras; see `spread_out`.

    Held-out photographs, sparse points, and the frame except `train_count` stay those of all photographs, so that
    scores can be compared. Raises LumigraphError for fewer than one, and for more than there are.
    """
    train = scene.splits["train"]
    if not 1 <= views <= len(train):
        raise LumigraphError(
            f"{scene.source} has {len(train)} photographs to learn from, so --views cannot be {views}; "
            f"give a number from 1 to {len(train)}"
        )
    kept = spread_out(scene.cameras[train])[:views].sort().values
    return with_train(scene, train[kept])


def with_all_views(scene: Scene) -> Scene:
    """The scene with every photograph in its "train" split, test photographs included."""
    return with_train(scene, torch.arange(len(scene.cameras)))


def with_train(scene: Scene, train: Int[Tensor, " image"]) -> Scene:
    """The scene with these training photographs."""
    frame = replace(scene.frame, train_count=len(train))
    return replace(scene, frame=frame, splits=scene.splits | {"train": train})


def spread_out(cameras: Camera) -> Int[Tensor, " camera"]:
    """Order of cameras by farthest-point sampling, every prefix of which is spread evenly (Gonzalez 1985).

    The first is the one nearest the mean. Distance is that of `pose_points`. Among equals the first comes first.
    """
    points = pose_points(cameras)
    order = [int(distances(points, points.mean(0)).argmin())]
    nearest = distances(points, points[order[0]])
    while len(order) < len(points):
        nearest[order[-1]] = -1.0  # taken, and no further for any other at the same place
        order.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, distances(points, points[order[-1]]))
    return torch.tensor(order)


def pose_points(cameras: Camera) -> Float[Tensor, "camera 6"]:
    """Positions, in units of their deviation, and viewing directions of cameras, between which distances are taken."""
    position, direction = cameras.position, cameras.pose[:, :, 2]
    centred = position - position.mean(0)
    deviation = centred.square().sum(-1).mean().sqrt().clamp_min(1e-9)
    return torch.cat([centred / deviation, direction], -1)


def distances(points: Float[Tensor, "point axis"], origin: Float[Tensor, " axis"]) -> Float[Tensor, " point"]:
    return (points - origin).norm(dim=-1)


def multiscale(scene: Scene, scales: int, memory: int | None = None, cache: Path | None = None) -> Scene:
    """The scene with every photograph `scales` times, each half as large as the previous one, as if taken from further
    away (Barron 2021, Mip-NeRF, section 4.1: trained on and tested together).

    Copies are means over squares of pixels, colours weighted by alpha; incomplete squares are cropped. They are called
    NAME@1/2, NAME@1/4 and so on, share their photograph's split and image index, and follow after all originals. Frame
    and points stay. Layers follow as in `resized`.

    The paper weights each pixel's loss by its footprint. `Scene.sample_rays` samples photographs uniformly, and their
    pixels uniformly, so that a pixel of a copy reduced f times is sampled f^2 times as often: the same in expectation,
    with less variance.
    memory, cache: as in `open_scene`
    Raises LumigraphError if the smallest copies are too small to compare, or have no trusted pixel.
    """
    if scales == 1:
        return scene
    shortest = int(scene.cameras.size.min())
    most = max((shortest // WINDOW).bit_length(), 1)
    if not 1 <= scales <= most:
        raise LumigraphError(
            f"{scene.source} cannot be had at {scales} scales, for each halves the last and {WINDOW} pixels are the "
            f"least; give --scales a number from 1 to {most}"
        )
    count, factors = len(scene), [2**k for k in range(scales)]
    names = [name if f == 1 else f"{name}@1/{f}" for f in factors for name in scene.names]
    sizes = torch.cat([scene.cameras.size // f for f in factors]).tolist()
    copies = [(i, f) for f in factors for i in range(count)]
    pictures = [
        ImageSource((width, height), partial(reduced, scene, i, f))
        for (i, f), (width, height) in zip(copies, sizes, strict=True)
    ]
    images = load(pictures, memory, cache)
    for name, pixels in zip(names, images.trusted_pixels.tolist(), strict=True):
        if not pixels:
            raise LumigraphError(
                f"{scene.source}: the mask trusts no whole pixel of {name}; give a smaller number of --scales"
            )
    splits = {split: torch.cat([index + k * count for k in range(scales)]) for split, index in scene.splits.items()}
    cameras = Camera.cat([scene.cameras.reduced(f) for f in factors])
    layers = {
        name: layer.like(images, [LayerSource(partial(layer.reduced, i, f)) for i, f in copies])
        for name, layer in scene.layers.items()
    }
    about = {name: torch.cat([values] * scales) for name, values in scene.about.items()}
    scene = replace(scene, digests=scene.digests * scales, layers=layers, about=about)
    return replace(scene, cameras=cameras, images=images, splits=splits, names=names)


def reduced(scene: Scene, index: int, factor: int) -> tuple[np.ndarray, np.ndarray | None]:
    """A photograph's bytes reduced by a factor, and a mask of trusted pixels."""
    photograph = scene.photograph(index).reduced(factor)
    channels = [photograph.rgb] if photograph.alpha is None else [photograph.rgb, photograph.alpha[..., None]]
    pixels = torch.cat(channels, -1).mul(255).round().clamp(0, 255).byte().numpy()
    return pixels, None if photograph.mask is None else photograph.mask.numpy()
