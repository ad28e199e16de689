"""Normalisation: the similarity that maps a capture's box of interest into [-1, 1]^3, the reach of the rest, and the
near plane of forward-facing cameras.

By order of preference it uses the source's own bounds, silhouettes of an object, and sparse points with the cameras'
viewing directions. Nothing here depends on the program that found the poses, nor on a user's numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..datasets.images import ImageStore
from ..datasets.scene import Forward, Frame, Vector
from ..geometry import evenly
from .capture import Capture, Shot
from .hull import hull_box, silhouettes
from .up import find_upright, upright_by

BOX_MARGIN = 1.01  # factor around an object whose bounds are known exactly
MAX_REACH = 64  # half-size of the largest cube, in scene units
DEFAULT_REACH = 16.0  # of a capture without points
REACH_QUANTILE = 0.99  # share of observations that the reach must contain
MIN_CONVERGENCE = 0.02  # mean squared sine between optical axes from which on their meeting point is known: 8 degrees
BOX_SHARE = 0.5  # of the distance from which things are looked at: half-size of the box of interest
MIN_MEAN_DIRECTION = 0.5  # length of the mean viewing direction; below it cameras look around themselves
NEAR_SCALE = 0.4  # rays begin at this share of the distance to the nearest visible point
MIN_NEAR = 1e-3
INDOOR_NEAR = 0.02  # of the half-size: near distance for cameras inside a box, without other evidence
ZERO_EXTENT = 1e-9  # units of the source that count as zero
SAMPLED_POINTS, SAMPLED_CAMERAS = 5000, 64
MIN_AXIS_COSINE = math.cos(math.radians(30))  # of the angle between a camera's axis and the mean camera's
MAX_TANGENT = math.tan(math.radians(70))  # of the angle between a viewing ray and the mean camera's axis
MAX_MAGNIFICATION = 2.0  # relative to infinity: a plane just before the cameras must not squeeze the background
BORDER_POINTS = tuple((x, y) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0))  # of a picture, and its centre
NEAR_PLANE_SCALE = 0.75  # times the distance from the mean camera to the nearest point, as in LLFF
OUTLIER_SHARE = 0.005  # of the sparse points may lie nearer


@dataclass(frozen=True)
class ScenePlacement:
    """The similarity x_scene = M x_source, and the geometric fields of the scene's frame."""

    scene_from_source: Float[np.ndarray, "4 4"]
    frame: Frame


UNIT_CUBE: tuple[Vector, Vector] = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
BLACK_COLOUR: Vector = (0.0, 0.0, 0.0)
WHITE_COLOUR: Vector = (1.0, 1.0, 1.0)


def find_place(
    capture: Capture,
    cameras: Camera,
    images: ImageStore,
    views: list[int],
    upright: Float[np.ndarray, "3 3"] | None = None,
) -> ScenePlacement:
    """Placement of the capture.

    cameras: in the source's frame
    views:   images that may be used, not held out
    upright: the rotation to +z up; None to estimate it
    """
    background = capture.background or (WHITE_COLOUR if images.has_alpha else BLACK_COLOUR)
    if capture.bounds is not None:
        return stated_place(capture, cameras, background)
    upright = upright_of(capture, cameras) if upright is None else upright
    turned = cameras.transformed(torch.from_numpy(similarity(upright, np.zeros(3), 1.0)))
    if capture.around is not None:
        return part_place(capture, turned, upright, background)
    gaze = find_gaze(capture, turned, upright)
    found = silhouettes(turned, images, views, gaze.centre)
    moves = cameras.time is not None and len(cameras.time.unique()) > 1
    box = None if found is None else hull_box(found[0], gaze.centre, gaze.distance, moves)
    if found is None or box is None:
        return open_place(capture, images, upright, gaze, background)
    return object_place(upright, box, turned, capture.background or found[1])


def upright_of(capture: Capture, cameras: Camera) -> Float[np.ndarray, "3 3"]:
    """The rotation of a capture's frame to +z up: the identity where it has bounds, which are upright."""
    if capture.bounds is not None:
        return np.eye(3)
    if capture.up is not None:
        return upright_by(np.array(capture.up))
    cloud = reliable_points(capture, np.eye(3))
    return find_upright(cameras, None if cloud is None else cloud.points)


