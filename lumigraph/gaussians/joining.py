"""Joining clouds: several as one."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.nn.functional import pad

from ..errors import LumigraphWarning
from .cloud import Gaussians


def joined(clouds: Sequence[Gaussians]) -> Gaussians:
    """One cloud from several. Harmonics that some lack are zero; opacities keep the meaning that most of them have."""
    coefficients = max(cloud.harmonics.shape[1] for cloud in clouds)
    antialiased = [cloud.antialiased for cloud in clouds for _ in range(len(cloud))]
    majority = 2 * sum(antialiased) > len(antialiased)
    if len({cloud.antialiased for cloud in clouds}) > 1:
        warnings.warn(
            "Some of these clouds were learnt with the antialiasing filter and some without; the smallest Gaussians of "
            f"{'the latter' if majority else 'the former'} look a little too {'thin' if majority else 'thick'}",
            LumigraphWarning,
            2,
        )
    return replace(
        clouds[0],
        means=torch.cat([x.means for x in clouds]),
        quaternions=torch.cat([x.quaternions for x in clouds]),
        log_scales=torch.cat([x.log_scales for x in clouds]),
        opacities=torch.cat([x.opacities for x in clouds]),
        harmonics=torch.cat([pad(x.harmonics, (0, 0, 0, coefficients - x.harmonics.shape[1])) for x in clouds]),
        antialiased=majority,
    )
