"""Stereo: disparity of a rectified pair, by semi-global matching.

A point at the left pixel (x, y) is at (x - d, y) on the right. With the baseline b, the focal length f and the offset
d0 between the columns of both principal points, its distance along the axis is z = b f / (d + d0).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from .. import kernels
from ..camera import Camera
from ..camera.lens import Pinhole
from ..errors import LumigraphError
from . import loops
from .depth_map import DepthMap
from .flat_view import GREY, FlatView
from .optical_flow import optical_flow

SLOPE_PENALTY = 16  # P1, for a change of one disparity
JUMP_PENALTY, MIN_JUMP_PENALTY = 160, 32  # P2, for any other change; at the strongest edges
JUMP_EDGE = 15.0  # grey levels: an edge over which P2 falls to 1 / e
CONSISTENT = 1.0  # pixels between the disparities of both pictures
MIN_MARGIN = 16.0  # sum of eight costs: of the next best disparity over the best, of pixels that are sure
MAX_FINE_MOVE = 0.75  # pixels by which optical flow may change a disparity
TEXTURE_WINDOW, MIN_CONTRAST = 9, 8  # pixels a side; grey levels in it, at least, of pixels that are sure
FILL_DIRECTIONS = np.array([(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1)])
FILL_DIRECTIONS = np.concatenate([FILL_DIRECTIONS, -FILL_DIRECTIONS])
FILL_PER_DIRECTION, FILL_REACH = 2, 100  # known pixels, and steps up to which they are looked for
FILL_COLOUR, FILL_DISTANCE = 60.0, 30.0  # levels, summed over channels, and steps: a weight falls to 1 / e
MAX_DISPARITIES = 512
MIN_ACROSS = math.cos(math.radians(60.0))  # sine of the angle between gaze and baseline, at least
MIN_OVERLAP = 0.1  # share of the left picture's rows and columns that both pictures must show


@dataclass(frozen=True)
class Disparity:
    """Disparity of every pixel of a left picture.

    sure: left-right consistent and unambiguous
    """

    values: Float[Tensor, "height width"]
    sure: Bool[Tensor, "height width"]


@dataclass(frozen=True)
class RectifiedPair:
    """Rectified pair: two pictures of one size whose rows are epipolar lines.

    baseline: from the left camera to the right one, scene units
    offset:   d0, pixels
    span:     near and far limit of the z search
    """

    left: FlatView
    right: FlatView
    baseline: float
    offset: float
    span: tuple[float, float]

    @property
    def disparities(self) -> tuple[int, int]:
        """Smallest disparity of the search range, and their number."""
        focal = float(self.left.intrinsics[0, 0])
        first, last = (math.floor(self.baseline * focal / z - self.offset) for z in reversed(self.span))
        return first - 1, last - first + 3

    def z(self, disparity: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
        """Distance along the axis: b f / (d + d0); infinity for points not in front."""
        shift = disparity + self.offset
        return torch.where(shift > 0, self.baseline * self.left.intrinsics[0, 0] / shift, torch.inf)

    def depth_map(self, found: Disparity, image: int) -> DepthMap:
        """Depth of the left picture, NaN for unreliable pixels. image: number of the photograph"""
        view = self.left
        height, width = view.trust.shape
        lens = Pinhole(view.intrinsics.diagonal()[None, :2], view.intrinsics[None, :2, 2])
        camera = Camera(view.pose[None], lens, torch.tensor([[width, height]]), image_index=torch.tensor([image]))
        z = self.z(found.values)
        sure = found.sure & z.isfinite()
        depth = torch.where(sure, z * view.local_rays.norm(dim=-1), torch.nan)
        return DepthMap(camera, depth, sure.float(), view.rgb, None)

    def match(self) -> Disparity:
        """Semi-global matching over the searched disparities."""
        left, right = self.left, self.right
        first, count = self.disparities
        return semi_global(as_bytes(left.rgb), as_bytes(right.rgb), first, count, left.trust > 0.5, right.trust > 0.5)


# Matching


def semi_global(
    left: UInt8[Tensor, "height width 3"],
    right: UInt8[Tensor, "height width 3"],
    first: int,
    count: int,
    left_valid: Bool[Tensor, "height width"] | None = None,
    right_valid: Bool[Tensor, "height width"] | None = None,
    costs: UInt8[Tensor, "height width disparity"] | None = None,
) -> Disparity:
    """Semi-global matching (Hirschmüller 2008): census cost, eight paths, subpixel interpolation, left-right check,
    filling.

    first, count: smallest disparity of the search range, and their number
    costs:        instead of those of `kernels.census_cost`
    """
    guide, other = grey(left), grey(right)
    everywhere = torch.ones(guide.shape, dtype=torch.bool)
    valid = everywhere if left_valid is None else left_valid
    if costs is None:
        costs = kernels.census_cost(
            guide, other, valid, everywhere if right_valid is None else right_valid, first, count
        )
    found, its, margin = kernels.semi_global(costs, guide, jump_penalties(), SLOPE_PENALTY, first)
    state = agreement(found, its)
    sure = (state == 0) & (margin >= MIN_MARGIN) & (contrast(guide) >= MIN_CONTRAST) & valid
    return Disparity(filled(found, its, state, left), sure)


def contrast(guide: UInt8[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Local contrast: grey levels between the darkest and the brightest pixel of the window around each."""
    both = torch.stack([guide, 255 - guide]).float()[None]
    for sides in ((TEXTURE_WINDOW, 1), (1, TEXTURE_WINDOW)):
        both = max_pool2d(both, sides, 1, tuple(side // 2 for side in sides))
    return both[0, 0] + both[0, 1] - 255


def sharpened(
    found: Float[Tensor, "height width"], left: UInt8[Tensor, "height width 3"], right: UInt8[Tensor, "height width 3"]
) -> Float[Tensor, "height width"]:
    """Subpixel refinement of disparity, by optical flow that starts from it.

    Pixels that move farther than MAX_FINE_MOVE keep their disparity.
    """
    start = torch.stack([-found, torch.zeros_like(found)], -1)
    moved = optical_flow(left, right, start) - start
    near = moved.abs().amax(-1) < MAX_FINE_MOVE
    return torch.where(near, found - moved[..., 0], found)


def jump_penalties() -> UInt8[Tensor, "256"]:
    """P2 for each difference of grey levels: less at edges, likely depth edges too (Hirschmüller 2008, eq. 14)."""
    return (JUMP_PENALTY * torch.exp(-torch.arange(256) / JUMP_EDGE)).clamp_min(MIN_JUMP_PENALTY).to(torch.uint8)


def agreement(
    found: Float[Tensor, "height width"], its: Float[Tensor, "height width"]
) -> UInt8[Tensor, "height width"]:
    """Left-right check: 0 for equal disparities, 1 for different ones, 2 for pixels outside the other picture."""
    width = found.shape[1]
    there = torch.arange(width) - found.round().long()
    outside = (there < 0) | (there >= width)
    apart = (its.gather(1, there.clamp(0, width - 1)) - found).abs() > CONSISTENT
    return torch.where(outside, 2, apart).to(torch.uint8)


def filled(
    found: Float[Tensor, "height width"],
    its: Float[Tensor, "height width"],
    state: UInt8[Tensor, "height width"],
    rgb: UInt8[Tensor, "height width 3"],
) -> Float[Tensor, "height width"]:
    """Fill disparity of occluded pixels: the median of the next known pixels in 16 directions, weighted by similarity
    of colour and proximity (Hirschmüller 2008, section 2.7, with weights).

    Values in front of the other picture's surface are excluded. Beyond its border the next known pixel of the row
    counts.
    """
    out = found.clone()
    given = found.numpy(), its.numpy(), state.numpy(), rgb.contiguous().numpy(), FILL_DIRECTIONS
    loops.fill_disparity(*given, FILL_PER_DIRECTION, FILL_REACH, FILL_COLOUR, FILL_DISTANCE, out.numpy())
    return out


def as_bytes(rgb: Float[Tensor, "height width 3"]) -> UInt8[Tensor, "height width 3"]:
    return (rgb.clamp(0, 1) * 255).round().to(torch.uint8)


def grey(rgb: UInt8[Tensor, "height width 3"]) -> UInt8[Tensor, "height width"]:
    return (rgb.float() @ torch.tensor(GREY)).round().to(torch.uint8)


# Rectification


def rectify(first: FlatView, second: FlatView, span: tuple[float, float], names: str) -> RectifiedPair:
    """Rectify two pictures: rotate them about their centres until the baseline is parallel to their rows (Fusiello
                          2000).

    span: near and far limit of the depth; names: both, for messages
    Raises LumigraphError for pictures from one position, for those that look along the baseline, and for too little
    overlap.
    """
    apart = second.pose[:, 3] - first.pose[:, 3]
    gaze = normalize(first.pose[:, 2] + second.pose[:, 2], dim=0)
    baseline = float(apart.norm())
    if baseline < 1e-4 * span[0]:
        raise LumigraphError(f"{names} were taken from one place, so they have no depth; choose two places")
    across = apart - (apart @ gaze) * gaze
    if float(across.norm()) < MIN_ACROSS * baseline:
        raise LumigraphError(
            f"{names} lie behind one another along their gaze, where a pair has no rows in common; choose two beside "
            "each other, or leave out --pair"
        )
    mean_up = -(first.pose[:, 1] + second.pose[:, 1])
    sideways = torch.linalg.cross(gaze, mean_up)  # to the right
    if float(across @ sideways) < 0:
        apart, first, second = -apart, second, first
    right = apart / baseline
    forward = normalize(gaze - (gaze @ right) * right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
    views = first, second
    focal = float(torch.stack([view.intrinsics[0, 0] for view in views]).mean())
    bounds = [turned_bounds(view, rotation, focal) for view in views]
    top, bottom = max(x[1] for x in bounds), min(x[3] for x in bounds)
    near_shift, far_shift = (baseline * focal / z for z in span)
    common = min(bounds[0][2] - far_shift, bounds[1][2]) - max(bounds[0][0] - near_shift, bounds[1][0])
    sides = first.trust.shape
    if bottom - top < MIN_OVERLAP * sides[0] or common < MIN_OVERLAP * sides[1]:
        raise LumigraphError(f"{names} do not overlap: too little of the scene is in both; choose neighbours")
    width = math.ceil(max(x[2] - x[0] for x in bounds))
    size = math.ceil(bottom - top), width
    left, its_right = (
        turned(view, rotation, focal, (-x[0], -top), size) for view, x in zip(views, bounds, strict=True)
    )
    pair = RectifiedPair(left, its_right, baseline, bounds[0][0] - bounds[1][0], span)
    if pair.disparities[1] > MAX_DISPARITIES:
        raise LumigraphError(
            f"{names} are too far apart for what lies near: {pair.disparities[1]} disparities, and at "
            f"most {MAX_DISPARITIES} are possible; choose neighbours, or a smaller --size"
        )
    return pair


def turned_bounds(view: FlatView, rotation: Float[Tensor, "3 3"], focal: float) -> list[float]:
    """Left, top, right and bottom of a picture after rotation, with its principal point at the origin."""
    height, width = view.trust.shape
    corners = torch.tensor([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]).float()
    rays = corners @ view.intrinsics.inverse().T @ view.pose[:, :3].T @ rotation
    if bool((rays[:, 2] < 0.05).any()):
        raise LumigraphError("Photographs of a pair look in directions too different; choose neighbours")
    places = focal * rays[:, :2] / rays[:, 2:]
    return [*places.amin(0).tolist(), *places.amax(0).tolist()]


def turned(
    view: FlatView, rotation: Float[Tensor, "3 3"], focal: float, centre: tuple[float, float], size: tuple[int, int]
) -> FlatView:
    """The picture of a camera rotated about its centre. rotation: camera-to-world; size: rows and columns"""
    intrinsics = torch.tensor([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    pose = torch.cat([rotation, view.pose[:, 3:]], 1)
    flat = FlatView(pose, intrinsics, torch.empty(*size, 3), torch.empty(size))
    pixels, depth = view.project(pose[:, 3] + flat.rays.reshape(-1, 3))
    height, width = view.trust.shape
    at = pixels / torch.tensor([width, height]) * 2 - 1
    at = torch.where(depth[:, None] > 0, at, -4).view(1, *size, 2)
    known = torch.cat([view.rgb * view.trust[..., None], view.trust[..., None]], -1).movedim(-1, 0)[None]
    rgb, trust = torch.nn.functional.grid_sample(known, at, align_corners=False)[0].split([3, 1])
    rgb = (rgb / trust.clamp_min(1e-6)).movedim(0, -1)
    return FlatView(pose, intrinsics, rgb.contiguous(), trust[0].contiguous())
