"""Photographs with their poses, and the picture at the end. This is the only file here that uses the large house."""

import os
from pathlib import Path

import torch
from jaxtyping import Float, Num
from PIL import Image
from torch import Tensor

import lumigraph

SCENE = "procedural:still-life,size=128,views=40"  # wooden toys on a turntable, ray-traced once, then kept
BOX = torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]])  # two corners of the box that holds them, scene units
NEAR, FAR = 2.2, 5.0  # distances from the cameras between which the box lies, scene units

Images = Float[Tensor, "image height width 3"]
Poses = Float[Tensor, "image 3 4"]


def photographs(split: str = "train", source: str = SCENE) -> tuple[Images, Poses, float]:
    """Photographs before white (sRGB in [0, 1]), camera-to-world poses, and the focal length in pixels."""
    scene = lumigraph.open_scene(source)
    shots = [scene.photograph(i) for i in scene.splits[split].tolist()]
    images = torch.stack([shot.before(torch.ones(3)) for shot in shots])
    return images, torch.cat([shot.camera.pose for shot in shots]), float(scene.cameras.lens.focal[0, 0])


def layer(name: str, split: str = "train", source: str = SCENE) -> Num[Tensor, "image height width"]:
    """A further value of each pixel, such as "depth": the distance along its ray, infinite where nothing is."""
    scene = lumigraph.open_scene(source)
    return torch.stack([scene.photograph(i, [name]).extra[name] for i in scene.splits[split].tolist()])


def times(split: str = "train", source: str = SCENE) -> Float[Tensor, " image"]:
    """Time of each photograph, in [0, 1]."""
    scene = lumigraph.open_scene(source)
    return torch.cat([scene.photograph(i).camera.time for i in scene.splits[split].tolist()])


def psnr(picture: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in decibels: -10 log10 of the mean squared error."""
    return float(-10 * (picture - truth).square().mean().log10())


def save(name: str, *pictures: Float[Tensor, "height _ 3"]) -> None:
    """Write pictures side by side into `reading-NAME.png` of the present folder."""
    strip = torch.cat([picture.detach().clamp(0, 1) for picture in pictures], 1)
    path, shown = Path(f"reading-{name}.png"), Image.fromarray((255 * strip).round().byte().numpy())
    scale = max(1, 256 // shown.height)
    shown.resize((scale * shown.width, scale * shown.height), Image.Resampling.BICUBIC).save(f"{path}.part", "png")
    os.replace(f"{path}.part", path)  # whole or not at all
    print(f"{path.resolve()}")
