"""Loop closure: recognition of revisited places, and pose graph optimisation.

Similar keyframes are candidates. Points of one at matched features of the other give a rigid motion by RANSAC, and
measured depths that agree verify the loop. Poses then minimise the error of motions between neighbours and across loops
(Grisetti et al. 2010, eq. 7), with a robust loss by SciPy: COLMAP's pose graph optimises none.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, max_pool2d, normalize

from ...datasets.scene import Photograph
from ...method import Part
from ..training.bundle_adjustment import rotation_vector
from ..training.shared_points import Seen, features, matched, resected
from .frames import MIN_COMMON, MISSED, DepthFrame
from .trajectory import Pose, apply_twists, relative

THUMBNAIL = 12, 16  # rows and columns of a picture by which places are compared
HOLE = 2  # pixels to measured depth, up to which a feature has that depth
MIN_LIKENESS = 0.5  # correlation of thumbnails of one place
CANDIDATES = 3  # keyframes that a new one is compared with by features
MIN_AGE = 10  # keyframes between the two ends of a loop
MIN_INLIERS = 15  # matches that a loop's motion explains; dense depth must agree, too
DRIFTED = 0.45  # contradiction of two keyframes at the poses of a path, from which on it has drifted between them
MIN_JUDGED = 0.05  # share of points in common, from which on depth can contradict
MAX_STEPS = 50  # evaluations of the pose graph's Jacobian
DEVIATION = 0.01, 0.01  # radians and metres, of the motion from one keyframe to the next and across a loop


@dataclass(frozen=True)
class KeyframePlace:
    """Features of a keyframe for place recognition. points: of its features, camera's frame, NaN for unmeasured"""

    seen: Seen
    points: Float[Tensor, "feature 3"]
    thumbnail: Float[Tensor, " pixel"]

    @staticmethod
    @torch.no_grad()
    def of(frame: DepthFrame) -> KeyframePlace:
        width, height = frame.size
        camera, picture = frame.camera.to("cpu"), frame.rgb.view(height, width, 3).cpu()
        seen = features(Photograph(camera, picture))
        depth, known = (x.view(height, width).cpu() for x in (frame.depth, frame.measured))
        near = -max_pool2d(torch.where(known, -depth, -torch.inf)[None], 2 * HOLE + 1, 1, HOLE)[0]
        depth = torch.where(known, depth, torch.where(near.isfinite(), near, torch.nan))  # the nearest beside a hole
        places, inside = camera.locate(seen.bearings)
        along = torch.where(inside, depth[places[:, 0], places[:, 1]], torch.nan)
        small = adaptive_avg_pool2d(picture.mean(-1)[None, None], THUMBNAIL).flatten()
        return KeyframePlace(seen, seen.bearings * along[:, None], normalize(small - small.mean(), dim=0))

    def matched_points(self, other: KeyframePlace) -> tuple[Float[Tensor, "match 3"], Float[Tensor, "match 3"]]:
        """Points of this keyframe, and the directions in which another one sees them."""
        pairs = matched(self.seen, other.seen)
        return self.points[pairs[:, 0]], other.seen.bearings[pairs[:, 1]]


class FramePlaces:
    """Features of frames, found once and kept for keyframes and the latest frame."""

    def __init__(self) -> None:
        self._known: dict[int, KeyframePlace] = {}

    def of(self, frame: DepthFrame) -> KeyframePlace:
        if frame.index not in self._known:
            self._known[frame.index] = KeyframePlace.of(frame)
        return self._known[frame.index]

    def keep(self, images: Iterable[int]) -> None:
        """Forget frames that are not among these images."""
        self._known = {i: self._known[i] for i in images if i in self._known}

    def alike(self, frame: DepthFrame, others: Sequence[DepthFrame]) -> list[DepthFrame]:
        """At most CANDIDATES of other frames whose thumbnails look like this one's, the most similar first."""
        if not others:
            return []
        likeness = torch.stack([self.of(other).thumbnail for other in others]) @ self.of(frame).thumbnail
        order = likeness.argsort(descending=True, stable=True)[:CANDIDATES].tolist()
        return [others[i] for i in order if likeness[i] >= MIN_LIKENESS]


