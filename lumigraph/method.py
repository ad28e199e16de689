"""Method and RayMethod: the only two abstract classes in the house."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .camera import Camera
from .errors import LumigraphError
from .gaussians import Gaussians
from .rays import Look, Rays, Rendering
from .scene import Batch, Frame, Photograph, Scene


class Method(nn.Module, ABC):
    """One paper: something that learns from a Scene's batches and can be seen through a Camera.

    frame:  where the scene is (bounds, reach, near distance, background, number of images). A saved run holds it,
            so that a method can be built again where the photographs are gone.
    config: the paper's numbers, a frozen dataclass named Config in the method's file
    All that must survive a resume lives in parameters, buffers and optimizers.
    """

    Config: ClassVar[type]
    any_lens: ClassVar[bool] = False  # whether `render` follows every lens, or flat pictures alone

    def __init__(self, frame: Frame, config: Any):
        super().__init__()
        self.frame, self.config = frame, config

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """The Config to use where the user chose none: the paper's on a GPU, on a CPU what learns most in a minute."""
        return cls.Config()

    @abstractmethod
    def batch(self, scene: Scene, generator: torch.Generator) -> Batch | Photograph:
        """What one step learns from. All randomness comes from `generator`, on the CPU."""

    @abstractmethod
    def loss(self, batch: Any, step: int) -> dict[str, Tensor]:
        """The terms to minimise, by name; the trainer sums them."""

    @abstractmethod
    def optimizers(self) -> list[torch.optim.Optimizer]:
        """Fresh optimizers over the parameters; the trainer calls this once."""

    @abstractmethod
    def render(self, camera: Camera) -> Rendering:
        """What one camera sees, (height, width, ...), without gradients, in eval mode."""

    def begin(self, scene: Scene) -> None:
        """Called once, ahead of the first step of a new run: what the photographs tell without any learning."""

    def before_step(self, step: int, progress: float) -> None:
        """Called ahead of each step. progress is the share of the budget (steps or seconds) spent, in [0, 1]."""

    def after_step(self, step: int) -> None:
        """Called once the optimizers have stepped."""

    def statistics(self) -> dict[str, float]:
        """Figures of the last step worth a line in metrics.jsonl, e.g. rays and samples."""
        return {}

    def gaussians(self) -> Gaussians:
        """The scene as a cloud of Gaussians, in the scene's frame. Raises LumigraphError for methods without one."""
        raise LumigraphError(
            f"{type(self).__name__} holds no Gaussians, so no splats can be made of it; train gaussian-splatting"
        )

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit at points of the scene. Raises LumigraphError for methods without a field."""
        raise LumigraphError(
            f"{type(self).__name__} holds no density at points; what is made of it comes from its renderings instead"
        )

    def random(self, number: int) -> torch.Generator:
        """Random numbers that depend on the config's seed and a number alone, the step for example, so that a resumed
        run draws the same."""
        return torch.Generator().manual_seed((self.config.seed << 40) + (number % (1 << 40)))

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device


class RayMethod(Method):
    """A Method that sees one ray at a time: write `render_rays`, inherit the rest."""

    any_lens: ClassVar[bool] = True
    rays_per_chunk: int = 16_384

    @property
    def background(self) -> Float[Tensor, "1 3"]:
        """The scene's own, as `render_rays` takes it."""
        return torch.tensor([self.frame.background], device=self.device)

    @abstractmethod
    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        """What each ray sees, in front of a background colour."""

    def looks(self, rays: Rays) -> list[Look]:
        """What lies along rays, one entry for each pass, the one that is composited into the picture last.

        Raises LumigraphError for methods that do not march along rays.
        """
        raise LumigraphError(f"{type(self).__name__} takes no samples along rays, so there is nothing to draw of one")

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        width, height = camera.size[0].tolist()
        rays = camera.rays(camera.pixels()).to(self.device)
        background = self.background
        chunks = [slice(i, i + self.rays_per_chunk) for i in range(0, len(rays), self.rays_per_chunk)]
        parts = [self.render_rays(rays[chunk], background) for chunk in chunks]
        return Rendering.cat(parts).reshape(height, width)
