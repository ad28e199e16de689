"""NeRFactor: geometry, albedo, reflectance and light of photographs taken apart, so that a scene can be relit (Zhang et
al. 2021, arXiv 2106.01970; visibility after NeRV, Srinivasan et al. 2021).

Geometry is a hash table's, so that a CPU learns it in minutes; the paper's is a NeRF.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ...camera import Camera
from ...camera.rays import Rays, Rendering
from ...color.blending import over
from ...components.fields.hash_field import HashField, HashNumbers
from ...components.fields.spaces import space_of
from ...components.fields.teacher import distil, teacher_of
from ...components.sampling.occupancy_sampler import OccupancyNumbers, StepNumbers
from ...components.sampling.samplers import CPU_HASH, TINY_HASH, ProposalNumbers, sampler_for, sampling_bytes
from ...components.training.development import CONTROLS, decoded, encoded, exposed, toned
from ...components.training.photometric import backdrop, huber, residuals
from ...components.training.schedules import falling, hold_and_decay
from ...datasets.scene import Batch, Frame, Scene
from ...errors import LumigraphError
from ...files.ranges import (
    BatchSize,
    LearningRate,
    NonNegative,
    PositiveShare,
    Share,
    Width,
    between,
)
from ...geometry import unit
from ...light import SUFFIXES, EnvironmentLight, directions, solid_angles
from ...method import BaseConfig, FieldMethod, seeded
from ...method.controls import Control, Value
from ...method.field import Colours, Densities, Directions, Points
from ...volume import composite
from .properties import HashProperties, NetworkProperties, Properties, Raw, VisibilityNetwork
from .shading import MIN_ROUGHNESS, LearntReflectance, microfacet, shaded
from .surface import SurfaceGrid, surface_distance

FINAL_GEOMETRY_RATE = 1e-3  # learning rate of the geometry at its end
PROPERTY_LAYERS = 4  # layers of a property's network, section 3
POSITION_FREQUENCIES = 10  # octaves of encoded points; more give finer detail, and noise
DIRECTION_FREQUENCIES = 4  # octaves of encoded directions to lights
ANGLE_FREQUENCIES = 2  # octaves of encoded half-difference angles, of the learnt reflectance
CODE_WIDTH = 3  # numbers of a code of the learnt reflectance, section 3.3
PRIOR_STEPS = 20_000  # steps in which the reflectance is learnt beforehand
JITTER = 0.01  # standard deviation of the offsets of smoothness, scene units
SHAPE_WEIGHT = 1.0  # weight of the distances from the geometry's normals and visibility in the shape's stage
SHAPE_LEARNING_RATE = 1e-2  # Adam's learning rate in the shape's stage
NORMAL_WEIGHT = 0.1  # weight of the distance from the geometry's normals in joint training; higher follows them
VISIBILITY_WEIGHT = 0.1  # weight of the distance from traced visibility in joint training
NORMAL_SMOOTHNESS = 0.05  # weight of smooth normals
VISIBILITY_SMOOTHNESS = 0.05  # weight of smooth visibility
ALBEDO_SMOOTHNESS = 0.05  # weight of smooth albedo; higher leaves more to shading
TABLE_SMOOTHNESS = 0.01  # the three of a hash table, which no release has
CODE_SMOOTHNESS = 0.01  # weight of smooth reflectance
LIGHT_VARIATION = 5e-6  # weight of the squared differences of neighbouring pixels of the light
PROPERTY_WIDTH = 128  # width of a property's network, section 3


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's and its release's parameters (nerfactor.ini, shape.ini, brdf.ini), with a hash table for the NeRF."""

    table: HashNumbers = HashNumbers()
    occupancy: OccupancyNumbers = OccupancyNumbers()
    steps: StepNumbers = StepNumbers()
    proposals: ProposalNumbers = ProposalNumbers()
    light: str = "unknown"  # light of the photographs: unknown, known (their own maps), or a file with a map
    properties: Literal["network", "hash"] = "network"  # albedo, code and normals: the paper's networks, or a table
    visibility: Literal["network", "traced", "none"] = "network"  # of lights; none: no shadows, a baseline
    reflectance: Literal["learnt", "microfacet"] = "learnt"  # highlights: a learnt prior, or microfacets themselves
    geometry_share: Share = 0.5  # share of the budget in which geometry learns, before all else
    shape_share: Share = 200 / 300  # share of the rest in which normals and visibility alone learn, with networks
    hidden_width: Width = 64  # neurons of a hidden layer behind hash tables; wider costs time
    light_rows: Annotated[int, between(4, 64)] = 16  # rows of the light's map, section 3.4; twice as many columns
    grid_resolution: Annotated[int, between(8, 512)] = 256  # cells along the box that hold the geometry
    surface_rays: BatchSize = 1024  # rays of a step once geometry is learnt; more reduce noise, and cost time
    learning_rate: LearningRate = 5e-3  # Adam's learning rate of properties and light
    final_learning_rate: LearningRate = 5e-3 * 0.1 ** (10 / 500)  # the same at the end, reached exponentially
    light_rate: LearningRate = 5e-3  # learning rate of the light's logarithm
    geometry_rate: LearningRate = 1e-2  # learning rate of the geometry at first; higher: faster, may diverge
    hash_weight_decay: NonNegative = 0.0  # decoupled weight decay of the geometry's table, towards a density of 1
    huber_delta: PositiveShare = 0.1  # residual of the geometry's loss at which it turns linear; 1: always squared


