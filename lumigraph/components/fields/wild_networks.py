"""The field of NeRF in the Wild (Martin-Brualla et al. 2021, figure 3)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from ...camera.rays import Rays, Samples
from ...datasets.scene import Frame
from ...volume import weights_of
from ..sampling.sampling import inverse_transform, midpoints, stratified
from ..sampling.spaces import space_of
from .coded_field import Places
from .coordinate_network import CoordinateNetwork
from .dense import Dense, in_chunks
from .encodings import FrequencyEncoding
from .wild_field import Passing, WildField


class WildNetworks(WildField):
    """The paper's field (figure 3): a coarse network, and a fine one with a transient head."""

    rays_per_chunk = 1024  # the features of all their samples are in memory

    def __init__(self, frame: Frame, config: Any):
        super().__init__()
        self.config, self.space = config, space_of(frame)
        self.encode_position = FrequencyEncoding(3, config.position_frequencies)
        self.encode_direction = FrequencyEncoding(3, config.direction_frequencies)
        inputs = self.encode_position.width, self.encode_direction.width + config.appearance_code
        shape, exact = (config.depth, config.hidden_width, config.skip_layer), not config.bfloat16
        self.coarse, self.fine = (CoordinateNetwork(*inputs, *shape, exact=exact) for _ in range(2))
        widths = [config.hidden_width + config.transient_code, *[config.transient_width] * config.transient_layers]
        hidden = [Dense(a, b, True, exact) for a, b in zip(widths, widths[1:], strict=False)]
        self.transient = nn.Sequential(*hidden, Dense(widths[-1], 5, False, exact))

    @property
    def batch_size(self) -> int:
        return self.config.rays_per_step

    def passes(self, rays: Rays, generator: torch.Generator | None = None) -> list[Places]:
        """Samples evenly along each ray, then more where those found something (Mildenhall 2020, section 5.2)."""
        c, count, device = self.config, len(rays), rays.origins.device
        shares = stratified(count, c.coarse_samples, generator, device)
        coarse = self._places("coarse", rays, shares)
        weights = weights_of(coarse.samples, coarse.density).view(count, -1).detach()
        again = stratified(count, c.fine_samples, generator, device)
        again = inverse_transform(midpoints(shares), weights[:, 1:-1], again)
        return [coarse, self._places("fine", rays, torch.cat([shares, again], -1).sort(-1)[0])]

    def _places(self, name: Literal["coarse", "fine"], rays: Rays, shares: Float[Tensor, "ray sample"]) -> Places:
        """What a network says at places along rays; each holds as far as the next place."""
        near, far = self.space.interval(rays)
        t = self.space.distance(shares, rays, near, far)
        samples, network = Samples.rows(t, far), getattr(self, name)
        points = (rays.origins[:, None] + t[..., None] * rays.directions[:, None]).flatten(0, 1)
        raw, feature = in_chunks(lambda x: network.geometry(self.encode_position(x)), self.space.warp(points))
        stretch = self.space.along(rays, samples)
        view = self.encode_direction(rays.directions)[samples.ray_index]
        return Places(name, samples, softplus(raw) * stretch, (feature, view), feature, stretch, len(samples))

    def colour(self, places: Places, codes: Float[Tensor, "sample code"]) -> Float[Tensor, "sample 3"]:
        network = getattr(self, places.name)
        (raw,) = in_chunks(lambda z, view, code: (network.seen(z, torch.cat([view, code], -1)),), *places.seen, codes)
        return raw.sigmoid()

    def passing(self, places: Places, codes: Float[Tensor, "sample code"]) -> Passing:

        def answer(feature: Tensor, code: Tensor) -> tuple[Tensor]:
            return (self.transient(torch.cat([feature, code.to(feature.dtype)], -1)).float(),)

        (raw,) = in_chunks(answer, places.unseen, codes)
        return Passing(softplus(raw[:, 0]) * places.stretch, raw[:, 1:4].sigmoid(), softplus(raw[:, 4]))

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        (raw,) = in_chunks(lambda x: (self.fine.density(self.encode_position(x)),), self.space.warp(points))
        return softplus(raw) * self.space.stretch(points)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"], code: Float[Tensor, " code"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        def answer(x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
            view = torch.cat([self.encode_direction(direction), code.expand(len(x), -1)], -1)
            return self.fine(self.encode_position(x), view)

        raw, rgb = in_chunks(answer, self.space.warp(points), directions)
        return softplus(raw) * self.space.stretch(points), rgb.sigmoid()

    def optimizers(self, codes: list[nn.Parameter]) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam([*self.parameters(), *codes], self.config.learning_rate, eps=1e-7)]
