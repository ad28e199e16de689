"""Placement of parts on one another, and the frame that holds all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera.crop import CropBox
from ..datasets.scene import Frame
from ..geometry import Similarity

MAX_REACH = 64.0


def standing(
    part: Frame, lead: Frame, at: Float[Tensor, " 3"] | None = None, scale: float = 1.0, turn: float = 0.0
) -> Similarity:
    """The place of a part that stands upright in the lead's scene, from the part's source to the lead's.

    at:    where the foot of the part goes, the middle of its box of interest's lower side, in the lead's source;
           None for the lead's own foot
    scale: units of the lead's source to one of the part's
    turn:  degrees about the vertical, counterclockwise as seen from above
    """
    here, there = part.to_source, lead.to_source
    angle = math.radians(turn)
    cosine, sine = math.cos(angle), math.sin(angle)
    turned = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    rotation = there.rotation @ turned @ here.rotation.T
    goal = there.points(foot(lead)) if at is None else at.double()
    return Similarity.make(scale, rotation, goal - scale * rotation @ here.points(foot(part)))


def foot(frame: Frame) -> Float[Tensor, " 3"]:
    """The middle of the lower side of a frame's box of interest, in the scene's frame."""
    lower, upper = torch.tensor(frame.bounds, dtype=torch.float64)
    x, y, _ = (0.5 * (lower + upper)).tolist()
    return torch.tensor([x, y, float(lower[2])], dtype=torch.float64)


def frame_around(lead: Frame, others: Sequence[tuple[Frame, Similarity, CropBox | None]]) -> Frame:
    """The lead's frame, with bounds and reach that hold other parts as well: their frames, places in it, and boxes.

    Its box of interest may then be larger than [-1, 1]^3, unlike that of any single scene.
    """
    corners = [torch.tensor(lead.bounds)]
    farthest = lead.reach
    for frame, place, box in others:
        interest = box or CropBox(*frame.bounds)
        corners.append(interest.moved(place).corners.float())
        all_of_it = interest if box or not frame.is_open else CropBox((-frame.reach,) * 3, (frame.reach,) * 3)
        farthest = max(farthest, float(all_of_it.moved(place).corners.abs().max()))
    points = torch.cat(corners)
    lower, upper = ((x, y, z) for x, y, z in (points.amin(0).tolist(), points.amax(0).tolist()))
    reach = lead.reach
    while reach < min(farthest - 1e-6, MAX_REACH):
        reach *= 2
    return replace(lead, bounds=(lower, upper), reach=reach)
