"""Photometric differences between scene and photographs: backdrops, residuals, variation of light, exposure gains."""

from __future__ import annotations

import copy
import warnings
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import huber_loss, normalize

from ...camera import Camera
from ...camera.rays import Rendering
from ...datasets.scene import Batch, Photograph, Scene
from ...depth_maps.flat_view import FlatView, flat_view
from ...errors import LumigraphWarning
from ...geometry import evenly
from ...method import Part
from ...method.controls import AVERAGE, Control, Value
from .development import decoded, encoded

MAX_PHOTOGRAPHS = 32  # photographs, each beside its neighbour
MAX_SIDE = 200  # pixels along their longer side
POINTS = 1 << 14  # places at most
MIN_SHARED = 30  # places that two photographs must share to be compared
MIN_COLOUR, MAX_COLOUR = 0.05, 0.95  # colours between which a ratio says something
MAX_ANGLE = 20.0  # degrees between the directions from which two photographs see a place; shading differs beyond
MAX_SCATTER = 1.1  # stops by which ratios of one pair deviate (median); beyond, occlusion and not light explains them


@torch.no_grad()
def spread_of_light(scene: Scene) -> float | None:
    """Variation of light between neighbouring photographs, in stops of linear light: the root mean square over
    photographs and channels of the median log2 ratio at common points. None without common points.

    Neighbours have similar views and occlusions, so that the rest is light and exposure. In a sparse capture they may
    not: pairs with directions more than MAX_ANGLE apart, or with ratios that scatter by more than MAX_SCATTER, are
         excluded.
    """
    if scene.points is None or len(train := scene.splits["train"]) < 2:
        return None
    points = scene.points[evenly(range(len(scene.points)), POINTS)]
    beside = neighbours(scene.cameras[train])
    chosen = evenly(range(len(train)), MAX_PHOTOGRAPHS)
    views = {i: flat_view(scene.photograph(int(train[i])), MAX_SIDE) for i in {*chosen, *beside[chosen].tolist()}}
    ratios = [ratio for i in chosen if (ratio := brighter(points, views[i], views[int(beside[i])])) is not None]
    return float(torch.stack(ratios).square().mean().sqrt()) if ratios else None


def spread_of_exposure(scene: Scene) -> float:
    """Variation of light, or without common points the deviation of stated exposures (`Scene.about`), in stops. 0 if
    unknown. Photographs developed from raw files are normalised by `brightness`."""
    measured = spread_of_light(scene)
    if measured is not None:
        return measured
    exposure = scene.about.get("exposure")
    if exposure is None:
        return 0.0
    stops = (exposure * scene.about.get("brightness", torch.tensor(1.0))).log2()[scene.splits["train"]]
    known = stops[stops.isfinite()]
    return float(known.std()) if len(known) > 1 else 0.0


def neighbours(cameras: Camera) -> Int[Tensor, " camera"]:
    """Nearest neighbour of each camera: distance over the extent of all, plus one minus the cosine of directions."""
    position, forward = cameras.position, cameras.forward
    apart = torch.cdist(position, position)
    unlike = apart / apart.amax().clamp_min(1e-9) + 1 - forward @ forward.T
    return unlike.fill_diagonal_(torch.inf).argmin(-1)


def brighter(points: Float[Tensor, "point 3"], one: FlatView, other: FlatView) -> Float[Tensor, " 3"] | None:
    """Stops of linear light by which one picture is brighter than another at common points, for each channel; None for
    too few points, or differences beyond light and exposure."""
    colours, known = [], torch.ones(len(points), dtype=torch.bool)
    for view in (one, other):
        seen, row, column, _ = view.sees(points)
        rgb = view.rgb[row, column]
        colours.append(rgb)
        known &= seen & (view.trust[row, column] > 0.5) & (rgb > MIN_COLOUR).all(-1) & (rgb < MAX_COLOUR).all(-1)
    if int(known.sum()) < MIN_SHARED:
        return None
    towards = [normalize(points[known] - view.pose[:, 3], dim=-1) for view in (one, other)]
    angle = (towards[0] * towards[1]).sum(-1).clamp(-1, 1).acos().rad2deg()
    one_light, other_light = (decoded(rgb[known]) for rgb in colours)
    ratios = (one_light / other_light).log2()
    stops = ratios.median(0).values
    scatter = (ratios - stops).abs().median(0).values
    return stops if float(angle.median()) < MAX_ANGLE and float(scatter.mean()) < MAX_SCATTER else None


Setting = Literal["auto", "yes", "no"]
MIN_SPREAD = 0.33  # stops between neighbouring photographs, beyond which they are of different exposure
MAX_STOPS = 4.0  # that exposure can be turned up or down
RATE_SCALE = 0.05  # of the method's learning rate
GAIN_PIXELS = 4096  # pixels of a photograph from which its gain is found
SCENE = "scene"  # beside photographs and their average: a gain of 1


