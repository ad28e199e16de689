"""Exposure correction: a gain for each photograph, where photographs are found to differ."""

from __future__ import annotations

import copy
import warnings
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ...datasets.scene import Photograph, Scene
from ...errors import LumigraphWarning
from ...method import Part
from ...method.controls import Control, Value
from ..fields.appearance import AVERAGE, drawn
from .lights import BRIGHTEST, DARKEST, spread_of_exposure

Setting = Literal["auto", "yes", "no"]
MIN_SPREAD = 0.15  # stops between neighbouring photographs, beyond which they are of different exposure
MAX_STOPS = 4.0  # that exposure can be turned up or down
RATE_SCALE = 0.05  # of the method's learning rate
GAIN_PIXELS = 4096  # pixels of a photograph from which its gain is found
SCENE = "scene"  # beside photographs and their average: a gain of 1


class Exposure(Part):
    """A gain per photograph and colour channel, 1 at first; photographs that were not trained on keep it.

    A gain multiplies sRGB-encoded colours, as a photograph has them: photograph = gain x scene. So a stop doubles
    them in this space, and not linear light.

    differ: whether photographs are of different exposure; nothing is learnt where they are not
    found:  gain of a photograph that was given as evidence
    rate:   name of the learning rate that the gains follow
    """

    differ: Tensor
    found: Tensor | None = None

    def __init__(self, image_count: int, setting: Setting = "yes", rate: str = ""):
        super().__init__()
        self.setting, self.rate = setting, rate
        self.log_gain = nn.Parameter(torch.zeros(image_count, 3))
        self.register_buffer("differ", torch.tensor(setting == "yes"))

    def begin(self, method: Any, data: Scene, seconds: float) -> None:
        """Find out whether photographs differ, with the setting auto."""
        if self.setting != "auto":
            return
        stops = spread_of_exposure(data)
        self.differ.fill_(stops > MIN_SPREAD)
        if bool(self.differ):
            warnings.warn(
                f"Neighbouring photographs differ by {stops:.1f} stops, so each has an exposure of its own; "
                "`--exposure-correction no` takes all for the same",
                LumigraphWarning,
                stacklevel=3,
            )

    def forward(self, rgb: Float[Tensor, "ray 3"], image_index: Int[Tensor, " ray"]) -> Float[Tensor, "ray 3"]:
        """Colours of the scene as photographs have them; unchanged where photographs do not differ."""
        return rgb * self.log_gain[image_index].exp() if bool(self.differ) else rgb

    def optimizers(self) -> list[torch.optim.Optimizer]:
        group = {"params": [self.log_gain], "scale": RATE_SCALE} | ({"name": self.rate} if self.rate else {})
        return [torch.optim.Adam([group], betas=(0.9, 0.99), eps=1e-15)]

    # Settings

    @property
    def controls(self) -> tuple[Control, ...]:
        """Brightness in stops, and the photograph whose exposure they count from. By default they count from the scene
        as it was learnt, which is arbitrary: a gain that all photographs share can be the scene's own."""
        if not bool(self.differ):
            return ()
        photographs = tuple(str(i) for i in range(len(self.log_gain)))
        stops = (-MAX_STOPS, MAX_STOPS)
        about = "The photograph, by number or name, whose brightness and tint are shown; or the average of all."
        return (
            Control("exposure", 0.0, stops, unit="stops", about="Each stop doubles the scene's colours."),
            Control("exposed_as", SCENE, choices=(SCENE, AVERAGE, *photographs), about=about, of_photographs=True),
        )

    @property
    def accepts(self) -> tuple[type, ...]:
        """Photographs, where their exposures were learnt to differ."""
        return (Photograph,) if bool(self.differ) else ()

    def recoloured(self, method: Any, rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Colours with the gain of the settings, or of a photograph given as evidence."""
        if self.found is not None and "exposed_as" not in method.settings:
            rgb = rgb * self.found
        return rgb * self.gain(method.settings) if method.settings and bool(self.differ) else rgb

    def gain(self, told: dict[str, Value]) -> Float[Tensor, " 3"]:
        """The factor on colours that settings ask for: 1 without any."""
        whose = told.get("exposed_as", SCENE)
        if whose == SCENE:
            log_gain = torch.zeros_like(self.log_gain[0])
        elif whose == AVERAGE:
            learnt = self.log_gain[(self.log_gain != 0).any(-1)]
            log_gain = learnt.sum(0) / max(len(learnt), 1)
        else:
            log_gain = self.log_gain[int(whose)]
        return log_gain.exp() * 2 ** float(told.get("exposure", 0.0))

    @torch.no_grad()
    def adapted(self, method: Any, evidence: Photograph) -> Exposure:
        """The part with the gain of a photograph, found from its trusted pixels."""
        batch = drawn(evidence, GAIN_PIXELS, method.random(0)).to(self.log_gain.device)
        method.settings.pop("exposed_as", None)
        adapted = copy.copy(self)
        if not len(batch):
            return adapted
        plain = copy.copy(method)
        plain.settings = {}
        parts = [
            plain.render_rays(batch.rays[part], plain.background).rgb
            for part in torch.arange(len(batch), device=self.log_gain.device).split(plain.rays_per_chunk)
        ]
        gain = gain_between(torch.cat(parts), batch.before(plain.background))
        adapted.found = gain if self.found is None else gain * self.found
        return adapted


@torch.no_grad()
def gain_between(rgb: Float[Tensor, "pixel 3"], target: Float[Tensor, "pixel 3"]) -> Float[Tensor, " 3"]:
    """Gain that turns colours into a photograph's: the median ratio of each channel, over pixels that are neither too
    dark nor too bright; 1 where there are none."""
    inside = ((rgb > DARKEST) & (target > DARKEST) & (target < BRIGHTEST)).all(-1)
    return (target[inside] / rgb[inside]).median(0).values if inside.any() else torch.ones_like(target[:1].sum(0))
