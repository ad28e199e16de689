"""User-made camera paths: a few keyframes with times, and a smooth flight through them.

Keyframes are in the frame of the photographs' source, so that one path fits every run of a capture. Between them
position, log angle of view and quaternion follow one Catmull-Rom curve with the keyframes' times as knots: it passes
each keyframe at its time, velocity is continuous, and it stops between two equal keyframes.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Lens, Pinhole
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..files import read_json, write_json
from ..files.ranges import Coordinate, Row, Side, between, typed
from ..files.reading import reads
from ..geometry import RIGID_TOLERANCE, is_similarity, to_matrix, to_quaternion

FORMAT = "lumigraph camera path 1"
MIN_DEGREES, MAX_DEGREES = 1.0, 170.0  # degrees that a flat picture can show
MAX_FRAMES = 100_000  # frames of a film
Fps = Annotated[float, between(1e-3, 1000)]


@dataclass(frozen=True)
class Keyframe:
    """Camera pose and field of view at one moment of a path.

    pose:    camera-to-world in the source's frame; +x right, +y down, +z forward
    fov:     degrees across the picture's smaller side
    seconds: from the beginning of the film
    time:    rendered moment of a moving scene; `None` leaves it to the method
    """

    pose: tuple[Row, Row, Row]
    fov: float
    seconds: Coordinate
    time: Coordinate | None = None


@dataclass(frozen=True)
class FilmRecord:
    """Cameras in the JSON beside a film, see `export.film`."""

    poses: list[tuple[Row, Row, Row]]
    lens: dict[str, Any]
    size: tuple[Side, Side]
    source_from_scene: tuple[Row, ...]
    fps: Fps
    times: list[Coordinate] | None = None


@dataclass(frozen=True)
class CameraPath:
    """Keyframes in the order of their times. Raises LumigraphError for an invalid path.

    loop: whether the path returns from the last keyframe to the first, in the mean time between two keyframes
    fps:  frames per second of the film
    """

    keyframes: tuple[Keyframe, ...]
    loop: bool = False
    fps: Fps = 30.0

    def __post_init__(self) -> None:
        if not self.keyframes:
            raise LumigraphError("The path has no keyframe; give it at least one")
        if not 0 < self.fps <= 1000:
            raise LumigraphError(f"The path has {self.fps:g} frames per second; give it from 1 to 1000")
        for i, key in enumerate(self.keyframes):
            check(key, f"Keyframe {i + 1}")
        for i, (a, b) in enumerate(pairwise(self.keyframes)):
            if not a.seconds < b.seconds:
                raise LumigraphError(
                    f"Keyframe {i + 2} is at {b.seconds:g} s, not after the one before it at {a.seconds:g} s; "
                    "put them in the order of their times"
                )
        if len({key.time is None for key in self.keyframes}) > 1:
            raise LumigraphError("Some keyframes have a time and others have none; give it to all of them or to none")
        if self.duration * self.fps > MAX_FRAMES:
            raise LumigraphError(
                f"The path takes {self.duration:g} s, more than {MAX_FRAMES} frames; bring its keyframes' times closer"
            )

    @property
    def duration(self) -> float:
        """Seconds from the first keyframe to the last; back to the first, if it loops."""
        count, between = len(self.keyframes), self.keyframes[-1].seconds - self.keyframes[0].seconds
        return between * count / (count - 1) if self.loop and count > 1 else between

    def save(self, path: Path) -> None:
        """Write as JSON, whole or not at all."""
        data = asdict(self)
        for key in data["keyframes"]:
            if key["time"] is None:
                del key["time"]
        write_json(path, {"format": FORMAT, **data}, "camera path")

    @classmethod
    @reads()
    def load(cls, path: Path) -> CameraPath:
        """A path that `save` wrote, or the JSON beside a film that `lumigraph render` made.

        Raises LumigraphError for a file that holds neither.
        """
        fields = read_json(path)
        if not isinstance(fields, dict):
            fields = {}
        try:
            if fields.get("format") == FORMAT:
                rest = {name: value for name, value in fields.items() if name != "format"}
                return typed(cls, rest, path, closed=True)
            if {"poses", "lens", "size", "source_from_scene"} <= fields.keys():
                film = typed(FilmRecord, fields, path)
                return cls(keys_of_film(film, Lens.from_json(film.lens, path)), fps=film.fps)
        except LumigraphError as error:
            text = str(error)
            if text.startswith(str(path)):
                raise
            raise LumigraphError(f"{path} is no camera path: {text[:1].lower()}{text[1:]}") from error
        raise LumigraphError(
            f"{path} holds no camera path that this version reads; save one in the viewer, "
            "or take the JSON beside a film"
        )

    def at(self, seconds: Float[Tensor, " time"]) -> tuple[Float[Tensor, "time 3 4"], Float[Tensor, " time"]]:
        """Poses in the source's frame and angles of view (degrees) at some times, double precision."""
        at = seconds.double()
        if len(self.keyframes) == 1:
            curve = self._knots().expand(len(at), -1)
        else:
            curve = through(*self._padded(), at)
        rotation, position = to_matrix(curve[:, 4:]), curve[:, :3]
        return torch.cat([rotation, position[:, :, None]], -1), curve[:, 3].exp()

    def times_at(self, seconds: Float[Tensor, " time"]) -> Float[Tensor, " time"] | None:
        """Scene times at film times, interpolated between keyframes; None without times."""
        times = [key.time for key in self.keyframes if key.time is not None]
        if not times:
            return None
        knots = [key.seconds for key in self.keyframes]
        if self.loop:
            times, knots = [*times, times[0]], [*knots, knots[0] + self.duration]
        return torch.from_numpy(np.interp(seconds.double().numpy(), knots, times))

    def cameras(self, frame: Frame, size: tuple[int, int], frames: int | None = None) -> Camera:
        """The cameras of a film in a scene's frame, one for each picture, behind a pinhole lens.

        size:   (width, height) in pixels
        frames: how many, evenly over the whole duration; None means `fps` each second
        """
        if frames is not None and frames < 1:
            raise LumigraphError(f"A film cannot have {frames} frames; give --frames a number above 0")
        begin, open_end = self.keyframes[0].seconds, 0 if self.loop else 1
        if frames is None:
            frames = max(1, round(self.duration * self.fps) + open_end)
            step = 1 / self.fps
        else:
            step = self.duration / max(frames - open_end, 1)
        last = begin + self.duration  # against rounding beyond the end
        seconds = (begin + step * torch.arange(frames, dtype=torch.double)).clamp_max(last)
        (pose, fov), time = self.at(seconds), self.times_at(seconds)
        focal = 0.5 * min(size) / torch.tan(0.5 * fov.deg2rad())
        lens = Pinhole(focal[:, None].expand(frames, 2).float(), torch.tensor([size]).expand(frames, 2) / 2)
        there = Camera(pose, lens, torch.tensor([size]).expand(frames, 2))
        scene_from_source = frame.to_source.inverse.matrix
        moved = there.transformed(scene_from_source)
        return Camera(moved.pose.float(), lens, moved.size, None if time is None else time.float())

    def _knots(self) -> Float[Tensor, "key 8"]:
        """Position, log angle of view, quaternion of each keyframe."""
        rows = []
        for key in self.keyframes:
            pose = torch.tensor(key.pose, dtype=torch.double)
            fov = torch.tensor([math.log(key.fov)], dtype=torch.double)
            rows.append(torch.cat([pose[:, 3], fov, to_quaternion(pose[:, :3])]))
        return torch.stack(rows)

    def _padded(self) -> tuple[Float[Tensor, " knot"], Float[Tensor, "knot 8"]]:
        """Times and values of all knots, with one more on either side; a loop has its first two keyframes again."""
        values = self._knots()
        times = torch.tensor([key.seconds for key in self.keyframes], dtype=torch.double)
        if self.loop:
            values, period = torch.cat([values[-1:], values, values[:2]]), self.duration
            times = torch.cat([times[-1:] - period, times, times[:2] + period])
        # q and -q are one rotation: each takes the sign that is nearer to the one before it.
        turned = (values[1:, 4:] * values[:-1, 4:]).sum(-1) < 0
        sign = torch.cat([turned.new_zeros(1), turned]).cumsum(0) % 2
        values[:, 4:] *= (1 - 2 * sign)[:, None]
        if not self.loop:  # mirrored beyond the ends: the slope there is that of the last stretch
            values = torch.cat([2 * values[:1] - values[1:2], values, 2 * values[-1:] - values[-2:-1]])
            times = torch.cat([2 * times[:1] - times[1:2], times, 2 * times[-1:] - times[-2:-1]])
        return times, values