class Exposure(Part):
    """A gain per photograph and colour channel, initially 1; photographs outside of training keep it.

    A gain multiplies sRGB-encoded colours: photograph = gain x scene. The control `exposure` multiplies linear light,
    as in all methods.

    differ: whether photographs differ in exposure; if not, nothing is trained
    found:  gain of a photograph given as evidence
    rate:   name of the gains' learning rate
    """

    differ: Tensor
    found: Tensor | None = None

    def __init__(self, image_count: int, setting: Setting = "yes", rate: str = ""):
        super().__init__()
        self.setting, self.rate = setting, rate
        self.log_gain = nn.Parameter(torch.zeros(image_count, 3))
        self.register_buffer("differ", torch.tensor(setting == "yes"))

    def begin(self, method: object, data: Scene, seconds: float) -> None:
        """Test whether photographs differ, with the setting auto."""
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
        """Colours of the scene with the photographs' gains; unchanged if photographs do not differ."""
        return rgb * self.log_gain[image_index].exp() if bool(self.differ) else rgb

    def optimizers(self) -> list[torch.optim.Optimizer]:
        group = {"params": [self.log_gain], "scale": RATE_SCALE} | ({"name": self.rate} if self.rate else {})
        return [torch.optim.Adam([group], betas=(0.9, 0.99), eps=1e-15)]

    # Settings

    @property
    def controls(self) -> tuple[Control, ...]:
        """Brightness in stops, and the reference photograph, by default the trained scene, of arbitrary gain."""
        if not bool(self.differ):
            return ()
        photographs = tuple(str(i) for i in range(len(self.log_gain)))
        stops = (-MAX_STOPS, MAX_STOPS)
        about = "The photograph, by number or name, whose brightness and tint are shown; or the average of all."
        return (
            Control("exposure", 0.0, stops, unit="stops", about="Each stop doubles the light."),
            Control("exposed_as", SCENE, choices=(SCENE, AVERAGE, *photographs), about=about, of_photographs=True),
        )

    @property
    def accepts(self) -> tuple[type, ...]:
        """Photographs, if they differ in exposure."""
        return (Photograph,) if bool(self.differ) else ()

    def recoloured(self, method: Any, rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Colours with the gain of the settings, or of a photograph given as evidence, then with the exposure."""
        if self.found is not None and "exposed_as" not in method.settings:
            rgb = rgb * self.found
        if not method.settings or not bool(self.differ):
            return rgb
        rgb, stops = rgb * self.gain(method.settings), float(method.settings.get("exposure", 0.0))
        return encoded(2**stops * decoded(rgb)) if stops else rgb

    def gain(self, told: dict[str, Value]) -> Float[Tensor, " 3"]:
        """Gain of the photograph that settings choose: 1 without any."""
        whose = told.get("exposed_as", SCENE)
        if whose == SCENE:
            log_gain = torch.zeros_like(self.log_gain[0])
        elif whose == AVERAGE:
            learnt = self.log_gain[(self.log_gain != 0).any(-1)]
            log_gain = learnt.sum(0) / max(len(learnt), 1)
        else:
            log_gain = self.log_gain[int(whose)]
        return log_gain.exp()

    @torch.no_grad()
    def adapted(self, method: Any, evidence: Photograph) -> Exposure:
        """The part with the gain of a photograph, fitted to its trusted pixels."""
        batch = evidence.sample_rays(GAIN_PIXELS, method.random(0)).to(self.log_gain.device)
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
    """Gain from colours to a photograph's: median ratio of each channel over well exposed pixels; 1 without any."""
    inside = ((rgb > MIN_COLOUR) & (target > MIN_COLOUR) & (target < MAX_COLOUR)).all(-1)
    return (target[inside] / rgb[inside]).median(0).values if inside.any() else torch.ones_like(target[:1].sum(0))


def backdrop(
    batch: Batch, background: Float[Tensor, "1 3"], generator: torch.Generator, opaque: bool = False
) -> Float[Tensor, "#ray 3"]:
    """Background colours of a batch's rays: the scene's own, or for photographs with alpha a random one for each ray,
    so that colour cannot replace opacity.

    opaque: every ray ends at a surface. Random colours then keep thin fog over black from imitating dark surfaces, and
            over white bright ones
    """
    if batch.alpha is None and not opaque:
        return background
    return torch.rand(len(batch), 3, generator=generator).to(background.device)


def residuals(
    rendering: Rendering, batch: Batch, background: Float[Tensor, "#ray 3"], exposure: Exposure | None = None
) -> tuple[Float[Tensor, "row 3"], float]:
    """Differences of a composited rendering from photographs, and their mean square.

    With alpha, as many rows again are composited over the opposite colours, 1 - background, which shows only errors of
    opacity; they are not in the mean.
    exposure: gains of the photographs, which apply to the scene and not to the background
    """
    rgb = rendering.rgb
    if exposure and batch.rays.image_index is not None:
        behind = (1 - rendering.opacity)[:, None] * background
        rgb = exposure(rgb - behind, batch.rays.image_index) + behind
    residual = rgb - batch.before(background)
    mse = float(residual.detach().square().mean())
    if batch.alpha is not None:
        lacking = (batch.alpha - rendering.opacity)[:, None]
        residual = torch.cat([residual, residual + lacking * (1 - 2 * background)])
    return residual, mse


def huber(residual: Float[Tensor, "row 3"], delta: float, reduction: str = "mean") -> Tensor:
    """Huber loss of residuals divided by delta, so that the linear part has slope 1; with a delta of 1, the largest
    residual of colours, the squared error.

    reduction: "mean", or "none" for a row of each residual
    """
    if delta >= 1:
        return residual.square().mean() if reduction == "mean" else residual.square()
    return huber_loss(residual, torch.zeros_like(residual), reduction=reduction, delta=delta) / delta
