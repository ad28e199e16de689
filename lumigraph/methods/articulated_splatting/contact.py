"""Contact of two bodies as the closeness of their Gaussians (Pokhariya 2024, section 5)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ...figures import ramp
from ...gaussians import Gaussians
from ...gaussians.cloud import BAND_0
from ...method.controls import Control

SOLID_OPACITY = 0.2  # from which a Gaussian counts as surface
REACH = 3.0  # largest gap that a map of contact shows, in contact distances
PICTURE, CONTACT = "picture", "contact"


def contact_control() -> Control:
    about = "The picture, or its contact map: how close each place is to another body."
    return Control("show", PICTURE, choices=(PICTURE, CONTACT), about=about)


def bodies_of(parents: tuple[int, ...]) -> Int[np.ndarray, " bone"]:
    """Number of the body, a tree of bones, that each bone belongs to."""
    found: list[int] = []
    for parent in parents:
        found.append(len(set(found)) if parent < 0 else found[parent])
    return np.array(found)


def gaps(cloud: Gaussians, body: Int[Tensor, " gaussian"]) -> Float[Tensor, " gaussian"]:
    """Distance of each Gaussian to the nearest solid one of another body, less mean deviations of both, scene units.

    body: number of the body that each belongs to. Infinite where there is no other body.
    """
    means, sizes = cloud.means.detach().cpu().numpy(), cloud.log_scales.detach().mean(1).exp().cpu().numpy()
    solid, body_of = (cloud.opacities.sigmoid() > SOLID_OPACITY).cpu().numpy(), body.cpu().numpy()
    found = np.full(len(means), np.inf)
    for number in np.unique(body_of):
        own, others = body_of == number, (body_of != number) & solid
        if others.any():
            away, nearest = cKDTree(means[others]).query(means[own])
            found[own] = away - sizes[own] - sizes[others][nearest]
    return torch.from_numpy(found).to(cloud.means)


def contact_map(cloud: Gaussians, body: Int[Tensor, " gaussian"], distance: float) -> Gaussians:
    """The cloud in colours of contact, full within a distance and fading out at REACH times that."""
    share = ((REACH - gaps(cloud, body) / distance) / (REACH - 1)).clamp(0, 1)
    harmonics = torch.zeros_like(cloud.harmonics)
    harmonics[:, 0] = (ramp(share) - 0.5) / BAND_0
    return replace(cloud, harmonics=harmonics)
