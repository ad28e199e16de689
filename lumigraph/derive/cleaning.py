"""Clean a cloud of Gaussians of floaters, or crop it, and draw it before and after."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool
from PIL import Image
from torch import Tensor

from ..camera import ring
from ..composition import PickedCloud
from ..composition.floaters import CANDIDATE_COLOUR, STRENGTH, floaters
from ..errors import LumigraphError
from ..exchange import names_splats, place_of
from ..export.loaded import Loaded
from ..figures import Row, contact_sheet, save_picture
from ..files import claim
from ..gaussians import Gaussians
from ..gaussians.cloud import gone, painted, unwanted
from ..geometry import evenly
from ..method.capabilities import HasGaussians, needs
from ..run import Opened
from ..run.derived import check_output, save_picked
from ..system.progress import track
from .options import CleanOptions

SIZE = 400  # pixels of the longer side of the pictures that compare


@dataclass(frozen=True)
class Cleaned:
    """A cloud that was cleaned: its Gaussians before, those removed by reason, and the picture that compares."""

    before: int
    removed: dict[str, int]
    picture: Path


def clean(
    opened: Opened,
    output: Path,
    options: CleanOptions = CleanOptions(),
    overwrite: bool | None = None,
    device: torch.device | str = "auto",
) -> Cleaned:
    """Write a cloud without floaters, cropped, as a run or a splat file, and a picture that compares.

    Raises LumigraphError if no Gaussian is left.
    """
    check_output(opened, output, overwrite, [opened.path])
    place = place_of(output)
    picture = place.with_name(f"{place.name}.png") if names_splats(output) else output / "clean.png"
    claim(picture, "comparison", overwrite, [opened.path])
    loaded = Loaded.of(opened, device)
    gaussians = needs(loaded.method, HasGaussians).gaussians()
    strength = STRENGTH if options.strength is None else options.strength
    floating = floaters(gaussians, loaded.photographers, opened.frame, strength)
    reasons = unwanted(gaussians, options.part.crop(opened.frame), floating=floating)
    which = gone(reasons)
    if len(gaussians) and which.all():
        raise LumigraphError(
            "No Gaussian is left; give --box or --sphere where the scene is (`lumigraph info` shows its bounds), "
            "or a smaller --strength"
        )
    counts = {reason: count for reason, some in reasons.items() if (count := int(some.sum()))}
    sheet = before_and_after(opened, gaussians, which)  # reads the cameras, so it comes before anything is written
    save_picked(opened, ~which.cpu(), output, {"removed": counts})
    save_picture(picture, sheet, "comparison")
    return Cleaned(len(gaussians), counts, picture)


def before_and_after(opened: Opened, gaussians: Gaussians, gone: Bool[Tensor, " gaussian"]) -> Image.Image:
    """A sheet of some views: all Gaussians, the removed ones coloured, those that stay. Two are from afar, where
    floaters show."""
    shown = gaussians, painted(gaussians, gone, CANDIDATE_COLOUR), gaussians[~gone]
    clouds = [PickedCloud(opened.frame, some) for some in shown]
    around = ring(opened.frame.bounds, size=SIZE)
    views = [around[i] for i in evenly(range(len(around)), 3)[:2]]
    if opened.photographed:
        own = opened.cameras()["train"]
        views = [own[i] for i in evenly(range(len(own)), 4)[1:]] + views
    rows = [
        Row("", [cloud.render(camera.resized(min(1.0, SIZE / int(camera.size.max())))).rgb for cloud in clouds])
        for camera in track(views, "Drawing before and after", len(views))
    ]
    return contact_sheet(opened.title, ("before", "removed Gaussians coloured", "after"), rows, SIZE)
