"""3D Gaussian Splatting: a scene as a cloud of soft, coloured ellipsoids (Kerbl et al. 2023, arXiv 2308.04079)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from .. import kernels
from ..camera import Camera
from ..components.cloud import Cloud, CloudAdam
from ..components.density_control import AdaptiveDensity, MarkovChain
from ..components.initial_cloud import initial_cloud, random_cloud
from ..components.memory import room_for
from ..components.smoothing import sampling_interval, smoothed
from ..errors import LumigraphWarning
from ..gaussians import Gaussians
from ..method import Method
from ..rays import Rendering
from ..scene import Frame, Photograph, Scene
from ..splatting import Splatted, render, splat, view_of


@dataclass(frozen=True)
class Config:
    """The paper's numbers, with where it gives them; those without a section are the authors' release's."""

    degree: int = 3  # of the spherical harmonics, section 5.1
    raise_degree_every: int = 1000  # steps, section 7.1; or the share below of the budget, if that is sooner
    raise_degree_share: float = 1 / 8
    ssim: float = 0.2  # share of D-SSIM in the loss, eq. 7
    strategy: Literal["adaptive", "mcmc"] = "adaptive"  # density control: section 5, or Kheradmand 2024
    most: int = 1_000_000  # Gaussians
    initial: int = 100_000  # random Gaussians where a capture has no points, section 7.1
    half_until: float = 0.0  # share of the budget that is learnt at half size, and a quarter of that at a quarter
    refine_every: int = 100  # steps between changes of the cloud, section 5.2
    refine_from: int = 500  # step
    refine_until: float = 0.5  # share of the budget; section 7.1: 15 000 of 30 000 steps
    pull: float = 2e-4  # gradient that asks for more Gaussians, section 5.2
    reset_every: int = 3000  # steps between resets of opacity, section 5.2
    means_rate: float = 1.6e-4  # times the extent of the cameras
    last_means_rate: float = 1.6e-6
    harmonics_rate: float = 2.5e-3  # a twentieth of it beyond the first band
    opacities_rate: float = 0.05
    scales_rate: float = 5e-3
    quaternions_rate: float = 1e-3
    opacity_weight: float = 0.01  # of the mean opacity in the loss, for mcmc (Kheradmand 2024, eq. 11)
    scale_weight: float = 0.01  # of the mean deviation, in extents, for mcmc
    stop: float = 1e-4  # transmittance at which a pixel is finished, appendix C
    antialiased: bool = False  # Mip-Splatting's 2-D filter (Yu 2024, section 5.2)
    smooth: bool = False  # Mip-Splatting's 3-D filter (Yu 2024, section 5.1)
    seed: int = 0


NEAR = 0.1  # of the distance within which, as the scene says, nothing is
SMALLEST = 64  # pixels of a photograph's shorter side that are kept when it is reduced
RECOVERY = 3  # times reset_every: steps that must be left after opacities are reset, or the pictures stay dim
GROWTH = 1.05  # of the number at each change, for mcmc (Kheradmand 2024, section 3.2)
LAST_MOVE = 0.9  # share of the budget from which on nobody is moved any more, so that all settle
BYTES = 4096  # that one more Gaussian needs while it learns: itself, its gradient and moments, its share of a picture


