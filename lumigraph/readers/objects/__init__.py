"""Masks of an object against its background, from the photographs of a capture alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import uniform_filter

from ...datasets.scene import Scene
from ...errors import LumigraphError
from ...figures import Row, contact_sheet, fit_into, save_picture
from ...files import claim, replacing_folder
from ...geometry import evenly
from ...system.progress import track
from ..assemble import assemble
from ..capture import Capture
from ..masks import OBJECT_MASKS, inner_names
from .segment import Segmentation, segment
from .view import ObjectView

SHEET_FILE = "object.png"
MAX_SHOWN, ROW_LENGTH = 16, 4  # photographs on the sheet, and on a line of it
OUTLINE_RADIUS = 0.006  # of a photograph's longer side: distance over which an outline may snap to an edge
OUTLINE_GAIN = 2.0  # steepness factor of the filter's soft outline
MIN_SEPARATION = 0.8  # share of superpixels that colours separate, below which a warning is due
MAX_FILLED_SHARE = 0.6  # share of the region that an object may fill
BACKGROUND_BRIGHTNESS = 0.2  # factor on the background of the sheet


@dataclass(frozen=True)
class Masked:
    """Result of masking: number of photographs, contact sheet, and doubts: a sentence each."""

    photographs: int
    sheet: Path
    doubts: list[str]


def mask_object(folder: Path, capture: Capture) -> Masked:
    """Find the central object in a scene's photographs, and write its masks.

    folder:  of the scene; gets object_masks/ with image.jpg.png for image.jpg, and a contact sheet object.png
    capture: from the folder's reader
    Raises LumigraphError where masks exist already, and if no object can be separated.
    """
    if (folder / OBJECT_MASKS).exists():
        raise LumigraphError(f"{folder / OBJECT_MASKS} is there already; delete it, and masks will be made anew")
    claim(folder / SHEET_FILE, "masks")
    scene = assemble(replace(capture, shots=[replace(shot, mask=None, alpha=None) for shot in capture.shots]))
    views = [
        ObjectView.of(scene.names[i], scene.cameras[i], scene.photograph(i).rgb)
        for i in track(range(len(scene)), "Dividing photographs", len(scene))
    ]
    found = segment(views, scene.points)
    tiles: dict[int, Image.Image] = {}
    shown = evenly(range(len(scene)), MAX_SHOWN)
    with replacing_folder(folder / OBJECT_MASKS) as partial:
        for i in track(range(len(scene)), "Writing masks", len(scene)):
            rgb = scene.photograph(i).rgb.numpy()
            alpha = refined(found, i, rgb)
            path = partial / f"{next(inner_names(scene.names[i]))}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray((alpha * 255).round().astype(np.uint8)).save(path)
            if i in shown:
                lit = rgb * (BACKGROUND_BRIGHTNESS + (1 - BACKGROUND_BRIGHTNESS) * alpha[..., None])
                tiles[i] = fit_into(Image.fromarray((lit * 255).astype(np.uint8)), 320, 320)
    save_picture(folder / SHEET_FILE, sheet_of(scene, tiles), "masks")
    return Masked(len(scene), folder / SHEET_FILE, doubts(found))


def refined(
    found: Segmentation, index: int, rgb: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width"]:
    """The mask at a photograph's size, refined to its edges; in [0, 1]."""
    height, width = rgb.shape[:2]
    small = Image.fromarray(found.masks[index])
    rough = np.asarray(small.convert("L").resize((width, height), Image.Resampling.BILINEAR)) / 255
    soft = guided(rgb.mean(-1), rough, max(1, round(OUTLINE_RADIUS * max(width, height))))
    return (OUTLINE_GAIN * (soft - 0.5) + 0.5).clip(0, 1)


def doubts(found: Segmentation) -> list[str]:
    """Doubts that a user should check before training on the masks."""
    told = []
    if found.region.table is None:
        told.append("no table or floor was found below the object, so shadows at its foot may belong to it")
    if len(found.body) > MAX_FILLED_SHARE * len(found.region.cells):
        told.append("what was found fills nearly all that the photographs look at, so it may be no object at all")
    if found.distinct < MIN_SEPARATION:
        told.append("the object has nearly the colours of what is around it, so the outlines are guesses")
    if names := found.doubtful:
        some = ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")
        told.append(f"the outlines of {len(names)} photographs do not agree with the others' ({some})")
    return told


def sheet_of(scene: Scene, tiles: dict[int, Image.Image]) -> Image.Image:
    pictures = [(scene.names[i], torch.from_numpy(np.asarray(tile) / 255).float()) for i, tile in tiles.items()]
    lines = [pictures[k : k + ROW_LENGTH] for k in range(0, len(pictures), ROW_LENGTH)]
    rows = [Row([Path(name).name for name, _ in line], [picture for _, picture in line]) for line in lines]
    return contact_sheet("What the masks keep", [""] * min(ROW_LENGTH, len(pictures)), rows, 240)


def guided(
    guide: Float[np.ndarray, "height width"], rough: Float[np.ndarray, "height width"], radius: int, noise: float = 1e-3
) -> Float[np.ndarray, "height width"]:
    """Guided filter (He, Sun and Tang 2010): a rough mask with the guide's edges, a guide + b, with a and b fitted to
    `rough` in the windows around each pixel (eq. 5 to 8).

    noise: variance of the guide below which it is flat
    """

    def mean(x: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
        return uniform_filter(x, 2 * radius + 1, mode="nearest")

    middle, level = mean(guide), mean(rough)
    a = (mean(guide * rough) - middle * level) / (mean(guide * guide) - middle**2 + noise)
    return mean(a) * guide + mean(level - a * middle)
