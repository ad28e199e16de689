"""Appearance embedding: a learnt code per photograph, for light and colours.

Generative latent optimisation (Bojanowski 2018), as in Martin-Brualla 2021, section 4.1.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ... import kernels
from ...camera.rays import Rays
from ...datasets.scene import Batch, Frame, Photograph
from ...errors import LumigraphError
from ...files.ranges import between
from ...method import Part
from ...method.controls import AVERAGE, Control, blend
from ...volume import composite, weights_of
from .hash_field import side_by_side
from .layers import MLP


def axes_of(codes: Float[Tensor, "known code"], least: float = 0.0) -> Float[Tensor, "axis code"]:
    """Principal axes of codes, scaled by their deviations: the mean plus `w @ axes` with standard normal w has the
    distribution of the fitted Gaussian. None for fewer than two codes.

    least: deviation added to every axis; above 0 there are as many axes as numbers
    """
    if len(codes) < 2:
        return codes[:0]
    off = (codes - codes.mean(0)) / (len(codes) - 1) ** 0.5
    _, found, along = torch.linalg.svd(off, full_matrices=least > 0)
    deviation = (torch.cat([found, found.new_zeros(len(along) - len(found))]).square() + least**2).sqrt()
    return (deviation[:, None] * along)[deviation > 1e-4 * deviation[:1].clamp_min(1e-9)]


def fitted(
    start: Float[Tensor, " width"], error: Callable[[Float[Tensor, " width"]], Tensor], steps: int, learning_rate: float
) -> Float[Tensor, " width"]:
    """Minimise an error over some numbers by `steps` steps of Adam from a start, with everything else fixed.

    error: differentiable function of the numbers
    """
    with torch.enable_grad():
        code = start.detach().clone().requires_grad_()
        adam = torch.optim.Adam([code], learning_rate)
        for step in range(steps):
            (code.grad,) = torch.autograd.grad(error(code), [code])
            adam.param_groups[0]["lr"] = learning_rate * (1 - step / steps)
            adam.step()
    return code.detach()


CodeWidth = Annotated[int, between(1, 1024)]  # numbers of a photograph's code
APPEARANCE = "The photograph, by number or name, in whose light and colours the scene is shown; or the average of all."

FIT_STEPS, FIT_RATE = 100, 0.1  # the rate in deviations of the learnt codes
FIT_PRIOR = 2e-5  # of squared error, for a deviation from the average
FIT_WEIGHT = 5e-3  # weight in its pixel above which a sample counts
FIT_LEAST = 0.03  # deviation also where none of the codes differ; those of trained blocks differ by 0.07 on average


@dataclass(frozen=True)
class Appearance:
    """A code as evidence: `method.given(Appearance(code))` is the scene with that appearance."""

    code: Float[Tensor, " width"]


@dataclass(frozen=True)
class Patches:
    """Small patches of pictures as evidence, compared by their mean colours.

    Compared pixel by pixel, noise in either geometry would look like low contrast, and the fitted code would reduce
    contrast.

    batch: rays patch by patch, with their colours
    size:  rays of a patch
    """

    batch: Batch
    size: int


class PhotographCodes(Part):
    """Code of each photograph, initially zero; photographs outside of training keep zeros.

    image_count: photographs of the scene, held-out ones included
    width:       length of a code
    """

    def __init__(self, image_count: int, width: int):
        super().__init__()
        self.codes = nn.Parameter(torch.zeros(image_count, width))

    def forward(self, image_index: Int[Tensor, " ray"]) -> Float[Tensor, "ray width"]:
        return self.codes.index_select(0, image_index)

    @property
    def learnt(self) -> Bool[Tensor, " image"]:
        """Mask of the photographs with trained codes."""
        return (self.codes != 0).any(-1)

    @property
    def average(self) -> Float[Tensor, " width"]:
        """Mean of the trained codes; zeros without any."""
        learnt = self.learnt
        return self.codes[learnt].sum(0) / max(int(learnt.sum()), 1)

    def fitted(
        self, start: Float[Tensor, " width"], error: Callable[[Float[Tensor, " width"]], Tensor]
    ) -> Float[Tensor, " width"]:
        """Fit a code by an error, regularised by the distribution of the trained codes, since codes far from them are
        undefined. The start, if fewer than two were trained.

        error: the mean squared error of colours, differentiable in the code
        """
        average, axes = self.average.detach(), axes_of(self.codes.detach()[self.learnt], FIT_LEAST)
        if not len(axes):
            return start

        def likely(where: Float[Tensor, " axis"]) -> Tensor:
            return error(average + where @ axes) + FIT_PRIOR * where.square().sum()

        there = (start - average) @ axes.T / axes.square().sum(-1)
        return average + fitted(there, likely, FIT_STEPS, FIT_RATE) @ axes

    def code_of(self, value: str) -> Float[Tensor, " width"]:
        """Code of a control's value: a photograph's (the average if untrained), the average, or an interpolation of
        two."""
        first, second, share = blend(value)
        return torch.lerp(self._of(first), self._of(second), share)

    def control(self, name: str, about: str) -> Control:
        """The control that chooses among the codes, the average by default."""
        photographs = tuple(str(i) for i in range(len(self.codes)))
        return Control(name, AVERAGE, choices=(AVERAGE, *photographs), about=about, of_photographs=True, blends=True)

    def _of(self, choice: str) -> Float[Tensor, " width"]:
        known = choice != AVERAGE and bool(self.codes[int(choice)].any())
        return self.codes[int(choice)] if known else self.average


class AppearanceCodes(PhotographCodes):
    """Appearance code of each photograph, chosen by the control `appearance` or fitted to evidence. The field's code
    begins with it.

    evidence: kinds of evidence that an appearance can be fitted to
    pixels:   number of compared pixels of a photograph
    found:    appearance of the evidence
    """

    found: Tensor | None = None

    def __init__(self, image_count: int, width: int, evidence: tuple[type, ...] = (Photograph,), pixels: int = 1024):
        super().__init__(image_count, width)
        self.evidence, self.pixels = evidence, pixels

    @property
    def controls(self) -> tuple[Control, ...]:
        return (self.control("appearance", APPEARANCE),)

    @property
    def accepts(self) -> tuple[type, ...]:
        return self.evidence

    def shown(self, method: Any) -> Float[Tensor, " width"]:
        """Code of the settings, else of the evidence, else the average."""
        if self.found is not None and "appearance" not in method.settings:
            return self.found
        return self.code_of(str(method.control("appearance")))

    def adapted(self, method: Any, evidence: Photograph | Patches | Appearance) -> AppearanceCodes:
        """The part with the appearance fitted to a photograph's trusted pixels (Martin-Brualla 2021, section 5), or to
        patches of pictures; or with a given code."""
        adapted = copy.copy(self)
        adapted.found = self._matched(method, evidence)
        method.settings.pop("appearance", None)
        return adapted

    @torch.no_grad()
    def _matched(self, method: Any, evidence: Photograph | Patches | Appearance) -> Float[Tensor, " width"]:
        """Appearance fitted to a piece of evidence; the current one without trusted pixels."""
        start = self.shown(method)
        if isinstance(evidence, Appearance):
            if evidence.code.shape != start.shape:
                raise LumigraphError(
                    f"An appearance of {len(evidence.code)} numbers does not fit a block whose photographs have "
                    f"{len(start)}; give it one that was aligned with this block"
                )
            return evidence.code.to(start)
        if isinstance(evidence, Patches):
            batch, size = evidence.batch.to(start.device), evidence.size
        else:
            batch, size = evidence.sample_rays(self.pixels, method.random(0)).to(start.device), 1
        if not len(batch):
            return start
        codes = method.code(batch.rays)
        background, rest = method.background, codes[:, len(start) :]
        target = batch.before(background)
        last = method.sampler.sample(batch.rays, method.network, codes)[-1]
        last = last.keep(weights_of(last.samples, last.density) > FIT_WEIGHT)

        def error(appearance: Tensor) -> Tensor:
            code = torch.cat([appearance.expand(len(rest), -1), rest], -1)
            look, behind = last.look(method.network, code), method.behind(batch.rays, code, background)
            residual = composite(look.samples, look.density, look.rgb, behind).rgb - target
            return residual.view(-1, size, 3).mean(1).square().sum(-1).mean()

        return self.fitted(start, error)


class SkyField(Part):
    """Learnt sky colours (as in Rematas 2022, beside the code).

    Sky and weather change between photographs. Without a sky, a transient head would explain them, and with them the
    scene.
    """

    def __init__(self, bands: int, code: int, hidden_width: int):
        super().__init__()
        self.bands, self.network = bands, MLP(bands**2 + code, hidden_width, 3)

    def behind(
        self, rays: Rays, code: Float[Tensor, "#ray code"] | None, background: Float[Tensor, "#ray 3"]
    ) -> Float[Tensor, "ray 3"]:
        codes = [] if code is None else [code.expand(len(rays), -1)]
        harmonics = kernels.spherical_harmonics(rays.directions, self.bands)
        return self.network(side_by_side(harmonics, *codes)).sigmoid()


def sky_for(frame: Frame, wanted: bool, bands: int, code: int, hidden_width: int) -> SkyField | None:
    """A sky for an unbounded scene, if wanted."""
    return SkyField(bands, code, hidden_width) if wanted and frame.is_open and not frame.has_alpha else None
