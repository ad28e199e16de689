"""Runs of one category become a folder of files, one for each, that open as the run in the canonical frame of all.

Instances are moments, in which a rotation is a matrix for each band. Their correlation with another shape under any
rotation is then one sum over bands, <D_l(R), sum over shells of g_l f_l^T>, so that thousands of rotations are tried at
once (as Kostelec 2008, in plain products); the best of that lattice is refined in ever smaller steps.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from ... import files
from ...camera import ring
from ...errors import LumigraphError, LumigraphWarning
from ...figures import Row, contact_sheet, save_picture
from ...files.names import natural
from ...geometry import Similarity, evenly
from ...method import Method
from ...method.capabilities import HasDensity, can, needs
from ...run import Run
from ...run.composition import relative, write_canonicalised
from ...system.progress import track
from .grids import Instance, sampled
from .harmonics import band, moments, near, spread, turning
from .network import CanonicalConfig, Canonicaliser, found_rotations, learn

CANONICAL_SPREAD = 0.4  # of opaque points about their mean, canonical units: nearly all lie within [-1, 1]^3
PICTURE_SIDE, MAX_SHOWN = 200, 12  # pixels; runs on the sheet
FIELD_OF_VIEW, CAMERA_INDEX = 38.0, 4  # degrees; number of the ring's camera
SHEET_FILE = "canonical.png"
SHELLS, BANDS = 8, 8  # of moments; finer ones tell no more of grids of some forty cells
LATTICE_ROTATIONS = 4608  # rotations that are tried: any other one is within 13 degrees of one of them
STEP_DEGREES = (6.0, 3.0, 1.5, 0.75, 0.4)  # of the refinement; each repeats while it helps, at most ROUNDS times
STEP_ROUNDS = 4
MIN_IMPROVEMENT = 1e-4  # of the agreement, for another round over all instances
MAX_ROUNDS = 12  # rounds over all instances


@dataclass(frozen=True)
class RunInstance:
    """A run with its method and its opaque region, in a frame with a similarity to the run's scene."""

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
        runs = (x for x in folder.iterdir() if files.is_file(x / "config.json"))
        places = sorted(runs, key=lambda x: natural(x.name))
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


def canonicalise(
    found: Sequence[RunInstance], config: CanonicalConfig, output: Path, like: str | None = None
) -> Solution:
    """Write a file for each run, NAME.json, that opens as this run in the canonical frame, and a picture before and
    after. The runs are not changed.

    like: the run that keeps its orientation; the first by default
    Raises LumigraphError if there is no such run.
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
            points = place.points(one.instance.place.points(one.instance.points))
            (a, b, c), (d, e, f) = points.amin(0).tolist(), points.amax(0).tolist()
            source = relative(one.run.folder, output / "one.json")
            bounds = (a, b, c), (d, e, f)
            write_canonicalised(new / f"{one.name}.json", source, to_source, bounds, min(agreement, 1.0))
        save_picture(new / SHEET_FILE, before_and_after(found, places), ours=True)
    return solution


def placed(instance: Instance, rotation: Float[Tensor, "3 3"]) -> Similarity:
    """From the frame that an instance was sampled in to the canonical one."""
    return Similarity.make(CANONICAL_SPREAD, rotation) @ instance.place.inverse


def before_and_after(found: Sequence[RunInstance], places: Sequence[Similarity]) -> Image.Image:
    """Some of the runs from one side, in their scenes' frames and in the canonical frame."""
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


@dataclass(frozen=True)
class Solution:
    """rotations: of each instance into the canonical frame
    predicted: the network's prediction alone, in a frame of its own
    agreement: of each instance with the mean shape, 1 for the same
    explained: share of all instances' squared moments that the mean shape has"""

    rotations: Float[Tensor, "some 3 3"]
    predicted: Float[Tensor, "some 3 3"]
    agreement: Float[Tensor, " some"]
    explained: float
    network: Canonicaliser


def solve(instances: Sequence[Instance], config: CanonicalConfig) -> Solution:
    """Learn the common shape, and align each instance to it.

    The mean shape is found from several initialisations: the network's prediction, and a few instances; the one that
    explains most of all instances is kept.
    """
    network = learn(instances, config)
    predicted = found_rotations(network, instances)
    shapes = described(instances)
    some = evenly(range(len(instances)), config.templates)
    found = best_alignment(shapes, [predicted, *(best_rotations(shapes[i], shapes) for i in some)])
    return Solution(found.rotations, predicted, found.agreement, found.explained, network)


@dataclass(frozen=True)
class Alignment:
    """rotations: of each instance onto the mean shape
    agreement: of each with the mean shape, the cosine between their moments
    explained: share of all instances' squared moments that the mean shape has
    """

    rotations: Float[Tensor, "some 3 3"]
    agreement: Float[Tensor, " some"]
    explained: float