def part_place(capture: Capture, cameras: Camera, upright: np.ndarray, background: Vector) -> ScenePlacement:
    """Placement of a part of a larger capture: a cube around its centre, and cubes around it as far as the points go.

    cameras: in the upright frame
    """
    assert capture.around is not None
    centre, half = upright @ np.array(capture.around[0]), capture.around[1]
    cloud = reliable_points(capture, upright)
    depths = None if cloud is None else visible_depths(cameras, cloud)
    near = INDOOR_NEAR * half if depths is None else NEAR_SCALE * float(np.nanpercentile(depths[:, 0], 2))
    reach = DEFAULT_REACH
    if capture.reach is not None:
        reach = power_of_two(capture.reach / half)
    elif cloud is not None:
        reach = power_of_two(quantile(np.abs(cloud.points - centre).max(-1), cloud.weights, REACH_QUANTILE) / half)
    near = near if capture.near is None else capture.near
    frame = Frame(UNIT_CUBE, max(2.0, reach), max(near / half, MIN_NEAR), background)
    return ScenePlacement(similarity(upright, centre, half), frame)


def stated_place(capture: Capture, cameras: Camera, background: Vector) -> ScenePlacement:
    """Placement by the source's bounds, and its reach and near if it has them."""
    assert capture.bounds is not None
    low, high = np.array(capture.bounds, np.float64)
    centre, half = 0.5 * (low + high), 0.5 * float((high - low).max())
    bounds = box_in_scene(low, high, centre, half)
    reach = 1.0 if capture.reach is None else power_of_two(capture.reach / half)
    near = nearest_to_box(cameras, low, high) if capture.near is None else capture.near
    frame = Frame(bounds, reach, max(near / half, MIN_NEAR), background)
    return ScenePlacement(similarity(np.eye(3), centre, half), frame)


def object_place(
    upright: np.ndarray, box: tuple[np.ndarray, np.ndarray], cameras: Camera, background: Vector
) -> ScenePlacement:
    """Placement of a single object: its box fills the scene."""
    low, high = box
    centre, half = 0.5 * (low + high), 0.5 * BOX_MARGIN * float((high - low).max())
    low, high = centre - 0.5 * BOX_MARGIN * (high - low), centre + 0.5 * BOX_MARGIN * (high - low)
    near = max(nearest_to_box(cameras, low, high) / half, MIN_NEAR)
    frame = Frame(box_in_scene(low, high, centre, half), 1.0, near, background)
    return ScenePlacement(similarity(upright, centre, half), frame)


def nearest_to_box(cameras: Camera, low: np.ndarray, high: np.ndarray) -> float:
    """Half the distance from the nearest camera to a box; for cameras inside it, a hundredth of its size."""
    position = cameras.position.double().numpy()
    away = np.linalg.norm(np.maximum(0, np.maximum(low - position, position - high)), axis=-1).min()
    return max(0.5 * away, 0.01 * float((high - low).max()))


@dataclass(frozen=True)
class WeightedPoints:
    """Sparse points in the upright frame, and their numbers of sightings."""

    points: Float[np.ndarray, "point 3"]
    weights: Float[np.ndarray, " point"]


@dataclass(frozen=True)
class Gaze:
    """Point and region that the cameras look at, in the upright frame.

    centre:     of the region
    distance:   typical, from the cameras
    half:       half-size of the box of interest
    nearest:    least depth of any camera's view
    cloud:      sparse points, if any
    """

    centre: Float[np.ndarray, " 3"]
    distance: float
    half: float
    nearest: float
    cloud: WeightedPoints | None


def find_gaze(capture: Capture, cameras: Camera, upright: np.ndarray) -> Gaze:
    position, forward = cameras.position.double().numpy(), cameras.forward.double().numpy()
    cloud = reliable_points(capture, upright)
    meeting, converging = where_axes_meet(position, forward)
    depths = None if cloud is None else visible_depths(cameras, cloud)
    if depths is not None:
        middle, nearest = (np.nanmedian(depths[:, 1]), np.nanpercentile(depths[:, 0], 2))
    elif all(shot.depths is not None for shot in capture.shots):
        stated = np.array([shot.depths for shot in capture.shots])
        middle, nearest = np.median(2 / (1 / stated).sum(-1)), stated[:, 0].min()
    else:
        away = np.linalg.norm(position - meeting, axis=-1) if converging else None
        spread = np.linalg.norm(position - position.mean(0), axis=-1).mean()
        middle = np.median(away) if away is not None else 3 * spread if spread > ZERO_EXTENT else 1.0
        nearest = 0.25 * (away.min() if away is not None else middle)
    if converging:
        centre, distance = meeting, float(np.median(np.linalg.norm(position - meeting, axis=-1)))
    else:
        centre, distance = (position + middle * forward).mean(0), float(middle)
    around = not converging and np.linalg.norm(forward.mean(0)) < MIN_MEAN_DIRECTION
    half = distance if around else BOX_SHARE * distance  # from inside, all that is seen lies at that distance
    return Gaze(centre, distance, half, float(nearest), cloud)