SOURCES = {  # of the numbers of `paper`; the others are ours
    "google/nerfactor, nerfactor/config/nerfactor.ini (a668dca)": (
        "properties visibility reflectance property_layers property_width position_frequencies direction_frequencies "
        "light_rows surface_rays jitter normal_weight visibility_weight normal_smoothness visibility_smoothness "
        "albedo_smoothness code_smoothness light_variation learning_rate final_learning_rate light_rate"
    ),
    "google/nerfactor, nerfactor/config/shape.ini (a668dca)": "shape_share shape_weight shape_learning_rate",
    "google/nerfactor, nerfactor/config/brdf.ini (a668dca)": "angle_frequencies code_width",
}
MIN_ALBEDO, ALBEDO_RANGE = 0.03, 0.77  # section 3.3
FIRST_LIGHT = 0.5  # radiance of the light at first, the middle of what the release draws
DECAY_START = 0.3  # share of the geometry's stage before its rate falls
MIN_FACING = 0.05  # cosine at which a surface faces the eye at least
MIN_OPACITY = 0.5  # of a ray that shows a surface
SUN_WIDTH = 1.5  # degrees of half the sun that the control sets
CAMERAS_LIGHT, SUN, WHITE = "photographs", "sun", "white"
SHOWN = ("picture", "albedo", "normals", "roughness", "visibility")
FACTORS = ("red", "green", "blue")
# Numbers of the sun: any of them alone brings sun and sky; the least value stands for the default below.
SUN_CONTROLS = (
    ("sun_azimuth", 360.0, "degrees", "Direction of the sun: 0 is +y, 90 is +x. Alone, it brings sun and sky."),
    ("sun_elevation", 90.0, "degrees", "Height of the sun; -1 is 40 degrees. Alone, it brings sun and sky."),
    ("sun", 20.0, "", "Radiance of a white surface that faces the sun, by it alone; -1 is 1."),
    ("sky", 20.0, "", "Radiance of level white ground, by the sky alone; -1 is 0.3."),
)
UNSAID = {"sun_azimuth": -360.0, "sun_elevation": -1.0, "sun": -1.0, "sky": -1.0}
SUN_DEFAULTS = {"sun_azimuth": 0.0, "sun_elevation": 40.0, "sun": 1.0, "sky": 0.3}


class Shading(NamedTuple):
    """Properties of surface points, and the light that they send to the eye."""

    radiance: Float[Tensor, "point 3"]
    albedo: Float[Tensor, "point 3"]
    code: Float[Tensor, "point code"]
    roughness: Float[Tensor, "point 1"]
    normals: Float[Tensor, "point 3"]
    visibility: Float[Tensor, "point light"]


