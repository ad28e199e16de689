"""Appearance of photographs: affine colours and a sky for each, if photographs differ."""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...camera import Camera
from ...camera.rays import Rendering
from ...datasets.scene import Frame, Photograph, Scene
from ...errors import LumigraphWarning
from ...gaussians import Gaussians
from ...kernels.spherical_harmonics import K00
from ...method.controls import Configured, Control
from ..fields.appearance import APPEARANCE, PhotographCodes
from ..training.photometric import spread_of_light
from ..training.schedules import falling
from .addition import Addition, Step
from .cloud import CloudAdam
from .interval_schedule import short_schedule_lr_scale

MIN_SPREAD = 0.66  # stops between neighbouring photographs, beyond which each has an appearance
FULL_SCHEDULE_PASSES = 400  # steps for each photograph, from which on the learning rate is not scaled
MAX_LR_SCALE = 6.0  # of the learning rate, in short runs
FINAL_APPEARANCE_LR = 5e-4  # learning rate of appearance codes at the end of the budget
APPEARANCE_REGULARIZATION = 1e-3  # weight of squares of appearance codes in the loss
APPEARANCE_LR = 5e-3  # learning rate of these colours and skies at first


@dataclass(frozen=True)
class AppearanceNumbers:
    """A Config's numbers of the appearance of photographs."""

    appearance: Literal["auto", "yes", "no"] = "auto"  # colours for each photograph; auto: where photographs differ
    own_skies: bool = True  # with appearance, learn a sky for each photograph of an open capture


class SplatAppearance(Addition):
    """A code for each photograph: affine colours, then a sky in unbounded scenes.

    differ: whether photographs differ in appearance; if not, nothing is trained
    found:  code of a photograph given as evidence
    """

    differ: Tensor
    found: Tensor | None = None

    def __init__(self, frame: Frame, numbers: AppearanceNumbers):
        super().__init__()
        self.numbers = numbers
        self.has_sky = numbers.own_skies and frame.is_open and not frame.has_alpha
        self.codes = PhotographCodes(frame.image_count, COLOUR_NUMBERS + SKY_NUMBERS * self.has_sky)
        self.register_buffer("differ", torch.tensor(numbers.appearance == "yes"))

    @property
    def is_active(self) -> bool:
        return bool(self.differ)

    # Training

    @torch.no_grad()
    def begin(self, method: object, data: Scene, seconds: float) -> None:
        """Test whether photographs differ, with the setting auto; initialise uniform skies."""
        if self.numbers.appearance == "auto":
            stops = spread_of_light(data) or 0.0
            self.differ.fill_(stops > MIN_SPREAD)
            if self.is_active:
                warnings.warn(
                    f"Neighbouring photographs differ by {stops:.1f} stops, so each has colours of its own, and what "
                    "moved between them is left out; `--appearance no` takes all for the same light",
                    LumigraphWarning,
                    stacklevel=3,
                )
        if self.is_active and self.has_sky:
            self.codes.codes[:, COLOUR_NUMBERS:] = mean_skies(data).to(self.differ.device)

    def after_raster(self, step: Step) -> None:
        if not self.is_active or step.camera.image_index is None:
            return
        code, opacity = self.codes(step.camera.image_index)[0], step.picture.opacity
        step.rgb = recoloured(step.rgb, opacity, code)
        if self.has_sky:
            step.background = sky(code[COLOUR_NUMBERS:], step.photograph.camera)
            step.terms["sky"] = sky_loss(step.background, step.photograph, opacity)
        step.terms["appearance"] = APPEARANCE_REGULARIZATION * code[:COLOUR_NUMBERS].square().sum()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        """Optimizer in which one row a step has a gradient, as with Gaussians."""
        return [CloudAdam([{"name": "appearance", "params": [self.codes.codes], "lr": APPEARANCE_LR}])]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        full_schedule = FULL_SCHEDULE_PASSES * len(self.codes.codes)
        rate = falling(APPEARANCE_LR, FINAL_APPEARANCE_LR, progress)
        return {"appearance": short_schedule_lr_scale(step, progress, full_schedule, MAX_LR_SCALE) * rate}

    # Rendering

    def apply_appearance(
        self, method: Configured, seen: Rendering, camera: Camera, background: Float[Tensor, "... 3"]
    ) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "... 3"]]:
        code = self.code(method)
        if code is None:
            return seen.rgb, background
        rgb = recoloured(seen.rgb, seen.opacity, code).clamp(0, 1)
        return rgb, sky(code[COLOUR_NUMBERS:], camera).clamp(0, 1) if self.has_sky else background

    def recoloured_cloud(self, method: Configured, cloud: Gaussians) -> Gaussians:
        code = self.code(method)
        return cloud if code is None else replace(cloud, harmonics=recoloured_harmonics(cloud.harmonics, code))

    def code(self, method: Configured) -> Float[Tensor, " number"] | None:
        """Code of the control, else of a given photograph, else the average; None where photographs do not differ."""
        if not self.is_active:
            return None
        if self.found is not None and "appearance" not in method.settings:
            return self.found
        return self.codes.code_of(str(method.control("appearance"))).detach()

    # Settings

    @property
    def controls(self) -> tuple[Control, ...]:
        return (self.codes.control("appearance", APPEARANCE),) if self.is_active else ()

    @property
    def accepts(self) -> tuple[type, ...]:
        """Photographs, if they differ in appearance."""
        return (Photograph,) if self.is_active else ()

    @torch.no_grad()
    def adapted(self, method: Any, evidence: Photograph) -> SplatAppearance:
        """The part with the code fitted to the trusted pixels of a photograph; the average without any."""
        photograph, background = evidence.to(method.device), method.background[0]
        seen = method.rasterized(photograph.camera)
        target, trusted = photograph.before(background), photograph.mask
        if trusted is None:
            trusted = torch.ones_like(seen.opacity, dtype=torch.bool)
        behind = sky_harmonics(photograph.camera)[trusted] if self.has_sky else None
        if behind is None:
            target = target - (1 - seen.opacity[..., None]) * background
        adapted, start = copy.copy(self), self.codes.average
        adapted.found = fit_colours(start, seen.rgb[trusted], seen.opacity[trusted], target[trusted], behind)
        method.settings.pop("appearance", None)
        return adapted


