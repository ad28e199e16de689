"""SRN: scenes as networks that a hypernetwork makes, seen by a learnt ray marcher (Sitzmann et al. 2019, arXiv
1906.01618)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...budget import Effort, Efforts
from ...camera.rays import Rays, Rendering
from ...color.blending import before
from ...components.fields.appearance import fitted
from ...components.fields.instance_codes import InstanceCodes
from ...components.fields.kept_photographs import Kept, chance, photographed, rays_through
from ...components.training.schedules import exponential_decay
from ...datasets.collection import Collection
from ...datasets.scene import Batch, Frame, Scene
from ...files.ranges import BatchSize, Count, Layers, LearningRate, NonNegative, Share, Width, between
from ...method import BaseConfig, Method, RayMethod, seeded
from ...method.controls import Control, Value
from .networks import Layer, RayMarcher, SceneHyperNetwork, perceptron, scene_features

CODE_DEVIATION = 0.01  # standard deviation of codes at first
HYPER_LAYERS = 2  # hidden layers of the hypernetwork, as wide as the code
MARCHER_STATE = 16  # numbers of the ray marcher's state
START_DISTANCE = 0.05  # distance along a ray at which it starts, scene units
START_DEVIATION = 5e-4  # standard deviation of that in training, scene units
COLOUR_WEIGHT = 200.0  # weight of the colours' squared error, of colours in [-1, 1]
DEPTH_WEIGHT = 10.0  # weight of the square of negative distances, eq. 6
CODE_WEIGHT = 1.0  # weight of the codes' mean square, eq. 6; higher keeps codes near zero
CODE_LEARNING_RATE = 1e-2  # Adam's learning rate of that fit


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, as its published code has them (srns.py, train.py)."""

    code: Width = 256  # numbers of a scene's code; more hold more scenes
    hidden_width: Width = 256  # channels of the scene's network and of the pixel generator; wider costs time
    depth: Layers = 4  # layers of the scene's network; more hold more detail, and cost time
    pixel_layers: Layers = 5  # hidden layers of the pixel generator; more cost time
    march_steps: Annotated[int, between(1, 128)] = 10  # steps of the ray marcher; more find farther surfaces, slower
    start: Literal["camera", "box"] = "camera"  # where rays start: near the camera, or where they enter the scene's box
    members: Count = 4096  # members of a collection at most; each has a code, so more cost memory
    members_per_step: Annotated[int, between(1, 1024)] = 64  # scenes in a step; more reduce noise, and cost time
    rays_per_member: BatchSize = 4096  # rays of each scene in a step; more reduce noise, and cost time
    targets: Annotated[int, between(1, 64)] = 1  # photographs of a member that a step's rays come from
    opacity_weight: NonNegative = 1.0  # of the squared error of opacity, beside that of colours, with alpha
    learning_rate: LearningRate = 5e-5  # Adam's learning rate at first; higher learns faster, and may diverge
    final_learning_rate: LearningRate = 5e-5  # learning rate at the end of the budget, reached exponentially
    warmup: Share = 0.0  # share of the budget in which the learning rate rises; 0: none
    # Finding the code of one scene.
    code_steps: Annotated[int, between(0, 100_000)] = 1000  # steps that fit the code of a new scene; more take longer
    fit_rays: BatchSize = 1024  # rays of a step of that fit; more reduce noise, and cost time


SOURCES = {  # of the numbers of `paper`; the others are ours
    "vsitzmann/scene-representation-networks, srns.py (8165b50)": (
        "code_deviation hyper_layers hidden_width depth pixel_layers depth_weight"
    ),
    "vsitzmann/scene-representation-networks, custom_layers.py (8165b50)": (
        "marcher_state start start_distance start_deviation"
    ),
    "vsitzmann/scene-representation-networks, train.py (8165b50)": (
        "code march_steps targets colour_weight code_weight learning_rate"
    ),
    "vsitzmann/scene-representation-networks, train_configs/chairs.yml (8165b50)": "members_per_step rays_per_member",
}


@dataclass(frozen=True)
class CodeLesson:
    """Members by number, and as many rays of each."""

    unit: ClassVar[str] = "rays"

    members: list[int]
    batches: list[Batch]
    backgrounds: list[tuple[float, float, float]]

    def __len__(self) -> int:
        return sum(map(len, self.batches))


MAX_CANDIDATES = 64  # learnt codes at most that a fit may begin with
MIN_DEPTH = 1e-4  # scene units, of renderings: the marcher may stop behind the camera
MIN_OPACITY = 0.05  # from which on a ray has a depth