class Loops(Part):
    """Detected loops: pairs of images, the earlier one first, and the pose of the later one in its frame."""

    grows: ClassVar[tuple[str, ...]] = ("pairs", "motions")
    pairs: Tensor
    motions: Tensor

    def __init__(self, unit: float):
        super().__init__()
        self.unit = unit
        self.register_buffer("pairs", torch.zeros(0, 2, dtype=torch.int64))
        self.register_buffer("motions", torch.zeros(0, 3, 4))
        self.places = FramePlaces()

    def find(self, frame: DepthFrame, older: list[DepthFrame], poses: Float[Tensor, "image 3 4"]) -> bool:
        """Search the place of a new keyframe among older ones, those that look alike or see most of its points at the
        poses of now; True if one is found from which the path has drifted."""
        old = older[:-MIN_AGE]
        common = [frame.compared(x, motion(poses[x.index], poses[frame.index])).common for x in old]
        near = sorted(range(len(old)), key=lambda i: -common[i])[:CANDIDATES]
        beside = [old[i] for i in near if common[i] >= MIN_COMMON]
        for other in {x.index: x for x in [*beside, *self.places.alike(frame, old)]}.values():
            if drift(frame, other, poses) < DRIFTED:
                continue
            found = resected(*self.places.of(other).matched_points(self.places.of(frame)), MIN_INLIERS)
            if found is not None and frame.compared(other, found).agrees:
                pair = torch.tensor([[other.index, frame.index]]).to(self.pairs)
                self.pairs = torch.cat([self.pairs, pair])
                self.motions = torch.cat([self.motions, found[None].to(self.motions)])
                return True
        return False

    def close(
        self, frames: dict[int, DepthFrame], poses: Float[Tensor, "image 3 4"]
    ) -> Float[Tensor, "keyframe 3 4"] | None:
        """Poses of keyframes, in order, closed by all loops. None, and the latest loop is forgotten, where neighbours
        and ends of loops then fit no better than before."""
        keyframes, after = list(frames), poses.clone()
        after[keyframes] = self.closed(keyframes, poses[keyframes])
        pairs = [*pairwise(keyframes), *self.pairs.tolist()]

        def error(poses: Tensor) -> float:
            errors = [frames[b].compared(frames[a], motion(poses[a], poses[b])).error for a, b in pairs]
            return sum(min(x, MISSED) for x in errors)

        if error(after) < error(poses):
            return after[keyframes]
        self.pairs, self.motions = self.pairs[:-1], self.motions[:-1]
        return None

    def closed(self, keyframes: list[int], poses: Float[Tensor, "keyframe 3 4"]) -> Float[Tensor, "keyframe 3 4"]:
        """Poses of keyframes optimised with all loops; the first one is fixed."""
        number = {image: i for i, image in enumerate(keyframes)}
        neighbours = torch.arange(len(poses) - 1)
        loops = torch.tensor([[number[a], number[b]] for a, b in self.pairs.tolist()])
        edges = torch.cat([torch.stack([neighbours, neighbours + 1], -1), loops])
        steps = [motion(poses[i], poses[i + 1]) for i in neighbours.tolist()]
        motions = torch.cat([torch.stack(steps), self.motions.to(poses)])
        return optimised(poses.double(), edges, motions.double(), self.unit).to(poses)


def motion(first: Pose, second: Pose) -> Pose:
    """Pose of the second in the frame of the first."""
    turn, shift = relative(first, second)
    return torch.cat([turn, shift[:, None]], -1)


def drift(frame: DepthFrame, older: DepthFrame, poses: Float[Tensor, "image 3 4"]) -> float:
    """Contradiction of two frames' depth at these poses, the larger of both directions: 0 to 1. 1 if they have hardly
    a point in common."""
    ahead = frame.compared(older, motion(poses[older.index], poses[frame.index]))
    back = older.compared(frame, motion(poses[frame.index], poses[older.index]))
    return 1.0 if ahead.common < MIN_JUDGED else max(ahead.contradiction, back.contradiction)


def optimised(
    poses: Float[Tensor, "pose 3 4"], edges: Int[Tensor, "edge 2"], motions: Float[Tensor, "edge 3 4"], unit: float
) -> Float[Tensor, "pose 3 4"]:
    """Poses that minimise the robust sum over edges (i, j) of |log(Z_ij^-1 T_i^-1 T_j)|^2 over DEVIATION; the first
    stays.

    motions: Z_ij, measured pose of j in the frame of i; unit: scene units of a metre
    """
    i, j = edges.unbind(-1)
    turn, shift = motions[:, :, :3], motions[:, :, 3]

    def at(twists: np.ndarray) -> Tensor:
        moves = torch.cat([torch.zeros(1, 6).double(), torch.from_numpy(twists).view(-1, 6)])
        return apply_twists(poses, torch.cat([moves[:, :3], moves[:, 3:] * unit], -1))

    def residuals(twists: np.ndarray) -> np.ndarray:
        there = at(twists)
        back = there[i, :, :3].mT
        turned = turn.mT @ back @ there[j, :, :3]
        away = torch.einsum("eab,eb->ea", back, there[j, :, 3] - there[i, :, 3]) - shift
        parts = rotation_vector(turned) / DEVIATION[0], away / (DEVIATION[1] * unit)
        return torch.cat(parts, -1).flatten().numpy()

    known = lil_matrix((6 * len(edges), 6 * len(poses)), dtype=np.int8)
    for edge, (a, b) in enumerate(edges.tolist()):
        for end in (a, b):
            known[6 * edge : 6 * edge + 6, 6 * end : 6 * end + 6] = 1
    start = np.zeros(6 * (len(poses) - 1))
    sparsity = known[:, 6:]
    found = least_squares(residuals, start, jac_sparsity=sparsity, loss="soft_l1", x_scale=0.1, max_nfev=MAX_STEPS)
    return at(found.x)