def described(instances: Sequence[Instance]) -> Float[Tensor, "some shell basis"]:
    """Each instance as moments of length one."""
    found = torch.stack([moments(x.points.double(), x.weights.double(), SHELLS, BANDS) for x in instances])
    return found / found.square().sum((1, 2), keepdim=True).sqrt()


def aligned(shapes: Float[Tensor, "some shell basis"], start: Float[Tensor, "some 3 3"]) -> Alignment:
    """Instances aligned to their mean shape from initial rotations: each is rotated to the current mean by the best of
    all rotations, until convergence (congealing, Learned-Miller 2006)."""
    rotations, explained = start, 0.0
    for _ in range(MAX_ROUNDS):
        mean = turn(shapes, rotations).mean(0)
        if (now := float(mean.square().sum())) < explained + MIN_IMPROVEMENT:
            break
        explained = now
        rotations = best_rotations(mean, shapes)
    there = turn(shapes, rotations)
    mean = there.mean(0)
    length = float(mean.square().sum())
    return Alignment(rotations, (there * mean).sum((1, 2)) / length**0.5, length)


def best_alignment(shapes: Float[Tensor, "some shell basis"], starts: Sequence[Float[Tensor, "some 3 3"]]) -> Alignment:
    """Align from several initialisations; return the alignment whose mean shape explains most."""
    return max((aligned(shapes, start) for start in starts), key=lambda found: found.explained)


def best_rotations(
    target: Float[Tensor, "shell basis"], shapes: Float[Tensor, "some shell basis"]
) -> Float[Tensor, "some 3 3"]:
    """Rotation of each shape that best matches the target: of the lattice, then refined."""
    entries, table = correlations(target, shapes), lattice()
    which = (entries @ table.flat.T).argmax(-1)
    return refined(table.take(which), entries)


def correlations(
    target: Float[Tensor, "shell basis"], shapes: Float[Tensor, "some shell basis"]
) -> Float[Tensor, "some entry"]:
    """Coefficients of the entries of D in the correlation of two shapes: sum over shells of g_l f_l^T for each band."""
    parts = [target[:, band(n)].mT @ shapes[..., band(n)] for n in range(BANDS)]
    return torch.cat([part.flatten(-2) for part in parts], -1)


def refined(found: BandRotations, entries: Float[Tensor, "some entry"]) -> Float[Tensor, "some 3 3"]:
    """Rotations refined as long as the correlation grows."""
    for degrees in STEP_DEGREES:
        around = steps(degrees)
        for _ in range(STEP_ROUNDS):
            tried = around.after(found)
            which = (tried.flat * entries[:, None]).sum(-1).argmax(-1)
            found = tried.pick(which)
            if not which.any():
                break
    return found.rotations


@dataclass(frozen=True)
class BandRotations:
    """Rotations, and their matrices in each band."""

    rotations: Float[Tensor, "*some 3 3"]
    matrices: Sequence[Float[Tensor, "*some _ _"]]

    @staticmethod
    def of(rotations: Float[Tensor, "*some 3 3"]) -> BandRotations:
        return BandRotations(rotations, turning(rotations, BANDS))

    @property
    def flat(self) -> Float[Tensor, "*some entry"]:
        """All entries of the matrices side by side, as `correlations` has them."""
        return torch.cat([matrix.flatten(-2) for matrix in self.matrices], -1)

    def take(self, which: Tensor) -> BandRotations:
        return BandRotations(self.rotations[which], [matrix[which] for matrix in self.matrices])

    def pick(self, which: Tensor) -> BandRotations:
        """Select one rotation per row, by number."""
        rows = torch.arange(len(which))
        return BandRotations(self.rotations[rows, which], [matrix[rows, which] for matrix in self.matrices])

    def after(self, others: BandRotations) -> BandRotations:
        """Each of these rotations (columns) after each of the others (rows)."""
        every = zip(self.matrices, others.matrices, strict=True)
        return BandRotations(self.rotations @ others.rotations[:, None], [a @ b[:, None] for a, b in every])


@cache
def lattice() -> BandRotations:
    return BandRotations.of(spread(LATTICE_ROTATIONS))


@cache
def steps(degrees: float) -> BandRotations:
    return BandRotations.of(near(degrees))


def turn(shapes: Float[Tensor, "some shell basis"], rotations: Float[Tensor, "some 3 3"]) -> Tensor:
    """Moments of rotated shapes."""
    matrices = turning(rotations, BANDS)
    return torch.cat([shapes[..., band(n)] @ matrices[n].mT for n in range(BANDS)], -1)
