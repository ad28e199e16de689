"""NeRF-W: a scene from photographs in other light, with passers-by (Martin-Brualla et al. 2021, arXiv 2008.02268)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from .. import kernels
from ..camera.rays import Look, Rays, Rendering, Samples
from ..components.backbone import CPU_BACKBONE, TINY_BACKBONE, BackboneNumbers
from ..components.fields.appearance import AppearanceCodes, CodeWidth, PhotographCodes, sky_for
from ..components.fields.coordinate_field import CoordinateField, NetworkNumbers
from ..components.fields.hash_field import CODES_RATE, OPEN_RATE, HashField, side_by_side
from ..components.fields.layers import MLP, Dense, in_chunks, truncated_exp
from ..components.fields.spaces import space_of
from ..components.sampling.hierarchical_sampler import RAYS_WITH_FEATURES, HierarchicalSampler, RayNumbers
from ..components.sampling.samplers import sampling_bytes
from ..components.training.photometric import backdrop
from ..components.training.schedules import held_decay
from ..datasets.scene import Batch, Frame
from ..files.ranges import Layers, PositiveShare, Share, Width, changed
from ..method import BaseConfig, FieldMethod, Pass, seeded
from ..method.controls import AVERAGE, Control
from ..method.field import Densities, Points
from ..volume import composite

MIN_OPACITY = 1e-10  # opacity of a sample that is divided by at least
THIN = 3.0  # transient density is exp(-THIN) per scene unit at first, beside a hash table: it is only where needed


@dataclass(frozen=True)
class Transient:
    """Density per scene unit, colour and colour deviation of a photograph's transient objects."""

    density: Float[Tensor, " sample"]
    rgb: Float[Tensor, "sample 3"]
    beta: Float[Tensor, " sample"]


class TransientHead(nn.Module):
    """Density, colour and deviation from features of the static field and a transient code (eq. 10).

    widths: of the features with the code, and of the hidden layers
    """

    def __init__(self, *widths: int, exact: bool = False):
        super().__init__()
        hidden = [Dense(a, b, True, exact) for a, b in zip(widths, widths[1:], strict=False)]
        self.layers = nn.Sequential(*hidden, Dense(widths[-1], 5, False, exact))

    def forward(
        self, features: tuple[Tensor, ...], code: Float[Tensor, "sample code"], stretch: Float[Tensor, " sample"]
    ) -> Transient:
        """stretch: coordinates in a scene unit"""

        def answer(feature: Tensor, code: Tensor) -> tuple[Tensor]:
            return (self.layers(torch.cat([feature, code.to(feature.dtype)], -1)).float(),)

        (raw,) = in_chunks(answer, features[0], code)
        return Transient(softplus(raw[:, 0]) * stretch, raw[:, 1:4].sigmoid(), softplus(raw[:, 4]))


class HashTransientHead(nn.Module):
    """The same from the encoding of an `EncodedHashField`. One photograph alone does not determine a transient's
    distance, so transient density is learnt at the static field's samples: at the surfaces behind."""

    def __init__(self, *widths: int):
        super().__init__()
        self.layers = MLP(*widths, 5)

    def forward(
        self, features: tuple[Tensor, ...], code: Float[Tensor, "sample code"], stretch: Float[Tensor, " sample"]
    ) -> Transient:
        raw = self.layers(side_by_side(features[1], code))
        return Transient(truncated_exp(raw[:, 0] - THIN), raw[:, 1:4].sigmoid(), softplus(raw[:, 4]))


class EncodedHashField(HashField):
    """A hash table whose features include the encoding, detached: a transient head does not change the table."""

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Any]:
        encoded = self.encode(points)
        density, geometry = self.decode(points, encoded)
        return density, (geometry, encoded.detach())

    def colour(self, features: Any, directions: Float[Tensor, "point 3"], code: Tensor | None = None) -> Tensor:
        return super().colour(features[0], directions, code)


