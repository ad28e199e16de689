"""HyP-NeRF: a hypernetwork gives the hash table and networks of an object (Sen et al. 2023, arXiv 2306.06093)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...budget import Effort, Efforts
from ...camera import Camera
from ...camera.rays import Look, Rays, Rendering
from ...components.fields.appearance import fitted
from ...components.fields.hash_field import HashNumbers
from ...components.fields.instance_codes import FOUND, InstanceCodes
from ...components.fields.kept_photographs import Kept, chance, photographed, rays_through
from ...components.sampling.occupancy import OccupancyGrid, visual_hull
from ...components.sampling.occupancy_sampler import reached
from ...components.training.photometric import backdrop, residuals
from ...components.training.row_optimizers import LazyAdam
from ...components.training.schedules import exponential_decay
from ...datasets.collection import Collection
from ...datasets.scene import Batch, Frame, Photograph, Scene
from ...errors import LumigraphError
from ...files.ranges import BatchSize, Count, LearningRate, NonNegative, Positive, Share, Width, between
from ...geometry import look_at, turning
from ...method import BaseConfig, Method, RayMethod, seeded
from ...method.controls import Control, Value, blend
from ...method.field import Colours, Densities, Directions, Points
from ...readers.up import common_up
from ...volume import composite
from .networks import HashInstance, HashShape, HyperNetwork, PictureDenoiser

Tally = Annotated[int, between(0, 100_000)]


DENOISE_WEIGHT = 0.5  # weight of denoised renderings beside the photographs, in tuning

HYPER_LAYERS = 2  # hidden layers of the hypernetwork for each tensor
DENOISER_WIDTH = 32  # channels of the denoiser, section 3.3
CODE_WEIGHT = 0.0  # of the codes' squares: an option of older runs, always off


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers where it or its published code gives them; `HypNeRF.preset` has those of a plain CPU."""

    table: HashNumbers = HashNumbers(log2_hashmap_size=11)  # of an object
    shape_code: Width = 512  # numbers of the code of table and density, section 3.2; more hold more shapes
    colour_code: Width = 512  # numbers of the code of the colour network, section 3.2; more hold more colours
    code_deviation: Positive = 0.01  # standard deviation of codes at first; larger ones start farther apart
    hyper_width: Width = 512  # channels of the hypernetwork's hidden layers; wider costs memory and time
    members: Count = 4096  # members of a collection at most; each has a code, so more cost memory
    hidden_width: Width = 64  # channels of an object's density and colour networks; wider costs time
    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 512  # samples across the diagonal; fewer are faster
    transmittance_threshold: Share = 1e-4  # transmittance at which a ray terminates; higher is faster, less exact
    occupancy_resolution: Annotated[int, between(4, 256)] = 64  # cells per axis of the occupancy grid; more skip more
    members_per_step: Annotated[int, between(1, 1024)] = 1  # members in a step; more reduce noise, and cost time
    rays_per_member: BatchSize = 4096  # rays of each member in a step; more reduce noise, and cost time
    targets: Annotated[int, between(1, 64)] = 4  # photographs of a member that a step's rays come from
    empty_points: Tally = 1024  # random points of a member in empty space, for empty_weight; 0: no such term
    empty_weight: NonNegative = 0.01  # weight of density in known empty space; higher removes floating density
    learning_rate: LearningRate = 1e-3  # Adam's learning rate at first; higher learns faster, and may diverge
    final_learning_rate: LearningRate = 1e-4  # learning rate at the end of the budget, reached exponentially
    denoiser_start: Share = 0.7  # share of the budget before the denoiser is trained; later leaves it fewer steps
    # Fitting one scene.
    code_steps: Tally = 200  # steps that fit the code of a new scene, section 3.3; more take longer
    code_prior: NonNegative = 1e-3  # weight of a new code's distance from the average; higher: closer to learnt ones
    tune_steps: Tally = 60  # steps that tune the field to the photographs, section 3.3; 0: code alone
    denoise_views: Tally = 12  # denoised renderings around the object to tune on, section 3.3; 0: none
    denoise_steps: Tally = 60  # steps of tuning with denoised renderings, section 3.3; 0: none