COLOUR_NUMBERS = 12  # of a photograph's code: the nine of A by rows, the three of b
ZERO_COLOUR = 0.5  # colour of a Gaussian whose harmonics are zero
ROUNDS = 12  # of reweighted least squares, with which a code is fitted to a photograph
MAX_PIXELS = 1 << 14  # evenly chosen, that a code is fitted to
MIN_RESIDUAL = 0.01  # below which a pixel's weight stays the same
COLOUR_PRIOR = 3e-3  # weight of the squared change of A and b: a grey wall does not determine how channels mix
REST_PRIOR = 0.01  # weight of the squared change of the rest of a code, which most pixels do not determine


def recoloured(
    rgb: Float[Tensor, "*#row 3"], opacity: Float[Tensor, "*#row"], code: Float[Tensor, " number"]
) -> Float[Tensor, "*#row 3"]:
    """Colours over black in a photograph's appearance; the affine map applies to the scene only, not to the background.

    rgb:     premultiplied by opacity, so that b is multiplied by it too
    opacity: of each colour
    """
    matrix, offset = _map(code)
    return rgb @ matrix.T + opacity[..., None] * offset


def recoloured_harmonics(
    harmonics: Float[Tensor, "gaussian coefficient 3"], code: Float[Tensor, " number"]
) -> Float[Tensor, "gaussian coefficient 3"]:
    """Spherical harmonics with a photograph's affine appearance, for all directions.

    A colour is 1/2 + sum_k Y_k h_k, so that h_k' = (I + A) h_k, and the constant takes up the rest of 1/2 and b. Exact
    except for colours clamped at 0, which happens after this and before `recoloured`.
    """
    matrix, offset = _map(code)
    out = harmonics @ matrix.T
    constant = out[:, :1] + (ZERO_COLOUR * (matrix.sum(-1) - 1) + offset) / K00
    return torch.cat([constant, out[:, 1:]], 1)


