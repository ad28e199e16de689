"""A speaking head, from time 0 to time 1, photographed by a dome of cameras: glossy skin, and a tracked mesh.

Mouth, smile, brows and gaze have different periods, so that most times have a unique expression. Each photograph has
the mesh at its time, `Scene.about["vertices"]`: a grid (row, column, 3) over directions from the centre of the head, in
the source's frame, from the crown down and once around from the back.
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch

from ...camera import Camera
from ...camera.rays import Rays
from ...files.ranges import between
from ..cameras import look_at, pinhole, sphere_point
from ..rendering import trace
from ..shapes import Ball, Cylinder, SoftCapsule, Torus
from ..stage import Pictures, SyntheticStage
from ..textures import Mottle, Plain
from ..world import Lamp, Material, Object, Pose, Sky, World

ROWS, COLUMNS = 97, 129  # of the mesh; the last column is the first one again
FRONT = -90.0  # azimuth of the face, degrees; that of -y
WIDEST, LOWEST, HIGHEST = 60.0, -15.0, 35.0  # degrees of the dome: to either side of the face, and elevations
RADIUS, FIELD_OF_VIEW = 3.4, 23.0  # of the dome, scene units; degrees
OUTSIDE = 2.0  # distance from which the mesh is traced inwards, scene units
SKIN, BLUSH = (0.86, 0.64, 0.52), (0.76, 0.47, 0.40)
HAIR, DARK_HAIR = (0.30, 0.18, 0.11), (0.14, 0.08, 0.06)
LIP, MOUTH, WHITE, IRIS = (0.70, 0.25, 0.26), (0.20, 0.05, 0.06), (0.93, 0.93, 0.91), (0.16, 0.36, 0.52)


@dataclass(frozen=True)
class Options(Pictures):
    """Options of every scene. moments: number of times at which the dome takes photographs, `views` in all"""

    moments: Annotated[int, between(2, 200)] = 16


class Expression(NamedTuple):
    """Facial expression. mouth: from closed to open; smile, brow, gaze: around 0"""

    mouth: float
    smile: float
    brow: float
    gaze: float


def expression(time: float) -> Expression:
    """Expression at a time in [0, 1]."""
    turn = 2 * math.pi * time
    mouth = 0.5 - 0.5 * math.cos(2 * turn)
    return Expression(mouth, math.sin(turn + 0.4), math.sin(2 * turn + 1.1), math.sin(turn - 0.8))


def face(now: Expression):
    """Parts of the head, centred at the origin, the face towards -y."""
    skin = Material(Mottle(SKIN, BLUSH, size=0.5, contrast=1.6, seed=2.0), gloss=1.0, roughness=0.3)
    hair = Material(Mottle(HAIR, DARK_HAIR, size=0.12, contrast=2.5, seed=5.0), gloss=0.8, roughness=0.4)
    lip = Material(Plain(LIP), gloss=1.0, roughness=0.3)
    inside = Material(Plain(MOUTH), gloss=1.0, roughness=0.3)
    white, iris = (Material(Plain(colour), gloss=1.0, roughness=0.15) for colour in (WHITE, IRIS))
    across, drop = Pose.about((0, 1, 0), 90), 0.14 * now.mouth
    lips, width = -0.215 - 0.5 * drop, 0.055 + 0.02 * now.mouth
    yield Object(Ball(0.42), skin, Pose.at(0, 0.02, 0.12), "skin")
    cheeks = SoftCapsule(0.31, 0.13, 0.0, 1.0 + 0.2 * now.mouth)
    yield Object(cheeks, skin, Pose.at(0, -0.10, -0.14 - 0.4 * drop), "face")
    yield Object(SoftCapsule(0.13, 0.12, 2.0, 1.0), skin, Pose.at(0, -0.24, -0.40 - drop) @ chin(), "jaw")
    yield Object(SoftCapsule(0.055, 0.07), skin, Pose.at(0, -0.41, -0.02, tilt=-18), "nose")
    yield Object(Cylinder(0.19, 0.22, 0.02), skin, Pose.at(0, 0.06, -0.52), "neck")
    yield Object(Ball(0.445), hair, Pose.at(0, 0.09, 0.17), "hair")
    for side, name in ((-1, "left"), (1, "right")):
        yield Object(Ball(0.085), skin, Pose.at(0.41 * side, 0.03, 0.0), f"{name} ear")
        x, y, z = 0.15 * side, -0.325, 0.09
        yield Object(Ball(0.078), white, Pose.at(x, y, z), f"{name} eye")
        aside = 0.35 * now.gaze
        pupil = Pose.at(x + 0.046 * math.sin(aside), y - 0.046 * math.cos(aside), z)
        yield Object(Ball(0.043), iris, pupil, f"{name} iris")
        brow = Pose.at(x, -0.362, 0.20 + 0.035 * now.brow, tilt=-10) @ across
        yield Object(SoftCapsule(0.022, 0.075, -3.0 + 1.5 * now.brow), hair, brow, f"{name} brow")
    yield Object(Torus(width, 0.026), lip, Pose.at(0, -0.40, lips, tilt=90), "mouth")
    yield Object(Ball(width), inside, Pose.at(0, -0.37, lips), "inside")
    smile = Pose.at(0, -0.415, lips + 0.02 * now.smile) @ across
    yield Object(SoftCapsule(0.024, 0.10, 6.0 * now.smile), lip, smile, "lips")


def chin() -> Pose:
    """A capsule along z laid along x, its arc around the face."""
    return Pose.about((0, 1, 0), 90) @ Pose.about((0, 0, 1), 90)


def world(time: float) -> World:
    """The world at a time in [0, 1]."""
    key = Lamp((-2.2, -2.8, 2.4), radius=0.35, power=17.0, colour=(1.0, 0.95, 0.87))
    fill = Lamp((2.8, -1.6, 1.0), radius=0.6, power=6.0, colour=(0.86, 0.93, 1.0))
    sky = Sky((0.84, 0.91, 1.0), (0.95, 0.94, 0.92), (0.70, 0.62, 0.54), light=0.42)
    return World(tuple(face(expression(time))), (key, fill), sky)


@cache
def tracked(time: float) -> np.ndarray:
    """The mesh at a time, (row, column, 3): the outermost surface along each direction from the origin."""
    polar = np.linspace(0, math.pi, ROWS)[:, None]
    around = np.linspace(0, 2 * math.pi, COLUMNS)[None] + math.radians(-FRONT)
    flat = np.sin(polar)
    out = np.stack([flat * np.cos(around), flat * np.sin(around), np.cos(polar) + 0 * around], -1).reshape(-1, 3)
    directions = torch.from_numpy(out).float()
    seen = trace(world(time), Rays(OUTSIDE * directions, -directions, torch.zeros(len(out))), shaded=False)
    return ((OUTSIDE - seen.depth)[:, None] * out).reshape(ROWS, COLUMNS, 3)


def stage(size: int = 200, views: int = 160, seed: int = 0, moments: int = 16) -> SyntheticStage:
    """The head from a dome. Held out are new cameras at training times, then cameras between times."""
    random = np.random.default_rng(seed)
    times = (np.arange(moments) + 0.5) / moments
    train = [(place(random), float(times[k % moments])) for k in range(views)]
    held = max(views // 8, 2)
    again = [(place(random), float(times[(5 * k + 2) % moments])) for k in range(held)]
    halfway = (np.arange(moments - 1) + 1.0) / moments
    new = [(place(random), float(halfway[(3 * k + 1) % len(halfway)])) for k in range(held)]
    splits = {"train": train, "test": again + new}
    cameras, first = dict[str, Camera](), 0
    for name, stops in splits.items():
        moment, index = torch.tensor([t for _, t in stops]).float(), first + torch.arange(len(stops))
        made = pinhole(np.stack([pose for pose, _ in stops]), size, FIELD_OF_VIEW)
        cameras[name], first = replace(made, time=moment, image_index=index), first + len(stops)
    every = [t for stops in splits.values() for _, t in stops]

    def facts(index: int) -> dict[str, Any]:
        return {"vertices": tracked(every[index]).astype(np.float32)}

    bounds = ((-0.6, -0.6, -0.75), (0.6, 0.65, 0.65))
    return SyntheticStage(world(0.0), cameras, bounds, reach=0.8, near=1.5, moving=world, facts=facts)


def place(random: np.random.Generator) -> np.ndarray:
    """Pose of a camera on the dome, turned to the middle of the face."""
    azimuth = math.radians(FRONT + random.uniform(-WIDEST, WIDEST))
    elevation = math.radians(random.uniform(LOWEST, HIGHEST))
    return look_at(sphere_point(azimuth, elevation, RADIUS), (0.0, 0.0, -0.05))
