"""Block-NeRF: one block of a city, in the light of each photograph (Tancik et al. 2022, arXiv 2202.05263).

The field of one block learns from any scene. `large.compositing` makes one picture of many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import huber_loss

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering
from ..components.clouds.dense_points import compile_sweep
from ..components.fields import hash_field
from ..components.fields.appearance import Appearance, Patches, PhotographCodes, drawn
from ..components.fields.coded_field import of_samples
from ..components.fields.coded_frustums import CodedFrustums
from ..components.fields.coded_hash import CodedHash
from ..components.fields.exposures import Exposures
from ..components.fields.hash_field import HashNumbers
from ..components.fields.visibility import Visibility
from ..components.sampling.coarse_to_fine import SAMPLES_OF_A_RAY
from ..components.sampling.occupancy import OccupancyGrid
from ..components.sampling.spaces import space_of
from ..components.sampling.unbounded import OpenNumbers, Unbounded
from ..components.training.moving import Moving
from ..components.training.photometric import backdrop
from ..components.training.pose_refinement import PoseRefinement
from ..components.training.schedules import falling, held
from ..datasets.scene import Batch, Frame, Photograph, Scene
from ..errors import LumigraphError
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
    """The paper's numbers, with where it gives them; `BlockNeRF.preset` says what a plain CPU does otherwise."""

    field: Literal["hash", "network"] = "network"  # what holds the block: a hash table, or the paper's Mip-NeRF
    appearance: bool = True  # a code for each photograph, section 4.2.1
    appearance_code: Code = 32  # its numbers
    exposure: bool = True  # log exposure as input, where photographs say theirs, section 4.2.3
    exposure_frequencies: Octaves = 4  # its octaves, section 4.2.3
    visibility: bool = True  # learn which places were seen, section 4.2.5
    visibility_frequencies: Octaves = 6  # octaves of places
    visibility_layers: Layers = 4  # hidden layers: a network much smaller than the field
    visibility_width: Width = 128  # their channels
    residual_masks: bool = False  # leave out parts of photographs that no other agrees with, beside the masks given
    refine_cameras: bool = False  # learn where each photograph was taken from, section 4.2.2
    pose_learning_rate: LearningRate = 5e-4  # radians by which a step moves a picture, with refine_cameras
    match_photographs: bool = False  # with refine_cameras, begin where features that photographs share say (slow)
    huber_delta: PositiveShare = 1.0  # residual at which the loss turns from square to linear; 1: never
    own_skies: bool = True  # of the hash table in the open: behind everything a sky that the codes tell
    hidden_width: Width = 512  # channels of a layer
    learning_rate: LearningRate = 1e-3
    final_learning_rate: LearningRate = 1e-5  # at the end of the budget
    decay_start: Annotated[float, between(0, 0.99)] = 0.0  # share of the budget before the learning rate falls
    # Of the field of networks: see mip-nerf, whose numbers these are.
    depth: Depth = 8  # hidden layers before density
    skip_layer: Layers = 5  # the layer whose activation the input joins again
    position_frequencies: Octaves = 16  # L for frustums
    direction_frequencies: Octaves = 4  # L for directions
    coarse_samples: RaySamples = 128  # frustums of a ray
    fine_samples: RaySamples = 128  # of a ray, drawn where the first found something
    resample_padding: NonNegative = 0.01  # weight that every frustum has at least
    coarse_loss_weight: NonNegative = 0.1  # 0: the first look only guides the second
    rays_per_step: BatchSize = 4096
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


# Finding an appearance: pixels that are looked at, steps and learning rate of Adam, and the weight in its pixel from
# which on a sample counts.
FIT_RAYS, FIT_WEIGHT = 2048, 5e-3
SEEING_RATES = 5e-3, 5e-4  # of the visibility network, at first and in the end