class GaussianSplatting(Method):
    """A photograph at a time: splat the cloud, compare, step; now and then change how many Gaussians there are."""

    Config = Config
    extent: Tensor
    drawn: Tensor
    began: Tensor
    interval: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        placeholder = random_cloud(frame, min(1000, config.most), config.degree, self.random(0))
        self.cloud = Cloud(placeholder)
        self.cloud.antialiased = config.antialiased
        self.density_control = AdaptiveDensity(len(self.cloud), config.pull)
        self.exploration = MarkovChain()
        self.register_buffer("extent", torch.tensor(1.0))
        self.register_buffer("drawn", torch.tensor(0))
        self.register_buffer("began", torch.tensor(len(self.cloud)))
        self.register_buffer("interval", torch.zeros(len(self.cloud) if config.smooth else 0))
        self._bands = config.degree + 1
        self._progress = 0.0
        self._cameras: Camera | None = None
        self._told_full = False
        self._optimizer: CloudAdam | None = None
        self._seen: Splatted | None = None
        self._difference = torch.zeros(0)

    @property
    def _near(self) -> float:
        """Well ahead of all that is there: what a camera does not see it cannot teach to vanish."""
        return NEAR * self.frame.near

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers; on a CPU a smaller cloud, which learns more in the same time."""
        return Config() if device.type == "cuda" else Config(most=120_000, initial=20_000, half_until=0.3)

    def begin(self, scene: Scene) -> None:
        config = self.config
        found = initial_cloud(scene, config.initial, config.most, config.degree, self.random(1))
        self.cloud.replace(found, self._optimizer)
        self.density_control.begin(len(found))
        self.began.fill_(len(found))
        if config.smooth:
            self._cameras = scene.cameras[scene.splits["train"]]
            self.interval = sampling_interval(self.cloud.means, self._cameras, self._near)
        positions = scene.cameras.position[scene.splits["train"]]
        self.extent.fill_(1.1 * float((positions - positions.mean(0)).norm(dim=-1).max()))

    def batch(self, scene: Scene, generator: torch.Generator) -> Photograph:
        """Every photograph once, in a random order, then again."""
        train = scene.splits["train"]
        if self.config.smooth and self._cameras is None:  # in a run that was resumed
            self._cameras = scene.cameras[train]
        turn, place = divmod(int(self.drawn), len(train))
        self.drawn += 1
        order = torch.randperm(len(train), generator=self.random(1_000_000 + turn))
        photograph = scene.photograph(int(train[order[place]]))
        return photograph.reduced(self._reduction(min(photograph.rgb.shape[:2]))).to(self.device)

    def _reduction(self, shorter: int) -> int:
        """How many times smaller photographs are for now; none gets smaller than SMALLEST pixels."""
        half = self.config.half_until
        wanted = 4 if self._progress < half / 4 else 2 if self._progress < half else 1
        return max(1, min(wanted, shorter // SMALLEST))

    def loss(self, batch: Photograph, step: int) -> dict[str, Tensor]:
        config, cloud = self.config, self.gaussians()
        seen = splat(cloud, view_of(batch.camera, self._near), self._bands, config.stop)
        rgb, target = seen.rgb, batch.rgb
        background = torch.tensor(self.frame.background, device=rgb.device)
        if batch.alpha is not None:  # a random colour behind everything, so that only opacity can imitate opacity
            background = torch.rand(3, generator=self.random(~step)).to(rgb.device)
            target = background + batch.alpha[..., None] * (target - background)
        if background.any():
            rgb = rgb + (1 - seen.opacity)[..., None] * background
        if batch.mask is not None:
            target = torch.where(batch.mask[..., None], target, rgb.detach())
        if seen.centres.requires_grad:
            seen.centres.retain_grad()
        self._seen = seen
        difference = rgb - target
        self._difference = difference.detach()
        terms = {
            "l1": (1 - config.ssim) * difference.abs().mean(),
            "ssim": config.ssim * (1 - kernels.ssim(rgb, target)),
        }
        if config.strategy == "mcmc":
            terms["opacity"] = config.opacity_weight * cloud.opacities.sigmoid().mean()
            terms["scale"] = config.scale_weight / float(self.extent) * cloud.log_scales.exp().mean()
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, cloud = self.config, self.cloud
        columns = [1.0] * 3 + [1 / 20] * (3 * (c.degree + 1) ** 2 - 3)
        groups = [
            {"params": [cloud.means], "lr": c.means_rate},
            {"params": [cloud.quaternions], "lr": c.quaternions_rate},
            {"params": [cloud.log_scales], "lr": c.scales_rate},
            {"params": [cloud.opacities], "lr": c.opacities_rate},
            {"params": [cloud.harmonics], "lr": c.harmonics_rate, "columns": columns},
        ]
        self._optimizer = CloudAdam(groups)
        return [self._optimizer]

    def before_step(self, step: int, progress: float) -> None:
        config, self._progress = self.config, progress
        assert self._optimizer is not None
        fall = (config.last_means_rate / config.means_rate) ** progress
        self._optimizer.param_groups[0]["lr"] = config.means_rate * float(self.extent) * fall
        raised = max(step // config.raise_degree_every, int(progress / config.raise_degree_share))
        self._bands = 1 + min(raised, config.degree)

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        config, seen, optimizer = self.config, self._seen, self._optimizer
        assert seen is not None and optimizer is not None
        self._seen, size = None, len(self.cloud)
        due = step >= config.refine_from and step % config.refine_every == 0
        if config.strategy == "mcmc":
            self._sample(due, optimizer, self.random(step))
        elif self._progress < config.refine_until:
            self._densify(step, due, seen, optimizer)
        if config.smooth and (due or len(self.cloud) != size):
            assert self._cameras is not None
            self.interval = sampling_interval(self.cloud.means, self._cameras, self._near)

    def _densify(self, step: int, due: bool, seen: Splatted, optimizer: CloudAdam) -> None:
        height, width = seen.opacity.shape
        assert seen.centres.grad is not None
        control = self.density_control
        control.note(seen.centres.grad, seen.opacities > 0, (width, height))
        if due:
            most, chance = self._most_by_now(), self.random(step)
            wanted_more = control.refine(self.cloud, optimizer, float(self.extent), most, chance)
            if wanted_more and len(self.cloud) >= 0.99 * self._most():
                self._tell_full()
        every = self.config.reset_every
        if step and step % every == 0 and step / max(self._progress, 1e-6) - step >= RECOVERY * every:
            control.reset_opacity(self.cloud, optimizer)

    def _sample(self, due: bool, optimizer: CloudAdam, chance: torch.Generator) -> None:
        if due and self._progress < LAST_MOVE:
            count = len(self.cloud)
            wanted = int(GROWTH * count) if self._progress < self.config.refine_until else count
            if wanted > max(most := self._most(), count) and most < self.config.most:
                self._tell_full()
            self.exploration.refine(self.cloud, optimizer, min(wanted, max(most, count)), chance)
        self.exploration.explore(self.cloud, optimizer.param_groups[0]["lr"], chance)

    def _most(self) -> int:
        """How many Gaussians there may be: as told, or as the memory at hand allows."""
        return min(self.config.most, len(self.cloud) + room_for(BYTES, self.device))

    def _most_by_now(self) -> int:
        """The same at this moment: the number may grow evenly, so that early steps are quick ones."""
        began, most = int(self.began), self._most()
        share = min(1.0, self._progress / self.config.refine_until)
        return min(most, int(began + share * max(most - began, 0)))

    def _tell_full(self) -> None:
        """Once: the cloud would grow further, and may not."""
        if not self._told_full:
            self._told_full = True
            why = "--most says so" if len(self.cloud) >= 0.95 * self.config.most else "memory is short"
            warnings.warn(f"The cloud stops growing at {len(self.cloud):,} Gaussians, for {why}", LumigraphWarning, 2)

    def gaussians(self) -> Gaussians:
        """The cloud, in the scene's frame; with the 3-D filter in it, where that is used."""
        cloud = self.cloud.gaussians()
        return smoothed(cloud, self.interval) if self.config.smooth else cloud

    def render(self, camera: Camera) -> Rendering:
        return render(self.gaussians(), camera.to(self.device), self.frame.background, self._near)

    def statistics(self) -> dict[str, float]:
        return {"mse": float(self._difference.square().mean()), "gaussians": len(self.cloud)}

    def _load_from_state_dict(self, state_dict, prefix, *rest):
        if prefix + "interval" in state_dict:
            self.interval = self.interval.new_empty(state_dict[prefix + "interval"].shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)
