"""Automatic camera paths. They stay close to the photographs' cameras, so that only observed parts are shown.

Cameras that look at a subject are described relative to it: azimuth, elevation and distance. Photographs from all
around give a full circle; those from one side a sway. Cameras that look outward give a turn on the spot. All paths but
`held_out` are closed or end smoothly.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Pinhole
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..geometry import look_at, nearest_to_lines, unit

Poses = Float[Tensor, "frame 3 4"]

FULL_CIRCLE = math.radians(260)  # of azimuth that must be covered for a path to go all the way round
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.double)  # scenes are upright
SHARPNESS = 4.0  # of the weights with which nearby cameras set a path's height and distance (von Mises)
MAX_DEVIATIONS = 4.0  # median deviations of log distance beyond which a camera does not count
FRAMES_PER_KEY = 6  # interpolated frames between two photographs, at least
MAX_DEGREES, MIN_DEGREES = 75.0, 20.0  # degrees, of a film's smaller angle of view
FACING_COSINE = 0.5  # cosine of the angle to the focus up to which a camera looks at it
ALIKE_GAZE_LENGTH = 0.9  # length of the mean of all gazes above which cameras look the same way
SWEEP_SHARE = 0.7  # of what the middle two thirds of the cameras span, how far a sweep goes
MIN_FACING_SHARE = 0.4  # of the cameras that must look at the focus; gazes in all directions give a quarter to a third


def camera_path(kind: str, cameras: Camera, frame: Frame, frames: int, size: tuple[int, int]) -> Camera:
    """Cameras of a film: one for each frame, with a pinhole lens.

    kind:    one of `PATHS`
    cameras: of the photographs
    size:    (width, height) of the film
    """
    if frames < 1:
        raise LumigraphError(f"A film cannot have {frames} frames; give --frames a number above 0")
    poses = PATHS[kind](Surroundings(cameras, frame), frames)
    focal = 0.5 * min(size) / math.tan(0.5 * angle_of_view(cameras))
    lens = Pinhole(torch.full((frames, 2), focal), torch.tensor([size]).expand(frames, 2) / 2)
    return Camera(poses.float(), lens, torch.tensor([size]).expand(frames, 2))


def film_size(camera: Camera, longest: int) -> tuple[int, int]:
    """Even (width, height) in the shape of the first camera's picture, the longer side as given."""
    width, height = camera.size[0].tolist()
    scale = longest / max(width, height)
    return max(2, round(width * scale / 2) * 2), max(2, round(height * scale / 2) * 2)


