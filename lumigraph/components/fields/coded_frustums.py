"""A network of cones for photographs in other light: colours of Barron 2021 depend on a code of each as well."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad, softplus

from ...camera.rays import Rays
from ...datasets.scene import Frame
from ...volume import weights_of
from ..sampling.frustums import blurred, frustums_between
from ..sampling.sampling import inverse_transform, stratified
from ..sampling.spaces import space_of
from .coded_field import CodedField, Places
from .coded_hash import Joining
from .coordinate_network import CoordinateNetwork
from .dense import in_chunks
from .encodings import FrequencyEncoding, IntegratedEncoding

FINEST = (2 / 128) ** 2 / 12  # variance that a point is encoded with: a cell's of a grid of 128


class CodedFrustums(CodedField):
    """One network, evaluated twice on stretches of cones as Mip-NeRF does (Tancik 2022, figure 3).

    code:    numbers that colour depends on beside place and direction
    joining: how much each octave counts, while poses are refined coarse to fine
    """

    rays_per_chunk = 1024  # the features of all their samples are in memory

    def __init__(self, frame: Frame, config: Any, code: int, joining: Joining | None = None):
        super().__init__()
        self.config, self.space, self.joining = config, space_of(frame), joining
        self.encode_frustum = IntegratedEncoding(3, config.position_frequencies)
        self.encode_direction = FrequencyEncoding(3, config.direction_frequencies, base=1.0)
        inputs = self.encode_frustum.width, self.encode_direction.width + code
        shape = config.depth, config.hidden_width, config.skip_layer
        self.network = CoordinateNetwork(*inputs, *shape, exact=not config.bfloat16)

    @property
    def batch_size(self) -> int:
        return self.config.rays_per_step

    def passes(self, rays: Rays, generator: torch.Generator | None = None) -> list[Places]:
        """Frustums evenly along each ray, then more where those found something (Barron 2021, section 3.2)."""
        c, count, device = self.config, len(rays), rays.origins.device
        between = stratified(count, c.coarse_samples - 1, generator, device)
        between = (0.5 + (c.coarse_samples - 1) * between) / c.coarse_samples
        edges = pad(pad(between, (1, 0)), (0, 1), value=1.0)
        with torch.set_grad_enabled(torch.is_grad_enabled() and c.coarse_loss_weight > 0):
            coarse = self._places("coarse", rays, edges)
            weights = weights_of(coarse.samples, coarse.density).view(count, -1).detach()
        again = stratified(count, c.fine_samples + 1, generator, device)
        edges = inverse_transform(edges, blurred(weights) + c.resample_padding, again)
        return [coarse, self._places("fine", rays, edges)]

    def _places(self, name: str, rays: Rays, edges: Float[Tensor, "ray edge"]) -> Places:
        """What the network says of the frustums between edges, which are shares of the way along each ray."""
        samples, means, variances = frustums_between(edges, rays, self.space)
        ray = samples.ray_index
        raw, feature = in_chunks(lambda x, v: self.network.geometry(self._encoded(x, v)), means, variances)
        stretch = self.space.along(rays, samples)
        view = self.encode_direction(rays.directions)[ray]
        return Places(name, samples, softplus(raw - 1) * stretch, (feature, view), feature, stretch, len(samples))

    def colour(self, places: Places, codes: Float[Tensor, "sample code"]) -> Float[Tensor, "sample 3"]:
        (raw,) = in_chunks(lambda z, view, code: (self._seen(z, view, code),), *places.seen, codes)
        return raw.sigmoid()

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        (raw,) = in_chunks(lambda x: (self.network.density(self._encoded(x)),), self.space.warp(points))
        return softplus(raw - 1) * self.space.stretch(points)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"], code: Float[Tensor, " code"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        def answer(x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
            raw, feature = self.network.geometry(self._encoded(x))
            return raw, self._seen(feature, self.encode_direction(direction), code.expand(len(x), -1))

        raw, rgb = in_chunks(answer, self.space.warp(points), directions)
        return softplus(raw - 1) * self.space.stretch(points), rgb.sigmoid()

    def _seen(self, feature: Tensor, view: Tensor, code: Tensor) -> Tensor:
        return self.network.seen(feature, torch.cat([view, code], -1))

    def _encoded(
        self, means: Float[Tensor, "point 3"], variances: Float[Tensor, "point 3"] | None = None
    ) -> Float[Tensor, "point width"]:
        """Frustums as waves; points over as much space as photographs show. While poses are refined, of as many octaves
        as have joined."""
        joining = self.joining(self.config.position_frequencies) if self.joining else None
        return self.encode_frustum(means, torch.full_like(means, FINEST) if variances is None else variances, joining)

    def optimizers(self, codes: list[nn.Parameter]) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam([*self.parameters(), *codes], self.config.learning_rate)]
