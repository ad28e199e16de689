"""Opening: initial camera of pages and the viewer, and limits of its movement; the subject of a capture."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.crop import Sphere
from ..datasets.scene import Frame, Vector
from ..geometry import look_at
from .automatic import UP, Surroundings, angle_of_view, camera_path

OUTWARD_FOCUS_DISTANCE = 0.02  # scene units from an outward-looking camera to its pivot, so that it turns on the spot
MIN_FOCUS_SHARE = 0.1  # of the typical distance to the focus: smallest distance of a pivot
MIN_DISTANCE, MAX_DISTANCE = 0.1, 3.0  # limits of zooming, times the first distance to the target
MAX_OPEN_DISTANCE = 1.5  # likewise, where the ground ends somewhere: from far outside it would be an island
MIN_POLAR = 2.0  # degrees between up and the direction from the target to the camera; likewise in web/src/stage.js
DEGREES_BELOW, DEGREES_BELOW_OPEN = 20.0, 5.0  # limit of the camera below the lowest photograph; for open scenes
SUBJECT_SHARE = 0.7  # radius of the subject at most, as a share of the radius that the typical photograph shows
MIN_SUBJECT_POINTS = 16  # sparse points from which on they say where the subject ends
SUBJECT_QUANTILE, SUBJECT_MARGIN = 0.95, 1.1  # quantile of the points' distances, and the factor for the radius


@dataclass(frozen=True)
class Backdrop:
    """sRGB-encoded colours overhead, at the horizon and underfoot; and the height of the floor, in scene units."""

    overhead: Vector
    horizon: Vector
    underfoot: Vector
    floor: float


@dataclass(frozen=True)
class Opening:
    """Camera, limits and colours of a page or the viewer: lengths in scene units, angles in degrees.

    background: background colour, sRGB in [0, 1]
    position, target: of the camera, and its centre of rotation, at which it looks
    angle:      of view, across the window's smaller side
    near, far:  near and far plane
    nearest, farthest: limits of the distance from the target in zooming
    lowest:     largest angle between up and the direction from the target to the camera
    inward:     whether the camera orbits the target; otherwise it turns on the spot
    within:     two corners of the box that limits the target in panning
    floor:      least height of the camera; None for any
    sky:        colours overhead and underfoot, with the background at the horizon; None for the background everywhere
    """

    title: str
    background: Vector
    position: tuple[float, ...]
    target: tuple[float, ...]
    angle: float
    near: float
    far: float
    nearest: float
    farthest: float
    lowest: float
    inward: bool
    within: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    floor: float | None = None
    sky: tuple[Vector, Vector] | None = None

    @property
    def pose(self) -> Float[np.ndarray, "3 4"]:
        """Camera-to-world pose at the beginning, upright."""
        return upright(np.array(self.position), np.array(self.target))

    @property
    def distance(self) -> float:
        """Distance from the first position to the target, in scene units."""
        return math.dist(self.position, self.target)

    def limited(
        self, position: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]
    ) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Camera position and target moved to within the limits, in the order of `Stage.stay` in web/src/stage.js.

        Unchanged within them, and where the camera turns on the spot.
        """
        if not self.inward:
            return position, target
        x, y, z = position - target
        distance = math.hypot(x, y, z)
        polar = math.degrees(math.acos(z / distance)) if distance else 0.0
        polar = math.radians(min(max(polar, MIN_POLAR), self.lowest))
        distance = min(max(distance, self.nearest), self.farthest)
        level, azimuth = distance * math.sin(polar), math.atan2(y, x)
        low, high = self.within or (target, target)
        target = np.clip(target, low, high)
        offset = np.array([level * math.cos(azimuth), level * math.sin(azimuth), distance * math.cos(polar)])
        rise = 0.0 if self.floor is None else max(0.0, self.floor - float(target[2] + offset[2]))
        target = target + np.array([0.0, 0.0, rise])
        return target + offset, target