SOURCES = {  # of the numbers of `paper`; the others are ours
    "hyp-nerf/HyP-NeRF, nerf/network_fcblock.py (6ae0b3b)": (
        "log2_hashmap_size levels density_layers colour_layers shape_code colour_code code_deviation hyper_width "
        "hyper_layers hidden_width"
    ),
}


@dataclass(frozen=True)
class Evidence:
    """Observations of one scene: some rays, possibly occupied cells, and the background colour."""

    rays: Batch
    cells: OccupancyGrid
    background: Float[Tensor, "1 3"]


@dataclass(frozen=True)
class InstanceLesson:
    """Members by number with the evidence of each; and a patch of a photograph of the last, for the denoiser."""

    unit: ClassVar[str] = "rays"

    members: list[int]
    evidence: list[Evidence]
    rays: Rays
    picture: Float[Tensor, "height width 3"]

    def __len__(self) -> int:
        return sum(len(x.rays) for x in self.evidence)


class TensorChanges(torch.nn.Module):
    """Changes of an instance's tensors by fine-tuning: a row of each, or none."""

    def __init__(self, rows: Iterable[Float[Tensor, "_ _ _"]]):
        super().__init__()
        self.kept = torch.nn.ModuleList(map(Kept, rows))

    def __bool__(self) -> bool:
        return all(len(kept.rows) for kept in self.kept)  # type: ignore[arg-type]

    @property
    def changes(self) -> list[Float[Tensor, "_ _"]]:
        return [kept.rows[0] for kept in self.kept]  # type: ignore[index]


OCCUPANCY_THRESHOLD = 0.05  # optical thickness of a cell below which it is empty
CODE_LEARNING_RATE = 0.1  # rate of fitting a code, in deviations of the learnt codes
TUNE_LEARNING_RATE = 2e-3  # rate of tuning a field
PATCH_PIXELS = 64  # side of the pictures from which the denoiser learns, at most
GRID_UPDATES = 6  # of the occupancy grid of a field that is rendered
EMPTY_LENGTH = 1 / 16  # scene units over which density in empty space absorbs light
RAYS_PER_STEP = 1024  # rays of a step that fits a code or tunes a field
MAX_CANDIDATES = 64  # learnt codes at most that a fit may begin with
ELEVATIONS = 0.35, 0.8  # radians above the horizon, of views that are denoised

Seen = Callable[[int, torch.Generator], Evidence]  # so many random rays of what is known of a scene