def with_transient(look: Look, transient: Transient, background: Float[Tensor, "#ray 3"]) -> Rendering:
    """A rendering of the static scene and the transient (eq. 9), and as the extra "beta" the deviation of its colours
    (eq. 11), without beta_min.

        C = sum_i T_i (alpha(sigma_i) c_i + alpha(sigma'_i) c'_i)      T_i = exp(-sum_{j<i} (sigma_j + sigma'_j) d_j)
        beta = sum_i T'_i alpha(sigma'_i) beta_i                       T'_i = exp(-sum_{j<i} sigma'_j d_j)

    A sample's weight T_i alpha(sigma_i + sigma'_i) is shared out so that each part has the alpha of its own density.
    """
    samples, length = look.samples, look.samples.length
    density = look.density + transient.density
    whole = opaque(density * length).clamp_min(MIN_OPACITY)
    static, passing = (opaque(x * length) / whole for x in (look.density, transient.density))
    colours = static[:, None] * look.rgb + passing[:, None] * transient.rgb
    seen = composite(samples, density, colours, background)
    (beta, *_) = kernels.composite(transient.density * length, transient.beta[:, None], samples.ray_starts)
    return seen.with_extra(beta=beta[:, 0])


def opaque(thickness: Float[Tensor, " sample"]) -> Float[Tensor, " sample"]:
    """alpha = 1 - exp(-sigma d), the share of light that optical thickness stops."""
    return -torch.expm1(-thickness)


TRANSIENT_WEIGHT = 0.01  # lambda_u, weight of transient density, section 5


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, with NeRF's learning rates; `NeRFW.preset` has those of a plain CPU."""

    backbone: BackboneNumbers = BackboneNumbers(NetworkNumbers(position_frequencies=15))  # supplement
    rays: RayNumbers = RayNumbers(512, 512, rays_per_step=2048)  # supplement
    appearance_code: CodeWidth = 48  # n^(a), numbers of an appearance code, section 5; more fit its light more closely
    transient_code: CodeWidth = 16  # n^(tau), numbers of a transient code, section 5; more fit more passers-by
    transient_layers: Layers = 4  # hidden layers of the transient head, supplement; more cost time
    transient_width: Width = 128  # channels of the transient head, supplement; wider costs time
    beta_min: PositiveShare = 0.03  # least uncertainty, section 5; higher gives uncertain pixels more weight
    transient_start: Share = 0.0  # share of the budget before the transient part is on; later: more is static
    own_skies: bool = True  # a sky for each photograph behind open captures, by hash table; off: one background


SOURCES = {  # of the numbers of `paper`; the others are ours
    "Martin-Brualla 2021, supplement": (
        "field depth position_frequencies hidden_width rays_per_step transient_layers transient_width beta_min "
        "transient_start"
    ),
    "rover-xingyu/Ha-NeRF, issue 31": "coarse_samples fine_samples",
    "kwea123/nerf_pl, opt.py (2dd2759)": "appearance_code transient_code",
    "kwea123/nerf_pl, losses.py (2dd2759)": "transient_weight",
}


HIDDEN, SHOWN = "hidden", "shown"


