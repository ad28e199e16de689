"""Neural Scene Graphs: a static background, and moving instances of classes in boxes (Ost et al. 2021)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from ...camera.rays import Look, Rays
from ...components.backbone import CPU_BACKBONE, TINY_BACKBONE, BackboneNumbers
from ...components.fields.coordinate_field import CoordinateField
from ...components.fields.hash_field import CODES_RATE, HashField
from ...components.fields.spaces import space_of
from ...components.sampling.hierarchical_sampler import HierarchicalSampler, RayNumbers
from ...components.sampling.samplers import sampling_bytes
from ...components.sampling.sampling import stratified
from ...components.training.photometric import backdrop, huber
from ...components.training.pose_refinement import PoseNumbers, poses_for
from ...components.training.schedules import held_decay
from ...composition.composed import union
from ...datasets.scene import Batch, Frame, Scene
from ...datasets.tracks import BoxTrack, GraphNode, TrackEdit, TrackEdits, nodes_of
from ...errors import LumigraphError
from ...files.ranges import NonNegative, PositiveShare, between, changed
from ...method import BaseConfig, FieldMethod, Pass, frozen, seeded
from ...method.controls import Control, Value, blend, moment
from ...method.field import Colours, Densities, Directions, Points
from ...volume import composite
from .fields import CUBE, ClassField, HashClassField, NetworkClassField
from .nodes import BoxStretches, NodeNumbers, PoseTable, TrackCorrections, crossings, inside

REMOVED = "removed"  # choice of an instance's control
CODE_STEPS, CODE_RAYS, CODE_RATE = 200, 512, 2e-2  # of finding the codes of unseen instances


@dataclass(frozen=True)
class Config(BaseConfig):
    """The release's numbers (example_configs/config_kitti_0006_example_train.txt); `preset` has a plain CPU's."""

    backbone: BackboneNumbers = BackboneNumbers()
    rays: RayNumbers = RayNumbers(rays_per_step=8192)
    poses: PoseNumbers = PoseNumbers()
    nodes: NodeNumbers = NodeNumbers()
    class_log2_hashmap_size: Annotated[int, between(1, 28)] = 17  # log2 of entries of a level of a class's hash table
    class_max_resolution: Annotated[int, between(1, 1 << 20)] = 256  # cells along a box of its finest level
    code_width: Annotated[int, between(1, 1024)] = 256  # numbers of an instance's latent code; more tell more apart
    code_weight: NonNegative = 1e-4  # weight of codes' lengths, squared with tables; higher: instances are more alike
    box_samples: Annotated[int, between(2, 512)] = 7  # samples of a ray in a box, section 4.2; more are sharper, slower
    box_scale: Annotated[float, between(1, 4)] = 1.9  # factor on the boxes' sizes, which then hold shadows
    pose_input: Literal["location", "heading"] = "location"  # of a box, that colour depends on besides the direction
    symmetric: bool = False  # left and right sides of boxes are alike, so that either one shows the other
    huber_delta: PositiveShare = 1.0  # residual at which the loss turns from squared to linear; 1: always squared


RELEASE = "princeton-computational-imaging/neural-scene-graphs"
SOURCES = {  # of the numbers of `paper`; the others are ours
    f"{RELEASE}, example_configs/config_kitti_0006_example_train.txt (8d3d9ce)": (
        "rays_per_step code_width code_weight box_samples box_scale learning_rate"
    ),
    f"{RELEASE}, main.py (8d3d9ce)": (
        "field depth skip_layer position_frequencies direction_frequencies hidden_width pose_input symmetric "
        "huber_delta"
    ),
}


class NeuralSceneGraph(FieldMethod):
    """A background field, one field per class with a latent code per instance, and nodes: boxes with poses over time.

    shown_nodes: rendered nodes: those of the tracks, after edits
    edits:       the edits
    found:       tracks and codes of instances fitted to another scene's photographs
    """

    Config, learning_rate, accepts = Config, held_decay, (Scene, TrackEdits)
    further_bytes = staticmethod(sampling_bytes)
    network: HashField | CoordinateField
    rays_per_chunk: ClassVar[int] = 4096  # type: ignore[misc]

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        if not frame.tracks:
            raise LumigraphError(
                "The scene has no tracks, and a scene graph needs the boxes of what moves; put tracks.json beside the "
                "photographs, name a KITTI sequence, or train nsff, which needs none"
            )
        self.categories = tuple(dict.fromkeys(track.category for track in frame.tracks))
        self.poses = poses_for(frame, c.poses)
        space = space_of(frame)
        b, joining = c.backbone, self.poses.weights if self.poses else None
        with seeded(c.seed):
            self.network = b.build(frame, space, joining=joining)
            self.sampler = b.sampler(frame, space) if b.hashed else HierarchicalSampler(space, c.rays)
            small = changed(b, log2_hashmap_size=c.class_log2_hashmap_size, max_resolution=c.class_max_resolution)
            kinds = HashClassField, NetworkClassField
            made = (small.build(Frame(), CUBE, *kinds, latent=c.code_width) for _ in self.categories)
            self.classes = nn.ModuleList(made)
            self.codes = nn.Parameter(0.1 * torch.randn(len(frame.tracks), c.code_width))
        self.nodes = TrackCorrections(frame.tracks, c.nodes)
        self.found: tuple[tuple[BoxTrack, ...], Tensor] = (), torch.zeros(0, c.code_width)
        self.edits = TrackEdits(())
        self.arrange()

    @classmethod
    def cpu_preset(cls) -> Any:
        """Hash tables with Instant-NGP's numbers for the background, and smaller ones for the classes."""
        return changed(Config(), **CPU_BACKBONE, class_log2_hashmap_size=15, class_max_resolution=96, code_width=16,
            code_weight=1e-3, box_samples=16, box_scale=1.1, pose_input="heading", symmetric=True,
            huber_delta=0.3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Tiny tables and networks with corrections of poses, within some twenty quick steps."""
        return changed(Config(), **TINY_BACKBONE | {"final_learning_rate": 2e-3}, class_log2_hashmap_size=10,
            class_max_resolution=16, code_width=4, box_samples=8, box_scale=1.1, pose_input="heading",
            refine_tracks=True)  # fmt: skip

    # The graph

    @property
    def tracks(self) -> tuple[BoxTrack, ...]:
        """Tracks of all instances that have a code."""
        return (*self.frame.tracks, *self.found[0])

    def arrange(self) -> None:
        """Set nodes and their poses by the edits and the settings."""
        chosen = []
        for track, control in self.instances.items():
            name, other, share = blend(str(self.settings.get(control, track)))
            nearest = other if share > 0.5 else name
            if nearest == REMOVED:
                chosen.append(TrackEdit(track, remove=True))
            elif nearest != track:
                chosen.append(TrackEdit(track, like=nearest))
        there = {node.name for node in nodes_of(self.tracks, self.edits)}
        own = tuple(edit for edit in chosen if edit.node in there)
        self.shown_nodes: tuple[GraphNode, ...] = nodes_of(self.tracks, TrackEdits((*self.edits.edits, *own)))
        self._table = PoseTable(self.shown_nodes, self.frame.tracks)

    @property
    def table(self) -> PoseTable:
        """Given poses of the rendered nodes, on the method's device."""
        if self._table.times.device != self.device:
            self._table = PoseTable(self.shown_nodes, self.frame.tracks, self.device)
        return self._table

    @property
    def instances(self) -> dict[str, str]:
        """Control names of all instances, by instance name."""
        names: dict[str, str] = {}
        for track in self.tracks:
            name = re.sub(r"\W", "_", track.name)
            name = name if name.isidentifier() and name != "time" else f"thing_{name}"
            names[track.name] = f"{name}_{len(names) + 1}" if name in names.values() else name
        return names

    def shown_codes(self) -> Float[Tensor, "node code"]:
        """The latent code of each node, interpolated by its control."""
        known = {track.name: i for i, track in enumerate(self.tracks)}
        codes = torch.cat([self.codes, self.found[1].to(self.codes)])
        rows = []
        for node in self.shown_nodes:
            value = str(self.settings.get(self.instances.get(node.name, ""), node.like))
            first, second, share = blend(value)
            between_two = share and first in known and second in known
            a, b = (first, second) if between_two else (node.like, node.like)
            rows.append(torch.lerp(codes[known[a]], codes[known[b]], share if between_two else 0.0))
        return torch.stack(rows) if rows else codes[:0]

    @property
    def class_fields(self) -> list[ClassField]:
        return list(self.classes)  # type: ignore[arg-type]

    def class_of(self, node: GraphNode) -> int:
        """Class number of a node's appearance."""
        return self.categories.index(next(track.category for track in self.tracks if track.name == node.like))

    def moments(self, rays: Rays) -> Float[Tensor, " ray"]:
        return super().moments(rays) if self.frame.times else torch.zeros_like(rays.radius)

    # Along rays

    def crossings(self, rays: Rays) -> BoxStretches:
        """Stretches of rays inside the boxes of their moments."""
        moments, twist = self.moments(rays), self.nodes.twist
        return crossings(rays, moments, self.table, twist, self.config.box_scale, self.frame.near)

    def instance_looks(self, rays: Rays, generator: torch.Generator | None = None) -> list[Look]:
        """Density and colour in boxes: one look for the first box of each ray, one for the second, and so on."""
        found = self.crossings(rays)
        if not len(found):
            return []
        count = self.config.box_samples
        t = found.at(stratified(len(found), count, generator, rays.origins.device))
        points = found.origins[:, None] + t[..., None] * found.directions[:, None]
        stretch = torch.arange(len(found), device=t.device).repeat_interleave(t.shape[1])
        density, rgb = self.evaluate(points.flatten(0, 1), found, stretch)
        density, rgb = density.view(t.shape), rgb.view(*t.shape, 3)
        looks = []
        for place in range(int(found.rank.max()) + 1):
            here = found.rank == place
            samples = found[here].samples(len(rays), count)
            looks.append(Look(f"boxes {place}", samples, density[here].flatten(), rgb[here].flatten(0, 1)))
        return looks

    def evaluate(self, points: Points, found: BoxStretches, stretch: Tensor) -> tuple[Densities, Colours]:
        """Density per scene unit and colour at points in boxes' axes, each of one of the stretches (eq. 5)."""
        half = 0.5 * self.config.box_scale * self.table.size
        node = found.node[stretch]
        coordinates, directions = points / half[node], found.directions[stretch]
        side = torch.ones_like(points[:, :1])
        if self.config.symmetric:
            side = torch.where(points[:, 1:2] < 0, -side, side)
            mirrored = torch.cat([torch.ones_like(side), side, torch.ones_like(side)], -1)
            coordinates, directions = coordinates * mirrored, directions * mirrored
        pose = found.heading if self.config.pose_input == "heading" else found.location
        code = torch.cat([torch.cat([self.shown_codes()[found.node], pose], -1)[stretch], side], -1)
        kinds = torch.tensor([self.class_of(node) for node in self.shown_nodes], device=points.device)[node]
        density, rgb = points.new_zeros(len(points)), points.new_zeros(len(points), 3)
        for number, field in enumerate(self.class_fields):
            mine = (kinds == number).nonzero()[:, 0]
            if len(mine):
                here, features = field.geometry(coordinates[mine], code[mine])
                colour = field.colour(features, directions[mine], code[mine])
                density, rgb = density.index_copy(0, mine, here), rgb.index_copy(0, mine, colour)
        return density / half.log().mean(-1).exp()[node], rgb

    def _look(self, seen: Pass, rays: Rays) -> Look:
        return union([super()._look(seen, rays), *self.instance_looks(rays)])

    # At points

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Background and instances at the moment of the control `time`; densities add, colours mix by density."""
        density, rgb = super().field(points, directions)
        if not len(points):
            return density, rgb
        poses = self.table.at(self.moments(Rays(points, directions, points[:, 0]))[:1], self.nodes.twist)
        point, node, local = inside(points, poses, self.table.size, self.config.box_scale)
        if not len(point):
            return density, rgb
        rotation, position = poses.rotation[node, 0], poses.position[node, 0]
        seen = torch.einsum("pij,pi->pj", rotation, directions[point])
        zero = local.new_zeros(len(point))
        found = BoxStretches(point, node, zero, zero, local, seen, rotation[:, :, 0], position)
        half = 0.5 * self.config.box_scale * self.table.size[node]
        more, colour = self.evaluate(local * half, found, torch.arange(len(point), device=point.device))
        total = density.index_add(0, point, more)
        mixed = (density[:, None] * rgb).index_add(0, point, more[:, None] * colour)
        return total, mixed / total.clamp_min(1e-9)[:, None]

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit at the moment of the control `time`."""
        return self.field(points, normalize(torch.ones_like(points), dim=-1))[0]

    # Learning

    def density_in_training(self, generator: torch.Generator) -> Any:
        return self.network.density

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Errors of composited colours, and the prior of codes (eq. 10)."""
        c, generator = self.config, self.random(step)
        rays = self.refine_rays(batch.rays)
        passes, terms = self.learn_along(rays, generator)
        instances = self.instance_looks(rays, generator)
        background = backdrop(batch, self.background, generator, opaque=self.sampler.is_open)
        target = batch.before(background)
        for each in passes:
            look = union([each.look(self.network), *instances])
            error = composite(look.samples, look.density, look.rgb, background).rgb - target
            self.figures["mse"] = float(error.detach().square().mean())
            terms[each.name] = huber(error, c.huber_delta)
        self.figures["box_samples"] = sum(len(look.samples) for look in instances)
        return terms | {"codes": prior_of(self.codes, c)} | self.nodes.terms()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        b = self.config.backbone
        codes = {"params": [self.codes], "scale": b.scale(CODES_RATE)}
        own = self.network.optimizers_at(b.learning_rate, groups=[codes])
        classes = [optimizer for field in self.class_fields for optimizer in field.optimizers_at(b.learning_rate)]
        return [*own, *classes, *super().optimizers()]

    # Editing

    @property
    def controls(self) -> tuple[Control, ...]:
        """The time, and a control of each instance's appearance."""
        own = []
        for track in self.tracks:
            alike = [other.name for other in self.tracks if other.category == track.category and other != track]
            about = f"Looks of {track.name}: its own, those of another {track.category}, or removed."
            choices = (track.name, *alike, REMOVED)
            own.append(Control(self.instances[track.name], track.name, choices=choices, about=about, blends=True))
        times = (moment(self.frame.times),) if self.frame.times else ()
        return *super().controls, *times, *own

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Apply edits, or add a scene's new instances: only their codes are fitted to its photographs."""
        for piece in evidence:
            if isinstance(piece, TrackEdits):
                self.edits = TrackEdits((*self.edits.edits, *piece.edits))
            else:
                self.found = found_in(self, piece)
        self.arrange()


def prior_of(codes: Float[Tensor, "track code"], config: Config) -> Float[Tensor, ""]:
    """Prior of codes (eq. 10): the sum of their lengths, as the release has it; with hash tables, their mean square."""
    size = codes.norm(dim=-1).sum() if config.backbone.field == "network" else codes.square().mean()
    return config.code_weight * size


def found_in(method: NeuralSceneGraph, scene: Scene) -> tuple[tuple[BoxTrack, ...], Float[Tensor, "track code"]]:
    """Tracks of a scene that are new to a graph, in the graph's frame, and their codes fitted to its photographs.

    Codes start at the mean of their class; only these are optimised. Raises LumigraphError for a scene without new
    tracks of a known class.
    """
    place = method.frame.to_source.inverse @ scene.frame.to_source
    known = {track.name for track in method.tracks}
    new = tuple(
        track.transformed(place)
        for track in scene.frame.tracks
        if track.name not in known and track.category in method.categories
    )
    if not new:
        raise LumigraphError(
            f"{scene.source} has no track of {' or '.join(method.categories)} besides {', '.join(sorted(known))}; "
            "name a scene with another one"
        )
    kinds = [track.category for track in method.frame.tracks]
    means = [method.codes.detach()[[i for i, kind in enumerate(kinds) if kind == x.category]].mean(0) for x in new]
    codes = torch.stack(means).requires_grad_()
    student: Any = method.given()
    student.settings = {}
    student.edits = TrackEdits(())
    student.found = (*method.found[0], *new), torch.cat([method.found[1].to(codes.device), codes])
    student.arrange()
    fresh = torch.tensor([node.name in {track.name for track in new} for node in student.shown_nodes])
    optimizer = torch.optim.Adam([codes], CODE_RATE)
    chance = method.random(7)
    with frozen(method), torch.enable_grad():
        for _ in range(CODE_STEPS):
            batch = scene.sample_rays(8 * CODE_RAYS, chance).to(method.device)
            batch = in_frame(batch, place)
            meets = student.crossings(batch.rays)
            rows = meets.ray[fresh.to(meets.node.device)[meets.node]].unique()[:CODE_RAYS]
            if not len(rows):
                continue
            student.found = (*method.found[0], *new), torch.cat([method.found[1].to(codes.device), codes])
            rays = batch.rays[rows]
            with torch.no_grad():
                last = student.sampler.sample(rays, student.network, None)[-1]
                behind = FieldMethod._look(student, last, rays)
            look = union([behind, *student.instance_looks(rays, chance)])
            seen = composite(look.samples, look.density, look.rgb, student.background)
            target = batch.rgb[rows] if batch.alpha is None else batch.before(student.background)[rows]
            loss = (seen.rgb - target).square().mean() + prior_of(codes, method.config)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return (*method.found[0], *new), torch.cat([method.found[1].to(codes.device), codes]).detach()


def in_frame(batch: Batch, place: Any) -> Batch:
    """A batch whose rays are in another frame."""
    rays = replace(
        batch.rays,
        origins=place.points(batch.rays.origins),
        directions=place.directions(batch.rays.directions),
        image_index=None,
    )
    return replace(batch, rays=rays)
