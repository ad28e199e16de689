"""The mean shape of a category, and each instance turned so that it lies on it as well as in any rotation.

Instances are moments, in which a rotation is a matrix for each band. Their correlation with another shape under any
rotation is then one sum over bands, <D_l(R), sum over shells of g_l f_l^T>, so that thousands of rotations are tried at
once (as Kostelec 2008, in plain products); what is found on that lattice is refined in ever smaller steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from .grids import Instance
from .harmonics import band, turning
from .moments import moments
from .rotations import near, spread

SHELLS, BANDS = 8, 8  # of moments; finer ones tell no more of grids of some forty cells
LATTICE_ROTATIONS = 4608  # rotations that are tried: any other one is within 13 degrees of one of them
STEP_DEGREES = (6.0, 3.0, 1.5, 0.75, 0.4)  # of the refinement; each repeats while it helps, at most ROUNDS times
STEP_ROUNDS = 4
MIN_IMPROVEMENT = 1e-4  # of the agreement, for another round over all instances
MAX_ROUNDS = 12  # rounds over all instances


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
    """Instances on their mean shape, from rotations to begin with: all are turned onto the mean of what they are then,
    by the best of all rotations, until that helps no more (congealing, Learned-Miller 2006)."""
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
    """The rotation of each shape that brings it onto the target: of the lattice, then refined."""
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
    """Rotations a little further on, as long as the correlation grows."""
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
    """The moments of shapes that are turned, each by its rotation."""
    matrices = turning(rotations, BANDS)
    return torch.cat([shapes[..., band(n)] @ matrices[n].mT for n in range(BANDS)], -1)
