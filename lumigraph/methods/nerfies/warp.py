"""Deformation of a scene: a code for each moment, and fields of screw motions and of slices under it."""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import embedding

from ...components.fields.deformation import DeformationNetwork, window
from ...components.fields.spaces import Space
from ...datasets.scene import Frame, Scene
from ...method import Part
from ...method.controls import Control, moment

SMALL_ANGLE = 1e-2  # radians, below which a motion's coefficients are their series; exact to 1e-9
FIRST_CODE, WAVE = 0.05, 0.5  # largest number of a code at first, at random and as a wave

Motion = Literal["se3", "translation", "none"]


class MomentCodes(Part):
    """A code for each moment of training, which photographs of one moment share; interpolated in between.

    waves:   whether codes begin as waves of time, so that what one moment learns helps its neighbours; else at random
    moments: ascending, infinite in rows without a moment
    """

    moments: Tensor

    def __init__(self, frame: Frame, width: int, waves: bool = False):
        super().__init__()
        self.times, self.waves = frame.times, waves
        rows = max(frame.image_count, 2)
        self.register_buffer("moments", torch.linspace(*(frame.times or (0.0, 1.0)), rows))
        self.codes = nn.Parameter(FIRST_CODE * torch.rand(rows, width))

    def begin(self, method: object, data: Scene, seconds: float) -> None:
        if data.cameras.time is not None:
            found = data.cameras.time[data.splits["train"]].unique()
            self.moments.fill_(math.inf)
            self.moments[: len(found)] = found
            if self.waves and self.times:
                self.codes.data[: len(found)] = self.wave((found - self.times[0]) / (self.times[1] - self.times[0]))

    def wave(self, share: Float[Tensor, " moment"]) -> Float[Tensor, "moment width"]:
        """Sines and cosines of half a period over the capture, of two halves, of three ..."""
        column = torch.arange(self.codes.shape[1], device=share.device)
        return WAVE * torch.sin(math.pi * ((column // 2 + 1) * share[:, None] + 0.5 * (column % 2)))

    def forward(self, times: Float[Tensor, " ray"]) -> Float[Tensor, "ray width"]:
        after = torch.searchsorted(self.moments, times.contiguous()).clamp(1, len(self.moments) - 1)
        a, b = self.moments[after - 1], self.moments[after]
        share = ((times - a) / (b - a)).clamp(0, 1)[:, None]
        return (1 - share) * embedding(after - 1, self.codes) + share * embedding(after, self.codes)

    @property
    def controls(self) -> tuple[Control, ...]:
        return (moment(self.times),) if self.times else ()


class MotionField(Part):
    """Canonical positions of points at a time: a screw motion of each (Park 2021, eqs. 4 to 7), or a translation.

    bands:  m, of the encoding, annealed from coarse to fine over a share `annealing` of the budget (section 3.5)
    alpha:  number of active bands
    """

    alpha: Tensor

    def __init__(
        self, space: Space, motion: Motion, bands: int, code: int, shape: tuple[int, int, int], annealing: float
    ):
        super().__init__()
        self.space, self.bands, self.annealing = space, bands, annealing
        self.network = DeformationNetwork(bands, code, *shape, 6 if motion == "se3" else 3)
        self.register_buffer("alpha", torch.tensor(0.0))

    def before_step(self, method: object, step: int, progress: float) -> None:
        self.alpha.fill_(self.bands * min(progress / self.annealing, 1.0) if self.annealing else self.bands)

    def forward(self, points: Float[Tensor, "point 3"], code: Float[Tensor, "point code"]) -> Float[Tensor, "point 3"]:
        return moved(points, self.network(self.space.warp(points), code, window(self.bands, self.alpha)))

    def jacobian(
        self, points: Float[Tensor, "point 3"], code: Float[Tensor, "point code"]
    ) -> Float[Tensor, "point 3 3"]:
        """Derivatives of canonical positions, [i, j] of coordinate i along axis j; differentiable in the network."""
        weights, slope = window(self.bands, self.alpha), self.space.jacobian(points)

        def warped(x: Tensor, coordinates: Tensor) -> Tensor:
            return moved(x, self.network.differentiable(coordinates, code, weights))

        at, axes = (points, self.space.warp(points)), torch.eye(3).to(points)
        along = ((a.expand_as(points), slope @ a) for a in axes)
        return torch.stack([torch.func.jvp(warped, at, tangents)[1] for tangents in along], -1)

    def inverse(
        self, canonical: Float[Tensor, "point 3"], code: Float[Tensor, "point code"], start: Tensor, steps: int = 20
    ) -> Float[Tensor, "point 3"]:
        """Points with given canonical positions, by fixed-point iteration from a start: each step inverts the motion at
        the last result, which is exact for locally constant motion."""
        x = start
        for _ in range(steps):
            x = unmoved(canonical, self.network(self.space.warp(x), code, window(self.bands, self.alpha)))
        return x


class SliceField(Part):
    """Ambient coordinates of points at a time: a slice of a higher-dimensional canonical space (Park 2021b, HyperNeRF,
    section 4.2), for changes of topology."""

    def __init__(self, space: Space, bands: int, code: int, shape: tuple[int, int, int], dimensions: int):
        super().__init__()
        self.space = space
        self.network = DeformationNetwork(bands, code, *shape, dimensions)
        self.register_buffer("weights", torch.ones(bands), persistent=False)

    def forward(
        self, points: Float[Tensor, "point 3"], code: Float[Tensor, "point code"]
    ) -> Float[Tensor, "point ambient"]:
        return self.network(self.space.warp(points), code, self.weights)


def moved(points: Float[Tensor, "point 3"], motion: Float[Tensor, "point number"]) -> Float[Tensor, "point 3"]:
    """Points after motions: translations v, or screw motions (r, v) by the exponential map.

    x' = R x + G v      R = 1 + a [r] + b [r]^2      G = 1 + b [r] + c [r]^2
    a = sin t / t      b = (1 - cos t) / t^2      c = (t - sin t) / t^3      t = |r|
    """
    if motion.shape[1] == 3:
        return points + motion
    r, v = motion.split(3, 1)
    a, b, c = coefficients(r)
    return combined(points, r, a, b) + combined(v, r, b, c)


def unmoved(points: Float[Tensor, "point 3"], motion: Float[Tensor, "point number"]) -> Float[Tensor, "point 3"]:
    """The inverse of `moved` under the same motions."""
    if motion.shape[1] == 3:
        return points - motion
    r, v = motion.split(3, 1)
    a, b, c = coefficients(r)
    return combined(points - combined(v, r, b, c), -r, a, b)


def combined(
    x: Float[Tensor, "point 3"], r: Float[Tensor, "point 3"], first: Tensor, second: Tensor
) -> Float[Tensor, "point 3"]:
    """(1 + first [r] + second [r]^2) x."""
    once = torch.linalg.cross(r, x)
    return x + first * once + second * torch.linalg.cross(r, once)


def coefficients(r: Float[Tensor, "point 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """a, b, c of `moved`, with finite gradients at r = 0."""
    square = r.square().sum(-1, keepdim=True)
    small = square < SMALL_ANGLE**2
    t = torch.where(small, torch.ones_like(square), square).sqrt()
    a = torch.where(small, 1 - square / 6, t.sin() / t)
    b = torch.where(small, 0.5 - square / 24, (1 - t.cos()) / t**2)
    c = torch.where(small, 1 / 6 - square / 120, (t - t.sin()) / t**3)
    return a, b, c
