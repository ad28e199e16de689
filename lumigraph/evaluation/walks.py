"""Evaluate generated pictures of a block world: temporal consistency of a walk, and agreement of colours with labels.

There are no photographs to compare with.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from PIL import Image
from torch import Tensor
from torch.nn.functional import grid_sample

from ..camera import Camera
from ..camera.rays import Rendering
from ..datasets.world import LABELS, BlockWorld
from ..errors import LumigraphError
from ..figures import Row, colour_depth, contact_sheet, depth_range
from ..geometry import evenly
from ..method import Method
from ..metrics import Score
from ..system.progress import track
from ..system.work import at_work
from .options import EvaluationOptions

SHEET_FRAMES = 8  # frames of the contact sheet
FAR = 1e4  # distance at which the sky lies, scene units
DEPTH_TOLERANCE = 0.02  # of the distance, within which a place is the same surface in both frames
MIN_PIXELS = 20  # of a label in a frame, from which on it has a colour

Picture = Float[Tensor, "height width 3"]


@dataclass(frozen=True)
class WalkFrame:
    """One frame. change: mean difference from the frame before, which is warped by the exact depth, colours in [0, 1];
    None of the first frame"""

    name: str
    change: float | None
    shared: float | None  # share of the pixels that the frame before shows, too


@dataclass(frozen=True)
class WalkEvaluation:
    """Frames of a walk, and how they were compared.

    separation: share of the colours' variance that lies between labels
    colours:    mean colour of each label, sRGB in [0, 1]
    """

    frames: list[WalkFrame]
    separation: float
    colours: dict[str, tuple[float, float, float]]
    protocol: dict[str, Any]
    shown: dict[str, tuple[Picture, Rendering]]

    @property
    def change(self) -> float:
        """Mean change from frame to frame."""
        known = [frame.change for frame in self.frames if frame.change is not None]
        return sum(known) / max(len(known), 1)

    @property
    def scores(self) -> list[Score]:
        return [
            Score("warped difference", 100 * self.change, "%", "lower", 2),
            Score("colours by label", 100 * self.separation, "%", "higher", 1),
        ]

    @property
    def compared(self) -> str:
        return f"{len(self.frames)} {self.protocol['split']} frames"

    def to_json(self) -> dict[str, Any]:
        return {
            "scores": [score.to_json() for score in self.scores],
            "protocol": self.protocol,
            "colours": self.colours,
            "frames": [asdict(frame) for frame in self.frames],
        }

    def contact_sheet(self, title: str) -> Image.Image:
        """Blocks, rendering and depth of some frames."""
        rows = []
        for name, (blocks, seen) in self.shown.items():
            depth = colour_depth(seen.depth, seen.opacity, depth_range(seen.depth, seen.opacity))
            rows.append(Row(name, [blocks, seen.rgb.clamp(0, 1), depth]))
        return contact_sheet(title, ["blocks", "rendering", "depth"], rows)


@at_work()
@torch.no_grad()
def evaluate_walk(
    method: Method,
    world: BlockWorld,
    options: EvaluationOptions = EvaluationOptions(),
    keep: Callable[[str, Rendering], object] = lambda name, rendering: None,
) -> WalkEvaluation:
    """Render the cameras of a split, which lie along a walk, and compare each frame with the previous one.

    keep: receives each frame's name and rendering
    options: of which the views are the first frames
    Raises LumigraphError for a split without cameras.
    """
    split = options.split
    chosen = world.splits.get(split, torch.empty(0, dtype=torch.int64)).tolist()[: options.views]
    if not chosen:
        raise LumigraphError(f"{world.source} has no frames in the split {split!r}; choose one of: train, test")
    method.eval()
    numbers, spread = world.label_numbers, set(evenly(chosen, SHEET_FRAMES))
    frames, pictures, labels, shown = list[WalkFrame](), list[Picture](), list[Tensor](), {}
    before: tuple[Picture, Camera, Tensor] | None = None
    for index in track(chosen, "Walking", len(chosen)):
        shot = world.photograph(index, ("labels", "depth"))
        seen, depth = method.render(shot.camera).cpu(), shot.extra["depth"]
        name, rgb = world.names[index], seen.rgb.clamp(0, 1)
        keep(name, seen)
        change, shared = (None, None) if before is None else warped_difference(rgb, shot.camera, depth, *before)
        frames.append(WalkFrame(name, change, shared))
        pictures.append(rgb)
        labels.append(numbers[shot.extra["labels"]])
        if index in spread:
            shown[name] = shot.rgb, seen
        before = rgb, shot.camera, depth
    separation, colours = colours_by_label(torch.stack(pictures), torch.stack(labels))
    return WalkEvaluation(frames, separation, colours, protocol(split, len(chosen), len(world.splits[split])), shown)


def protocol(split: str, count: int, total: int) -> dict[str, Any]:
    return {
        "split": split,
        "frames": count,
        "of": total,
        "warped difference": "mean |difference| of sRGB from the frame before, warped by the exact depth, "
        "where both show the same place; per frame, then averaged",
        "colours by label": "share of the variance of sRGB that lies between labels",
    }


def warped_difference(
    rgb: Picture,
    camera: Camera,
    depth: Float[Tensor, "height width"],
    other: Picture,
    other_camera: Camera,
    other_depth: Float[Tensor, "height width"],
) -> tuple[float | None, float]:
    """Mean absolute difference of a picture from another one that is warped to it, and the share of the pixels that
    both show; None where there are none.

    depth: exact distances along the rays of each picture, infinite in the sky
    """
    distance = depth.flatten().nan_to_num(posinf=FAR)
    points = camera.rays(camera.pixels()).at(distance)
    pixels, seen = other_camera.project(points)
    found, there = sampled(other, pixels)
    own = (points - other_camera.position).norm(dim=-1)
    # The nearest pixel decides whether the place is hidden: between a hill and the sky there is no depth.
    known, _ = sampled(other_depth.nan_to_num(posinf=FAR)[..., None], pixels, "nearest")
    same = seen & there & ((known[:, 0] - own).abs() < DEPTH_TOLERANCE * own)
    if not same.any():
        return None, 0.0
    return float((rgb.reshape(-1, 3)[same] - found[same]).abs().mean()), float(same.float().mean())


def sampled(
    picture: Float[Tensor, "height width channel"], pixels: Float[Tensor, "point 2"], mode: str = "bilinear"
) -> tuple[Float[Tensor, "point channel"], Bool[Tensor, " point"]]:
    """Values of a picture at pixels, and whether they lie within it."""
    size = torch.tensor(picture.shape[1::-1], dtype=pixels.dtype)
    inside = ((pixels >= 0) & (pixels <= size)).all(-1)
    places = (pixels.nan_to_num(-1.0) / size * 2 - 1).clamp(-2, 2)[None, None]
    found = grid_sample(picture.movedim(-1, 0)[None], places, mode, "border", align_corners=False)
    return found[0, :, 0].T, inside


def colours_by_label(
    pictures: Float[Tensor, "picture height width 3"], labels: Int[Tensor, "picture height width"]
) -> tuple[float, dict[str, tuple[float, float, float]]]:
    """Share of the variance of colours between labels, and the mean colour of each label."""
    colours, which = pictures.reshape(-1, 3), labels.flatten()
    between, means = torch.zeros(()), {}
    for label, name in enumerate(LABELS):
        own = colours[which == label]
        if len(own) >= MIN_PIXELS:
            r, g, b = own.mean(0).tolist()
            means[name] = (r, g, b)
            between = between + len(own) * (own.mean(0) - colours.mean(0)).square().sum()
    total = (colours - colours.mean(0)).square().sum().clamp_min(1e-9)
    return float(between / total), means
