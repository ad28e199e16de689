"""Block-NeRF: one block of a city, in the light of each photograph (Tancik et al. 2022, arXiv 2202.05263).

The field of one block learns from any scene. `large.compositing` makes one picture of many.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...components.backbone import CPU_BACKBONE, TINY_BACKBONE, BackboneNumbers
from ...components.fields.appearance import Appearance, AppearanceCodes, CodeWidth, Patches, sky_for
from ...components.fields.coordinate_field import FrustumField, NetworkNumbers
from ...components.fields.hash_field import CODES_RATE, OPEN_RATE, HashField
from ...components.fields.spaces import space_of
from ...components.sampling.cone_sampler import ConeSampler
from ...components.sampling.hierarchical_sampler import RAYS_WITH_FEATURES, RayNumbers
from ...components.sampling.samplers import sampling_bytes
from ...components.training.photometric import backdrop, huber
from ...components.training.pose_refinement import PoseNumbers, poses_for
from ...components.training.schedules import RISE, held_decay
from ...datasets.scene import Batch, Frame, Photograph, Scene
from ...files.ranges import Layers, NonNegative, Octaves, PositiveShare, Steps, Width, changed
from ...method import BaseConfig, FieldMethod, seeded
from ...method.field import Directions, Points
from ...volume import composite
from .parts import Exposures, Moving, Visibility

VISIBILITY_FREQUENCIES = 6  # octaves of positions in the visibility network, section 4.2.5


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, with where it gives them; `BlockNeRF.preset` has a CPU's."""

    backbone: BackboneNumbers = BackboneNumbers(
        NetworkNumbers(position_frequencies=16),  # mip-NeRF's
        hidden_width=512,  # this and all below: appendix
        learning_rate=2e-3,
        final_learning_rate=2e-5,
    )
    rays: RayNumbers = RayNumbers(256, 512, rays_per_step=16_384)  # appendix
    poses: PoseNumbers = PoseNumbers(match_photographs=False)  # section 4.2.2
    pose_penalty: NonNegative = 1e5  # weight of the squares of refined poses' changes at first, appendix; 0: none
    final_pose_penalty: NonNegative = 0.1  # that weight at the end of the budget, reached linearly; 0: none
    appearance: bool = True  # learn an appearance code for each photograph, section 4.2.1; off: one light
    appearance_code: CodeWidth = 32  # numbers of an appearance code, section 4.2.1; more fit its light more closely
    exposure: bool = True  # log exposure as an input, where photographs state it, section 4.2.3; off: ignored
    exposure_frequencies: Octaves = 4  # octaves of the exposure's encoding, section 4.2.3; more fit it more closely
    visibility: bool = True  # learn which places were seen, section 4.2.5; off: all blocks count as seeing
    visibility_layers: Layers = 4  # hidden layers of the visibility network; more cost time
    visibility_width: Width = 128  # channels of the visibility network; wider costs time
    residual_masks: bool = False  # exclude parts of photographs with large errors, in addition to given masks
    huber_delta: PositiveShare = 1.0  # residual at which the loss turns from squared to linear; 1: always squared
    head_layers: Layers = 3  # of the network: hidden colour layers, appendix; more cost time
    head_width: Width = 128  # of the network: channels of a hidden colour layer, appendix; wider costs time
    warmup_steps: Steps = 1024  # steps in which the learning rate rises, appendix; more begin more carefully
    coarse_loss_weight: NonNegative = 0.1  # of the network: weight of the coarse colours; 0: it only guides


SOURCES = {  # of the numbers of `paper`; the others are ours
    "Tancik 2022, appendix": (
        "field depth position_frequencies head_layers head_width coarse_samples fine_samples rays_per_step "
        "exposure_frequencies visibility_layers visibility_width learning_rate final_learning_rate warmup_steps "
        "pose_penalty final_pose_penalty coarse_loss_weight huber_delta"
    ),
    "hjxwhy/Block-NeRF, configs/waymo.yaml (bc16e5c), not the authors'": "hidden_width appearance_code",
}


OWN_SKIES = True  # a sky for each photograph behind open captures, by hash table
FIT_PIXELS = 2048  # pixels of a photograph that its appearance is found from