def open_place(
    capture: Capture, images: ImageStore, upright: np.ndarray, gaze: Gaze, background: Vector
) -> ScenePlacement:
    """Placement of an unbounded capture: a box around the point of interest, and cubes around it as far as the points
    go.

    The reach of an object alone is used only where masks may remove its surroundings.
    """
    centre, half = gaze.centre, gaze.half
    reach = DEFAULT_REACH
    if gaze.cloud is not None:
        centre, half = settle(gaze.cloud, centre, half)
        radius = np.abs(gaze.cloud.points - centre).max(-1)
        reach = power_of_two(quantile(radius, gaze.cloud.weights, REACH_QUANTILE) / half)
    elif all(shot.depths is not None for shot in capture.shots):
        farthest = max(shot.depths[1] for shot in capture.shots if shot.depths is not None)
        reach = power_of_two((farthest + gaze.distance) / half)
    if capture.reach is not None and (images.may_have_masks or capture.reach > half):
        reach = power_of_two(capture.reach / half)
    near = NEAR_SCALE * gaze.nearest if capture.near is None else capture.near
    frame = Frame(UNIT_CUBE, reach, max(near / half, MIN_NEAR), background)
    return ScenePlacement(similarity(upright, centre, half), frame)


def settle(cloud: WeightedPoints, centre: np.ndarray, half: float) -> tuple[np.ndarray, float]:
    """Move a box to the mean of the points inside it, and shrink it to them."""
    points, weights = cloud.points, cloud.weights
    inside = np.abs(points - centre).max(-1) < half
    for _ in range(5):
        if weights[inside].sum() < 0.05 * weights.sum():
            return centre, half  # the points say little about what is looked at
        centre = np.array([quantile(points[inside, k], weights[inside], 0.5) for k in range(3)])
        inside = np.abs(points - centre).max(-1) < half
    filled = quantile(np.abs(points[inside] - centre).max(-1), weights[inside], 0.95)
    return centre, min(half, 1.1 * filled) if filled > ZERO_EXTENT else half


def reliable_points(capture: Capture, upright: np.ndarray) -> WeightedPoints | None:
    """Finite points with at least two sightings; None if they are few."""
    if capture.points is None:
        return None
    sightings = np.full(len(capture.points), 2) if capture.sightings is None else capture.sightings
    keep = np.isfinite(capture.points).all(-1) & (sightings >= 2)
    if keep.sum() < 16:
        return None
    return WeightedPoints(capture.points[keep] @ upright.T, sightings[keep].astype(np.float64))


def visible_depths(cameras: Camera, cloud: WeightedPoints) -> Float[np.ndarray, "camera 2"] | None:
    """Near (2nd percentile) and median distance of the points in each picture. NaN without points, None if all are."""
    chosen = evenly(range(len(cloud.points)), SAMPLED_POINTS)
    points, weights = cloud.points[chosen], cloud.weights[chosen]
    sampled = torch.from_numpy(points).float()
    depths = []
    for i in evenly(range(len(cameras)), SAMPLED_CAMERAS):
        camera = cameras[i]
        inside = camera.locate(sampled)[1].numpy()
        away = np.linalg.norm(points[inside] - camera.position[0].numpy(), axis=-1)
        depths.append([quantile(away, weights[inside], q) if inside.any() else math.nan for q in (0.02, 0.5)])
    return None if np.isnan(depths).all() else np.array(depths)


