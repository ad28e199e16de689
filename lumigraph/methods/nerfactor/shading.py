"""Reflectance and the rendering equation under lights at infinity."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...components.fields.encodings import FrequencyEncoding
from ...geometry import unit

FRESNEL = 0.04  # F0 of a dielectric
MIN_COSINE = 1e-3
MIN_ROUGHNESS = 0.1
PRIOR_LOBES, PRIOR_PAIRS = 64, 1024  # materials that the prior learns from, pairs of directions of a step
CODE_DEVIATION = 0.01  # of their codes at first

Lights = Float[Tensor, "point light"]


def microfacet(
    nl: Float[Tensor, "*pairs"],
    nv: Float[Tensor, "*#pairs"],
    vl: Float[Tensor, "*pairs"],
    roughness: Float[Tensor, "*#pairs"],
) -> Float[Tensor, "*pairs"]:
    """Specular reflectance per steradian of GGX microfacets (Walter 2007) with Smith's masking and Schlick's Fresnel.

        f = D(h) G(l) G(v) F(v.h) / (4 n.l n.v),    alpha = roughness^2

    from the cosines between normal n, light l and eye v
    """
    nl, nv = nl.clamp_min(MIN_COSINE), nv.clamp_min(MIN_COSINE)
    vh = (0.5 + 0.5 * vl).clamp_min(1e-6).sqrt()  # |l + v| = 2 v.h
    nh = ((nl + nv) / (2 * vh)).clamp(max=1.0)
    square = roughness.square().square()
    d = square / (math.pi * (nh.square() * (square - 1) + 1).square())
    shadowing = nl + (square + (1 - square) * nl.square()).sqrt()
    masking = nv + (square + (1 - square) * nv.square()).sqrt()
    fresnel = FRESNEL + (1 - FRESNEL) * (1 - vh) ** 5
    return d * fresnel / (shadowing * masking)  # G(l) G(v) / (4 n.l n.v)


def shaded(
    albedo: Float[Tensor, "point 3"],
    specular: Lights,
    reached: Lights,
    power: Float[Tensor, "light 3"],
) -> Float[Tensor, "point 3"]:
    """Radiance towards the eye (eq. 7), the sum over lights of (albedo / pi + f) V n.l power.

    reached: visibility V times cosine n.l
    power:   irradiance of each light on what faces it: radiance times solid angle for pixels of a map
    """
    return albedo / math.pi * (reached @ power) + (reached * specular) @ power


def rusinkiewicz(
    normals: Float[Tensor, "pair 3"], eyes: Float[Tensor, "pair 3"], lights: Float[Tensor, "pair 3"]
) -> Float[Tensor, "pair 3"]:
    """Half-difference angles phi_d, theta_h, theta_d of pairs of directions (Rusinkiewicz 1998), by their cosines."""
    half = unit(eyes + lights)
    nh, vh = (normals * half).sum(-1), (eyes * half).sum(-1)
    across_n, across_l = unit(normals - nh[:, None] * half), unit(lights - vh[:, None] * half)
    return torch.stack([(across_n * across_l).sum(-1), nh, vh], -1)


class LearntReflectance(nn.Module):
    """Specular reflectance by a network of half-difference angles and a code (section 3.3), learnt beforehand from
    procedural microfacet materials and frozen, so that codes are confined to plausible lobes."""

    def __init__(self, code: int, frequencies: int, layers: int, width: int):
        super().__init__()
        self.code, self.encoding = code, FrequencyEncoding(3, frequencies)
        sizes = [self.encoding.width + code, *[width] * layers]
        hidden = [x for a, b in zip(sizes[:-1], sizes[1:], strict=True) for x in (nn.Linear(a, b), nn.ReLU())]
        self.network = nn.Sequential(*hidden, nn.Linear(width, 1), nn.Softplus())
        self.requires_grad_(False)

    def forward(self, angles: Float[Tensor, "pair 3"], codes: Float[Tensor, "pair code"]) -> Float[Tensor, " pair"]:
        return self.network(torch.cat([self.encoding(angles), codes], -1))[:, 0]

    def at(
        self,
        normals: Float[Tensor, "point 3"],
        eyes: Float[Tensor, "point 3"],
        directions: Float[Tensor, "light 3"],
        codes: Float[Tensor, "point code"],
    ) -> Lights:
        """Specular reflectance of points from all lights."""
        shape = len(normals), len(directions)
        n, v, z = (x[:, None].expand(*shape, -1).reshape(-1, x.shape[-1]) for x in (normals, eyes, codes))
        return self(rusinkiewicz(n, v, directions.repeat(len(normals), 1)), z).reshape(shape)

    def learn(self, steps: int, learning_rate: float, generator: torch.Generator) -> float:
        """Train lobes of many roughnesses as an autodecoder, with a code for each; the loss compares logarithms
        (section 3.3). Returns the last loss."""
        device = next(self.network.parameters()).device
        roughness = torch.linspace(MIN_ROUGHNESS, 1.0, PRIOR_LOBES, device=device)
        codes = nn.Parameter((CODE_DEVIATION * torch.randn(PRIOR_LOBES, self.code, generator=generator)).to(device))
        weights = [weight.requires_grad_() for weight in self.network.parameters()]
        optimizer = torch.optim.Adam([codes, *weights], lr=learning_rate)
        loss = torch.zeros(())
        for _ in range(steps):
            lobe = torch.randint(PRIOR_LOBES, (PRIOR_PAIRS,), generator=generator).to(device)
            n, v, way = (unit(torch.randn(PRIOR_PAIRS, 3, generator=generator)).to(device) for _ in range(3))
            v, way = (torch.where((x * n).sum(-1, keepdim=True) < 0, -x, x) for x in (v, way))  # above the surface
            truth = microfacet((n * way).sum(-1), (n * v).sum(-1), (v * way).sum(-1), roughness[lobe])
            with torch.enable_grad():
                found = self(rusinkiewicz(n, v, way), codes[lobe])
                loss = ((1 + found).log() - (1 + truth).log()).square().mean()
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
            optimizer.step()
        self.requires_grad_(False)
        return float(loss.detach())