class BlockNeRF(FieldMethod):
    """Radiance field conditioned on a photograph's appearance and exposure, with a visibility network."""

    Config, further_bytes, learning_rate = Config, staticmethod(sampling_bytes), held_decay
    network: HashField | FrustumField
    in_blocks = True

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space, photographs, self.sky = space_of(frame), frame.image_count, None
        self.poses = poses_for(frame, c.poses)
        # Exposures come first: the appearance of a photograph is found in its exposure.
        self.exposures = Exposures(photographs, c.exposure_frequencies) if c.exposure else None
        evidence = Photograph, Patches, Appearance
        codes = photographs, c.appearance_code, evidence, FIT_PIXELS
        self.appearance = AppearanceCodes(*codes) if c.appearance else None
        self.moving = Moving(photographs) if c.residual_masks else None
        code = (c.appearance_code if c.appearance else 0) + (self.exposures.width if self.exposures else 0)
        b, joining = c.backbone, self.poses.weights if self.poses else None
        network = partial(FrustumField, head=[c.head_width] * c.head_layers, padding=0.0)
        with seeded(c.seed):
            self.network = b.build(frame, space, network=network, code=code, joining=joining)
            if b.hashed:
                self.sky = sky_for(frame, OWN_SKIES, b.table.sh_bands, code, b.hidden_width)
                self.sampler = b.sampler(frame, space)
            else:
                self.sampler = ConeSampler(
                    space, c.rays, learns_coarse=c.coarse_loss_weight > 0, rays_per_chunk=RAYS_WITH_FEATURES
                )
            shape = VISIBILITY_FREQUENCIES, c.visibility_layers, c.visibility_width
            self.sight = Visibility(space, *shape) if c.visibility else None

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table with Instant-NGP's numbers."""
        return changed(Config(), **CPU_BACKBONE, coarse_samples=128, fine_samples=128, rays_per_step=4096,
            visibility_layers=2, visibility_width=64, head_layers=1, head_width=16, pose_penalty=0.0,
            final_pose_penalty=0.0, warmup_steps=RISE, huber_delta=0.3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table with tiny networks, every part of it, within some twenty quick steps."""
        return changed(Config(), **TINY_BACKBONE, refine_cameras=True, residual_masks=True, appearance_code=4,
            exposure_frequencies=2, visibility_layers=1, visibility_width=16,
            warmup_steps=RISE, pose_penalty=1.0)  # fmt: skip

    # Learning

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        places = self.moving is not None
        return data.sample_rays(self.sampler.batch_size, generator, places=places).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The error of every pass's colours, and of the visibility network along the last pass's rays."""
        c, generator, rays = self.config, self.random(step), self.refine_rays(batch.rays)
        assert rays.image_index is not None
        codes = self.codes(rays.image_index)
        background = backdrop(batch, self.background, generator, opaque=self.frame.is_open)
        target = batch.before(background)
        behind = self.behind(rays, codes, background)
        passes, terms = self.learn_along(rays, generator)
        counted = self._counted(batch)
        for each in passes:
            if weight := self.pass_weights.get(each.name, 1.0):
                look = each.look(self.network, codes)
                residual = composite(look.samples, look.density, look.rgb, behind).rgb - target
                terms[each.name] = weight * (counted * huber(residual, c.huber_delta, "none").mean(-1)).mean()
        if self.sight:
            terms["visibility"] = self.sight.error(rays, look.samples, look.density.detach(), generator)
        if self.poses and (weight := c.pose_penalty + self.progress * (c.final_pose_penalty - c.pose_penalty)):
            terms["poses"] = weight * self.poses.moves[rays.image_index].square().sum(-1).mean()
        if self.moving:
            self.moving.note(rays.image_index, batch.extra["place"], residual.detach().abs().mean(-1))
        self.figures |= {"mse": float(residual.detach().square().mean())}
        return terms

    def _counted(self, batch: Batch) -> Float[Tensor, " ray"]:
        """Mask of rays: 0 for those on transient objects."""
        if self.moving is None or batch.rays.image_index is None:
            return torch.ones_like(batch.rays.radius)
        weights = self.moving.weights(batch.rays.image_index, batch.extra["place"])
        self.figures["left_out"] = float(1 - weights.mean())
        return weights

    def optimizers(self) -> list[torch.optim.Optimizer]:
        groups = [{"params": [self.appearance.codes] if self.appearance else [], "scale": CODES_RATE}]
        groups += [{"params": [*self.sky.parameters()], "scale": OPEN_RATE}] if self.sky else []
        own = self.config.backbone.optimizers(self.network, groups=groups, scale=OPEN_RATE)
        return [*own, *super().optimizers()]

    def codes(self, image: Int[Tensor, " ray"]) -> Float[Tensor, "ray code"]:
        """The code of each ray's photograph: appearance, then exposure."""
        nothing = torch.zeros(len(image), 0, device=self.device)
        return torch.cat([nothing, *(part(image) for part in (self.appearance, self.exposures) if part)], -1)

    # Rendering

    @property
    def shown_code(self) -> Float[Tensor, "1 code"]:
        nothing = torch.zeros(0, device=self.device)
        return torch.cat([nothing, *(x.shown(self) for x in (self.appearance, self.exposures) if x)])[None]

    @property
    def shown_in(self) -> Appearance:
        """Appearance code of renderings: of the settings, else of the evidence, else the average; empty without
        codes."""
        return Appearance(self.appearance.shown(self) if self.appearance else torch.zeros(0, device=self.device))

    @property
    def usual_exposure(self) -> float | None:
        """log2 of the training photographs' median exposure; None if unknown."""
        return self.exposures.usual_stops if self.exposures else None

    @torch.no_grad()
    def visibility(self, points: Points, directions: Directions) -> Float[Tensor, " point"]:
        """Visibility of points along a unit direction from the photographs (section 4.2.5); 1 if not learnt."""
        return self.sight(points, directions) if self.sight else torch.ones_like(points[:, 0])
