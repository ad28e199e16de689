"""NeRF-W: a scene from photographs in other light, with passers-by (Martin-Brualla et al. 2021, arXiv 2008.02268)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera.rays import Look, Rays, Rendering, Samples
from ..components.clouds.dense_points import compile_sweep
from ..components.fields import hash_field
from ..components.fields.appearance import PhotographCodes, drawn
from ..components.fields.coded_field import of_samples
from ..components.fields.hash_field import ON_A_CPU, TINY, HashNumbers
from ..components.fields.wild_field import with_passing
from ..components.fields.wild_hash import WildHash
from ..components.fields.wild_networks import WildNetworks
from ..components.sampling.coarse_to_fine import SAMPLES_OF_A_RAY
from ..components.sampling.occupancy import OccupancyGrid
from ..components.sampling.unbounded import OpenNumbers, Unbounded
from ..components.training.corrections import AVERAGE
from ..components.training.photometric import backdrop
from ..components.training.schedules import held
from ..datasets.scene import Batch, Frame, Photograph, Scene
from ..files.ranges import (
    BatchSize,
    Depth,
    Layers,
    LearningRate,
    NonNegative,
    Octaves,
    PositiveShare,
    RaySamples,
    Seed,
    Share,
    Steps,
    Width,
    between,
)
from ..method import Method, RayMethod
from ..method.controls import Control, Value
from ..volume import composite, weights_of

Code = Annotated[int, between(1, 1024)]  # numbers of a photograph's code


@dataclass(frozen=True)
class Config(HashNumbers, OpenNumbers):
    """The paper's numbers, with where it gives them; `NeRFW.preset` says what a plain CPU does otherwise."""

    field: Literal["hash", "network"] = "network"  # what holds the scene: a hash table, or the paper's networks
    appearance_code: Code = 48  # n^(a), numbers to a photograph, section 5
    transient_code: Code = 16  # n^(tau), section 5
    transient_layers: Layers = 4  # hidden layers of the transient head, supplement
    transient_width: Width = 128  # their channels, supplement
    beta_min: PositiveShare = 0.03  # least deviation of a colour, section 5
    transient_weight: NonNegative = 0.01  # lambda_u, of the mean transient density, section 5
    transient_start: Share = 0.0  # share of the budget before which nobody passes by, so that what stays takes shape
    own_skies: bool = True  # of the hash table in the open: behind everything a sky that the appearance tells
    hidden_width: Width = 256  # channels of a layer, supplement
    learning_rate: LearningRate = 5e-4
    final_learning_rate: LearningRate = 5e-5  # at the end of the budget
    decay_start: Annotated[float, between(0, 0.99)] = 0.0  # share of the budget before the learning rate falls
    # Of the field of networks.
    depth: Depth = 8  # hidden layers before density, supplement
    skip_layer: Layers = 5  # the layer whose activation the input joins again
    position_frequencies: Octaves = 15  # L for points, supplement
    direction_frequencies: Octaves = 4  # L for directions, supplement
    coarse_samples: RaySamples = 64  # of a ray
    fine_samples: RaySamples = 64  # of a ray, drawn where the first found something
    rays_per_step: BatchSize = 2048  # supplement
    bfloat16: bool = True  # multiply in bfloat16 where the machine is fast at it
    density_layers: Layers = 1  # hidden layers
    colour_layers: Layers = 2  # hidden layers
    geometry_features: Annotated[int, between(1, 256)] = 16  # from density to colour network
    sh_bands: Annotated[int, between(1, 4)] = 4  # of spherical harmonics
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 18
    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 1024  # of the unit cascade
    cone_angle: Share = 1 / 256  # growth of steps with distance
    transmittance_threshold: Share = 1e-4  # at which a ray is spent
    occupancy_resolution: Annotated[int, between(4, 512)] = 128  # cells per axis and cascade
    occupancy_threshold: NonNegative = 0.05  # optical thickness across a cell below which it is empty
    occupancy_interval: Steps = 16  # steps between updates of the occupancy grid
    occupancy_decay: Share = 0.95  # of the densities it remembers
    seed: Seed = 0

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        hash_field.check_levels(self)