def where_axes_meet(position: np.ndarray, forward: np.ndarray) -> tuple[np.ndarray, bool]:
    """Least-squares intersection of all optical axes, and whether it is reliable: in front, at an angle."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None]
    if np.linalg.eigvalsh(across.mean(0))[0] < MIN_CONVERGENCE:
        return position.mean(0), False
    meeting = np.linalg.solve(across.sum(0), (across @ position[:, :, None]).sum(0))[:, 0]
    in_front = ((meeting - position) * forward).sum(-1) > ZERO_EXTENT
    return meeting, bool(in_front.mean() > 0.8)


def similarity(upright: np.ndarray, centre: np.ndarray, half: float) -> Float[np.ndarray, "4 4"]:
    """Similarity: rotate upright, then map a centre to the origin and a half-size to 1."""
    matrix = np.eye(4)
    matrix[:3, :3] = upright / half
    matrix[:3, 3] = -np.asarray(centre) / half
    return matrix


def box_in_scene(low: np.ndarray, high: np.ndarray, centre: np.ndarray, half: float) -> tuple[Vector, Vector]:
    corners = np.clip((np.stack([low, high]) - centre) / half, -1, 1)
    return tuple(corners[0].tolist()), tuple(corners[1].tolist())


def power_of_two(value: float) -> float:
    """The smallest power of two that is at least `value`, from 1 to 64."""
    return float(min(2 ** max(0, math.ceil(math.log2(max(value, 1e-9)) - 1e-6)), MAX_REACH))


def quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Weighted quantile."""
    order = np.argsort(values)
    return float(
        values[order][np.searchsorted(np.cumsum(weights[order]), share * weights.sum()).clip(max=len(values) - 1)]
    )


def find_forward(
    capture: Capture, shots: list[Shot], cameras: Camera, scene_from_source: Float[np.ndarray, "4 4"], near: float
) -> Forward | None:
    """Frame of a forward-facing unbounded capture; None if its cameras do not all look one way.

    shots, cameras: training ones; cameras in the scene's frame
    near:           near distance of every camera, in scene units
    Condition: each camera looks within 30 degrees of the mean camera, and a plane across its axis is in front of all
    cameras and nearer than everything they see.
    """
    pose = mean_pose(cameras)
    if float((cameras.forward.double() @ pose[:, 2]).min()) < MIN_AXIS_COSINE:
        return None
    standing = (cameras.position.double() - pose[:, 3]) @ pose[:, 2]
    unit = float(np.cbrt(np.linalg.det(scene_from_source[:3, :3])))
    stated = [shot.depths[0] * unit for shot in shots if shot.depths is not None]
    cloud = reliable_points(capture, np.eye(3))
    if len(stated) == len(shots):
        nearest = float((standing + torch.tensor(stated)).min())
    elif cloud is not None:
        points = torch.from_numpy(cloud.points @ scene_from_source[:3, :3].T + scene_from_source[:3, 3])
        nearest = float(((points - pose[:, 3]) @ pose[:, 2]).quantile(OUTLIER_SHARE))
    else:
        nearest = float(standing.min()) + near
    foremost = float(standing.max())
    if nearest <= foremost:
        return None
    plane = max(NEAR_PLANE_SCALE * nearest, foremost)
    scale = fitting_scale(cameras, pose, plane)
    rows = tuple((a, b, c, d) for a, b, c, d in pose.tolist())
    return None if scale is None else Forward(rows, scale, plane)


def mean_pose(cameras: Camera) -> Float[Tensor, "3 4"]:
    """The mean position, and the rotation nearest to all (the chordal mean)."""
    mean = cameras.pose.double().mean(0)
    u, _, vt = torch.linalg.svd(mean[:, :3])
    proper = torch.tensor([1, 1, torch.linalg.det(u @ vt)], dtype=torch.float64)
    return torch.cat([u * proper @ vt, mean[:, 3:]], 1)


def fitting_scale(cameras: Camera, pose: Float[Tensor, "3 4"], plane: float) -> tuple[float, float] | None:
    """Factors on x / z and y / z in the mean camera that bring everything visible beyond the plane into [-1, 1]; None
    for too wide lenses.

    Mildenhall 2020 takes the focal lengths over half the picture. Cameras beside the mean one then see points beyond 1,
    which alias in a positional encoding.
    """
    count = len(BORDER_POINTS) * len(cameras)
    pixels = (torch.tensor(BORDER_POINTS) * cameras.size[:, None]).reshape(count, 2)
    rays = cameras.rays(pixels, torch.arange(len(cameras)).repeat_interleave(len(BORDER_POINTS)))
    origins, directions = (rays.origins - pose[:, 3]) @ pose[:, :3], rays.directions.double() @ pose[:, :3]
    if float(directions[:, 2].min()) <= 0:
        return None
    at_infinity = directions[:, :2] / directions[:, 2:]
    at_plane = (origins[:, :2] + at_infinity * (plane - origins[:, 2:])) / plane
    far, near = (x.abs().amax(0) for x in (at_infinity, at_plane))
    width, height = near.clamp(far, MAX_MAGNIFICATION * far).tolist()
    return None if float(far.max()) > MAX_TANGENT else (1 / width, 1 / height)