class HypNeRF(RayMethod):
    """Learns from a Collection a code for each member and a hypernetwork of codes; `given` a Scene, it fits the code to
    its photographs and fine-tunes that field."""

    Config, learns_from, accepts = Config, Collection, (Scene,)
    learning_rate = exponential_decay
    up: Tensor
    efforts: ClassVar[Efforts] = {"draft": Effort(50, 2000), "good": Effort(300, 10_000), "best": Effort(1500, 50_000)}

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.shape = HashShape.of(c.table, c.hidden_width)
        with seeded(c.seed):
            sizes = [c.colour_code if colour else c.shape_code for colour in self.shape.of_colour]
            self.hyper = HyperNetwork(sizes, c.hyper_width, HYPER_LAYERS, self.shape.tensors)
            self.denoiser = PictureDenoiser(DENOISER_WIDTH)
        self.codes = InstanceCodes(c.members, c.shape_code + c.colour_code)
        self.found = Kept(torch.empty(0, c.shape_code + c.colour_code))  # the code of a scene that was given, or drawn
        self.tuned = untuned(self.shape)
        self.register_buffer("up", torch.tensor([0.0, 0.0, 1.0]))  # of the members, by the cameras of the first
        self.step_length = 2 * math.sqrt(3) / c.steps_per_diagonal
        self._cells: dict[int, OccupancyGrid] = {}  # of members, by number
        self._shown: tuple[HashInstance, OccupancyGrid] | None = None  # until a step changes it
        self._denoising = False

    @classmethod
    def cpu_preset(cls) -> Any:
        """Smaller codes, tables and networks of the same design."""
        table = HashNumbers(
            levels=5, features_per_level=4, log2_hashmap_size=12, base_resolution=8, max_resolution=64, sh_bands=2
        )
        return Config(table, shape_code=64, colour_code=32, code_deviation=0.1, hyper_width=96, hidden_width=32,
            steps_per_diagonal=112, transmittance_threshold=1e-3, occupancy_resolution=32, members=1024,
            members_per_step=4, rays_per_member=192, targets=2, empty_points=256, learning_rate=4e-3,
            final_learning_rate=4e-4, denoiser_start=0.8)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        table = HashNumbers(levels=3, log2_hashmap_size=9, base_resolution=4, max_resolution=16, sh_bands=1)
        return Config(table, shape_code=4, colour_code=4, code_deviation=0.1, hyper_width=16,
            hidden_width=16, members=16, steps_per_diagonal=64, occupancy_resolution=16, empty_points=64,
            members_per_step=2, rays_per_member=128, learning_rate=1e-2, final_learning_rate=5e-3,
            denoiser_start=0.0, denoise_views=2, denoise_steps=4, code_steps=8, tune_steps=4)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Activations that a step keeps for its gradients."""
        samples = config.members_per_step * config.rays_per_member * config.steps_per_diagonal // 8
        return config.table.activation_bytes(samples, config.hidden_width) * learning

    # Learning

    def begin(self, data: Collection, seconds: float = math.inf) -> None:
        self.codes.check_room(len(data), data.source)
        self.codes.begin(data.splits["train"], self.config.code_deviation, self.random(1))
        _, first = next(data.members())
        scene = photographed(first, "hyp-nerf")
        if (up := common_up(scene.cameras[scene.splits["train"]].to("cpu"))) is not None:
            self.up.copy_(torch.from_numpy(up))

    def steps_per_pass(self, data: Collection) -> float:
        return len(data.splits["train"]) / self.config.members_per_step

    def batch(self, data: Collection, generator: torch.Generator) -> InstanceLesson:  # type: ignore[override]
        """Random members, and rays through random photographs of each."""
        c, members, evidence = self.config, list[int](), list[Evidence]()
        for _ in range(c.members_per_step):
            number, member = data.sample_member(generator)
            scene = photographed(member, "hyp-nerf")
            there = scene.splits["train"]
            chosen = there[torch.randperm(len(there), generator=generator)[: c.targets]].tolist()
            photographs = [scene.photograph(i) for i in chosen]
            members.append(number)
            batch = rays_through(photographs, c.rays_per_member, True, generator).to(self.device)
            background = torch.tensor([scene.frame.background], device=self.device)
            if number not in self._cells:
                self._cells[number] = self._cells_of(scene)
            evidence.append(Evidence(batch, self._cells[number], background))
        rays, picture = patch(photographs[0], scene.frame, generator)  # the last one's
        return InstanceLesson(members, evidence, rays.to(self.device), picture.to(self.device))

    def _cells_of(self, scene: Scene) -> OccupancyGrid:
        """Mask of a scene's cells that no photograph proves empty. Raises LumigraphError for scenes without bounds."""
        if scene.frame.is_open:
            raise LumigraphError(
                f"hyp-nerf knows objects, and {scene.source} is a place without bounds; name photographs of an object"
            )
        cells, n = OccupancyGrid(1.0, self.config.occupancy_resolution), self.config.occupancy_resolution
        if scene.images.has_alpha:
            cells.rule_out(visual_hull(scene, n, n)[None])
        return cells.to(self.device)

    def loss(self, batch: InstanceLesson, step: int) -> dict[str, Tensor]:  # type: ignore[override]
        """The squared error of colours of all members (eq. 2), density in empty space, and the denoiser's error."""
        generator, share = self.random(step), 1 / len(batch.members)
        instances = self._made(self.codes(torch.tensor(batch.members, device=self.device)))
        terms: dict[str, Tensor] = {}
        mse = 0.0
        for instance, evidence in zip(instances, batch.evidence, strict=True):
            for name, term in self._errors(instance, evidence, generator).items():
                terms[name] = terms.get(name, 0.0) + share * term
            mse += share * self.figures["mse"]
        self.figures["mse"] = mse
        if self._denoising:
            terms["denoiser"] = self._denoiser_error(batch, instances[-1])
        return terms

    def _errors(self, instance: HashInstance, evidence: Evidence, generator: torch.Generator) -> dict[str, Tensor]:
        """Errors of colours, before random backgrounds where photographs have alpha, and of density in empty space."""
        batch, cells = evidence.rays, evidence.cells
        jitter = torch.rand(len(batch), generator=generator).to(self.device)
        background = backdrop(batch, evidence.background, generator)
        seen = self._seen(instance, cells, batch.rays, background, jitter)
        residual, mse = residuals(seen, batch, background)
        self.figures |= {"mse": mse}
        terms = {"colour": residual.square().mean()}
        if self.config.empty_points and self.config.empty_weight:
            points = 2 * torch.rand(self.config.empty_points, 3, generator=generator).to(self.device) - 1
            density = instance.density(points[~in_cells(cells, points)])
            terms["empty"] = self.config.empty_weight * torch.log1p(EMPTY_LENGTH * density).sum() / len(points)
        return terms

    def _denoiser_error(self, batch: InstanceLesson, instance: HashInstance) -> Tensor:
        """Squared error of a denoised rendering against the photograph."""
        last = batch.evidence[-1]
        with torch.no_grad():
            seen = self._seen(instance, last.cells, batch.rays, last.background).rgb
        return (self._denoised(seen.view(batch.picture.shape)) - batch.picture).square().mean()

    def _seen(
        self,
        instance: HashInstance,
        cells: OccupancyGrid,
        rays: Rays,
        background: Float[Tensor, "#ray 3"],
        jitter: Float[Tensor, " ray"] | None = None,
    ) -> Rendering:
        """Rendering of an instance from all samples in cells, without early termination: few are occluded."""
        samples = cells.sample(rays, self.frame.near, self.step_length, jitter=jitter)
        density, rgb = instance(*samples.along(rays))
        self.figures |= {"rays": len(rays), "samples": len(samples)}
        return composite(samples, density, rgb, background, self.config.transmittance_threshold)

    def _denoised(self, picture: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
        return self.denoiser(picture.permute(2, 0, 1)[None])[0].permute(1, 2, 0)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        common = {"lr": self.config.learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        networks = [*self.hyper.parameters(), *self.denoiser.parameters()]
        return [torch.optim.Adam(networks, fused=True, **common), LazyAdam([self.codes.rows], **common)]

    def before_step(self, step: int, progress: float) -> None:
        self._shown, self._denoising = None, progress >= self.config.denoiser_start

    # Instances

    def _made(self, codes: Float[Tensor, "member code"]) -> list[HashInstance]:
        """Fields of codes (section 3.2): table and density of the shape's code, colour of the colour's."""
        shape, colour = codes.split([self.config.shape_code, self.config.colour_code], -1)
        made = self.hyper([colour if is_colour else shape for is_colour in self.shape.of_colour])
        return [HashInstance(self.shape, tensors) for tensors in made]

    @property
    def shown(self) -> tuple[HashInstance, OccupancyGrid]:
        """The field of renderings, and its occupied cells."""
        if self._shown is None:
            with torch.no_grad():
                instance = self._told()
            self._shown = instance, self._filled(instance)
        return self._shown

    def _filled(self, instance: HashInstance) -> OccupancyGrid:
        """Occupied cells of a field."""
        c, generator = self.config, self.random(0)
        cells = OccupancyGrid(1.0, c.occupancy_resolution).to(self.device)

        def density(points: Points) -> Densities:
            return instance.density(points) * self._inside(points)

        for _ in range(GRID_UPDATES):
            cells.update(density, OCCUPANCY_THRESHOLD, generator, decay=1.0)
        return cells

    def _told(self) -> HashInstance:
        """Field of the code in the control `instance`; for a code fitted to evidence, with its fine-tuned tensors."""
        value = str(self.control("instance"))
        (instance,) = self._made(self.codes.code_of(value, self.found.rows)[None])
        first, second, share = blend(value)
        weight = (1 - share) * (first == FOUND) + share * (second == FOUND)
        if not weight or not self.tuned:
            return instance
        tensors = [x + weight * change for x, change in zip(instance.tensors, self.tuned.changes, strict=True)]
        return HashInstance(self.shape, tensors)

    @property
    def controls(self) -> tuple[Control, ...]:
        return (self.codes.control(bool(len(self.found.rows))),)

    # One scene

    @property
    def evidence_views(self) -> int | None:
        return 1

    def evidence_bytes(self, scene: Scene) -> int:
        """Bytes of the photographs' sampled pixels, as rays."""
        return 4 * 12 * int(scene.cameras.size[scene.splits["train"]].prod(-1).sum())

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Fit the field to an object's photographs: first its code, then its tensors (section 3.3)."""
        self._shown = None
        for scene in evidence[-1:]:
            self.frame = scene.frame
            self.settings.pop("instance", None)
            self._find(scene)

    def draw_object(self, seed: int) -> Method:
        """A random object: a code from the Gaussian fitted to the trained codes."""
        told: Any = self.given()
        told.found, told._shown = Kept(self.codes.draw_code(seed)[None]), None
        told.tuned = untuned(self.shape)
        told.settings.pop("instance", None)
        return told

    def _find(self, scene: Scene) -> None:
        """Fit the code and the tensors of a scene, and store them."""
        c, there = self.config, scene.splits["train"]
        photographs = [scene.photograph(i) for i in there.tolist()]
        cells, background = self._cells_of(scene), torch.tensor([scene.frame.background], device=self.device)

        def seen(count: int, generator: torch.Generator) -> Evidence:
            return Evidence(rays_through(photographs, count, True, generator).to(self.device), cells, background)

        code = self._code_of(seen)
        with torch.no_grad():
            (made,) = self._made(code[None])
        tuned = self._tuned_to([seen], made.tensors, c.tune_steps, 2)
        if c.denoise_views and c.denoise_steps:
            denoised = self._denoised_views(HashInstance(self.shape, tuned), photographs[0].camera, background)
            tuned = self._tuned_to([seen, denoised], tuned, c.denoise_steps, 3)
        self.found = Kept(code[None])
        pairs = zip(tuned, made.tensors, strict=True)
        self.tuned = TensorChanges((tensor - first)[None] for tensor, first in pairs)

    def _code_of(self, seen: Seen) -> Float[Tensor, " code"]:
        """The code with the smallest error on photographs, regularised towards the trained ones (section 3.3)."""
        axes, average, generator = self.codes.axes, self.codes.average, self.random(2)

        def error(where: Float[Tensor, " axis"]) -> Tensor:
            (instance,) = self._made((average + where @ axes)[None])
            terms = self._errors(instance, seen(RAYS_PER_STEP, generator), generator)
            return torch.stack([*terms.values()]).sum() + self.config.code_prior * where.square().mean()

        if not len(axes):
            return average
        start = self.codes.along(self._nearest(seen))
        return average + fitted(start, error, self.config.code_steps, CODE_LEARNING_RATE) @ axes

    @torch.no_grad()
    def _nearest(self, seen: Seen) -> Float[Tensor, " code"]:
        """The trained code with the smallest error on photographs, or the average."""
        known = self.codes.rows[self.codes.learnt]
        some = torch.randperm(len(known), generator=self.random(3))[:MAX_CANDIDATES]
        codes = torch.cat([self.codes.average[None], known[some.to(known.device)]])
        evidence, errors = seen(RAYS_PER_STEP // 2, self.random(4)), list[Tensor]()
        for instance in (self._made(code[None])[0] for code in codes):
            errors.append(self._errors(instance, evidence, self.random(5))["colour"])
        return codes[int(torch.stack(errors).argmin())]

    @torch.enable_grad()
    def _tuned_to(self, sources: Sequence[Seen], tensors: Sequence[Tensor], steps: int, number: int) -> list[Tensor]:
        """Tensors of a field after fine-tuning steps on photographs, then on denoised views."""
        tuned = [tensor.detach().clone().requires_grad_() for tensor in tensors]
        adam, generator = torch.optim.Adam(tuned, eps=1e-15), self.random(number)
        instance, rate = HashInstance(self.shape, tuned), TUNE_LEARNING_RATE
        for step in range(steps):
            adam.param_groups[0]["lr"] = rate * (1 - step / steps)
            adam.zero_grad()
            for weight, seen in zip((1.0, DENOISE_WEIGHT), sources, strict=False):
                terms = self._errors(instance, seen(RAYS_PER_STEP // len(sources), generator), generator)
                (weight * torch.stack([*terms.values()]).sum()).backward()
            adam.step()
        return [tensor.detach() for tensor in tuned]

    @torch.no_grad()
    def _denoised_views(self, instance: HashInstance, like: Camera, background: Float[Tensor, "1 3"]) -> Seen:
        """Denoised renderings of a field from all around, as further photographs (section 3.2)."""
        cells, views = self._filled(instance), list[Photograph]()
        for camera in around(like, self.frame, self.config.denoise_views, self.up.cpu()):
            rays = camera.rays(camera.pixels()).to(self.device)
            width, height = camera.size[0].tolist()
            picture = self._seen(instance, cells, rays, background).rgb.view(height, width, 3)
            views.append(Photograph(camera, self._denoised(picture).clamp(0, 1).cpu()))

        def seen(count: int, generator: torch.Generator) -> Evidence:
            return Evidence(rays_through(views, count, True, generator).to(self.device), cells, background)

        return seen

    # Along rays

    def looks(self, rays: Rays) -> list[Look]:
        instance, cells = self.shown
        samples = cells.sample(rays, self.frame.near, self.step_length)
        samples, _ = reached(rays, samples, instance, None, self.config.transmittance_threshold)
        return [Look("samples", samples, *instance(*samples.along(rays)))]

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, nothing beyond the bounds, and sRGB-encoded colour seen along unit directions."""
        density, rgb = self.shown[0](points, directions)
        return density * self._inside(points), rgb

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit, nothing beyond the bounds."""
        return self.shown[0].density(points) * self._inside(points)

    def _inside(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        low, high = torch.tensor(self.frame.bounds, device=self.device)
        return ((points > low) & (points < high)).all(-1)


def untuned(shape: HashShape) -> TensorChanges:
    return TensorChanges(torch.empty(0, *sizes) for sizes in shape.tensors)


def in_cells(cells: OccupancyGrid, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
    """Mask of the points of [-1, 1]^3 in possibly occupied cells."""
    x, y, z = ((points + 1) * (cells.resolution / 2)).long().clamp(0, cells.resolution - 1).unbind(-1)
    return cells.occupied[0, x, y, z]


def patch(
    photograph: Photograph, frame: Frame, generator: torch.Generator
) -> tuple[Rays, Float[Tensor, "height width 3"]]:
    """A random part of a photograph, as rays and as a picture."""
    height, width = photograph.rgb.shape[:2]
    rows, columns = min(height, PATCH_PIXELS), min(width, PATCH_PIXELS)
    top, left = chance(height - rows + 1, generator), chance(width - columns + 1, generator)
    part = slice(top, top + rows), slice(left, left + columns)
    pixels = photograph.camera.pixels().view(height, width, 2)[part].reshape(-1, 2)
    return photograph.camera.rays(pixels), photograph.before(frame.background)[part].contiguous()


def around(camera: Camera, frame: Frame, count: int, up: Float[Tensor, " 3"]) -> Iterator[Camera]:
    """Cameras with the same lens and distance from the centre, around it at alternating heights. up: unit length"""
    middle = torch.tensor(frame.bounds).mean(0)
    distance = (camera.position - middle).norm()
    turn = turning(torch.tensor([0.0, 0.0, 1.0]), up).float()
    for number in range(count):
        azimuth, height = torch.tensor(2 * math.pi * number / count), torch.tensor(ELEVATIONS[number % len(ELEVATIONS)])
        outward = torch.stack([height.cos() * azimuth.cos(), height.cos() * azimuth.sin(), height.sin()])
        outward = (turn @ outward)[None]
        pose = look_at(middle + distance * outward, -outward, up)
        yield replace(camera, pose=pose)
