"""A folder of runs becomes a folder of files, one for each, that open as the run in the canonical frame of them all."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from ... import files
from ...camera import ring
from ...datasets.scene import Vector
from ...errors import LumigraphError, LumigraphWarning
from ...figures import Row, contact_sheet, save_picture
from ...files.names import natural
from ...geometry import Similarity, evenly
from ...method import Method
from ...method.capabilities import HasDensity, can, needs
from ...run import Run
from ...run.canonicalised import write_canonicalised
from ...run.composition import relative
from ...system.progress import track
from .grids import Instance, sampled
from .learning import Config
from .solve import Solution, solve

CANONICAL_SPREAD = 0.4  # of opaque points about their mean, canonical units: nearly all lie within [-1, 1]^3
PICTURE_SIDE, MAX_SHOWN = 200, 12  # pixels; runs on the sheet
FIELD_OF_VIEW, CAMERA_INDEX = 38.0, 4  # degrees; number of the ring's camera
SHEET_FILE = "canonical.png"


@dataclass(frozen=True)
class RunInstance:
    """A run with its method and what is opaque in it, in a frame of its own that leads to the run's scene."""

    run: Run
    method: Method
    instance: Instance

    @property
    def name(self) -> str:
        return self.run.folder.name


def found_in(folder: Path, cells: int, device: torch.device) -> list[RunInstance]:
    """The runs in a folder whose fields have a density. Others are named in a warning and passed over.

    cells: of density grids along the longest side
    Raises LumigraphError where fewer than two are left.
    """
    with files.explained(folder):
        places = sorted(
            (x for x in folder.iterdir() if files.is_file(x / "config.json")), key=lambda x: natural(x.name)
        )
    if not places:
        raise LumigraphError(f"{folder} holds no runs; name a folder in which each folder is one, as `runs` is")
    found = []
    for place in track(places, "Sampling density grids", len(places)):
        try:
            found.append(opened(place, cells, device))
        except LumigraphError as fault:
            warnings.warn(f"{place.name} is passed over: {fault}", LumigraphWarning, stacklevel=2)
    if len(found) < 2:
        raise LumigraphError(
            f"{folder} holds {len(found) or 'no'} {'run' if len(found) == 1 else 'runs'} with a density, "
            "and what a category shares takes two; train more, by instant-ngp for example"
        )
    return found


def opened(place: Path, cells: int, device: torch.device) -> RunInstance:
    """A run and its density grid. Raises LumigraphError for one that has none."""
    run = Run(place)
    method = run.method(device)
    if not can(method, HasDensity):
        raise LumigraphError(
            f"{place} is of {run.method_name}, which holds no density at points to align it by; "
            "train a field on it, instant-ngp for example"
        )
    dense = needs(method, HasDensity)
    return RunInstance(run, method, sampled(lambda x: dense.density(x.to(device)), run.frame.bounds, cells, str(place)))


def canonicalise(found: Sequence[RunInstance], config: Config, output: Path, like: str | None = None) -> Solution:
    """Write a file for each run, NAME.json, that opens as this run in the canonical frame, and a picture before and
    after. The runs stay as they are.

    like: the run that stays as it stands in its scene; the first unless said
    Raises LumigraphError where there is no such run.
    """
    names = [one.name for one in found]
    if like is not None and like not in names:
        raise LumigraphError(f"There is no run {like} to stand like; there are {', '.join(names)}")
    files.claim_folder(output, "canonical")
    solution = solve([one.instance for one in found], config)
    standing = solution.rotations[names.index(like) if like else 0]
    places = [placed(one.instance, standing.mT @ turn) for one, turn in zip(found, solution.rotations, strict=True)]
    with files.replacing_folder(output, "canonical") as new:
        for one, place, agreement in zip(found, places, solution.agreement.tolist(), strict=True):
            to_source = place @ one.run.frame.to_source.inverse
            bounds = bounds_of(one.instance, place)
            source = relative(one.run.folder, output / "one.json")
            write_canonicalised(new / f"{one.name}.json", source, to_source, bounds, min(agreement, 1.0))
        save_picture(new / SHEET_FILE, before_and_after(found, places), ours=True)
    return solution


def placed(instance: Instance, rotation: Float[Tensor, "3 3"]) -> Similarity:
    """From the frame that an instance was sampled in to the canonical one."""
    return Similarity.make(CANONICAL_SPREAD, rotation) @ instance.place.inverse


def bounds_of(instance: Instance, place: Similarity) -> tuple[Vector, Vector]:
    """Two corners around what is opaque, in the canonical frame."""
    points = place.points(instance.place.points(instance.points))
    (a, b, c), (d, e, f) = points.amin(0).tolist(), points.amax(0).tolist()
    return (a, b, c), (d, e, f)


def before_and_after(found: Sequence[RunInstance], places: Sequence[Similarity]) -> Image.Image:
    """Some of the runs from one side, as they stood in their scenes, and in the canonical frame."""
    cube = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    camera = ring(cube, angle=FIELD_OF_VIEW, size=PICTURE_SIDE)[-CAMERA_INDEX]
    some = evenly(list(zip(found, places, strict=True)), MAX_SHOWN)
    ways = [(placed(one.instance, torch.eye(3)), place) for one, place in some]
    views = [
        [one.method.render(camera.transformed(way.inverse.matrix)).rgb.cpu() for way in both]
        for (one, _), both in track(list(zip(some, ways, strict=True)), "Drawing before and after", len(some))
    ]
    stood, canonical = zip(*views, strict=True)
    rows = Row("as they stood", stood), Row("in their canonical frame", canonical)
    return contact_sheet("What these runs share", [one.name for one, _ in some], rows, PICTURE_SIDE)