class NeRFW(FieldMethod):
    """A static scene whose colours depend on the appearance of a photograph, and a transient of each photograph."""

    Config, further_bytes, learning_rate = Config, staticmethod(sampling_bytes), held_decay
    network: EncodedHashField | CoordinateField
    transient_head: TransientHead | HashTransientHead
    appearance: AppearanceCodes

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        b, space, code, self.sky = c.backbone, space_of(frame), c.appearance_code, None
        hidden = [c.transient_width] * c.transient_layers
        network = partial(CoordinateField.twice, keep_input=True, activation=softplus)
        with seeded(c.seed):
            self.network = b.build(frame, space, EncodedHashField, network, code=code)
            if b.hashed:
                self.sky = sky_for(frame, c.own_skies, b.table.sh_bands, code, b.hidden_width)
                self.transient_head = HashTransientHead(b.table.width + c.transient_code, *hidden)
                self.sampler = b.sampler(frame, space)
            else:
                exact = not b.network.bfloat16
                self.transient_head = TransientHead(b.hidden_width + c.transient_code, *hidden, exact=exact)
                self.sampler = HierarchicalSampler(space, c.rays, rays_per_chunk=RAYS_WITH_FEATURES)
        self.appearance = AppearanceCodes(frame.image_count, code)
        self.transient = PhotographCodes(frame.image_count, c.transient_code)

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table with Instant-NGP's numbers."""
        return changed(Config(), **CPU_BACKBONE, coarse_samples=64, fine_samples=64, transient_layers=2,
            transient_width=32, transient_start=0.1, beta_min=0.1)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table with tiny networks and a grid of three sizes, within some twenty quick steps."""
        return changed(
            Config(), **TINY_BACKBONE, appearance_code=4, transient_code=4, transient_layers=1, transient_width=16
        )

    # Learning

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Equations 13 and 14: the last pass with the transient, the coarse one without it and without uncertainty."""
        c, rays, generator = self.config, batch.rays, self.random(step)
        assert rays.image_index is not None
        background = backdrop(batch, self.background, generator)
        target = batch.before(background)
        appearance, transient = self.appearance(rays.image_index), self.transient(rays.image_index)
        background = self.behind(rays, appearance, background)
        (*coarse, last), further = self.learn(rays, generator)
        terms = {}
        for each in coarse:
            look = each.look(self.network, appearance)
            seen = composite(look.samples, look.density, look.rgb, background)
            terms[each.name] = 0.5 * squared(seen.rgb - target).mean()
        look = last.look(self.network, appearance)
        if self.progress < c.transient_start:  # the static scene learns alone
            seen = composite(look.samples, look.density, look.rgb, background)
            beta = torch.full_like(target[:, 0], c.beta_min)
        else:
            passing = self.transients(rays, last, transient)
            seen = with_transient(look, passing, background)
            beta = c.beta_min + seen.extra["beta"]
            terms["uncertainty"] = (beta / c.beta_min).log().mean()
            terms["transient"] = TRANSIENT_WEIGHT * mean_along(last.samples, passing.density)
        error = squared(seen.rgb - target)
        terms["colour"] = (error / (2 * beta.square())).mean()
        certain = 1 / (2 * c.beta_min**2)  # largest weight of an error, to which the other terms are relative
        terms |= {name: certain * term for name, term in further.items()}
        self.figures |= {"mse": float(error.detach().mean()) / 3, "beta": float(beta.detach().mean())}
        return terms

    def transients(self, rays: Rays, seen: Pass, code: Float[Tensor, "#ray code"]) -> Transient:
        """The transient at a pass's samples. code: transient codes"""
        codes = seen.code_of_samples(code)
        assert codes is not None
        return self.transient_head(seen.features, codes, self.network.space.along(rays, seen.samples))

    def optimizers(self) -> list[torch.optim.Optimizer]:
        codes = [self.appearance.codes, self.transient.codes]
        others = [*self.transient_head.parameters(), *(self.sky.parameters() if self.sky else [])]
        groups = [{"params": others, "scale": OPEN_RATE}, {"params": codes, "scale": CODES_RATE}]
        own = self.config.backbone.optimizers(self.network, groups=groups, eps=1e-7, scale=OPEN_RATE)
        return [*own, *super().optimizers()]

    # Rendering

    @property
    def shown_code(self) -> Float[Tensor, "1 code"]:
        return self.appearance.shown(self)[None]

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        if self.control("transient") == HIDDEN:
            return super().render_rays(rays, background)
        code, last = self.shown_code, self.sampler.sample(rays, self.network)[-1]
        transient = self.transient.code_of(str(self.settings.get("appearance", AVERAGE)))
        passing, background = self.transients(rays, last, transient[None]), self.behind(rays, code, background)
        seen = with_transient(last.look(self.network, code), passing, background)
        return replace(seen, rgb=seen.rgb.clamp(0, 1))

    @property
    def controls(self) -> tuple[Control, ...]:
        about = "Whether the transient of the photograph that appearance names, such as passers-by, is shown too."
        return *super().controls, Control("transient", HIDDEN, choices=(HIDDEN, SHOWN), about=about)


def squared(residual: Float[Tensor, "ray 3"]) -> Float[Tensor, " ray"]:
    return residual.square().sum(-1)


def mean_along(samples: Samples, values: Float[Tensor, " sample"]) -> Float[Tensor, ""]:
    """The mean over each ray's samples, averaged over all rays; 0 counts for a ray that has none."""
    counts = samples.ray_starts.diff()
    return (values / counts[samples.ray_index]).sum() / len(counts)
