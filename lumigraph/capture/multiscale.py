"""A scene at several resolutions at once, as if some of its photographs had been taken from further away.

Barron 2021 (Mip-NeRF), section 4.1: full, half, quarter and eighth resolution, trained on and tested together.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ..camera import Camera
from ..datasets.images import ImageSource, LayerSource, load
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..metrics import WINDOW


def multiscale(scene: Scene, scales: int, memory: int | None = None, cache: Path | None = None) -> Scene:
    """The scene with every photograph `scales` times, each half as large as the one before.

    Copies are means over squares of pixels, colours weighted by alpha; rows and columns that fill no square are left
    out. They are called NAME@1/2, NAME@1/4 and so on, share their photograph's split and image index, and follow behind
    all photographs as they are. Frame and points stay. Layers follow, as `resized` has it.

    The paper weights each pixel's loss by its footprint. `Scene.sample_rays` draws photographs evenly, and their pixels
    evenly, so that a pixel of a copy reduced f times is drawn f^2 times as often: the same in expectation, with less
    variance.
    memory, cache: as in `open_scene`
    Raises LumigraphError where the smallest copies would be too small to compare, or trust no pixel.
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
    cameras = Camera.cat([smaller(scene.cameras, f) for f in factors])
    layers = {
        name: layer.like(images, [LayerSource(partial(layer.reduced, i, f)) for i, f in copies])
        for name, layer in scene.layers.items()
    }
    about = {name: torch.cat([values] * scales) for name, values in scene.about.items()}
    return replace(scene, cameras=cameras, images=images, splits=splits, names=names, layers=layers, about=about)


def reduced(scene: Scene, index: int, factor: int) -> tuple[np.ndarray, np.ndarray | None]:
    """A photograph's bytes so many times smaller, and which of them to trust."""
    photograph = scene.photograph(index).reduced(factor)
    channels = [photograph.rgb] if photograph.alpha is None else [photograph.rgb, photograph.alpha[..., None]]
    pixels = torch.cat(channels, -1).mul(255).round().clamp(0, 255).byte().numpy()
    return pixels, None if photograph.mask is None else photograph.mask.numpy()


def smaller(cameras: Camera, factor: int) -> Camera:
    """The cameras of pictures reduced a whole number of times, as `Photograph.reduced` does."""
    scale = torch.full((1, 2), 1 / factor)
    return replace(cameras, lens=cameras.lens.resized(scale), size=cameras.size // factor)
