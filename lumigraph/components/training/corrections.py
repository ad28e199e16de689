"""What differs from photograph to photograph: exposure."""

from __future__ import annotations

import warnings
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ...controls import Control, Value
from ...errors import LumigraphWarning
from ...scene import Scene
from .lights import BRIGHTEST, DARKEST, spread_of_exposure

Setting = Literal["auto", "yes", "no"]
DIFFERENT = 0.15  # stops between neighbouring photographs, beyond which they are of different exposure
STOPS = 4.0  # that exposure can be turned up or down
SCENE, AVERAGE = "scene", "average"  # beside the photographs: a gain of 1, and the mean of those that were learnt


class Exposure(nn.Module):
    """A gain per photograph and colour channel, 1 at first; photographs that were not trained on keep it.

    A gain multiplies sRGB-encoded colours, as a photograph has them: photograph = gain x scene. So a stop doubles
    them in this space, and not linear light.

    differ: whether photographs are of different exposure; nothing is learnt where they are not
    """

    differ: Tensor

    def __init__(self, image_count: int, setting: Setting = "yes"):
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(image_count, 3))
        self.register_buffer("differ", torch.tensor(setting == "yes"))

    def begin(self, scene: Scene, setting: Setting) -> None:
        """Find out whether photographs differ, where nobody has said."""
        if setting != "auto":
            return
        stops = spread_of_exposure(scene)
        self.differ.fill_(stops > DIFFERENT)
        if bool(self.differ):
            warnings.warn(
                f"Neighbouring photographs differ by {stops:.1f} stops, so each has an exposure of its own; "
                "`--exposure-correction no` takes all for the same",
                LumigraphWarning,
                stacklevel=3,
            )

    def forward(self, rgb: Float[Tensor, "ray 3"], image_index: Int[Tensor, " ray"]) -> Float[Tensor, "ray 3"]:
        return rgb * self.log_gain[image_index].exp()

    @property
    def controls(self) -> tuple[Control, Control]:
        """Brightness in stops, and whose exposure they count from: by default that of the scene as it was learnt, which
        may be any, for a gain that all photographs share is as well the scene's own."""
        photographs = tuple(str(i) for i in range(len(self.log_gain)))
        return (
            Control("exposure", 0.0, (-STOPS, STOPS), unit="stops", about="Each stop doubles the scene's colours."),
            Control(
                "exposed_as",
                SCENE,
                choices=(SCENE, AVERAGE, *photographs),
                about="The photograph, by number or name, whose brightness and tint are shown; or the average of all.",
                of_photographs=True,
            ),
        )

    def gain(self, told: dict[str, Value]) -> Float[Tensor, " 3"]:
        """What the controls multiply colours with: 1 where they were not touched."""
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
def gain_between(rgb: Float[Tensor, "pixel 3"], target: Float[Tensor, "pixel 3"]) -> Float[Tensor, " 3"]:
    """What colours are to be multiplied with to be a photograph's: the median ratio of each channel, over pixels that
    are neither too dark nor too bright to tell; 1 where there are none."""
    inside = ((rgb > DARKEST) & (target > DARKEST) & (target < BRIGHTEST)).all(-1)
    return (target[inside] / rgb[inside]).median(0).values if inside.any() else torch.ones_like(target[:1].sum(0))
