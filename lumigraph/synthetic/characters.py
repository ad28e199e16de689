"""Photographed characters with a skeleton: exact bones at all times, or perturbed ones.

Times go from 0 to 1. One camera goes twice around the character, or a static rig photographs every time. Held out are
four static cameras at training times and halfway between two of them, and as split "val" novel poses after time 1:
every joint is turned by UNSEEN_TURN degrees about a random axis.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float

from ..camera import Camera
from ..datasets.skeleton import BonePose, Skeleton, disturbed
from ..files.ranges import between
from .cameras import look_at, pinhole, sphere_point
from .filming import BETWEEN, FRONT, MIN_MOMENTS, timed
from .shapes import SolidShape
from .stage import Pictures, SyntheticStage
from .textures import Texture
from .world import Lamp, Material, Object, Pose, Rotation, Sky, World, nested

RADIUS = 3.6  # of the cameras' paths, scene units
FIELD_OF_VIEW = 32.0  # degrees
ROUNDS = 2  # of the one camera about the character
ELEVATION, CLIMB = 12.0, 14.0  # degrees, and by how much it changes to either side
HELD_OUT = (25.0, 14.0), (115.0, 6.0), (205.0, 22.0), (295.0, 2.0)  # azimuth from the front and elevation, degrees
UNSEEN_POSES, UNSEEN_TURN = 12, 20.0  # poses after moment 1, and degrees of each joint
UNSEEN_STEP = 0.02  # between their moments
MARGIN = 0.04  # of the box of interest about all poses, scene units
KEY = Lamp((-2.6, -1.8, 3.2), radius=0.9, power=11.0, colour=(1.0, 0.95, 0.87))
FILL = Lamp((3.0, 2.4, 2.0), radius=1.2, power=7.0, colour=(0.86, 0.93, 1.0))
SKY = Sky((0.84, 0.91, 1.0), (0.95, 0.94, 0.92), (0.70, 0.62, 0.54), light=0.55)

Joints = Float[np.ndarray, "bone 3 4"]  # joint-to-world matrices


@dataclass(frozen=True)
class CharacterOptions(Pictures):
    """Options of every scene, and of characters.

    rig:          cameras of a rig, which photograph every time; 0 for one moving camera
    jitter_bones: error of the given bones at training times: degrees about random axes
    """

    rig: Annotated[int, between(0, 100)] = 0
    jitter_bones: Annotated[int, between(0, 45)] = 0


@runtime_checkable
class Character(Protocol):
    """A character with a skeleton.

    skeleton: with the rest pose, in the world
    """

    @property
    def skeleton(self) -> Skeleton: ...

    def pose(self, share: float) -> Joints:
        """Joints at a time from 0 to 1."""

    def world(self, pose: Joints) -> World:
        """The character in a pose, with its light."""

    def extent(self, pose: Joints) -> tuple[np.ndarray, np.ndarray]:
        """Bounding box in a pose: lowest and highest corner."""


class SolidCharacter:
    """Base of characters whose world holds an object for each shape."""

    def extent(self, pose: Joints) -> tuple[np.ndarray, np.ndarray]:
        """Bounding box in a pose: lowest and highest corner."""
        return self.world(pose).bounds()

    def world(self, pose: Joints) -> World:
        raise NotImplementedError


def moved_shapes(
    parts: Iterable[tuple[str, SolidShape, Texture, Pose]],
    names: Sequence[str],
    rest: Joints,
    pose: Joints,
    finish: tuple[float, float],
) -> World:
    """Shapes at rest, each moved by the bone of its name, with light. finish: gloss and roughness"""
    turn = pose[:, :, :3] @ rest[:, :, :3].transpose(0, 2, 1)
    shift = pose[:, :, 3] - (turn @ rest[:, :, 3:])[:, :, 0]
    moves = {name: Pose(tuple(shift[i].tolist()), nested(turn[i])) for i, name in enumerate(names)}
    objects = (
        Object(shape, Material(texture, *finish), moves[name] @ place, name) for name, shape, texture, place in parts
    )
    return World(tuple(objects), (KEY, FILL), SKY)


def turned_along(way: np.ndarray) -> Rotation:
    """Rotation of an upright shape to a unit direction."""
    side = np.cross([0.0, 1.0, 0.0], way)
    side /= np.linalg.norm(side)
    return nested(np.stack([side, np.cross(way, side), way], 1))


def photographed(character: Character, size: int, views: int, seed: int, rig: int, jitter_bones: int) -> SyntheticStage:
    """The character with cameras around it, and its skeleton at all times."""
    random = np.random.default_rng((seed, 0xB0E5))
    moments = np.linspace(0, 1, max(views // rig, MIN_MOMENTS) if rig else max(views, MIN_MOMENTS))
    halfway = 0.5 * (moments[:-1] + moments[1:])[BETWEEN // 2 :: BETWEEN]
    unseen = 1 + UNSEEN_STEP * (1 + np.arange(UNSEEN_POSES))
    start = random.uniform(0, 360)
    if rig:
        train = [(start + 360 * k / rig, ELEVATION + CLIMB * (-1) ** k, t) for t in moments for k in range(rig)]
    else:
        climbs = ELEVATION + CLIMB * np.sin(5 * 2 * math.pi * moments)
        train = [(start + 360 * ROUNDS * t, up, t) for t, up in zip(moments, climbs, strict=True)]
    seen = np.sort(np.concatenate([moments[::BETWEEN], halfway]))
    held = {"test": seen, "val": unseen}
    stops = {"train": train} | {
        name: [(*HELD_OUT[k % len(HELD_OUT)], t) for k, t in enumerate(times)] for name, times in held.items()
    }
    times = np.sort(np.unique(np.concatenate([moments, halfway, unseen])))
    poses = [
        character.pose(float(t))
        if t <= 1
        else disturbed(character.skeleton.parents, character.pose(random.uniform()), UNSEEN_TURN, random)
        for t in times
    ]
    learnt = set(moments.tolist())
    parents = character.skeleton.parents
    said = [
        disturbed(parents, pose, jitter_bones, random) if jitter_bones and t in learnt else pose
        for t, pose in zip(times.tolist(), poses, strict=True)
    ]
    corners = [character.extent(pose) for pose in (character.skeleton.rest.matrices.numpy(), *poses)]
    low, high = np.min([a for a, _ in corners], 0) - MARGIN, np.max([b for _, b in corners], 0) + MARGIN
    skeleton = replace(
        character.skeleton,
        times=tuple(np.float32(times).astype(float).tolist()),
        poses=tuple(BonePose.of(torch.from_numpy(pose)) for pose in said),
    )

    def moving(time: float) -> World:
        return character.world(poses[int(np.abs(times - time).argmin())])

    cameras = {name: _taken(places, size) for name, places in stops.items()}
    bounds = tuple(low.tolist()), tuple(high.tolist())
    reach = 0.5 * float((high - low).max())
    return SyntheticStage(
        moving(0.0), _numbered(cameras), bounds, reach, near=1.2, moving=moving, skeleton=skeleton,
        called=_called(character, cameras, times, poses),
    )  # fmt: skip


def _called(
    character: Character, cameras: dict[str, Camera], times: np.ndarray, poses: list[Joints]
) -> Callable[[int], str]:
    """Cache name of each photograph, by character and pose."""
    every = torch.cat([camera.time for camera in cameras.values() if camera.time is not None]).tolist()

    def name(index: int) -> str:
        pose = poses[int(np.abs(times - every[index]).argmin())]
        return f"{character!r} {pose.round(6).tolist()}"

    return name


def _taken(stops: list[tuple[float, float, float]], size: int) -> Camera:
    """Cameras that look at the origin. stops: azimuth from the front and elevation, degrees, and time of each"""
    places = [sphere_point(math.radians(FRONT + a), math.radians(e), RADIUS) for a, e, _ in stops]
    poses = np.stack([look_at(place, np.zeros(3)) for place in places])
    return timed(pinhole(poses, size, FIELD_OF_VIEW), np.array([time for _, _, time in stops]))


def _numbered(cameras: dict[str, Camera]) -> dict[str, Camera]:
    """Cameras with image indices."""
    found, first = {}, 0
    for name, batch in cameras.items():
        found[name] = replace(batch, image_index=first + torch.arange(len(batch)))
        first += len(batch)
    return found