def upright(position: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 4"]:
    """Camera-to-world pose at a position, looking at a target, without roll."""
    return look_at(torch.from_numpy(position), torch.from_numpy(target - position), UP).numpy()


def opening_of_scene(
    title: str, cameras: Camera, frame: Frame, background: Vector | None = None, behind: Backdrop | None = None
) -> Opening:
    """An opening from a typical position of the photographs, in their viewing direction.

    cameras:    of the photographs
    background: instead of the frame's
    behind:     of a scene under the open sky; its colours count where no background is given
    """
    around = Surroundings(cameras, frame)
    pose = camera_path("orbit", cameras, frame, 1, (2, 2)).pose[0].double()
    position, forward = pose[:, 3], pose[:, 2]
    target = pivot(around, position, forward)
    distance = float((position - target).norm())
    elevation = math.degrees(float(around.polar[:, 1].min()))
    alone = not frame.is_open
    low, high = (torch.tensor(corner, dtype=torch.double) for corner in frame.bounds)
    coloured = behind if background is None else None
    return Opening(
        title,
        background or (coloured.horizon if coloured else frame.background),
        tuple(position.tolist()),
        tuple(target.tolist()),
        math.degrees(angle_of_view(cameras)),
        frame.near,
        100 * frame.reach,
        MIN_DISTANCE * distance,
        (MAX_DISTANCE if alone else MAX_OPEN_DISTANCE) * distance,
        min(90 - elevation + (DEGREES_BELOW if alone else DEGREES_BELOW_OPEN), 175.0) if around.inward else 175.0,
        around.inward,
        (tuple(torch.minimum(low, target).tolist()), tuple(torch.maximum(high, target).tolist())),
        behind.floor if behind else None,
        (coloured.overhead, coloured.underfoot) if coloured else None,
    )


def pivot(around: Surroundings, position: Float[Tensor, " 3"], forward: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The point that a camera turns about, on its optical axis and in the scene's frame.

    Among photographs that look inward it is the point of the axis nearest to their focus, c + max(d . (f - c), m) d,
    where m keeps a camera that looks elsewhere from turning about a point in its own lens. Among those that look
    outward it lies OUTWARD_FOCUS_DISTANCE of the camera.

    forward: unit length
    """
    if not around.inward:
        return position + OUTWARD_FOCUS_DISTANCE * forward
    least = MIN_FOCUS_SHARE * float(around.polar[:, 2].median().exp())
    return position + max(float((around.focus - position) @ forward), least) * forward


def subject_of(around: Surroundings, points: Float[Tensor, "point 3"] | None = None) -> Sphere:
    """Sphere around the subject of a capture, in the scene's frame.

    It begins around the focus of the cameras, with SUBJECT_SHARE of what a photograph shows at that distance. The
    median of the sparse points in the inner half becomes the centre, and the points inside bound the radius. An object
    alone, and a scene whose cameras look outward, have the sphere around the box of interest.

    points: sparse points in the scene's frame
    """
    low, high = torch.tensor(around.frame.bounds, dtype=torch.double)
    centre, radius = (low + high) / 2, float((high - low).norm()) / 2
    if around.inward and around.frame.is_open:
        centre = around.focus
        shown = float(around.polar[:, 2].median().exp()) * math.tan(angle_of_view(around.cameras) / 2)
        radius = min(radius, SUBJECT_SHARE * shown)
        away = (points.double() - centre) if points is not None else centre.new_zeros(0, 3)
        inner = away[away.norm(dim=-1) < radius / 2]
        if len(inner) >= MIN_SUBJECT_POINTS:
            centre = centre + inner.median(0).values
            distance = (away + around.focus - centre).norm(dim=-1)
            filled = distance[distance < radius].quantile(SUBJECT_QUANTILE)
            radius = min(radius, SUBJECT_MARGIN * float(filled))
    x, y, z = centre.tolist()
    return Sphere((x, y, z), radius)
