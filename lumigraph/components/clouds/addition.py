"""Addition: a part of splatting methods with hooks in a training step; Step, the state of a step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rendering
from ...datasets.scene import Photograph, Scene
from ...gaussians import Gaussians
from ...gaussians.splatting import Splatted
from ...method import Part
from ...method.controls import Configured
from ..training.dense_points import Points
from .cloud import Cloud


@dataclass(frozen=True)
class TrainingViews:
    """Views that a cloud is learnt from.

    cameras:    of all photographs, as they were given; None before training
    refined:    gives cameras their learnt poses
    near_plane: of rasterization
    near:       distance within which nothing is, `Frame.near`
    move:       whether poses are learnt
    """

    cameras: Camera | None
    refined: Callable[[Camera], Camera]
    near_plane: float
    near: float
    move: bool


@dataclass
class Step:
    """State of one training step between the cloud and the loss.

    chance:     random numbers of this step; refining: those of density control
    whole:      the cloud that is learnt, with filters
    cloud:      the cloud that is rasterized
    camera:     of the photograph, with its learnt pose
    picture:    rasterized, over black
    rgb:        the picture in the photograph's appearance; in front of the background once `after_raster` is over
    background: behind everything, one colour or one for each pixel
    target:     colours that the loss compares with
    residual:   rgb - target before pixels are left out
    learnt:     the parameters
    progress:   share of the budget spent;  drawn: number of photographs that were learnt from
    bands:      of the harmonics in use
    moment:     of the photograph, in a scene that moves
    differ:     whether photographs have appearances of their own
    full_size:  whether photographs have their final size
    due:        whether density control is due after this step
    explained:  zeros whose gradient is the error that each Gaussian explains, where density control asks for it
    """

    photograph: Photograph
    chance: torch.Generator
    whole: Gaussians
    cloud: Gaussians
    camera: Camera
    learnt: Cloud
    views: TrainingViews
    number: int
    refining: torch.Generator
    progress: float
    drawn: int
    bands: int
    moment: float
    differ: bool
    full_size: bool
    picture: Splatted = field(init=False)
    rgb: Float[Tensor, "height width 3"] = field(init=False)
    background: Float[Tensor, "... 3"] = field(init=False)
    target: Float[Tensor, "height width 3"] = field(init=False)
    residual: Float[Tensor, "height width 3"] = field(init=False)
    terms: dict[str, Tensor] = field(default_factory=dict)
    due: bool = False
    explained: Float[Tensor, " gaussian"] | None = None


class Addition(Part):
    """A part that changes how a cloud is learnt or shown. All hooks do nothing by default, and are visited in the order
    in which parts were assigned.

    base_colours: whether it keeps harmonics beyond degree 0 at zero
    """

    base_colours: bool = False

    def layers(self, data: Scene) -> tuple[str, ...]:
        """Names of the layers of its photograph that a step reads."""
        return ()

    # The cloud

    def begin_cloud(self, cloud: Cloud, views: TrainingViews, chance: torch.Generator) -> None:
        """Follow a new cloud."""

    def begin_scene(self, cloud: Cloud, views: TrainingViews, data: Scene, sweep: Callable[[], Points]) -> None:
        """Initialise from the photographs. sweep: gives points that plane sweeps find"""

    def follow(self, source: Int[Tensor, " gaussian"]) -> None:
        """Follow a change of the cloud: Gaussian i is, or was made of, the former Gaussian source[i]."""

    def filtered(self, cloud: Gaussians) -> Gaussians:
        """The cloud with filters, as it is rasterised in training and rendering."""
        return cloud

    # A training step

    def before_raster(self, step: Step) -> None:
        """Change the cloud that a step rasterizes."""

    def after_raster(self, step: Step) -> None:
        """Change the colours and the background of a step."""

    def mask(self, step: Step) -> None:
        """Leave pixels out: their target becomes their own colour."""

    def regularize(self, step: Step) -> None:
        """Add terms to the loss."""

    def finish(self, step: Step) -> None:
        """Change the cloud, or what follows it, after a step."""

    # Rendering

    def apply_appearance(
        self, method: Configured, seen: Rendering, camera: Camera, background: Float[Tensor, "... 3"]
    ) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "... 3"]]:
        """Colours over black and the background, under the method's settings."""
        return seen.rgb, background

    def recoloured_cloud(self, method: Configured, cloud: Gaussians) -> Gaussians:
        """A cloud whose colours are those of the method's settings."""
        return cloud