def through(
    times: Float[Tensor, " knot"], values: Float[Tensor, "knot value"], at: Float[Tensor, " time"]
) -> Float[Tensor, "time value"]:
    """Catmull-Rom's curve with uneven knots (Barry & Goldman 1988) in Hermite's form; the first and last knot only
    give their neighbours a slope.

    A knot's slope is that of the parabola through it and its neighbours, or zero where a neighbour is where it is.
    """
    step = times.diff()[:, None]
    rate = values.diff(dim=0) / step
    slope = (rate[:-1] * step[1:] + rate[1:] * step[:-1]) / (step[:-1] + step[1:])
    still = (rate.abs() < 1e-12).all(-1, keepdim=True)
    slope = torch.where(still[:-1] | still[1:], 0.0, slope)
    i = (torch.searchsorted(times[1:-1].contiguous(), at, right=True) - 1).clamp(0, len(times) - 4)
    h, a, b = step[i + 1], values[i + 1], values[i + 2]
    t = ((at - times[i + 1])[:, None] / h).clamp(0, 1)
    s = 1 - t
    return s * s * (1 + 2 * t) * a + t * t * (1 + 2 * s) * b + h * t * s * (s * slope[i] - t * slope[i + 1])


def check(key: Keyframe, name: str) -> None:
    """Raise LumigraphError for an invalid keyframe."""
    pose = torch.tensor(key.pose, dtype=torch.double)
    if not (pose.isfinite().all() and all(map(math.isfinite, (key.fov, key.seconds, key.time or 0.0)))):
        raise LumigraphError(f"{name} holds a number that is not finite; put the camera somewhere else")
    if pose.shape != (3, 4):
        raise LumigraphError(f"{name} has a pose of shape {tuple(pose.shape)}; a pose has 3 rows of 4 numbers")
    rotation = pose[:, :3]
    off = float((rotation @ rotation.T - torch.eye(3, dtype=torch.double)).abs().max())
    if off > RIGID_TOLERANCE or float(torch.linalg.det(rotation)) < 0:
        raise LumigraphError(
            f"{name} has a pose that is no rotation and a place; its first three columns must be unit length, "
            "at right angles and right-handed"
        )
    if not MIN_DEGREES <= key.fov <= MAX_DEGREES:
        limits = f"{MIN_DEGREES:g} to {MAX_DEGREES:g}"
        raise LumigraphError(f"{name} sees {key.fov:g} degrees; a flat picture shows {limits}")