def angle_of_view(cameras: Camera) -> float:
    """Median angle of view across the smaller side, radians, limited to that of a pinhole."""
    angles = []
    for camera in (cameras[i] for i in range(0, len(cameras), max(1, len(cameras) // 16))):
        width, height = camera.size[0].tolist()
        x, y = (width / 2, 0.0) if height <= width else (0.0, height / 2)  # the middle of an edge, and of the other
        a, b = camera.lens.unproject(torch.tensor([[x, y], [width - x, height - y]]))
        angles.append(torch.acos((a @ b).clamp(-1, 1)).item())
    return min(max(sorted(angles)[len(angles) // 2], math.radians(MIN_DEGREES)), math.radians(MAX_DEGREES))


@dataclass(frozen=True)
class Surroundings:
    """Positions and directions of cameras relative to their common focus."""

    cameras: Camera
    frame: Frame

    @cached_property
    def position(self) -> Float[Tensor, "camera 3"]:
        return self.cameras.position.double().cpu()

    @cached_property
    def forward(self) -> Float[Tensor, "camera 3"]:
        return self.cameras.forward.double().cpu()

    @cached_property
    def focus(self) -> Float[Tensor, " 3"]:
        """Point nearest to all optical axes; where undetermined, nearest to the centre of the bounds."""
        middle = torch.tensor(self.frame.bounds, dtype=torch.double).mean(0)
        return nearest_to_lines(self.position, self.forward, middle)

    @cached_property
    def cosine(self) -> Float[Tensor, " camera"]:
        """Cosine of the angle between each camera's viewing direction and the focus."""
        return (unit(self.focus - self.position) * self.forward).sum(-1)

    @cached_property
    def middle(self) -> int:
        """Number of the camera nearest to the mean of all: its position is certainly free."""
        return int((self.position - self.position.median(0).values).norm(dim=-1).argmin())

    @cached_property
    def axes(self) -> Float[Tensor, "3 3"]:
        """Rows: towards azimuth 0, towards azimuth 90 degrees, up. Azimuth 0 is the cameras' mean direction."""
        towards = self._offset.mean(0)
        level = torch.stack([towards[0], towards[1], torch.zeros((), dtype=torch.double)])
        first = unit(level) if level.norm() > 1e-6 else torch.tensor([1.0, 0.0, 0.0], dtype=torch.double)
        return torch.stack([first, torch.linalg.cross(UP, first), UP])

    @cached_property
    def inward(self) -> bool:
        """True if most cameras look at a point between them. Some may look elsewhere: photographs of a courtyard may
        show both its fountain and its walls."""
        return float((self.cosine > FACING_COSINE).double().mean()) > MIN_FACING_SHARE

    @property
    def alike(self) -> bool:
        """True for cameras with about the same direction: at a front, or down from a drone."""
        return float(self.forward.mean(0).norm()) > ALIKE_GAZE_LENGTH

    @cached_property
    def _offset(self) -> Float[Tensor, "camera 3"]:
        """From the focus to each camera that looks at it; of cameras that look outward, their directions."""
        return (self.position - self.focus)[self.cosine > FACING_COSINE] if self.inward else self.forward

    @cached_property
    def polar(self) -> Float[Tensor, "camera 3"]:
        """Azimuth, elevation and log distance about the focus of each camera that looks at it; of the directions of
        all, if they look outward."""
        x, y, z = (self._offset @ self.axes.T).unbind(-1)
        distance = self._offset.norm(dim=-1).clamp_min(1e-9)
        return torch.stack([torch.atan2(y, x), torch.asin((z / distance).clamp(-1, 1)), distance.log()], -1)

    @cached_property
    def arc(self) -> tuple[float, float]:
        """Middle and half-width of the azimuths that cameras cover; half-width pi means all round."""
        azimuth = self.polar[:, 0].sort().values
        following = torch.cat([azimuth[1:], azimuth[:1] + 2 * math.pi])
        gap, at = (following - azimuth).max(0)
        covered = 2 * math.pi - float(gap)
        if covered > FULL_CIRCLE:
            return 0.0, math.pi
        return float(following[at]) + covered / 2, covered / 2

    def typical(self, azimuth: Float[Tensor, " frame"]) -> tuple[Tensor, Tensor]:
        """Elevation and log distance of the cameras near each azimuth."""
        away = (self.polar[:, 2] - self.polar[:, 2].median()).abs()
        ordinary = away <= MAX_DEVIATIONS * away.median() + 0.1
        near = ordinary * torch.exp(SHARPNESS * (torch.cos(azimuth[:, None] - self.polar[:, 0]) - 1)) + 1e-9
        near = near / near.sum(-1, keepdim=True)
        return near @ self.polar[:, 1], near @ self.polar[:, 2]

    def spread(self, column: int) -> float:
        """Half the range of the middle two thirds of the cameras."""
        low, high = torch.quantile(self.polar[:, column], torch.tensor([1 / 6, 5 / 6], dtype=torch.double)).tolist()
        return (high - low) / 2

    def poses(self, azimuth: Tensor, elevation: Tensor, log_distance: Tensor) -> Poses:
        """Poses at these positions, looking at the focus; for outward cameras, directions at the middle camera's
        position."""
        elevation = elevation.clamp(math.radians(-85), math.radians(85))
        level = elevation.cos()
        outward = torch.stack([level * azimuth.cos(), level * azimuth.sin(), elevation.sin()], -1) @ self.axes
        if self.inward:
            return look_at(self.focus + log_distance.exp()[:, None] * outward, -outward, UP)
        return look_at(self.position[self.middle].expand(len(outward), 3), outward, UP)


def orbit(around: Surroundings, frames: int) -> Poses:
    """Once around at the cameras' height and distance, or to and fro along their arc."""
    angle = turn(frames)
    middle, half = around.arc
    if half == math.pi:
        return around.poses(angle, *around.typical(angle))
    azimuth = middle + 0.8 * half * angle.sin()
    elevation, log_distance = around.typical(azimuth)
    return around.poses(azimuth, elevation + 0.5 * around.spread(1) * angle.cos(), log_distance)


def spiral(around: Surroundings, frames: int) -> Poses:
    """Twice around, rising and sinking; for a scene seen from one side, loops with varying distance."""
    angle = turn(frames)
    middle, half = around.arc
    if half == math.pi:
        elevation, log_distance = around.typical(2 * angle)
        return around.poses(2 * angle, elevation - around.spread(1) * angle.cos(), log_distance)
    azimuth = middle + 0.6 * half * (2 * angle).sin()
    elevation, log_distance = around.typical(azimuth)
    elevation = elevation + 0.8 * around.spread(1) * (2 * angle).cos()
    return around.poses(azimuth, elevation, log_distance - max(around.spread(2), 0.1) * (1 - angle.cos()) / 2)


def interpolate(around: Surroundings, frames: int) -> Poses:
    """Smooth interpolation through photographs, at constant speed."""
    keys = key_order(around, max(2, frames // FRAMES_PER_KEY))
    position, forward = around.position[keys], around.forward[keys]
    up = -around.cameras.pose[:, :, 1].double().cpu()[keys]
    scale = (position - around.focus).norm(dim=-1).median().clamp_min(1e-6)
    knots = torch.cat([position / scale, 0.5 * forward, 0.5 * up], -1)  # one curve through all, turning with its moving
    if len(keys) < 2:
        return around.cameras.pose[keys].double().cpu().expand(frames, 3, 4)
    fine = catmull_rom(knots, torch.linspace(0, len(keys) - 1, 64 * len(keys), dtype=torch.double))
    length = torch.cat([torch.zeros(1), fine.diff(dim=0).norm(dim=-1).cumsum(0)])
    wanted = torch.linspace(0, 1, frames, dtype=torch.double) * length[-1]
    after = torch.searchsorted(length, wanted).clamp(1, len(length) - 1)
    share = (wanted - length[after - 1]) / (length[after] - length[after - 1]).clamp_min(1e-12)
    curve = torch.lerp(fine[after - 1], fine[after], share[:, None])
    return look_at(curve[:, :3] * scale, curve[:, 3:6], curve[:, 6:])


def sweep(around: Surroundings, frames: int) -> Poses:
    """An ellipse among parallel cameras, with directions of nearby ones."""
    angle, gaze = turn(frames), unit(around.forward.mean(0))
    up = -around.cameras.pose[around.middle, :, 1].double().cpu()
    down_picture = unit(up - (up @ gaze) * gaze)
    flat = torch.stack([torch.linalg.cross(gaze, down_picture), down_picture])
    offset = around.position - around.position.median(0).values
    places = offset @ flat.T
    axes = torch.linalg.eigh(places.T @ places).eigenvectors
    low, high = torch.quantile(places @ axes, torch.tensor([1 / 6, 5 / 6], dtype=torch.double), dim=0)
    oval = torch.stack([angle.cos(), angle.sin()], -1) * SWEEP_SHARE * (high - low) / 2 + (low + high) / 2
    wide = (high - low).norm().clamp_min(1e-9) / 4
    near = torch.exp(-torch.cdist(oval, places @ axes).square() / (2 * wide**2)) + 1e-9
    near = near / near.sum(-1, keepdim=True)
    ahead = near @ (offset @ gaze)
    position = around.position.median(0).values + (oval @ axes.T) @ flat + ahead[:, None] * gaze
    return look_at(position, unit(near @ around.forward), up)


def still(around: Surroundings, frames: int) -> Poses:
    """The fixed camera of the central photograph, for dynamic scenes."""
    return around.cameras.pose[around.middle].double().cpu().expand(frames, 3, 4)


def fitting(cameras: Camera, frame: Frame) -> str:
    """Path of `PATHS` for a capture: a sweep for parallel cameras, else an orbit."""
    return "sweep" if Surroundings(cameras, frame).alike else "orbit"


PATHS: dict[str, Callable[[Surroundings, int], Poses]] = {
    "orbit": orbit,
    "sweep": sweep,
    "spiral": spiral,
    "interpolate": interpolate,
    "still": still,
}


def turn(frames: int) -> Float[Tensor, " frame"]:
    """Angles once around; the frame after the last would be the first."""
    return torch.arange(frames, dtype=torch.double) * (2 * math.pi / frames)


def key_order(around: Surroundings, count: int) -> Int[Tensor, " key"]:
    """Photographs to interpolate: in their order if that is a walk, otherwise by a short tour of a few."""
    position = around.position
    hop = (position[1:] - position[:-1]).norm(dim=-1)
    distances = torch.cdist(position, position) + torch.cdist(around.forward, around.forward) * position.std()
    nearest = (distances + torch.eye(len(position)) * 1e9).min(-1).values
    count = min(count, len(position))
    if len(position) < 3 or hop.median() <= 3 * nearest.median():
        return torch.linspace(0, len(position) - 1, count).round().long()
    chosen = [0]  # farthest first, so that few keys cover all
    away = distances[0].clone()
    for _ in range(count - 1):
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, distances[chosen[-1]])
    return torch.tensor(tour(chosen, distances.tolist()))


def tour(places: list[int], distances: list[list[float]]) -> list[int]:
    """Short tour through all positions: nearest neighbour, then 2-opt."""
    way, left = [places[0]], set(places[1:])
    while left:
        way.append(min(left, key=lambda place: distances[way[-1]][place]))
        left.remove(way[-1])
    improved = True
    while improved:
        improved = False
        for i in range(len(way) - 2):
            for j in range(i + 2, len(way)):
                before = distances[way[i]][way[i + 1]] + (distances[way[j]][way[j + 1]] if j + 1 < len(way) else 0)
                after = distances[way[i]][way[j]] + (distances[way[i + 1]][way[j + 1]] if j + 1 < len(way) else 0)
                if after < before - 1e-9:
                    way[i + 1 : j + 1] = reversed(way[i + 1 : j + 1])
                    improved = True
    return way


def catmull_rom(knots: Float[Tensor, "key value"], at: Float[Tensor, " point"]) -> Float[Tensor, "point value"]:
    """Catmull-Rom curve through knots 0, 1, 2, ... (Catmull & Rom 1974)."""
    padded = torch.cat([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    i = at.long().clamp(max=len(knots) - 2)
    t = (at - i)[:, None]
    a, b, c, d = (padded[i + k] for k in range(4))
    return 0.5 * (2 * b + t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))))