class BlockNeRF(RayMethod):
    """Colours that depend on a photograph's appearance and exposure, and a network that knows what was seen."""

    Config = Config
    in_blocks = True

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        c, photographs = config, frame.image_count
        self.poses = PoseRefinement(photographs, c.pose_learning_rate) if c.refine_cameras else None
        self.appearance = PhotographCodes(photographs, c.appearance_code) if c.appearance else None
        self.exposures = Exposures(photographs, c.exposure_frequencies) if c.exposure else None
        self.moving = Moving(photographs) if c.residual_masks else None
        code = (c.appearance_code if c.appearance else 0) + (self.exposures.width if self.exposures else 0)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            kind = CodedHash if c.field == "hash" else CodedFrustums
            self.network = kind(frame, config, code, self.poses.weights if self.poses else None)
            shape = c.visibility_frequencies, c.visibility_layers, c.visibility_width
            self.sight = Visibility(space_of(frame), *shape) if c.visibility else None
        self.found: Tensor | None = None  # the appearance that was given, or found for what was given
        self.taken: float | None = None  # stops from the usual exposure, of a photograph that was given
        self.rays_per_chunk = self.network.rays_per_chunk

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's networks. On a CPU a hash table with Instant-NGP's numbers there."""
        if device.type == "cuda":
            return Config()
        return Config(
            field="hash",
            visibility_layers=2,
            visibility_width=64,
            huber_delta=0.3,
            final_learning_rate=1e-3,
            decay_start=0.3,
            **hash_field.ON_A_CPU,
        )

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table with tiny networks, every part of it, within some twenty quick steps."""
        return Config(
            field="hash",
            appearance_code=4,
            exposure_frequencies=2,
            visibility_frequencies=3,
            visibility_layers=1,
            visibility_width=16,
            residual_masks=True,
            refine_cameras=True,
            final_learning_rate=1e-3,
            **hash_field.TINY,
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
        if self.exposures and "exposure" in scene.about:
            self.exposures.begin(scene.about["exposure"], scene.splits["train"])
        if self.poses:
            self.poses.find(scene, self.config.match_photographs)
        else:  # what neighbouring photographs agree on, seen from wrong poses, would be elsewhere
            self.network.begin(scene, seconds, self.random(1))

    def rehearse_begin(self) -> None:
        if self.config.field == "hash" and self.frame.reach > 1 and not self.poses:
            compile_sweep()

    def rays_in_a_step(self, data: Scene) -> float:
        c = self.config
        samples = c.samples_per_ray if self.frame.reach > 1 else SAMPLES_OF_A_RAY
        return c.samples_per_step / samples if c.field == "hash" else c.rays_per_step

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        places = self.moving is not None
        return data.sample_rays(self.network.batch_size, generator, places=places).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The error of every pass's colours, and of what the visibility network says of the last pass's rays."""
        c, generator = self.config, self.random(step)
        rays = self.poses(batch.rays) if self.poses else batch.rays
        assert rays.image_index is not None
        codes = self.codes(rays.image_index)
        background = backdrop(batch, self.background, generator, opaque=self.frame.reach > 1)
        target = batch.before(background)
        behind = self.network.behind(rays, codes, background)
        terms, counted = {}, self._counted(batch)
        for places in self.network.passes(rays, generator):
            weight = c.coarse_loss_weight if places.name == "coarse" else 1.0
            if weight:
                rgb = self.network.colour(places, of_samples(codes, places))
                residual = composite(places.samples, places.density, rgb, behind).rgb - target
                error = huber_loss(residual, torch.zeros_like(residual), reduction="none", delta=c.huber_delta)
                terms[places.name] = weight * (counted * error.mean(-1)).mean() / c.huber_delta
        terms |= self.network.further_terms(generator)
        if self.sight:
            terms["visibility"] = self.sight.error(rays, places.samples, places.density.detach(), generator)
        if self.moving:
            self.moving.note(rays.image_index, batch.extra["place"], residual.detach().abs().mean(-1))
        self.figures |= {"mse": float(residual.detach().square().mean())}
        self.figures |= {"rays": len(rays), "samples": places.asked}
        return terms

    def _counted(self, batch: Batch) -> Float[Tensor, " ray"]:
        """1 for rays that teach, 0 for those that see what moved."""
        if self.moving is None or batch.rays.image_index is None:
            return torch.ones_like(batch.rays.radius)
        weights = self.moving.weights(batch.rays.image_index, batch.extra["place"])
        self.figures["left_out"] = float(1 - weights.mean())
        return weights

    def optimizers(self) -> list[torch.optim.Optimizer]:
        optimizers = self.network.optimizers([self.appearance.codes] if self.appearance else [])
        if self.sight:
            group = {"params": [*self.sight.parameters()], "name": "visibility"}
            optimizers.append(torch.optim.Adam([group], SEEING_RATES[0]))
        return [*optimizers, self.poses.optimizer()] if self.poses else optimizers

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c = self.config
        rate = held(c.learning_rate, c.final_learning_rate, step, progress, c.decay_start)
        rates = {"": rate, "proposal": Unbounded.rate(progress), "visibility": falling(*SEEING_RATES, progress)}
        return rates | {"poses": self.poses.rate(progress)} if self.poses else rates

    def before_step(self, step: int, progress: float) -> None:
        if self.poses:
            self.poses.progress.fill_(progress)
        if self.moving:
            self.moving.before_step(step, progress)
        self.network.before_step(step, progress, self.random(~step))

    def after_step(self, step: int) -> None:
        self.network.after_step(self.figures["samples"])

    def codes(self, image: Int[Tensor, " ray"]) -> Float[Tensor, "ray code"]:
        """What colours depend on beside place and direction, of each ray's photograph: appearance, then exposure."""
        nothing = torch.zeros(len(image), 0, device=self.device)
        return torch.cat([nothing, *(part(image) for part in (self.appearance, self.exposures) if part)], -1)

    # Being seen

    def looks(self, rays: Rays) -> list[Look]:
        """The block in the light that was told."""
        found, code = [], self._code
        for places in self.network.passes(rays):
            rgb = self.network.colour(places, code.expand(len(places.samples), -1))
            found.append(Look(places.name, places.samples, places.density, rgb))
        return found

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        last, code = self.network.passes(rays)[-1], self._code
        background = self.network.behind(rays, code.expand(len(rays), -1), background)
        rgb = self.network.colour(last, code.expand(len(last.samples), -1))
        return composite(last.samples, last.density, rgb, background)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour in the light that was told."""
        return self.network.field(points, directions, self._code)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self.network.density(points)

    @torch.no_grad()
    def visibility(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, " point"]:
        """How much of each place, seen along a unit direction, the block's photographs saw, in [0, 1] (section 4.2.5);
        1 everywhere where that was not learnt."""
        return self.sight(points, directions) if self.sight else torch.ones_like(points[:, 0])

    def refined(self, cameras: Camera) -> Camera:
        return self.poses.refined(cameras) if self.poses else cameras

    # Being told something

    @property
    def accepts(self) -> tuple[type, ...]:  # type: ignore[override]  # it depends on the run
        """Photographs, rays with colours, or a code, where it learnt what differs between photographs."""
        if self.appearance:
            return Photograph, Patches, Appearance
        return (Photograph,) if self.usual_exposure is not None else ()

    @property
    def controls(self) -> tuple[Control, ...]:
        appearance = self.appearance and self.appearance.control(
            "appearance",
            "The photograph, by number or name, in whose light and colours the scene is shown; or the average of all.",
        )
        exposure = self.exposures and self.exposures.control
        return tuple(control for control in (appearance, exposure) if control)

    def given(self, *evidence: Any, **controls: Value) -> Method:
        """The same block, told its controls, or the appearance of an `Appearance`, or that in which it looks most like
        a Photograph, by the pixels that are to be trusted, or like Patches of pictures.

        A photograph whose exposure is known, by its camera's `image_index`, is shown with it.
        """
        mine: list[Any] = [piece for piece in evidence if isinstance(piece, self.accepts)]
        told = super().given(*(piece for piece in evidence if not isinstance(piece, self.accepts)), **controls)
        assert isinstance(told, BlockNeRF)
        for piece in mine:
            if isinstance(piece, Photograph):
                told.taken = told._stops_of(piece.camera)
            if self.appearance:
                told.found = told._appearance_of(piece)
                told.told.pop("appearance", None)
        return told

    @property
    def shown_in(self) -> Appearance:
        """The appearance that pictures have: as told, else as found, else the average. Empty where none was learnt."""
        if self.appearance is None:
            return Appearance(torch.zeros(0, device=self.device))
        if self.found is not None and "appearance" not in self.told:
            return Appearance(self.found)
        return Appearance(self.appearance.told(str(self.control("appearance"))))

    @property
    def usual_exposure(self) -> float | None:
        """log2 of the median exposure of the photographs that it learnt from; None where that is not known."""
        return self.exposures.usual_stops if self.exposures else None

    @property
    def _code(self) -> Float[Tensor, " code"]:
        """What colours depend on, as told."""
        parts = [self.shown_in.code]
        if self.exposures:
            stops = self.told.get("exposure", 0.0 if self.taken is None else self.taken)
            parts.append(self.exposures.encoded(parts[0].new_tensor([float(stops)]))[0])
        return torch.cat(parts)

    def _stops_of(self, camera: Camera) -> float | None:
        """The exposure of the photograph that a camera took, stops from the usual; None where that is not known."""
        if self.exposures is None or camera.image_index is None:
            return None
        return self.exposures.stops_of(int(camera.image_index[0]))

    @torch.no_grad()
    def _appearance_of(self, piece: Photograph | Patches | Appearance) -> Float[Tensor, " code"]:
        """The appearance in which the block looks most like a piece of evidence; that it has, where nothing tells."""
        start = self.shown_in.code
        if isinstance(piece, Appearance):
            if piece.code.shape != start.shape:
                raise LumigraphError(
                    f"An appearance of {len(piece.code)} numbers does not fit a block whose photographs have "
                    f"{len(start)}; give it one that was aligned with this block"
                )
            return piece.code.to(start)
        size = piece.size if isinstance(piece, Patches) else 1
        batch = drawn(piece, FIT_RAYS, self.random(0)) if isinstance(piece, Photograph) else piece.batch
        batch = batch.to(self.device)
        if self.appearance is None or not len(batch):
            return start
        rest, background = self._code[len(start) :], self.background
        target = batch.before(background)
        places = self.network.passes(batch.rays)[-1]
        places = places.keep(weights_of(places.samples, places.density) > FIT_WEIGHT)

        def error(appearance: Tensor) -> Tensor:
            code = torch.cat([appearance, rest])
            rgb = self.network.colour(places, code.expand(len(places.samples), -1))
            behind = self.network.behind(batch.rays, code.expand(len(batch), -1), background)
            off = composite(places.samples, places.density, rgb, behind).rgb - target
            return off.view(-1, size, 3).mean(1).square().sum(-1).mean()

        return self.appearance.fitted(start, error)