HIDDEN, SHOWN = "hidden", "shown"
# Finding a photograph's appearance: pixels that are looked at, steps and learning rate of Adam, and the weight in its
# pixel from which on a sample counts.
FIT_RAYS, FIT_WEIGHT = 1024, 5e-3


class NeRFW(RayMethod):
    """What stays is one scene, its colours in the light of a photograph; what passes is each photograph's own."""

    Config = Config
    accepts: ClassVar[tuple[type, ...]] = (Photograph,)

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = (WildHash if config.field == "hash" else WildNetworks)(frame, config)
        self.appearance = PhotographCodes(frame.image_count, config.appearance_code)
        self.transient = PhotographCodes(frame.image_count, config.transient_code)
        self.settling = False  # whether nobody passes by yet
        self.found: Tensor | None = None  # the appearance of a photograph that was given
        self.rays_per_chunk = self.network.rays_per_chunk

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's networks and numbers. On a CPU a hash table with Instant-NGP's numbers there."""
        if device.type == "cuda":
            return Config()
        return Config(
            field="hash",
            transient_layers=2,
            transient_width=32,
            beta_min=0.1,
            transient_start=0.1,
            **ON_A_CPU,
            final_learning_rate=1e-3,
            decay_start=0.3,
        )

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table with tiny networks and a grid of three sizes, within some twenty quick steps."""
        return Config(
            field="hash",
            appearance_code=4,
            transient_code=4,
            transient_layers=1,
            transient_width=16,
            **TINY,
            final_learning_rate=1e-3,
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        if config.field == "network":
            samples = config.rays_per_step * (config.coarse_samples + config.fine_samples)
            return 2 * samples * config.depth * config.hidden_width * learning
        grid = OccupancyGrid.bytes_of(frame.reach, config.occupancy_resolution)
        return grid + Unbounded.bytes_of(frame, learning) + hash_field.bytes_kept(config) * learning

    # Learning

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        self.network.begin(scene, seconds, self.random(1))

    def rehearse_begin(self) -> None:
        if self.config.field == "hash" and self.frame.reach > 1:
            compile_sweep()

    def rays_in_a_step(self, data: Scene) -> float:
        c = self.config
        samples = c.samples_per_ray if self.frame.reach > 1 else SAMPLES_OF_A_RAY
        return c.samples_per_step / samples if c.field == "hash" else c.rays_per_step

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        return data.sample_rays(self.network.batch_size, generator).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Equations 13 and 14: the last pass with passers-by, the coarse one without them and without uncertainty."""
        c, rays, generator = self.config, batch.rays, self.random(step)
        assert rays.image_index is not None
        background = backdrop(batch, self.background, generator)
        target = batch.before(background)
        appearance, transient = self.appearance(rays.image_index), self.transient(rays.image_index)
        background = self.network.behind(rays, appearance, background)
        *coarse, last = self.network.passes(rays, generator)
        terms = {}
        for places in coarse:
            rgb = self.network.colour(places, of_samples(appearance, places))
            seen = composite(places.samples, places.density, rgb, background)
            terms[places.name] = 0.5 * squared(seen.rgb - target).mean()
        rgb = self.network.colour(last, of_samples(appearance, last))
        if self.settling:
            seen, beta = (
                composite(last.samples, last.density, rgb, background),
                torch.full_like(target[:, 0], c.beta_min),
            )
        else:
            passing = self.network.passing(last, of_samples(transient, last))
            seen = with_passing(last, rgb, passing, background)
            beta = c.beta_min + seen.extra["beta"]
            terms["uncertainty"] = (beta / c.beta_min).log().mean()
            terms["transient"] = c.transient_weight * mean_along(last.samples, passing.density)
        error = squared(seen.rgb - target)
        terms["colour"] = (error / (2 * beta.square())).mean()
        certain = 1 / (2 * c.beta_min**2)  # what an error counts at most, beside which the others have their weights
        terms |= {name: certain * term for name, term in self.network.further_terms(generator).items()}
        self.figures |= {"mse": float(error.detach().mean()) / 3, "beta": float(beta.detach().mean())}
        self.figures |= {"rays": len(rays), "samples": last.asked}
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return self.network.optimizers([self.appearance.codes, self.transient.codes])

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c = self.config
        rate = held(c.learning_rate, c.final_learning_rate, step, progress, c.decay_start)
        return {"": rate, "proposal": Unbounded.rate(progress)}

    def before_step(self, step: int, progress: float) -> None:
        self.settling = progress < self.config.transient_start
        self.network.before_step(step, progress, self.random(~step))

    def after_step(self, step: int) -> None:
        self.network.after_step(self.figures["samples"])

    # Being seen

    def looks(self, rays: Rays) -> list[Look]:
        """What stays, in the light that was told."""
        found = []
        for places in self.network.passes(rays):
            rgb = self.network.colour(places, self._appearance.expand(len(places.samples), -1))
            found.append(Look(places.name, places.samples, places.density, rgb))
        return found

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        last, appearance = self.network.passes(rays)[-1], self._appearance
        background = self.network.behind(rays, appearance.expand(len(rays), -1), background)
        rgb = self.network.colour(last, appearance.expand(len(last.samples), -1))
        if self.control("transient") == HIDDEN:
            return composite(last.samples, last.density, rgb, background)
        codes = self.transient.told(str(self.told.get("appearance", AVERAGE))).expand(len(last.samples), -1)
        seen = with_passing(last, rgb, self.network.passing(last, codes), background)
        return replace(seen, rgb=seen.rgb.clamp(0, 1))

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density of what stays per scene unit, and its sRGB-encoded colour in the light that was told."""
        return self.network.field(points, directions, self._appearance)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density of what stays, per scene unit."""
        return self.network.density(points)

    # Being told something

    @property
    def controls(self) -> tuple[Control, ...]:
        appearance = self.appearance.control(
            "appearance",
            "The photograph, by number or name, in whose light and colours the scene is shown; or the average of all.",
        )
        about = "Whether what passed before the photograph that appearance names is shown too."
        return appearance, Control("transient", HIDDEN, choices=(HIDDEN, SHOWN), about=about)

    def given(self, *evidence: Any, **controls: Value) -> Method:
        """The same scene, told its controls, or in the light of a photograph: its appearance is found from the pixels
        that are to be trusted (section 5), and its passers-by are left out."""
        photographs = [piece for piece in evidence if isinstance(piece, Photograph)]
        told = super().given(*(piece for piece in evidence if not isinstance(piece, Photograph)), **controls)
        assert isinstance(told, NeRFW)
        for photograph in photographs:
            told.found = self._found(photograph)
            told.told.pop("appearance", None)
        return told

    @property
    def _appearance(self) -> Float[Tensor, " code"]:
        """The code that was told, else the one that was found, else the average."""
        if self.found is not None and "appearance" not in self.told:
            return self.found
        return self.appearance.told(str(self.control("appearance")))

    @torch.no_grad()
    def _found(self, photograph: Photograph) -> Float[Tensor, " code"]:
        """The appearance in which what stays looks most like a photograph; the average, where no pixel tells."""
        batch = drawn(photograph, FIT_RAYS, self.random(0)).to(self.device)
        if not len(batch):
            return self.appearance.average
        background, target = self.background, batch.before(self.background)
        places = self.network.passes(batch.rays)[-1]
        places = places.keep(weights_of(places.samples, places.density) > FIT_WEIGHT)

        def error(code: Tensor) -> Tensor:
            rgb = self.network.colour(places, code.expand(len(places.samples), -1))
            behind = self.network.behind(batch.rays, code.expand(len(batch), -1), background)
            return squared(composite(places.samples, places.density, rgb, behind).rgb - target).mean()

        return self.appearance.fitted(self.appearance.average, error)


def squared(residual: Float[Tensor, "ray 3"]) -> Float[Tensor, " ray"]:
    return residual.square().sum(-1)


def mean_along(samples: Samples, values: Float[Tensor, " sample"]) -> Float[Tensor, ""]:
    """The mean over each ray's samples, averaged over all rays; 0 counts for a ray that has none."""
    counts = samples.ray_starts.diff()
    return (values / counts[samples.ray_index]).sum() / len(counts)