@torch.no_grad()
def fit_colours(
    start: Float[Tensor, " number"],
    rgb: Float[Tensor, "pixel 3"],
    opacity: Float[Tensor, " pixel"],
    target: Float[Tensor, "pixel 3"],
    behind: Float[Tensor, "pixel 9"] | None = None,
) -> Float[Tensor, " number"]:
    """Fit a code to a photograph by mean absolute difference, which is robust to distractors.

    The picture, rgb (I + A)^T + opacity b + (1 - opacity) behind s, is linear in the code: so iteratively reweighted
    least squares (Schlossmacher 1973) converge in a few iterations.

    start:   prior mean of the code, and the result without pixels
    rgb:     of the scene over black;  target: the photograph, less a fixed background
    behind:  harmonics of the directions, for a code with a sky; it is kept unless pixels determine it
    """
    few = slice(None, None, -(-len(target) // MAX_PIXELS) or 1)
    rgb, opacity, target = rgb[few].double(), opacity[few, None].double(), target[few].double()
    if not len(target):
        return start
    parts = [rgb, opacity] if behind is None else [rgb, opacity, (1 - opacity) * behind[few]]
    rows, matrix = torch.cat(parts, 1), _columns(start).double()
    held = torch.full_like(matrix, REST_PRIOR)
    held[:4] = COLOUR_PRIOR
    first, drawn = matrix, torch.diag_embed(held.T)
    for _ in range(ROUNDS):
        weights = 0.5 / (rows @ matrix - target).abs().clamp_min(MIN_RESIDUAL) / target.numel()
        normal = torch.einsum("nc,na,nb->cab", weights, rows, rows) + drawn
        wanted = torch.einsum("nc,na->ca", weights * target, rows) + (held * first).T
        matrix = torch.linalg.solve(normal, wanted).T
    return torch.cat([(matrix[:3].T - torch.eye(3).to(matrix)).flatten(), matrix[3:].flatten()]).to(start)


def _columns(code: Float[Tensor, " number"]) -> Float[Tensor, "row 3"]:
    """(I + A)^T, b and the sky of a code, three colours a row."""
    matrix, offset = _map(code)
    return torch.cat([matrix.T, offset[None], code[COLOUR_NUMBERS:].view(-1, 3)])


def _map(code: Float[Tensor, " number"]) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """I + A and b, the first numbers of a photograph's code."""
    return torch.eye(3, device=code.device) + code[:9].view(3, 3), code[9:COLOUR_NUMBERS]


SKY_BANDS = 3  # of spherical harmonics
SKY_NUMBERS = 3 * SKY_BANDS**2  # of a photograph's code: the harmonics by rows, three colours each


def sky(code: Float[Tensor, " 27"], camera: Camera) -> Float[Tensor, "height width 3"]:
    """Sky colours at every pixel of one camera."""
    return sky_harmonics(camera) @ code.view(SKY_BANDS**2, 3)


def sky_harmonics(camera: Camera) -> Float[Tensor, "height width 9"]:
    """Values of the sky's harmonics at every pixel of one camera."""
    width, height = camera.size[0].tolist()
    directions = camera.rays(camera.pixels()).directions
    return kernels.spherical_harmonics(directions, SKY_BANDS).view(height, width, SKY_BANDS**2)


def sky_loss(
    background: Float[Tensor, "height width 3"], photograph: Photograph, opacity: Float[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """Absolute error of a sky at masked transparent pixels: a mask around an object excludes its surroundings from
    training, but must not let them have any colour."""
    if photograph.mask is None:
        return background.new_zeros(())
    counts = (1 - opacity.detach()) * ~photograph.mask
    return (counts[..., None] * (background - photograph.rgb).abs()).mean()


@torch.no_grad()
def mean_skies(scene: Scene) -> Float[Tensor, "image 27"]:
    """Codes of a uniform sky in the mean colour of each training photograph; zeros for the others."""
    codes = torch.zeros(len(scene.cameras), SKY_NUMBERS)
    for index in scene.splits["train"].tolist():
        codes[index, :3] = scene.photograph(index).rgb.flatten(0, 1).mean(0) / K00
    return codes
