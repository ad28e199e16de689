"""mask_object(): the object of a captured scene, as masks beside its photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from ...datasets.scene import Scene
from ...errors import LumigraphError
from ...figures import Row, contact_sheet, fit_into, save_picture
from ...files import claim, replacing_folder
from ...geometry.choice import evenly
from ..assemble import assemble
from ..capture import Capture
from ..masks import OBJECT_MASKS, inner_names
from .guided import guided
from .segment import Segmentation, segment
from .view import View

SHEET = "object.png"
SHOWN, ROW = 16, 4  # photographs on the sheet, and on a line of it
EDGE = 0.006  # of a photograph's longer side: how far an outline may move to the edge that it means
SHARPER = 2.0  # times, that the filter's soft outline is made steeper
ALIKE = 0.8  # share of superpixels that colours tell apart, below which they are said not to
WHOLE = 0.6  # share of the region that a body may fill before it is no object
DIM = 0.2  # of the light of what is outside, on the sheet

Track = Callable[[Sequence[Any], str, int], Iterable[Any]]


@dataclass(frozen=True)
class Masked:
    """Result of masking: number of photographs, contact sheet, and doubts: a sentence each."""

    photographs: int
    sheet: Path
    doubts: list[str]


def mask_object(folder: Path, capture: Capture, track: Track) -> Masked:
    """Find the object that a scene's photographs look at, and write what of each shows it.

    folder:  of the scene; gets object_masks/ with image.jpg.png for image.jpg, and object.png to judge them by
    capture: what a reader found there
    Raises LumigraphError where masks lie there already, and where no object stands out.
    """
    if (folder / OBJECT_MASKS).exists():
        raise LumigraphError(f"{folder / OBJECT_MASKS} is there already; delete it, and masks will be made anew")
    claim(folder / SHEET, "masks")
    scene = assemble(replace(capture, shots=[replace(shot, mask=None, alpha=None) for shot in capture.shots]))
    views = [view_of(scene, i) for i in track(range(len(scene)), "Dividing photographs", len(scene))]
    found = segment(views, scene.points, track)
    tiles: dict[int, Image.Image] = {}
    shown = evenly(range(len(scene)), SHOWN)
    with replacing_folder(folder / OBJECT_MASKS) as partial:
        for i in track(range(len(scene)), "Writing masks", len(scene)):
            rgb = scene.photograph(i).rgb.numpy()
            alpha = refined(found, i, rgb)
            path = partial / f"{next(inner_names(scene.names[i]))}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray((alpha * 255).round().astype(np.uint8)).save(path)
            if i in shown:
                lit = rgb * (DIM + (1 - DIM) * alpha[..., None])
                tiles[i] = fit_into(Image.fromarray((lit * 255).astype(np.uint8)), 320, 320)
    save_picture(folder / SHEET, sheet_of(scene, tiles), "masks")
    return Masked(len(scene), folder / SHEET, doubts(found))


def view_of(scene: Scene, index: int) -> View:
    return View.of(scene.names[index], scene.cameras[index], scene.photograph(index).rgb)


def refined(
    found: Segmentation, index: int, rgb: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width"]:
    """The outline at a photograph's size, drawn to its edges; in [0, 1]."""
    height, width = rgb.shape[:2]
    small = Image.fromarray(found.inside[index][found.views[index].patches])
    rough = np.asarray(small.convert("L").resize((width, height), Image.Resampling.BILINEAR)) / 255
    soft = guided(rgb.mean(-1), rough, max(1, round(EDGE * max(width, height))))
    return (SHARPER * (soft - 0.5) + 0.5).clip(0, 1)


def doubts(found: Segmentation) -> list[str]:
    """Doubts that a user should check before training on the masks."""
    told = []
    if found.region.table is None:
        told.append("no table or floor was found below the object, so shadows at its foot may belong to it")
    if len(found.body) > WHOLE * len(found.region.cells):
        told.append("what was found fills nearly all that the photographs look at, so it may be no object at all")
    if found.distinct < ALIKE:
        told.append("the object has nearly the colours of what is around it, so the outlines are guesses")
    if names := found.doubtful:
        some = ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")
        told.append(f"the outlines of {len(names)} photographs do not agree with the others' ({some})")
    return told


def sheet_of(scene: Scene, tiles: dict[int, Image.Image]) -> Image.Image:
    pictures = [(scene.names[i], torch.from_numpy(np.asarray(tile) / 255).float()) for i, tile in tiles.items()]
    lines = [pictures[k : k + ROW] for k in range(0, len(pictures), ROW)]
    rows = [Row([Path(name).name for name, _ in line], [picture for _, picture in line]) for line in lines]
    return contact_sheet("What the masks keep", [""] * min(ROW, len(pictures)), rows, 240)
