"""ObjectNeRF: a scene branch, and an object branch with a code for each instance (Yang et al. 2021, arXiv 2109.01847).

Masks of the photographs teach the object branch, an instance at a time. Where a nearer surface hides an instance, its
mask is 0 and says nothing of what is behind: guided by the scene branch's depth, such samples teach nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool3d, softplus

from ...camera.rays import Look, Rays, Rendering
from ...components.backbone import CPU_BACKBONE, TINY_BACKBONE, BackboneNumbers
from ...components.fields.appearance import CodeWidth
from ...components.fields.coordinate_field import CoordinateField, LatentField
from ...components.fields.hash_field import CODES_RATE, HashField
from ...components.fields.instance_codes import InstanceCodes
from ...components.fields.spaces import space_of
from ...components.instances import (
    ALONE,
    BESIDE,
    LABELS,
    NOT_AN_INSTANCE,
    Edit,
    check_labels,
    edit_controls,
    edit_of,
    labels_of,
    with_beside,
)
from ...components.sampling.hierarchical_sampler import HierarchicalSampler, RayNumbers
from ...components.sampling.samplers import sampling_bytes
from ...components.training.photometric import huber
from ...components.training.schedules import held_decay
from ...composition.composed import kept, union
from ...datasets.scene import Batch, Frame, Scene
from ...files.ranges import NonNegative, PositiveShare, between, changed
from ...geometry import Similarity
from ...method import BaseConfig, FieldMethod, seeded
from ...method.controls import Control
from ...method.field import Colours, Densities, Directions, Points
from ...volume import composite
from .fields import InstanceBoxes, ObjectTable, SceneWithout


@dataclass(frozen=True)
class Config(BaseConfig):
    """The numbers of the authors' release (zju3dv/object_nerf, config/); those of the paper have their section."""

    backbone: BackboneNumbers = BackboneNumbers(learning_rate=1e-3, final_learning_rate=1e-5)
    rays: RayNumbers = RayNumbers(64, 64, rays_per_step=2048)
    instances: Annotated[int, between(1, 256)] = 64  # instances that there is room for, labels 0 to one below
    code: CodeWidth = 64  # numbers of an instance's code
    guided: bool = True  # samples behind the scene's surface teach an object nothing, section 3.4; off: they do
    huber_delta: PositiveShare = 1.0  # residual at which the loss turns from squared to linear; 1: always squared
    hash_weight_decay: NonNegative = 0.0  # decoupled weight decay of both tables, towards a density of 1


SOURCES = {  # of the numbers of `paper`; the others are ours
    "zju3dv/object_nerf, config/default_conf.yml (6b7e2f6)": (
        "depth skip_layer position_frequencies direction_frequencies hidden_width object_layers object_width "
        "instances code coarse_samples fine_samples rays_per_step object_colour_weight outside_weight guard_margin "
        "learning_rate"
    ),
    "zju3dv/object_nerf, config/toy_desk_2.yml (6b7e2f6)": "object_opacity_weight",
    "Yang 2021, sections 3.2 to 3.4": "field guided",
}