def keys_of_film(film: FilmRecord, lens: Lens) -> tuple[Keyframe, ...]:
    """Every frame of a film as a keyframe. Raises LumigraphError where its parts do not fit together."""
    if not isinstance(lens, Pinhole):
        raise LumigraphError("The film was made through a bent lens, and paths are flown behind a flat picture")
    times: list[Any] = film.times or [None] * len(film.poses)
    to_source = torch.tensor(film.source_from_scene, dtype=torch.double)
    if len(times) != len(film.poses) or len(lens) not in (1, len(film.poses)) or not is_similarity(to_source):
        raise LumigraphError("The film's poses, lenses, times and source_from_scene do not fit together")
    size = torch.tensor(film.size)
    poses = torch.tensor(film.poses, dtype=torch.double).reshape(-1, 3, 4)
    source = Camera(poses, lens, size.expand(len(poses), 2)).transformed(to_source).pose
    side = int(size.argmin())
    fov = 2 * torch.atan(0.5 * size[side] / lens.focal[:, side].double()).rad2deg()
    rows = zip(source.tolist(), fov.expand(len(poses)).tolist(), times, strict=True)
    return tuple(
        Keyframe((tuple(a), tuple(b), tuple(c)), angle, i / film.fps, time)
        for i, ((a, b, c), angle, time) in enumerate(rows)
    )
