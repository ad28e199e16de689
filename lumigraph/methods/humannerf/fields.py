"""The field of a body in a pose: skeletal motion, then a non-rigid offset, to a canonical field (Weng 2022)."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...components.fields.coordinate_field import CoordinateField
from ...components.fields.deformation import DeformationNetwork, window
from ...components.fields.hash_field import HashField
from ...components.skinning.weight_volume import WeightVolume
from ...datasets.skeleton import rigid_inverse
from ...files.ranges import Layers, LearningRate, Octaves, Share, Width
from ...method import Field, Part
from ...method.field import Codes, Colours, Densities, Directions, Points

MIN_BODY = 1e-3  # sum of weights f(x) up to which a point is outside the body
OFF = -1.0  # in place of the number of octaves, before the offset begins
POINTS_PER_CHUNK = 1 << 14  # whose places in all bones' frames are held at a time


@dataclass(frozen=True)
class NonRigidNumbers:
    """A Config's numbers of the non-rigid offset; the paper's (section 3.3 and the supplement)."""

    nonrigid_depth: Layers = 6  # hidden layers
    nonrigid_width: Width = 128  # channels of a layer
    nonrigid_skip: Layers = 4  # layer whose activation the input joins again
    nonrigid_frequencies: Octaves = 6  # octaves of the encoding at the end of annealing
    nonrigid_from: Share = 0.025  # share of the budget before the offset, 10k of 400k steps; later: bones explain more
    nonrigid_until: Share = 0.125  # share of the budget until which octaves join, 50k of 400k steps
    nonrigid_lr: LearningRate = 5e-5  # its learning rate


class NonRigidOffset(Part):
    """x' = x + MLP(gamma(x; tau), Omega), whose octaves join under a Hann window (eqs. 8 to 10).

    alpha: octaves that have joined; OFF leaves points where they are
    """

    alpha: Tensor

    def __init__(self, angles: int, numbers: NonRigidNumbers):
        super().__init__()
        n = self.numbers = numbers
        self.angles = angles
        shape = n.nonrigid_depth, n.nonrigid_width, n.nonrigid_skip
        self.network = DeformationNetwork(n.nonrigid_frequencies, angles, *shape, 3)
        self.register_buffer("alpha", torch.tensor(OFF))

    def before_step(self, method: object, step: int, progress: float) -> None:
        n = self.numbers
        grown = (progress - n.nonrigid_from) / max(n.nonrigid_until - n.nonrigid_from, 1e-9)
        self.alpha.fill_(min(grown, 1.0) * n.nonrigid_frequencies if grown >= 0 else OFF)

    def forward(self, points: Points, angles: Float[Tensor, "point angle"]) -> Points:
        if self.alpha < 0:
            return points
        return points + self.network(points, angles, window(self.numbers.nonrigid_frequencies, self.alpha))

    def optimizers(self) -> list[torch.optim.Optimizer]:
        group = {"name": "nonrigid", "params": list(self.parameters())}
        return [torch.optim.Adam([group], self.numbers.nonrigid_lr)]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        return {"nonrigid": self.numbers.nonrigid_lr}


@dataclass(frozen=True)
class BodyPoses:
    """A body at some moments.

    table:   from posed to rest, of the bones
    angles:  Omega, of joints but roots, radians
    weights: shares of bones in the volume
    """

    table: Float[Tensor, "moment bone 3 4"]
    angles: Float[Tensor, "moment angle"]
    weights: Tensor


class PosedField(Field):
    """Density and colour of points of a posed body. The code of a point is the row of its moment in `poses`.

    poses: of the body; None for the field that `posed` puts into some
    """

    deforms: ClassVar[bool] = True

    def __init__(self, canonical: HashField | CoordinateField, volume: WeightVolume, offset: NonRigidOffset):
        super().__init__()
        self.canonical, self.volume, self.offset = canonical, volume, offset
        self.poses: BodyPoses | None = None

    def posed(self, transforms: Float[Tensor, "moment bone 3 4"], angles: Float[Tensor, "moment angle"]) -> PosedField:
        """The same field in poses; codes are rows of them. transforms: of bones, from rest to posed"""
        field = copy.copy(self)
        field.poses = BodyPoses(rigid_inverse(transforms), angles, self.volume.weights())
        return field

    def at_rest(self, points: Points, rows: Int[Tensor, " point"]) -> tuple[Points, Float[Tensor, " point"]]:
        """Places of points at rest, and the likelihood f that they are of the body (Weng 2022, eqs. 3 to 5):

        x_rest = sum_k w_k(x) (R_k x + t_k) / f(x),  w_k(x) = w_c,k(R_k x + t_k),  f(x) = sum_k w_k(x)
        """
        assert self.poses is not None
        if len(self.poses.table) == 1:
            table = self.poses.table[0]
            each = torch.einsum("bij,nj->bni", table[:, :, :3], points) + table[:, None, :, 3]
        else:
            table = self.poses.table[rows]
            each = (torch.einsum("nbij,nj->nbi", table[..., :3], points) + table[..., 3]).transpose(0, 1)
        weights = self.volume.of_each(each, self.poses.weights)
        body = weights.sum(0)
        body = body * (body > MIN_BODY)
        return (weights[..., None] * each).sum(0) / body.clamp_min(MIN_BODY)[:, None], body

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Any]:
        rows = self._rows(points, code)
        rest, body = self.at_rest(points, rows)
        density, features = self.canonical.geometry(self._moved(rest, rows))
        return density * body, features

    def density(self, points: Points, code: Codes | None = None) -> Densities:
        """Density per scene unit; without gradients the canonical field is evaluated in the body alone."""
        if torch.is_grad_enabled():
            return self.geometry(points, code)[0]
        rows = self._rows(points, code)
        found = [self._dense(*some) for some in zip(*(x.split(POINTS_PER_CHUNK) for x in (points, rows)), strict=True)]
        return torch.cat(found) if found else points.new_zeros(0)

    def _dense(self, points: Points, rows: Int[Tensor, " point"]) -> Densities:
        rest, body = self.at_rest(points, rows)
        inside = body.nonzero()[:, 0]
        placed = self._moved(rest[inside], rows[inside])
        return torch.zeros_like(body).index_copy(0, inside, self.canonical.density(placed) * body[inside])

    def _moved(self, rest: Points, rows: Int[Tensor, " point"]) -> Points:
        """Canonical positions of points at rest, with the non-rigid offset."""
        assert self.poses is not None
        return self.offset(rest, self.poses.angles[rows])

    def _rows(self, points: Points, code: Codes | None) -> Int[Tensor, " point"]:
        return torch.zeros(len(points), dtype=torch.long, device=points.device) if code is None else code[:, 0].long()

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        """Colours do not depend on the view (section 3.1)."""
        return self.canonical.colour(features, torch.zeros_like(directions))