class NeRFactor(FieldMethod):
    """A field is trained on photographs; its geometry is frozen; then surface properties and light are trained.

    stage:  1 once geometry is frozen
    began:  share of the budget at which it was; -1 before
    known:  the photographs' environment maps, if known
    """

    Config, accepts = Config, (EnvironmentLight,)
    looks = None  # type: ignore[assignment]  # a surface is shaded, not each sample of a ray
    network: HashField
    properties: Properties
    stage: Tensor
    began: Tensor
    known: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        code = CODE_WIDTH if c.reflectance == "learnt" else 1
        with seeded(c.seed):
            self.network = HashField(c.table, c.hidden_width, space, frame.reach)
            if c.properties == "hash":
                self.properties = HashProperties(c.table, c.hidden_width, code, space, frame.reach)
            else:
                self.properties = NetworkProperties(POSITION_FREQUENCIES, PROPERTY_LAYERS, PROPERTY_WIDTH, code)
            sizes = PROPERTY_LAYERS, PROPERTY_WIDTH
            frequencies = POSITION_FREQUENCIES, DIRECTION_FREQUENCIES
            self.lights_seen = VisibilityNetwork(*frequencies, *sizes) if c.visibility == "network" else None
            learnt = c.reflectance == "learnt"
            self.lobes = LearntReflectance(CODE_WIDTH, ANGLE_FREQUENCIES, *sizes) if learnt else None
        self.sampler = sampler_for(frame, space, c.occupancy, c.proposals, steps=c.steps)
        self.grid = SurfaceGrid(frame, c.grid_resolution)
        shape = c.light_rows, 2 * c.light_rows
        self.log_light = nn.Parameter(torch.full((*shape, 3), math.log(FIRST_LIGHT)))
        self.register_buffer("known", torch.zeros(max(frame.image_count, 1) if c.light == "known" else 1, *shape, 3))
        self.register_buffer("stage", torch.tensor(0))
        self.register_buffer("began", torch.tensor(-1.0))
        self._told: EnvironmentLight | None = None
        self._choose_learning()

    @classmethod
    def cpu_preset(cls) -> Any:
        """Hash tables, traced visibility, microfacets, a smaller grid and smaller steps."""
        return Config(
            **CPU_HASH, hidden_width=32, geometry_rate=2e-2, hash_weight_decay=0.3, huber_delta=0.3,
            properties="hash", visibility="traced", reflectance="microfacet", geometry_share=0.6, shape_share=0.0,
            grid_resolution=128, surface_rays=256, learning_rate=1e-2, final_learning_rate=1e-3, light_rate=3e-2,
        )  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Tiny tables and a light of few pixels, in all stages within some twenty steps."""
        return Config(**TINY_HASH, hidden_width=16, geometry_rate=2e-2, properties="hash", visibility="traced",
            reflectance="microfacet", geometry_share=0.6, shape_share=0.0, grid_resolution=16, huber_delta=1.0,
            light_rows=4, surface_rays=128, learning_rate=3e-2, final_learning_rate=5e-4, light_rate=3e-2)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        pairs = 2 * config.light_rows**2 * config.surface_rays * 4
        kept = 4 + 2 * PROPERTY_LAYERS * PROPERTY_WIDTH * (config.visibility == "network")
        return sampling_bytes(frame, config, learning) + pairs * kept * learning

    def _choose_learning(self) -> None:
        """Set trainable parameters: geometry first, later all others."""
        surface = bool(self.stage)
        self.network.requires_grad_(not surface)
        for part in (self.properties, self.lights_seen):
            if part is not None:
                part.requires_grad_(surface)
        self.log_light.requires_grad_(surface and self.config.light == "unknown")

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        found = super().load_state_dict(state_dict, strict, assign)
        self._choose_learning()
        return found

    # Light

    @cached_property
    def pixels(self) -> tuple[Float[Tensor, "light 3"], Float[Tensor, "light 1"]]:
        """Directions and solid angles of the light's pixels."""
        shape = self.config.light_rows, 2 * self.config.light_rows
        ways, angles = directions(*shape).reshape(-1, 3), solid_angles(*shape).reshape(-1, 1)
        return ways.to(self.device), angles.to(self.device)

    def environment(self) -> EnvironmentLight:
        """The learnt light, or the photographs' known one, of the first if they differ."""
        found = self.log_light.exp() if self.config.light == "unknown" else self.known[0]
        return EnvironmentLight(found.detach().cpu())

    def power(self, rays: Rays | None) -> Float[Tensor, "#point light 3"]:
        """Irradiance of each pixel of the photographs' light, one row for all or of each ray's photograph."""
        if self.config.light == "unknown":
            light = self.log_light.exp()[None]
        elif len(self.known) == 1 or rays is None or rays.image_index is None:
            light = self.known[:1]
        else:
            light = self.known[rays.image_index]
        return light.flatten(1, 2) * self.pixels[1]

    def lamps(self, rays: Rays | None) -> tuple[Float[Tensor, "light 3"], Float[Tensor, "#point light 3"]]:
        """Directions and irradiance of lights as the settings say."""
        light = self.shown_light()
        if light is None:
            return self.pixels[0], self.power(rays)
        rows = self.config.light_rows
        ways, power = light.resized(rows, 2 * rows).turned(float(self.control("light_turn"))).lamps
        return ways.to(self.device), power.to(self.device)[None]

    def shown_light(self) -> EnvironmentLight | None:
        """Light of the settings that replaces the photographs'; None for theirs."""
        kind, said = str(self.control("light")), {name: float(self.control(name)) for name in UNSAID}
        if kind == SUN or (kind == CAMERAS_LIGHT and self._told is None and said != UNSAID):
            azimuth, elevation, sun, sky = (SUN_DEFAULTS[k] if x == UNSAID[k] else x for k, x in said.items())
            return EnvironmentLight.outdoors(azimuth, elevation, sun, sky, SUN_WIDTH)
        if kind == WHITE:
            return EnvironmentLight.uniform()
        if kind == CAMERAS_LIGHT and self._told is None:
            return self.environment() if float(self.control("light_turn")) else None
        return self._told

    # Learning

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        self._begin_light(data)
        if self.lobes is not None:
            self.lobes.learn(PRIOR_STEPS, 1e-2, self.random(1))

    def _begin_light(self, data: Scene) -> None:
        """Load the photographs' light."""
        kind, rows = self.config.light, self.config.light_rows
        if kind == "unknown":
            return
        if kind != "known":
            self.known[0] = EnvironmentLight.open(kind).resized(rows, 2 * rows).radiance.to(self.device)
            return
        if "environment" not in data.about:
            raise LumigraphError(f"{data.source} has no environment maps of its photographs; name a file by --light")
        for image, radiance in enumerate(data.about["environment"]):
            self.known[image] = EnvironmentLight(radiance).resized(rows, 2 * rows).radiance.to(self.device)

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Copy or distil a teacher's density and colour; geometry is trained further for the rest of its share of
        the budget."""
        if self._is_alike(teacher):
            self.network.load_state_dict(teacher.network.state_dict())
            self.sampler = copy.deepcopy(teacher.sampler)
        else:
            known, chance = teacher_of(teacher, cameras), self.random(3)
            points = self.config.occupancy.samples_per_step
            optimizers = self.network.optimizers_at(self.config.geometry_rate)
            distil(self.network, known, self.network.space, optimizers, points, chance, self.device)
            self.sampler.begin_from(known, chance)
            self.sampler.settle(self.density, chance)
        if self.lobes is not None:
            self.lobes.learn(PRIOR_STEPS, 1e-2, self.random(1))

    def _is_alike(self, teacher: Any) -> bool:
        """True if a teacher has a hash table of the same sizes and the same sampler, so that weights can be copied."""
        own, other = self.network, getattr(teacher, "network", None)
        if not isinstance(other, HashField) or type(teacher.sampler) is not type(self.sampler):
            return False
        shapes = [{name: x.shape for name, x in field.state_dict().items()} for field in (own, other)]
        return shapes[0] == shapes[1]

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        """Rays of a step. Freezes geometry after its share of the budget."""
        if not self.stage and self.progress >= self.config.geometry_share:
            self.grid.fill(self.density, self.random(2))
            self.stage.fill_(1)
            self._choose_learning()
            self.began.fill_(self.progress)
            self._begin_light(data)
        if not self.stage:
            return data.sample_rays(self.sampler.batch_size, generator).to(self.device)
        layers = ("raw",) if "raw" in data.layers else ()
        return data.sample_rays(self.config.surface_rays, generator, layers=layers).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        return self.surface_loss(batch, step) if self.stage else self.geometry_loss(batch, step)

    def geometry_loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The Huber loss of composited colours, as Instant-NGP's."""
        generator = self.random(step)
        (samples,), terms = self.learn(batch.rays, generator)
        look = samples.look(self.network)
        background = backdrop(batch, self.background, generator, opaque=self.sampler.is_open)
        seen = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(seen, batch, background)
        return {"huber": huber(residual, self.config.huber_delta), **terms}

    def surface_loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Errors of encoded colours, distances from the geometry, and smoothness (sections 3.1 to 3.5)."""
        c, chance = self.config, self.random(step)
        light = batch.extra["raw"][:, :3] if "raw" in batch.extra else decoded(batch.rgb)
        points, opacity = self.surface(batch.rays)
        solid = (opacity > MIN_OPACITY) & self.in_grid(points) & light.isfinite().all(-1)
        if batch.alpha is not None:
            solid &= batch.alpha > 1 - 1e-3
        rays, points, light = batch.rays[solid], points[solid], light[solid]
        given, raw = self.grid.normals(points, -rays.directions), self.properties(points)
        jittered = points + JITTER * torch.randn(points.shape, generator=chance).to(points)
        other = self.properties(jittered)
        seen = self.shade(points, -rays.directions, raw, given, self.pixels[0], self.power(rays))
        near = self.properties.oriented(other.normals, given)

        def mean(values: Tensor) -> Tensor:
            """Mean over all rays of the step; rays without a surface count as zero."""
            return values.sum() / (len(batch) * values.shape[-1])

        alone = self._over(self.progress) < c.shape_share  # the shape's stage
        smooth = (NORMAL_SMOOTHNESS, VISIBILITY_SMOOTHNESS, ALBEDO_SMOOTHNESS)
        smooth = smooth if c.properties == "network" else (TABLE_SMOOTHNESS,) * 3
        terms = {
            "normals": (SHAPE_WEIGHT if alone else NORMAL_WEIGHT) * mean((seen.normals - given).square()),
            "normal_smoothness": smooth[0] * mean((seen.normals - near).abs()),
        }
        if self.lights_seen is not None:
            traced = self.grid.visibility(points, seen.normals.detach(), self.pixels[0])
            beside = self.lights_seen(jittered, self.pixels[0])
            weight = SHAPE_WEIGHT if alone else VISIBILITY_WEIGHT
            terms["visibility"] = weight * mean((seen.visibility - traced).square())
            terms["visibility_smoothness"] = smooth[1] * mean((seen.visibility - beside).abs())
        if alone:
            return terms
        error = mean((tone(seen.radiance) - tone(light)).square())
        self.figures = {"mse": float(error.detach()), "rays": len(batch), "surface_points": len(points)}
        terms["colour"] = error
        terms["albedo_smoothness"] = smooth[2] * mean((seen.albedo - albedo_of(other.albedo)).abs())
        terms["code_smoothness"] = CODE_SMOOTHNESS * mean((seen.code - self.code_of(other.code)).abs())
        if c.light == "unknown":
            terms["light_variation"] = LIGHT_VARIATION * variation(self.log_light.exp())
        return terms

    def _over(self, progress: float) -> float:
        """Share of the budget after geometry that is spent."""
        began = float(self.began)
        return (progress - began) / max(1 - began, 1e-9) if self.stage else 0.0

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c = self.config
        seen = [] if self.lights_seen is None else list(self.lights_seen.parameters())
        groups: list[dict[str, Any]] = [{"params": seen, "name": "properties"}] if seen else []
        if c.light == "unknown":
            groups.append({"params": [self.log_light], "name": "light"})
        geometry = self.network.optimizers_at(c.geometry_rate, c.hash_weight_decay)
        return [*geometry, *self.properties.optimizers_at(c.learning_rate, groups), *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c = self.config
        spent, over = min(progress / max(c.geometry_share, 1e-9), 1.0), self._over(progress)
        joint = falling(c.learning_rate, c.final_learning_rate, over)
        return {
            "": hold_and_decay(c.geometry_rate, FINAL_GEOMETRY_RATE, step, spent, DECAY_START),
            "properties": SHAPE_LEARNING_RATE if over < c.shape_share else joint,
            "light": falling(c.light_rate, c.light_rate * c.final_learning_rate / c.learning_rate, over),
        }

    def before_step(self, step: int, progress: float) -> None:
        share = self.config.geometry_share
        if not self.stage and progress < share:
            super().before_step(step, progress / share)

    def after_step(self, step: int) -> None:
        if not self.stage:
            super().after_step(step)

    # Surfaces

    @torch.no_grad()
    def surface(self, rays: Rays) -> tuple[Float[Tensor, "ray 3"], Float[Tensor, " ray"]]:
        """Points of the first surface along rays, and opacity."""
        seen = self.sampler.sample(rays, self.network)[-1]
        distance, opacity = surface_distance(seen.samples, seen.density)
        return rays.at(torch.where(distance.isfinite(), distance, 0)), opacity

    def in_grid(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        """Mask of the points whose geometry is on the grid; beyond, the field's colours are shown."""
        low, high = torch.tensor(self.frame.bounds, device=points.device)
        return ((points > low) & (points < high)).all(-1)

    def code_of(self, raw: Float[Tensor, "point code"]) -> Float[Tensor, "point code"]:
        """Codes of the learnt reflectance, or roughness of microfacets."""
        return raw if self.lobes is not None else MIN_ROUGHNESS + (1 - MIN_ROUGHNESS) * raw.sigmoid()

    def shade(
        self,
        points: Float[Tensor, "point 3"],
        eyes: Float[Tensor, "point 3"],
        raw: Raw,
        given: Float[Tensor, "point 3"],
        ways: Float[Tensor, "light 3"],
        power: Float[Tensor, "#point light 3"],
        tint: Float[Tensor, " 3"] | None = None,
        rougher: float = 1.0,
    ) -> Shading:
        """Properties of points and the light that they send to the eye (eq. 7).

        given: normals of the geometry; ways, power: of the lights; tint, rougher: factors on albedo and roughness
        """
        normals = facing(self.properties.oriented(raw.normals, given), eyes)
        albedo, code = albedo_of(raw.albedo), self.code_of(raw.code)
        albedo = albedo if tint is None else albedo * tint
        seen = self.visibility(points, normals, ways)
        cosines = normals @ ways.T
        reached = seen * cosines.clamp_min(0)
        if self.lobes is None:
            roughness = (code * rougher).clamp(MIN_ROUGHNESS, 1)
            specular = microfacet(cosines, (normals * eyes).sum(-1, keepdim=True), eyes @ ways.T, roughness)
        else:
            roughness = code[:, :1]
            specular = self.lobes.at(normals, eyes, ways, code)
        if len(power) == 1:
            radiance = shaded(albedo, specular, reached, power[0])
        else:
            sent = (albedo[:, None] / math.pi + specular[..., None]) * power
            radiance = (reached[..., None] * sent).sum(1)
        return Shading(radiance, albedo, code, roughness, normals, seen)

    def visibility(
        self, points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"], ways: Float[Tensor, "light 3"]
    ) -> Float[Tensor, "point light"]:
        """Share of each light that reaches each point. Suns beside the map's pixels are traced."""
        count = len(self.pixels[0])
        if self.config.visibility == "none":
            return torch.ones(len(points), len(ways), device=points.device)
        if self.lights_seen is None:
            return self.grid.visibility(points, normals.detach(), ways)
        suns = self.grid.visibility(points, normals.detach(), ways[count:])
        return torch.cat([self.lights_seen(points, ways[:count]), suns], -1)

    # Rendering

    @property
    def rays_per_chunk(self) -> int:  # type: ignore[override]
        return 2048 if self.stage else self.sampler.rays_per_chunk

    @property
    def controls(self) -> tuple[Control, ...]:
        about = "Light of the scene: the photographs' own, a sun with a sky, white from everywhere, or a map's file."

        def number(name: str, default: float, least: float, most: float, unit: str, about: str) -> Control:
            return Control(name, default, (least, most), unit=unit, about=about)

        return (
            Control("light", CAMERAS_LIGHT, choices=(CAMERAS_LIGHT, SUN, WHITE), files=SUFFIXES, about=about),
            number("light_turn", 0.0, -180.0, 180.0, "degrees", "Turns the light about the vertical axis."),
            *(number(name, UNSAID[name], UNSAID[name], most, unit, about) for name, most, unit, about in SUN_CONTROLS),
            *(number(name, 1.0, 0.0, 4.0, "", f"Factor on the {name} of all albedo.") for name in FACTORS),
            number("roughness", 1.0, 0.1, 10.0, "", "Factor on roughness: less is glossier."),
            Control("show", SHOWN[0], choices=SHOWN, about="The picture, or one of its layers."),
            *CONTROLS,
        )

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Relight by an `EnvironmentLight`, or by controls."""
        named = str(controls.get("light", ""))
        if named.lower().endswith(SUFFIXES):
            self._told = EnvironmentLight.open(named)
        elif evidence or named:
            self._told = evidence[-1] if evidence else None

    @torch.no_grad()
    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        seen = self.sampler.sample(rays, self.network)[-1]
        look = seen.look(self.network)
        plain = composite(look.samples, look.density, look.rgb, background)
        if not self.stage:
            return plain
        distance, opacity = surface_distance(look.samples, look.density)
        points = rays.at(torch.where(distance.isfinite(), distance, 0))
        lit = ((opacity > 0.01) & self.in_grid(points)).nonzero()[:, 0]
        given = self.grid.normals(points[lit], -rays.directions[lit])
        ways, power = self.lamps(rays[lit])
        tint = torch.tensor([float(self.control(name)) for name in FACTORS], device=self.device)
        raw, eyes = self.properties(points[lit]), -rays.directions[lit]
        found = self.shade(points[lit], eyes, raw, given, ways, power, tint, float(self.control("roughness")))
        # Beyond the grid and before the background the photographs' colours stay as they are.
        light = decoded(plain.rgb.clamp(0, 1))
        own = exposed(found.radiance, float(self.control("exposure")), float(self.control("white_balance")))
        light[lit] = own
        even = (found.normals @ self.pixels[0].T).clamp_min(0) * self.pixels[1].T
        share = (even * found.visibility[:, : even.shape[1]]).sum(-1) / even.sum(-1)
        values = {
            "albedo": found.albedo,
            "normals": found.normals,
            "roughness": found.roughness.clamp(0, 1),
            "visibility": share[:, None],
        }
        shown = str(self.control("show"))
        colour = toned(own, str(self.control("tone"))) if shown == SHOWN[0] else as_colour(shown, values[shown])
        rgb = plain.rgb.clone()
        rgb[lit] = over(colour * opacity[lit, None], opacity[lit], background.expand(len(rays), 3)[lit])
        extra = {
            name: value.new_zeros(len(rays), value.shape[-1]).index_copy(0, lit, value).squeeze(-1)
            for name, value in values.items()
        }
        return Rendering(rgb, torch.where(opacity > 1e-3, distance, torch.inf), opacity, {"radiance": light, **extra})

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions under the settings' light."""
        density, rgb = self.network(points, directions)
        if not self.stage:
            return density, rgb
        ways, power = self.lamps(None)
        tint = torch.tensor([float(self.control(name)) for name in FACTORS], device=self.device)
        found = []
        for part, toward in zip(points.split(self.rays_per_chunk), directions.split(self.rays_per_chunk), strict=True):
            raw, given = self.properties(part), self.grid.normals(part, -toward)
            factor = float(self.control("roughness"))
            found.append(self.shade(part, -toward, raw, given, ways, power, tint, factor).radiance)
        light = torch.cat(found) if found else points
        light = exposed(light, float(self.control("exposure")), float(self.control("white_balance")))
        return density, torch.where(self.in_grid(points)[:, None], toned(light, str(self.control("tone"))), rgb)


