"""Compare two methods' renderings with each other and with the photographs, and their speed."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rendering
from ...datasets.scene import Scene
from ...evaluation import evaluate
from ...evaluation.views import warm_up
from ...geometry import evenly
from ...method import Method
from ...metrics import psnr
from ...system.progress import track


@dataclass(frozen=True)
class Shown:
    """A method's views by name, seconds for each, and their PSNR in dB where there are photographs."""

    views: dict[str, Tensor]
    seconds: float
    psnr: float | None


def shown(method: Method, scene: Scene | None, held_out: Camera, most: int) -> Shown:
    """At most so many held-out views of a method: those of a scene with photographs, or, without one, of cameras."""
    views: dict[str, Tensor] = {}

    def keep(name: str, seen: Rendering) -> None:
        views[name] = seen.rgb.clamp(0, 1).cpu()

    if scene is not None:
        split = "test" if len(scene.splits.get("test", ())) else "train"
        found = evaluate(method, scene, split, keep, min(most, len(scene.splits[split])))
        return Shown(views, found.seconds_per_view, found.psnr)
    chosen = evenly(range(len(held_out)), most)
    warm_up(method, held_out[chosen[0]])
    begin = time.perf_counter()
    for i in track(chosen, "Rendering held-out views", len(chosen)):
        keep(str(i), method.render(method.refined(held_out[i])))
    return Shown(views, (time.perf_counter() - begin) / len(chosen), None)


def likeness(one: Shown, other: Shown) -> float:
    """Mean PSNR in dB of each view of one method against the other's."""
    found = [psnr(one.views[name], other.views[name]) for name in one.views]
    return float(torch.tensor(found).mean())
