"""Addition: a part of splatting methods with hooks in a training step; Step, the state of a step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rendering
from ...datasets.scene import Photograph, Scene
from ...gaussians import Gaussians
from ...gaussians.splatting import Splatted
from ...method import Part
from .dense_points import Points


@dataclass
class Step:
    """State of one training step between the cloud and the loss.

    chance:     random generator of this step
    whole:      the trained cloud, with filters
    cloud:      the rasterised cloud
    camera:     of the photograph, with its pose correction
    picture:    rasterised, over black
    rgb:        the picture in the photograph's appearance; composited over the background after `after_raster`
    background: one colour or one for each pixel
    target:     target colours of the loss
    residual:   rgb - target before masking
    due:        whether density control is due after this step
    """

    photograph: Photograph
    chance: torch.Generator
    whole: Gaussians
    cloud: Gaussians
    camera: Camera
    picture: Splatted = field(init=False)
    rgb: Float[Tensor, "height width 3"] = field(init=False)
    background: Float[Tensor, "... 3"] = field(init=False)
    target: Float[Tensor, "height width 3"] = field(init=False)
    residual: Float[Tensor, "height width 3"] = field(init=False)
    terms: dict[str, Tensor] = field(default_factory=dict)
    due: bool = False


class Addition(Part):
    """A part that changes training or rendering of a cloud. All hooks do nothing by default, and are called in order of
    assignment. `method` is the CloudMethod of the part.

    base_colours: whether it keeps harmonics beyond degree 0 at zero
    """

    base_colours: bool = False

    def layers(self, data: Scene) -> tuple[str, ...]:
        """Names of the layers of its photograph that a step reads."""
        return ()

    # The cloud

    def begin_cloud(self, method: Any) -> None:
        """Initialise for a new cloud."""

    def begin_scene(self, method: Any, data: Scene, sweep: Callable[[], Points]) -> None:
        """Initialise from the photographs. sweep: returns points of plane sweeps"""

    def prune(self, keep: Bool[Tensor, " gaussian"] | Int[Tensor, " kept"]) -> None:
        """Update after pruning to the Gaussians of a mask, or of indices."""

    def filtered(self, cloud: Gaussians) -> Gaussians:
        """The cloud with filters, as it is rasterised in training and rendering."""
        return cloud

    # A training step

    def before_raster(self, method: Any, step: Step) -> None:
        """Change the cloud before rasterisation in a step."""

    def after_raster(self, method: Any, step: Step) -> None:
        """Change the colours and the background in a step."""

    def mask(self, method: Any, step: Step) -> None:
        """Mask pixels: their target becomes their own colour."""

    def regularize(self, method: Any, step: Step) -> None:
        """Add terms to the loss."""

    # Rendering

    def apply_appearance(
        self, method: Any, seen: Rendering, camera: Camera, background: Float[Tensor, "... 3"]
    ) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "... 3"]]:
        """Colours over black and the background, under the method's settings."""
        return seen.rgb, background

    def recoloured_cloud(self, method: Any, cloud: Gaussians) -> Gaussians:
        """A cloud whose colours are those of the method's settings."""
        return cloud