def albedo_of(raw: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
    """Linear reflectance within what natural materials have (section 3.3)."""
    return MIN_ALBEDO + ALBEDO_RANGE * raw.sigmoid()


def facing(normals: Float[Tensor, "point 3"], eyes: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
    """Normals, with back-facing ones turned until they barely face the eye."""
    lacking = (MIN_FACING - (normals * eyes).sum(-1, keepdim=True)).clamp_min(0)
    return unit(normals + lacking * eyes)


def tone(light: Float[Tensor, "ray 3"]) -> Float[Tensor, "ray 3"]:
    """Linear light encoded as sRGB, not clipped at white."""
    return encoded(light.clamp_min(1e-5))


def variation(light: Float[Tensor, "row column 3"]) -> Tensor:
    """Sum of squared differences between neighbouring pixels (section 3.4); columns are cyclic."""
    down, across = light.diff(dim=0), light - light.roll(1, 1)
    return down.square().sum() + across.square().sum()


def as_colour(name: str, values: Float[Tensor, "point _"]) -> Float[Tensor, "point 3"]:
    """A layer as colours: albedo encoded, normals from -1 to 1, others grey."""
    if name == "albedo":
        return encoded(values.clamp(0, 1))
    return 0.5 + 0.5 * values if name == "normals" else values.expand(-1, 3)