OBJECT_LAYERS, OBJECT_WIDTH = 4, 128  # hidden layers of the object branch's network, and their channels
OBJECT_NETWORK = {"depth": OBJECT_LAYERS, "skip_layer": OBJECT_LAYERS // 2, "hidden_width": OBJECT_WIDTH}
OBJECT_COLOUR_WEIGHT = 1.0  # weight of an instance's colours, eq. 6
OBJECT_OPACITY_WEIGHT = 10.0  # weight of an instance's opacity against its mask, eq. 6
OUTSIDE_WEIGHT = 0.05  # weight of pixels far outside a mask in that, section 3.3; of those beside it: 1
GUARD_MARGIN = 0.05  # scene units behind a surface, from which on samples teach an object nothing
CODE_DEVIATION = 1.0  # of codes at first
OWN_SHARE = 0.5  # of rays that teach the instance they show; the others teach another what it does not cover
BESIDE_SHARE = 0.25  # of rays that teach an instance close by, where there is one; the others teach one at random
COUNT_AFTER = 0.3  # share of the budget from which on surfaces count for boxes
REGION_CELLS = 96  # of the grid that says what goes with an instance, along the longest side of its box
REGION_THICKNESS = 0.05  # optical thickness of the object branch over a cell, from which on it belongs to it
REGION_DILATION = 2  # cells around, whose soft edge goes along


class ObjectNeRF(FieldMethod):
    """A scene branch and an object branch, decomposed by the instances of its photographs' masks."""

    Config, further_bytes, learning_rate = Config, staticmethod(sampling_bytes), held_decay
    network: HashField | CoordinateField
    branch: ObjectTable | LatentField

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        b, space = c.backbone, space_of(frame)
        with seeded(c.seed):
            self.network = b.build(frame, space, network=partial(CoordinateField.twice, keep_input=True))
            narrow = b if b.hashed else changed(b, **OBJECT_NETWORK)
            kinds = ObjectTable, partial(LatentField, keep_input=True, activation=softplus)  # section 3.2
            self.branch = narrow.build(frame, space, *kinds, latent=c.code)
        self.sampler = b.sampler(frame, space) if b.hashed else HierarchicalSampler(space, c.rays)
        self.codes = InstanceCodes(c.instances, c.code)
        self.boxes = InstanceBoxes(c.instances, frame.bounds, space)
        self._regions: dict[tuple[int, int], Tensor] = {}
        self._labelled: tuple[Scene, Scene] | None = None  # the data, and the same with the layer BESIDE

    @classmethod
    def cpu_preset(cls) -> Any:
        """Two hash tables with Instant-NGP's numbers."""
        return changed(Config(), **CPU_BACKBONE, code=8, huber_delta=0.3, hash_weight_decay=0.3)

    @classmethod
    def smallest(cls) -> Any:
        """Two tiny tables with tiny networks, within some twenty quick steps."""
        return changed(Config(), **TINY_BACKBONE, instances=4, code=4, huber_delta=0.1)

    # Learning

    def check_data(self, data: Scene) -> None:
        check_labels(data)

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        self.codes.begin(torch.arange(self.config.instances), CODE_DEVIATION, self.random(1))

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        if self._labelled is None or self._labelled[0] is not data:
            self._labelled = data, with_beside(data)
        seen = self._labelled[1]
        layers = tuple(x for x in (LABELS, BESIDE) if x in seen.layers)
        return seen.sample_rays(self.sampler.batch_size, generator, layers=layers).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Colours of the scene (eq. 2); of one instance along each ray colour, and opacity against its mask (eq. 6)."""
        c, generator = self.config, self.random(step)
        passes, terms = self.learn(batch.rays, generator)
        target = batch.before(self.background)
        for each in passes:
            look = each.look(self.network)
            seen = composite(look.samples, look.density, look.rgb, self.background)
            terms[each.name] = huber(seen.rgb - target, c.huber_delta)
        self.figures["mse"] = float((seen.rgb - target).detach().square().mean())
        labels, known = labels_of(batch.extra, batch.alpha, c.instances)
        if self.progress >= COUNT_AFTER:
            solid = (labels >= 0) & seen.depth.isfinite() & (seen.opacity > 0.5)
            self.boxes.add(batch.rays.at(seen.depth.detach())[solid], labels[solid])
        asked, near = self.asked(labels, batch.extra.get(BESIDE, torch.full_like(labels, NOT_AN_INSTANCE)), generator)
        return terms | self.object_terms(batch.rays, target, labels, known, asked, near, seen, generator)

    def object_terms(
        self,
        rays: Rays,
        target: Float[Tensor, "ray 3"],
        labels: Int[Tensor, " ray"],
        known: Bool[Tensor, " ray"],
        asked: Int[Tensor, " ray"],
        near: Bool[Tensor, " ray"],
        seen: Rendering,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """L_obj = sum_k lambda_1 M |C_k - C|^2 + lambda_2 w (O_k - M)^2, of the instance that each ray asks about.

        asked, near: see `asked`
        """
        c = self.config
        mask = (labels == asked).float()
        look = self.instance_look(rays, asked, generator)
        if c.guided:  # the visible instance itself may lie behind the depth that the scene branch has so far
            guard = torch.where(mask > 0, torch.inf, seen.depth.detach() + GUARD_MARGIN)
            look = kept(look, look.samples.t < guard[look.samples.ray_index])
        own = composite(look.samples, look.density, look.rgb)
        weight = known * torch.where(near, 1.0, OUTSIDE_WEIGHT)
        colour = (known * mask)[:, None] * (own.rgb - target).square()
        opacity = weight * (own.opacity - mask).square()
        return {
            "object colour": OBJECT_COLOUR_WEIGHT * colour.mean(),
            "object opacity": OBJECT_OPACITY_WEIGHT * opacity.mean(),
        }

    def asked(
        self, labels: Int[Tensor, " ray"], beside: Int[Tensor, " ray"], generator: torch.Generator
    ) -> tuple[Int[Tensor, " ray"], Bool[Tensor, " ray"]]:
        """The trained instance of each ray: its own, one beside it, or one of those in the batch; and the rays in or
        beside the mask of theirs."""
        there = labels[labels >= 0].unique()
        if not len(there):
            return torch.zeros_like(labels), torch.zeros_like(labels, dtype=torch.bool)
        other = there[torch.randint(len(there), (len(labels),), generator=generator).to(labels.device)]
        share = torch.rand(len(labels), generator=generator).to(labels.device)
        close = (share >= OWN_SHARE) & (share < OWN_SHARE + BESIDE_SHARE) & (beside >= 0)
        asked = torch.where((share < OWN_SHARE) & (labels >= 0), labels, torch.where(close, beside, other))
        return asked, close | (asked == labels)

    def instance_look(self, rays: Rays, numbers: Int[Tensor, " ray"], generator: torch.Generator | None = None) -> Look:
        """Samples of the object branch, with the code of an instance for each ray."""
        codes = self.codes(numbers)
        return self.sampler.sample(rays, self.branch, codes, generator)[-1].look(self.branch, codes)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, codes = self.config, {"params": [*self.codes.parameters()], "scale": CODES_RATE}
        fields = self.network, self.branch
        own = c.backbone.optimizers(*fields, groups=[codes], eps=1e-7, weight_decay=c.hash_weight_decay)
        return [*own, *super().optimizers()]

    # Editing

    @property
    def controls(self) -> tuple[Control, ...]:
        return (*super().controls, *edit_controls(self.boxes.learnt, self.frame.reach))

    def looks(self, rays: Rays) -> list[Look]:
        edit = edit_of(self)
        return super().looks(rays) if edit is None else [self.edited(rays, edit)]

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        edit = edit_of(self)
        if edit is None:
            return super().render_rays(rays, background)
        look = self.edited(rays, edit)
        return composite(look.samples, look.density, look.rgb, background)

    def edited(self, rays: Rays, edit: Edit) -> Look:
        """The scene without the instance, the instance at its new place, or both in one."""
        if edit.kind == ALONE:
            return self.instance_at(rays, edit.number, Similarity.make(1.0))
        looks = [self.without(rays, edit.number) if edit.leaves else super().looks(rays)[-1]]
        if edit.appears:
            place = edit.place(self.boxes.points(self.boxes.box(edit.number).mean(0)[None])[0][0])
            looks.append(self.instance_at(rays, edit.number, place))
        return union(looks)

    def without(self, rays: Rays, number: int) -> Look:
        """The scene branch, without what goes with an instance."""
        if self.config.backbone.hashed:  # its samplers end rays at the first surface, which may be the instance
            scene = SceneWithout(self.network, lambda points: self.belongs(points, number))
            return self.sampler.sample(rays, scene)[-1].look(scene)
        look = super().looks(rays)[-1]
        points, _ = look.samples.along(rays)
        return kept(look, ~self.belongs(points, number))

    def instance_at(self, rays: Rays, number: int, place: Similarity) -> Look:
        """The object branch of one instance, inside its box, under a transform."""
        back = place.inverse
        local = replace(rays, origins=back.points(rays.origins), directions=back.directions(rays.directions))
        numbers = torch.full((len(rays),), number, device=rays.origins.device)
        look = self.instance_look(local, numbers)
        points, _ = look.samples.along(local)
        low, high = self.boxes.box(number)
        there = self.boxes.coordinates(points)
        return kept(look, ((there >= low) & (there <= high)).all(-1))

    @torch.no_grad()
    def belongs(self, points: Float[Tensor, "point 3"], number: int) -> Bool[Tensor, " point"]:
        """Mask of points in an instance's region: cells of its box that its branch occupies, and neighbouring ones."""
        low, high = self.boxes.box(number)
        sides = ((high - low) / (high - low).max() * REGION_CELLS).ceil().long().clamp_min(1)
        region = self._region(number, low, high, sides)
        cell = ((self.boxes.coordinates(points) - low) / (high - low) * sides).floor().long()
        inside = ((cell >= 0) & (cell < sides)).all(-1)
        x, y, z = torch.where(inside[:, None], cell, 0).unbind(-1)
        return inside & region[x, y, z]

    def _region(self, number: int, low: Tensor, high: Tensor, sides: Tensor) -> Bool[Tensor, "x y z"]:
        """Cells of an instance, remembered until it changes."""
        *_, last = self.branch.parameters()
        state = last._version  # which each step changes
        if (found := self._regions.get((number, state))) is not None:
            return found
        axes = [(torch.arange(int(n), device=self.device) + 0.5) / n for n in sides]
        points, units = self.boxes.points(low + (high - low) * torch.cartesian_prod(*axes))
        code = self.codes.rows[number][None]
        parts = [self.branch.density(x, code.expand(len(x), -1)) for x in points.split(1 << 16)]
        edge = units * ((high - low) / sides).max()
        filled = (torch.cat(parts) * edge > REGION_THICKNESS).view(*sides.tolist()).float()
        size = 2 * REGION_DILATION + 1
        found = max_pool3d(filled[None, None], size, 1, REGION_DILATION)[0, 0] > 0
        self._regions = {(number, state): found}
        return found

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density and colour of the scene, without an instance that was removed."""
        density, rgb = super().field(points, directions)
        edit = edit_of(self)
        return (density, rgb) if edit is None else (self._left(density, points, edit), rgb)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        density, edit = super().density(points), edit_of(self)
        return density if edit is None else self._left(density, points, edit)

    def _left(self, density: Densities, points: Points, edit: Edit) -> Densities:
        """Density after an edit, without a transformed instance."""
        belongs = self.belongs(points, edit.number)
        if edit.kind == ALONE:
            return torch.where(belongs, density, 0.0)
        return torch.where(belongs, 0.0, density) if edit.leaves else density
