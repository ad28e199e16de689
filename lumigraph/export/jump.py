"""Jump: a ring of cameras as a pair of omnidirectional stereo panoramas (Anderson et al. 2016).

For eyes r from the centre of the head, one eye's rays in all directions are tangents of a circle of radius r. Such a
ray meets the cameras' circle of radius R at the angle a with sin a = +- r / R aside, between two cameras. Their
pictures are matched, and each point is drawn at its direction for that eye.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from .. import kernels
from ..camera.lens import OmnidirectionalStereo
from ..datasets.scene import Photograph, Scene
from ..depth_maps import stereo
from ..errors import LumigraphError
from ..system.progress import track
from .options import JumpOptions
from .photo3d.layers import push_pull
from .photo3d.stitching import grid_faces

UP = torch.tensor([0.0, 0.0, 1.0])
MIN_CAMERAS = 6
OFF_CIRCLE = 0.1  # share of the radius by which a camera may be off the circle
MAX_GAP = 1.6  # of the angle between neighbours, over the usual one
EYE_SHARE = 0.25  # r / R where no distance of the eyes is given
LATITUDE = 75.0  # degrees up and down that pairs are matched in
HALF_ANGLE = 62.0  # degrees to both sides of a pair's middle that are matched
MAX_DISPARITY_SHARE = 0.3  # of a turned picture's columns
FADE_BEGIN, FADE_END = 50.0, 75.0  # degrees of latitude over which the eyes become one
FEATHER = 2.0  # degrees beyond its two cameras in which a pair still counts a little
SAME_SURFACE = 0.04  # of distance, within which surfaces are blended
STEADY_COST, STEADY_COLOUR = 2, 12  # cost of a disparity that differs from the one before, per pixel up to four; levels


@dataclass(frozen=True)
class CameraCircle:
    """Cameras on a level circle, anticlockwise seen from above.

    order: numbers of the photographs; azimuths: of the cameras, radians, rising
    """

    middle: Float[Tensor, " 3"]
    radius: float
    order: Int[Tensor, " camera"]
    azimuths: Float[Tensor, " camera"]

    @property
    def spacing(self) -> float:
        """Usual angle between neighbours, radians."""
        return 2 * math.pi / len(self.order)


@dataclass(frozen=True)
class StereoPanorama:
    """Both eyes' panoramas. seen: mask of pixels seen by a camera; the rest is filled

    nearest: distance from which on every surface is seen by both cameras that it needs, scene units
    trusted: share of the matched pixels with reliable depth
    """

    left: Float[Tensor, "height width 3"]
    right: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "2 height width"]
    seen: Bool[Tensor, "height width"]
    rig: CameraCircle
    eyes: float
    nearest: float
    trusted: float


def rig_of(scene: Scene) -> CameraCircle:
    """Circle of the training cameras. Raises LumigraphError if they are not on one, or one is missing."""
    numbers = scene.splits["train"]
    positions = scene.cameras.position[numbers]
    if len(numbers) < MIN_CAMERAS:
        raise LumigraphError(f"{scene.source} has {len(numbers)} cameras; a ring needs {MIN_CAMERAS} or more")
    middle = (positions.amax(0) + positions.amin(0)) / 2
    plane = torch.cat([2 * positions[:, :2], torch.ones(len(positions), 1)], 1)
    solved = torch.linalg.lstsq(plane, (positions[:, :2] ** 2).sum(1, keepdim=True)).solution[:, 0]
    middle = torch.cat([solved[:2], positions[:, 2].mean()[None]])
    away = positions - middle
    radius = float(away[:, :2].norm(dim=1).mean())
    off = torch.maximum((away[:, :2].norm(dim=1) - radius).abs(), away[:, 2].abs()).max()
    outward = (scene.cameras.forward[numbers] * normalize(away, dim=1)).sum(1)
    if radius == 0 or float(off) > OFF_CIRCLE * radius or float(outward.min()) < 0.7:
        raise LumigraphError(
            f"The cameras of {scene.source} are no rig: they must be on one level circle and look outward from it"
        )
    azimuths, order = torch.atan2(away[:, 1], away[:, 0]).sort()
    gaps = torch.cat([azimuths[1:], azimuths[:1] + 2 * math.pi]) - azimuths
    usual, wide = float(gaps.median()), int(gaps.argmax())
    if float(gaps[wide]) > MAX_GAP * usual:
        names = [scene.names[int(numbers[order[k % len(order)]])] for k in (wide, wide + 1)]
        raise LumigraphError(
            f"A camera is missing in {scene.source} between {names[0]} and {names[1]}: they are "
            f"{math.degrees(float(gaps[wide])):.0f} degrees apart, others {math.degrees(usual):.0f}; add its picture"
        )
    return CameraCircle(middle, radius, numbers[order], azimuths)


@torch.no_grad()
def stereo_panorama(
    scene: Scene, options: JumpOptions = JumpOptions(), before: list[Tensor] | None = None
) -> tuple[StereoPanorama, list[Tensor]]:
    """Stitch a rig's photographs of one time.

    before: what this function returned beside the panorama for the moment before, which keeps a film steady
    """
    rig = rig_of(scene)
    apart, width = options.interpupillary, options.size // 2 * 2
    radius = EYE_SHARE * rig.radius if apart is None else apart / scene.frame.to_export.scale / 2
    if radius >= rig.radius:
        raise LumigraphError("The eyes are farther apart than the cameras' circle is wide; give a smaller distance")
    photographs = [scene.photograph(int(k)) for k in rig.order]
    pairs = [RingPair.of(rig, photographs, k, width) for k in range(len(photographs))]
    gains = balanced(pairs)
    height = width // 2
    sums = torch.zeros(2, height, width, 5)  # weighted colour and distance, and weight, of the nearest surfaces
    shares, disparities = [], []
    for k, pair in enumerate(track(pairs, "Matching neighbours", len(pairs))):
        found, states = pair.match(None if before is None else before[k])
        shares.append(float(found[0].sure[pair.valid[0]].float().mean()))
        disparities.append(states)
        for side in (0, 1):
            places = pair.places(found[side].values, side)
            rgb = pair.pictures[side] * gains[(k + side) % len(pairs)]
            for eye in (0, 1):
                splat(sums[eye], pair, places, rgb, side, (2 * eye - 1) * radius, width)
    weight = sums[..., 4]
    known = weight > 0
    values = sums[..., :4] / weight.clamp_min(1e-9)[..., None]
    views = [push_pull(values[eye, ..., :3], known[eye]) for eye in (0, 1)]
    views = [torch.where(known[eye][..., None], values[eye, ..., :3], views[eye]).clamp(0, 1) for eye in (0, 1)]
    depth = torch.where(known, values[..., 3], torch.nan)
    trusted = sum(shares) / len(shares)
    nearest = nearest_distance(rig, photographs, radius, pairs[0].limit)
    seen = known[0] & known[1]
    panorama = StereoPanorama(views[0], views[1], depth, seen, rig, 2 * radius, nearest, trusted)
    return panorama, disparities


@dataclass(frozen=True)
class RingPair:
    """Two neighbours rectified to common rows: columns are angles from the plane across the baseline, rows angles
    around the baseline, so that a point has one row in both.

    rotation: to the world; x along the baseline, to the right seen from the rig; y down
    pictures, valid: of the left and the right camera
    step:     radians of a pixel
    """

    rig: CameraCircle
    number: int
    rotation: Float[Tensor, "3 3"]
    centres: Float[Tensor, "2 3"]
    pictures: tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]
    valid: tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]
    step: float

    @staticmethod
    def of(rig: CameraCircle, photographs: list[Photograph], number: int, width: int) -> RingPair:
        """Seen outward, the neighbour with the smaller azimuth is on the right. width: of the whole turn"""
        right, left = photographs[number], photographs[(number + 1) % len(photographs)]
        centres = torch.cat([left.camera.position, right.camera.position])
        x = normalize(centres[1] - centres[0], dim=0)
        down = normalize(-UP + (UP @ x) * x, dim=0)
        rotation = torch.stack([x, down, torch.linalg.cross(x, down)], 1)
        step = 2 * math.pi / width
        directions = RingPair.directions(step)
        seen = [turned(one, directions.reshape(-1, 3) @ rotation.T, directions.shape[:2]) for one in (left, right)]
        pictures, valid = zip(*seen, strict=True)
        return RingPair(rig, number, rotation, centres, pictures, valid, step)

    @staticmethod
    def directions(step: float) -> Float[Tensor, "height width 3"]:
        """Directions of the pixels in the frame of a pair."""
        columns, rows = (round(math.radians(x) / step) for x in (HALF_ANGLE, LATITUDE))
        across = (torch.arange(2 * columns) + 0.5 - columns) * step
        around = ((torch.arange(2 * rows) + 0.5 - rows) * step)[:, None]
        level = across.cos().expand(2 * rows, -1)
        return torch.stack([across.sin().expand(2 * rows, -1), level * around.sin(), level * around.cos()], -1)

    @property
    def limit(self) -> int:
        """Number of searched disparities."""
        return int(MAX_DISPARITY_SHARE * self.pictures[0].shape[1])

    def match(self, before: Tensor | None) -> tuple[list[stereo.Disparity], Tensor]:
        """Disparities of both pictures, and state for the next time. Those of the right are found in mirrored ones.

        Where the left picture is unchanged since the previous time, changes of disparity cost more.
        """
        left, right = (stereo.as_bytes(x) for x in self.pictures)
        now, count = stereo.grey(left), self.limit
        costs = kernels.census_cost(now, stereo.grey(right), *self.valid, 0, count)
        if before is not None:
            same = (now.int() - before[0].int()).abs() < STEADY_COLOUR
            apart = (torch.arange(count) - before[1][..., None]).abs().clamp(max=4)
            costs = costs + (STEADY_COST * apart * same[..., None]).to(torch.uint8)
        found = stereo.semi_global(left, right, 0, count, *self.valid, costs=costs)
        mirrored = [x.flip(1).contiguous() for x in (right, left, self.valid[1], self.valid[0])]
        its = stereo.semi_global(mirrored[0], mirrored[1], 0, count, mirrored[2], mirrored[3])
        its = stereo.Disparity(stereo.sharpened(its.values, mirrored[0], mirrored[1]).flip(1), its.sure.flip(1))
        found = stereo.Disparity(stereo.sharpened(found.values, left, right), found.sure)
        return [found, its], torch.stack([now.float(), found.values])

    def places(self, disparity: Float[Tensor, "height width"], side: int) -> Float[Tensor, "height width 3"]:
        """Points of one picture's pixels. In a row's plane, tan of the left angle less tan of the right one is the
        baseline over the distance across it."""
        directions = RingPair.directions(self.step)
        angle = torch.asin(directions[..., 0])
        shift = disparity.clamp_min(0.05) * self.step
        other = angle - shift if side == 0 else angle + shift
        apart = (angle.tan() - other.tan()) * (1 if side == 0 else -1)
        across = (self.centres[1] - self.centres[0]).norm() / apart.clamp_min(1e-6)
        return self.centres[side] + (across / angle.cos())[..., None] * directions @ self.rotation.T


def turned(
    photograph: Photograph, directions: Float[Tensor, "pixel 3"], shape: tuple[int, int] | torch.Size
) -> tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
    """Colours of a photograph in directions of the world, and a mask of directions inside it."""
    camera, (height, width) = photograph.camera, photograph.rgb.shape[:2]
    pixels, valid = camera.lens.project(directions @ camera.pose[0, :, :3])
    size = torch.tensor([width, height])
    inside = valid & ((pixels > 0.5) & (pixels < size - 0.5)).all(-1)
    at = torch.where(inside[:, None], pixels / size * 2 - 1, 0)
    rgb = grid_sample(photograph.rgb.movedim(-1, 0)[None], at[None, None], align_corners=False)[0, :, 0].T
    return torch.where(inside[:, None], rgb, 0).reshape(*shape, 3).contiguous(), inside.view(*shape)


def balanced(pairs: list[RingPair]) -> Float[Tensor, "camera 3"]:
    """Gains of the right cameras of pairs, in their order, that equalise neighbours: least squares of log ratios of
    mean colours in the overlap, with zero mean."""
    count = len(pairs)
    rows, ratios = torch.zeros(count + 1, count), torch.zeros(count + 1, 3)
    for k, pair in enumerate(pairs):
        both = pair.valid[0] & pair.valid[1]
        left, right = (picture[both].mean(0).clamp_min(1e-3) for picture in pair.pictures)
        rows[k, k], rows[k, (k + 1) % count] = 1, -1
        ratios[k] = (left / right).log()
    rows[count] = 1
    return torch.linalg.lstsq(rows, ratios).solution.exp()


def splat(
    sums: Float[Tensor, "height width 5"],
    pair: RingPair,
    places: Float[Tensor, "rows columns 3"],
    rgb: Float[Tensor, "rows columns 3"],
    side: int,
    offset: float,
    width: int,
) -> None:
    """Draw one picture's surfaces for one eye, and add them to its panorama with its camera's weight.

    The weight falls from 1, where the ray meets the cameras' circle at this camera, to 0 at its neighbours. Nearer
    surfaces replace farther ones.
    """
    rig = pair.rig
    height, spacing = width // 2, rig.spacing
    middle = float(rig.azimuths[pair.number]) + spacing / 2
    column = round(-middle / (2 * math.pi) * width)  # longitude grows to the right, azimuth to the left
    heading = -column * 2 * math.pi / width
    bend = math.asin(offset / rig.radius)
    half = math.ceil((spacing / 2 + abs(bend) + math.radians(FEATHER)) / (2 * math.pi) * width)
    forward = torch.tensor([math.cos(heading), math.sin(heading), 0.0])
    pose = torch.stack([torch.linalg.cross(-UP, forward), -UP, forward, rig.middle], 1)
    local = (places.reshape(-1, 3) - rig.middle) @ pose[:, :3]
    distance = local.norm(dim=1)
    latitude = torch.rad2deg(torch.asin((local[:, 1] / distance).clamp(-1, 1))).abs()
    fade = ((FADE_END - latitude) / (FADE_END - FADE_BEGIN)).clamp(0, 1)
    offsets = (offset * fade * fade * (3 - 2 * fade))[:, None]
    size = torch.tensor([[width, height]]).float()
    lens = OmnidirectionalStereo(
        size.expand(len(local), 2), torch.tensor([[float(half), height / 2]]).expand(len(local), 2), offset=offsets
    )
    pixels, _ = lens.project(local, torch.arange(len(local)))
    faces = grid_faces(distance.view(rgb.shape[:2]), pair.valid[side])
    across = pixels[faces][..., 0]
    faces = faces[(across.amax(1) - across.amin(1) < width / 4) & (across.amax(1) > 0) & (across.amin(1) < 2 * half)]
    corners = torch.cat([pixels * distance[:, None], distance[:, None]], 1)
    colours, depth, number = kernels.rasterize_mesh(corners, rgb.reshape(-1, 3), faces, (2 * half, height))
    # The ray of a column meets the circle aside by the bend; its share of the way between both cameras:
    longitude = (torch.arange(2 * half) + 0.5 - half) * 2 * math.pi / width
    share = (longitude + bend) / spacing + 0.5  # 0 at the left camera
    weight = 1 - share if side == 0 else share
    beyond = (share - 0.5).abs() - 0.5
    weight = weight.clamp(1e-3, 1) * (beyond < math.radians(FEATHER) / spacing) * torch.exp(-8 * beyond.clamp_min(0))
    weight = torch.where((beyond > 0), 1e-3, weight)[None] * (number >= 0)
    there = (torch.arange(2 * half) - half + column + width // 2) % width
    old = sums[:, there]
    before = old[..., 3] / old[..., 4].clamp_min(1e-9)
    fresh = (old[..., 4] == 0) | (depth < before * (1 - SAME_SURFACE)) & (weight > 0.1 * old[..., 4])
    join = ~fresh & (depth < before * (1 + SAME_SURFACE))
    values = torch.cat([colours, depth[..., None], torch.ones_like(depth)[..., None]], -1) * weight[..., None]
    drawn = (weight > 0)[..., None]
    joined = torch.where(drawn & join[..., None], old + values, old)
    sums[:, there] = torch.where(drawn & fresh[..., None], values, joined)


def nearest_distance(rig: CameraCircle, photographs: list[Photograph], radius: float, limit: int) -> float:
    """Distance from the centre beyond which both cameras see their common surfaces, within the searched disparities;
    infinity for too narrow lenses.

    Checked along the rays of both eyes, at eye level, from one camera to the next.
    """
    bend, spacing = math.asin(radius / rig.radius), rig.spacing
    cameras = [one.camera for one in photographs[:2]]
    shares = torch.linspace(0, 1, 9)
    step = math.radians(2 * HALF_ANGLE) * MAX_DISPARITY_SHARE / limit
    for distance in torch.logspace(math.log10(1.05), 3, 300) * rig.radius:
        reliable = True
        for side in (-1, 1):
            on_circle = float(rig.azimuths[0]) + shares * spacing
            gaze = on_circle + side * bend
            along = torch.stack([gaze.cos(), gaze.sin(), torch.zeros_like(gaze)], 1)
            foot = radius * side * torch.stack([gaze.sin(), -gaze.cos(), torch.zeros_like(gaze)], 1)
            places = rig.middle + foot + (distance**2 - radius**2).clamp_min(0).sqrt() * along
            for camera in cameras:
                pixels, valid = camera.project(places)
                reliable &= bool((valid & (pixels > 0).all(1) & (pixels < camera.size[0]).all(1)).all())
            rays = [normalize(places - camera.position, dim=1) for camera in cameras]
            reliable &= bool(((rays[0] * rays[1]).sum(1).clamp(-1, 1).acos() < limit * step).all())
        if reliable:
            return float(distance)
    return math.inf
