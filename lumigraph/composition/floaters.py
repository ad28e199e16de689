"""Floaters: Gaussians in free space, scored by evidence from the cloud, the cameras and their depth maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..camera import Camera
from ..datasets.scene import Frame
from ..depth_maps import DepthMap
from ..gaussians import Gaussians
from ..gaussians.cloud import ISOLATION_NEIGHBOURS, gaps
from ..gaussians.splatting import render
from ..geometry import evenly
from ..system.progress import counting

STRENGTH = 0.4  # default share of the slider: Gaussians with a score above 1 - STRENGTH are removed
CANDIDATE_COLOUR = (1.0, 0.1, 0.8)  # of floaters that are shown
MAX_VIEWS, MAX_SIDE = 32, 200  # depth maps of a pass, and pixels of the longer side of each
PASSES = 2  # of depth; from the second on, the first one's floaters hide no surface
NEAR_PLANE_SCALE = 0.1  # of the scene's near distance, in front of which nothing is rendered
CORE_DEVIATIONS = 1.5  # of isolation, up to which a Gaussian shows depth in the first pass
MIN_DEVIATIONS, MAX_DEVIATIONS = 0.5, 3.0  # robust deviations of isolation at which its evidence is 0 and 1
NEAR_SHARE = 0.5  # of the cameras' median depth, up to which a Gaussian counts as near
MAX_CORE_NEAR, MAX_CORE_SCORE = 0.2, 0.25  # evidence and score of Gaussians that show depth
FEW_VIEWS = 4  # cameras, from which on a Gaussian is not seen by few
FEW_WEIGHT = 0.5  # of being seen by few; the border of a scene is too
UNKNOWN_PLACE = 0.7  # evidence of the place without cameras, so that isolation alone decides
SURFACE_SHARE, SURFACE_DEVIATIONS = 0.05, 2.0  # of the distance, and deviations of a Gaussian, within a surface


@dataclass(frozen=True)
class FloaterEvidence:
    """Evidence that each Gaussian is a floater, each measure in [0, 1].

    isolated: distance to its neighbours in sizes of both, in robust deviations from the median
    in_front: share of cameras with a surface clearly behind it, among those that it is not hidden from
    near:     proximity to a camera, relative to the median depth
    few:      1 if no camera sees it, 0 from four cameras on
    """

    isolated: Float[Tensor, " gaussian"]
    in_front: Float[Tensor, " gaussian"]
    near: Float[Tensor, " gaussian"]
    few: Float[Tensor, " gaussian"]

    @property
    def place(self) -> Float[Tensor, " gaussian"]:
        """Evidence of position: in front, near a camera, or seen by few, combined as 1 - product of complements."""
        return 1 - (1 - self.in_front) * (1 - self.near) * (1 - FEW_WEIGHT * self.few)

    @property
    def score(self) -> Float[Tensor, " gaussian"]:
        """Weighted geometric mean of isolation and position, so that a floater needs both."""
        return (self.isolated * self.place.square()).pow(2 / 3).clamp(0, 1)

    def floaters(self, strength: float) -> Bool[Tensor, " gaussian"]:
        """Gaussians to remove: a score above 1 - strength. Monotonic in the strength."""
        return self.score > 1 - strength


def floaters(
    gaussians: Gaussians, cameras: Camera | None, frame: Frame, strength: float
) -> Bool[Tensor, " gaussian"] | None:
    """Gaussians to remove at a strength, by `evidence`; None at strength 0."""
    return evidence(gaussians, cameras, frame).floaters(strength) if strength else None


@torch.no_grad()
@counting("Looking for floaters")
def evidence(gaussians: Gaussians, cameras: Camera | None, frame: Frame) -> FloaterEvidence:
    """Evidence on each Gaussian of a cloud.

    cameras: of the photographs, in the cloud's frame; None without photographs
    """
    device, count = gaussians.means.device, len(gaussians)
    isolated, none = isolation(gaussians), torch.zeros(count, device=device)
    if cameras is None or not count:
        return FloaterEvidence(isolated, none + UNKNOWN_PLACE, none, none)
    chosen = cameras[torch.tensor(evenly(range(len(cameras)), MAX_VIEWS))].to("cpu")
    means, sizes = gaussians.means.cpu(), gaussians.log_scales.exp().amax(-1).cpu()
    near = nearness(gaussians, cameras, chosen, frame)
    core = (isolated.cpu() * (MAX_DEVIATIONS - MIN_DEVIATIONS) < CORE_DEVIATIONS - MIN_DEVIATIONS) & (
        near < MAX_CORE_NEAR
    )
    for _ in range(PASSES):
        past, on = torch.zeros(count), torch.zeros(count)
        for seen in depth_maps(gaussians[core.to(device)], chosen, frame):
            compared = seen.compare(means)
            tolerance = SURFACE_SHARE * compared.distance + SURFACE_DEVIATIONS * sizes
            finite = compared.ahead.isfinite()
            past += finite & (compared.ahead > tolerance)
            on += finite & (compared.ahead.abs() <= tolerance)
        few = (1 - (past + on) / FEW_VIEWS).clamp(0, 1)
        found = FloaterEvidence(*(x.to(device) for x in (isolated, past / (past + on + 1), near, few)))
        core = (found.score.cpu() < MAX_CORE_SCORE) & (near < NEAR_SHARE)
    return found


def isolation(gaussians: Gaussians) -> Float[Tensor, " gaussian"]:
    """Evidence of isolation: the logarithm of `gaps`, in robust deviations, from 0 at 0.5 to 1 at 3."""
    if len(gaussians) <= ISOLATION_NEIGHBOURS:
        return torch.zeros(len(gaussians), device=gaussians.means.device)
    logs = gaps(gaussians).log()
    away = logs - logs.median()
    deviations = away / (1.4826 * away.abs().median()).clamp_min(1e-9)
    return ((deviations - MIN_DEVIATIONS) / (MAX_DEVIATIONS - MIN_DEVIATIONS)).clamp(0, 1)


def nearness(gaussians: Gaussians, cameras: Camera, seen: Camera, frame: Frame) -> Float[Tensor, " gaussian"]:
    """Evidence of proximity to a camera: 1 at the camera, 0 from half of the median depth on.

    seen: the cameras of the depth measurement
    """
    depths = [x.depth[x.solid].median() for x in depth_maps(gaussians, seen, frame) if x.solid.any()]
    if not depths:
        return torch.zeros(len(gaussians))
    usual = torch.stack(depths).median()
    nearest = torch.cat(
        [torch.cdist(some, cameras.position.cpu()).amin(-1) for some in gaussians.means.cpu().split(1 << 14)]
    )
    return (1 - nearest / usual / NEAR_SHARE).clamp(0, 1)


def depth_maps(gaussians: Gaussians, cameras: Camera, frame: Frame) -> Iterator[DepthMap]:
    """Depth maps of a cloud, one after the other, at most 200 pixels long."""
    for i in range(len(cameras)):
        camera = cameras[i].resized(min(1.0, MAX_SIDE / int(cameras[i].size.max())))
        near = NEAR_PLANE_SCALE * frame.near
        rendering = render(gaussians, camera.to(gaussians.means.device), frame.background, near)
        yield DepthMap.of_rendering(camera, rendering, frame.background)
