"""References for a compressed run: its photographs where available, else renderings of the original."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8

from ...camera import Camera
from ...camera.rays import Rendering
from ...datasets.images import ImageStore
from ...datasets.scene import Scene
from ...errors import LumigraphError
from ...evaluation import evaluate
from ...geometry import evenly
from ...method import Method
from ...run import Run
from ...system.progress import track
from ...training.verdict import last_psnr

RENDERED_VIEWS = 40  # renderings in place of photographs, evenly spread
DEFAULT_PSNR = 30.0  # dB of a run without a recorded training PSNR


@dataclass(frozen=True)
class Truth:
    """References for tuning and for comparison.

    photographed: whether these are photographs; renderings of the run before it was compressed otherwise
    error:        mean squared error of the run before, on the photographs that it has learnt
    """

    scene: Scene
    photographed: bool
    error: float

    def loss(self, method: Method, views: int) -> float:
        """dB that a method has lost on photographs it has learnt. Where renderings stand in for them, errors that know
        nothing of each other are taken to add up."""
        error = squared_error(method, self.scene, "train", views)
        return decibels(error if self.photographed else self.error + error) * -1 + decibels(self.error)


def truth_of(run: Run, method: Method, source: str | None, views: int) -> Truth:
    """The run's photographs; where they cannot be opened, and no other place is named, its own renderings."""
    try:
        scene = run.scene(source)
        return Truth(scene, True, squared_error(method, scene, "train", views))
    except LumigraphError:
        if source is not None:
            raise
    learnt = last_psnr(run.metrics())
    return Truth(rendered(run, method), False, 10 ** (-(DEFAULT_PSNR if learnt is None else learnt) / 10))


def squared_error(method: Method, scene: Scene, split: str, views: int) -> float:
    """Mean over views of what their PSNR is the logarithm of, so that errors can be added."""
    return 10 ** (-evaluate(method, scene, split, views=views).psnr / 10)


def decibels(error: float) -> float:
    return -10 * math.log10(max(error, 1e-12))


def rendered(run: Run, method: Method) -> Scene:
    """A Scene whose photographs are what a method shows from where they were taken."""
    cameras = run.cameras()
    some = {split: evenly(range(len(own)), RENDERED_VIEWS) for split, own in cameras.items() if len(own)}
    chosen = [cameras[split][i] for split, index in some.items() for i in index]
    counts = torch.tensor([0, *(len(index) for index in some.values())]).cumsum(0).tolist()
    splits = {
        split: torch.arange(*pair) for split, pair in zip(some, zip(counts, counts[1:], strict=False), strict=True)
    }
    splits.setdefault("test", splits["train"])
    frame = run.frame
    pictures = [
        bytes_of(method.render(camera).cpu(), frame.background if frame.has_alpha else None)
        for camera in track(chosen, "Rendering what there is to keep", len(chosen))
    ]
    images, names = ImageStore.from_arrays(pictures), [f"{i:03d}" for i in range(len(chosen))]
    return Scene(Camera.cat(chosen), images, frame, splits, names, f"renderings of {run.folder}")


def bytes_of(
    seen: Rendering, background: tuple[float, float, float] | None
) -> UInt8[np.ndarray, "height width channel"]:
    """A rendering as a photograph; with straight alpha, where a background was behind it."""
    rgb, alpha = seen.rgb, seen.opacity[..., None].clamp(0, 1)
    if background is not None:
        own = (rgb - (1 - alpha) * torch.tensor(background)) / alpha.clamp_min(1e-3)
        rgb = torch.cat([own, alpha], -1)
    return (255 * rgb.clamp(0, 1)).round().byte().numpy()
