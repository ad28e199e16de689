"""Part: a submodule of a Method with hooks for training and for user settings."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..camera import Camera
from ..camera.rays import Rays
from ..exchange.packing import Stored
from .controls import Control


class Part(nn.Module):
    """A submodule with hooks that its Method visits, as `nn.Module.train` visits submodules: poses, appearance codes,
    exposure, samplers. All hooks do nothing by default. `method` is the Method of the part.

    moves_cameras: whether it optimises poses, so that other parts must not rely on the given ones
    """

    moves_cameras: ClassVar[bool] = False

    # Training

    def compile_begin(self) -> None:
        """Compile kernels that only `begin` uses; called on a copy before the clock starts."""

    def begin(self, method: Any, data: Any, seconds: float) -> None:
        """Initialise from the data before the first step of a new run; see `Method.begin`."""

    def before_step(self, method: Any, step: int, progress: float) -> None:
        """Hook before each step, for schedules. progress: spent share of the budget, in [0, 1]"""

    def after_step(self, method: Any, step: int) -> None:
        """Hook after each step."""

    def optimizers(self) -> list[torch.optim.Optimizer]:
        """Fresh optimizers over the part's own parameters."""
        return []

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        """Learning rates of this step by the "name" of the optimizers' groups."""
        return {}

    def storage(self) -> dict[str, Stored]:
        """Storage of the part's tensors in a compressed run, by their names in the part."""
        return {}

    @property
    def few_view_priors(self) -> tuple[str, ...]:
        """Names of the priors that supervise unobserved regions, for the verdict on a run."""
        return ()

    # Rendering

    def refine_rays(self, rays: Rays) -> Rays:
        """Rays of photographs with their learnt poses."""
        return rays

    def refined(self, cameras: Camera) -> Camera:
        """Cameras of photographs, by their `image_index`, with their learnt poses."""
        return cameras

    def recoloured(self, method: Any, rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Colours of a field under the method's settings."""
        return rgb

    def behind(
        self, rays: Rays, code: Float[Tensor, "#ray code"] | None, background: Float[Tensor, "#ray 3"]
    ) -> Float[Tensor, "#ray 3"]:
        """Background colours of rays: the scene's, or a sky."""
        return background

    # Settings

    @property
    def controls(self) -> tuple[Control, ...]:
        """Settings that a user may change."""
        return ()

    @property
    def accepts(self) -> tuple[type, ...]:
        """Kinds of evidence that `adapted` takes."""
        return ()

    def adapted(self, method: Any, evidence: Any) -> Part:
        """The part adapted to a piece of evidence, such as a photograph's exposure; it shares all tensors with this
        one. method: a copy, which is being adapted"""
        raise NotImplementedError