class SRN(RayMethod):
    """Learns from a Collection a code for each member, a hypernetwork from codes to scene networks, and a ray marcher
    for these; `given` a Scene, it fits the code to its photographs."""

    Config, learns_from, accepts = Config, Collection, (Scene,)
    learning_rate = exponential_decay
    efforts: ClassVar[Efforts] = {"draft": Effort(20, 2000), "good": Effort(400, 40_000), "best": Effort(4000, 400_000)}

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        with seeded(c.seed):
            self.hyper = SceneHyperNetwork(c.code, (3, *[c.hidden_width] * c.depth), HYPER_LAYERS)
            self.marcher = RayMarcher(c.hidden_width, MARCHER_STATE, c.march_steps)
            outputs = 4 if frame.has_alpha else 3
            widths = [c.hidden_width] * (c.pixel_layers + 1)
            self.pixel_generator = perceptron(*widths, outputs, normalised=False)
        self.codes, self.found = InstanceCodes(c.members, c.code), Kept(torch.empty(0, c.code))
        self._shown: list[Layer] | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        """Smaller networks; rays start where they enter the scene's box."""
        return Config(
            code=64, hidden_width=64, start="box", members=1024, members_per_step=4, rays_per_member=256, targets=4,
            learning_rate=2e-3, final_learning_rate=1e-4, warmup=0.02, code_steps=200, fit_rays=512)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        return Config(code=4, hidden_width=16, depth=2, pixel_layers=1, march_steps=4, start="box", members=8,
            members_per_step=1, rays_per_member=128, learning_rate=1e-2, final_learning_rate=3e-3, code_steps=5,
            fit_rays=64)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Activations that a step keeps for its gradients."""
        c = config
        layers = 2 * c.depth * (c.march_steps + 1) + 2 * c.pixel_layers
        return 4 * c.members_per_step * c.rays_per_member * c.hidden_width * layers * learning

    # Learning

    def begin(self, data: Collection, seconds: float = math.inf) -> None:
        self.codes.check_room(len(data), data.source)
        self.codes.begin(data.splits["train"], CODE_DEVIATION, self.random(1))

    def steps_per_pass(self, data: Collection) -> float:
        return len(data.splits["train"]) / self.config.members_per_step

    def batch(self, data: Collection, generator: torch.Generator) -> CodeLesson:  # type: ignore[override]
        c, lesson = self.config, CodeLesson([], [], [])
        for _ in range(c.members_per_step):
            number, member = data.sample_member(generator)
            scene = photographed(member, "srn")
            there = scene.splits["train"].tolist()
            chosen = [there[chance(len(there), generator)] for _ in range(c.targets)]
            rays = rays_through([scene.photograph(i) for i in chosen], c.rays_per_member, False, generator)
            lesson.members.append(number)
            lesson.batches.append(rays.to(self.device))
            lesson.backgrounds.append(scene.frame.background)
        return lesson

    def loss(self, batch: CodeLesson, step: int) -> dict[str, Tensor]:  # type: ignore[override]
        """L_img, L_depth and L_latent (eq. 6)."""
        codes = self.codes(torch.tensor(batch.members, device=self.device))
        terms = self._errors(codes, batch.batches, batch.backgrounds, self.random(step))
        return terms | {"code": CODE_WEIGHT * codes.square().mean()}

    def _errors(
        self,
        codes: Float[Tensor, "member code"],
        batches: list[Batch],
        backgrounds: list[tuple[float, float, float]],
        generator: torch.Generator | None = None,
    ) -> dict[str, Tensor]:
        """Errors of colours and of opacity, and distances behind the camera, of as many rays of each member."""
        c, behind = self.config, torch.tensor(backgrounds, device=self.device)[:, None]
        origins, directions = (
            torch.stack([getattr(batch.rays, name) for batch in batches]) for name in ("origins", "directions")
        )
        target = torch.stack([batch.before(behind[i]) for i, batch in enumerate(batches)])
        distance, rgb, opacity = self._seen(self.hyper(codes), origins, directions, generator)
        error = (before(rgb, opacity, behind) - target).square().mean()
        self.figures = {"mse": float(error.detach())}
        terms = {
            "colour": 4 * COLOUR_WEIGHT * error,  # of colours in [-1, 1]
            "depth": DEPTH_WEIGHT * distance.clamp_max(0).square().mean(),
        }
        if self.frame.has_alpha:
            known = [torch.ones_like(x.rays.radius) if x.alpha is None else x.alpha for x in batches]
            off = (opacity - torch.stack(known)).square().mean()
            terms["opacity"] = 4 * COLOUR_WEIGHT * c.opacity_weight * off
        return terms

    def _seen(
        self,
        layers: list[Layer],
        origins: Float[Tensor, "member ray 3"],
        directions: Float[Tensor, "member ray 3"],
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, "member ray"], Float[Tensor, "member ray 3"], Float[Tensor, "member ray"]]:
        """Distance, colour and opacity of rays, which start at slightly random distances with a generator."""
        c, shape = self.config, origins.shape[:2]
        start = torch.full(shape, START_DISTANCE, device=self.device)
        if c.start == "box":
            rays = Rays(origins.flatten(0, 1), directions.flatten(0, 1), start.flatten())
            enter, leave = rays.through_box(torch.tensor(self.frame.bounds, device=self.device))
            enter = torch.where(enter < leave, enter, 0.5 * (enter + leave))  # close to the box, where a ray misses it
            start = start.maximum(enter.view(shape))
        if generator is not None:
            start = start + START_DEVIATION * torch.randn(shape, generator=generator).to(start)
        distance = self.marcher(layers, origins, directions, start)
        features = scene_features(layers, origins + distance[..., None] * directions)
        seen = self.pixel_generator(features)
        opacity = seen[..., 3].sigmoid() if self.frame.has_alpha else torch.ones_like(distance)
        return distance, 0.5 + 0.5 * seen[..., :3], opacity

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.parameters(), self.config.learning_rate, foreach=True)]

    def before_step(self, step: int, progress: float) -> None:
        self._shown = None

    # Scenes

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        if self._shown is None:
            with torch.no_grad():
                self._shown = self.hyper(self.code[None])
        distance, rgb, opacity = (x[0] for x in self._seen(self._shown, rays.origins[None], rays.directions[None]))
        there = opacity > MIN_OPACITY
        if not self.frame.is_open:  # nothing bounds the marcher, which may leave the box behind
            there &= distance < rays.through_box(torch.tensor(self.frame.bounds, device=self.device))[1]
        depth = torch.where(there, distance.clamp_min(MIN_DEPTH), torch.inf)
        return Rendering(before(rgb.clamp(0, 1), opacity, background), depth, opacity)

    @property
    def code(self) -> Float[Tensor, " code"]:
        """Code of the current scene."""
        return self.codes.code_of(str(self.control("instance")), self.found.rows)

    @property
    def controls(self) -> tuple[Control, ...]:
        return (self.codes.control(len(self.found.rows) > 0),)

    @property
    def evidence_views(self) -> int | None:
        return 1

    def evidence_bytes(self, scene: Scene) -> int:
        """Pixels as rays."""
        return 4 * 12 * int(scene.cameras.size[scene.splits["train"]].prod(-1).sum())

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Fit the code of a scene to its photographs."""
        self._shown = None
        for scene in evidence[-1:]:
            self.frame = replace(scene.frame, has_alpha=self.frame.has_alpha)
            self._show(self._code_of(scene))

    def draw_object(self, seed: int) -> Method:
        """A random scene: a code from the Gaussian fitted to the trained codes."""
        told: Any = self.given()
        told._show(self.codes.draw_code(seed))
        return told

    def _show(self, code: Float[Tensor, " code"]) -> None:
        self.found, self._shown = Kept(code.detach()[None]), None
        self.settings.pop("instance", None)

    def _code_of(self, scene: Scene) -> Float[Tensor, " code"]:
        """The code with the smallest error on photographs, with frozen networks (section 4, few-shot reconstruction).

        The fit starts at the trained code with the smallest error.
        """
        c, generator = self.config, self.random(2)
        photographs = [scene.photograph(i) for i in scene.splits["train"].tolist()]

        def error(code: Float[Tensor, " code"]) -> Tensor:
            rays = rays_through(photographs, c.fit_rays, False, generator).to(self.device)
            terms = self._errors(code[None], [rays], [scene.frame.background])
            return torch.stack([*terms.values()]).sum() + CODE_WEIGHT * code.square().mean()

        known = self.codes.rows.detach()[self.codes.learnt]
        some = torch.randperm(len(known), generator=self.random(3))[:MAX_CANDIDATES]
        candidates = torch.cat([self.codes.average[None], known[some.to(known.device)]])
        with torch.no_grad():
            errors = torch.stack([error(code) for code in candidates])
        return fitted(candidates[int(errors.argmin())], error, c.code_steps, CODE_LEARNING_RATE)
