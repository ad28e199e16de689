"""Nuisances: options of every procedural scene that make it like data that nobody made for a method.

    open_scene("procedural:still-life,open=30,clutter=6,exposure=1")
    open_scene("procedural:room,depth,holes=grid,step=5")

`staged` changes the world before the camera, `disturbed` the photographs and what is known of them. `stage.Nuisances`
lists the options. Held-out photographs keep their colours, sharpness and poses, and nothing is held out anew.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.ndimage import shift

from ..camera.lens import Pinhole
from ..color.srgb import linear_from_srgb, srgb_from_linear
from ..errors import LumigraphError
from ..geometry import Similarity, evenly
from ..readers.capture import Capture, PixelPlane, Shot
from ..readers.unposed import TRUE_POSE
from .cameras import sphere_point
from .shapes import Arch, Ball, Cone, Cuboid, Cylinder, Plane, SolidShape, Torus
from .stage import Nuisances, SyntheticStage
from .textures import Bricks, Checker, Marble, Mottle, Stripes, Texture, Wood
from .world import Material, Object, Pose, World, nested, rotation_about

BODIES = 5  # of a statue
THIN = 0.012  # radius of a statue's rods, as a share of its half-size
RING = 14  # things of an open background
CLUTTER_WAY, CLUTTER_ASIDE, CLUTTER_SIZE = 0.3, 0.05, 0.02  # shares of the distance from a camera to the middle
BOARD_WAY, BOARD_SIZE, SWAY = 0.5, 2.5, 0.15  # of a backdrop: shares of that distance; behind the middle, half-size
BORDER = 0.12  # share of a picture's width at each side
JUMP = 0.05  # share of the depth between neighbours that makes an edge
LEVELS, WRONG_SCALE, SECOND_RETURN = 24, 1.05, 0.1  # of a depth picture: quantised, scaled; share of pixels
TRACKED = "vertices"  # of `Scene.about`: points of a tracked mesh, source's frame
LABEL_BLOCK = 8  # pixels along the side of a patch with a wrong label


def staged(stage: SyntheticStage, asked: Nuisances) -> SyntheticStage:
    """The stage with the nuisances that stand before the camera. Raises LumigraphError for a world without objects."""
    changed = asked.shape or asked.open or asked.clutter or asked.backdrop or asked.turntable
    if changed and not stage.world.objects:
        raise LumigraphError(
            "shape, open, clutter, backdrop and turntable need a scene of solids; a skinned mesh is none"
        )
    if asked.shape:
        if stage.moving is not None or stage.differing is not None:
            raise LumigraphError("shape replaces the object of a still scene, and this one changes; leave shape out")
        stage = replace(stage, world=replace(stage.world, objects=tuple(statue(asked.shape, stage))))
    if asked.open:
        far, sky = tuple(background(stage, asked.open)), replace(stage.world.sky, visible=True)
        stage = everywhere(stage, lambda world: replace(world, objects=(*world.objects, *far), sky=sky))
        stage = replace(stage, reach=max(stage.reach, 1.6 * (asked.open + distance_of(stage))))
    if asked.clutter:
        near = tuple(clutter(stage, asked.clutter))
        stage = everywhere(stage, lambda world: replace(world, objects=(*world.objects, *near)))
        stage = replace(stage, near=min(stage.near, 0.5 * CLUTTER_WAY * distance_of(stage)))
    if asked.backdrop or asked.turntable:
        stage = carried(stage, bool(asked.turntable))
    return stage


def everywhere(stage: SyntheticStage, change: Callable[[World], World]) -> SyntheticStage:
    """The stage with its world changed, at all times and in all photographs."""

    def after(world: Callable) -> Callable:
        return lambda moment: change(world(moment))

    worlds: dict[str, Any] = {
        name: after(old) for name in ("moving", "differing", "lasting") if (old := getattr(stage, name))
    }
    return replace(stage, world=change(stage.world), called=None, **worlds)


def middle_of(stage: SyntheticStage) -> np.ndarray:
    return np.mean(stage.bounds, 0)


def distance_of(stage: SyntheticStage) -> float:
    """Median distance of training cameras from the middle."""
    places = stage.cameras["train"].position.double().numpy()
    return float(np.median(np.linalg.norm(places - middle_of(stage), axis=1)))


def textures(random: np.random.Generator, size: float) -> Texture:
    """A random texture with details of a size."""
    a, b = (tuple(random.uniform(0.05, 0.95, 3).round(2).tolist()) for _ in range(2))
    seed = float(random.integers(100))
    choices = (
        Checker(a, b, size), Stripes(a, b, size), Wood(a, b, size, seed=seed), Marble(a, b, 2 * size, seed=seed),
        Bricks(a, b, 2 * size, size, size / 10), Mottle(a, b, 2 * size, seed=seed),
    )  # fmt: skip
    return choices[random.integers(len(choices))]


def statue(seed: int, stage: SyntheticStage) -> Iterator[Object]:
    """A random object in the box of interest: a body on a hollow base, with a handle, thin rods and a cup."""
    random, middle = np.random.default_rng((seed, 0x57A7)), middle_of(stage)
    half = 0.5 * (np.array(stage.bounds[1]) - stage.bounds[0])
    size = float(half.min())

    def part(shape: SolidShape, x: float, y: float, z: float, turn: float = 0.0, tilt: float = 0.0) -> Object:
        place = Pose(tuple(middle.tolist())) @ Pose.at(x * size, y * size, z * size - half[2], turn, tilt)
        paint = Material(textures(random, 0.15 * size), gloss=random.uniform(0, 0.5), roughness=0.4)
        return Object(shape, paint, place, "statue")

    arch = Arch((0.6 * size, 0.6 * size, 0.3 * size), 0.35 * size, 0.1 * size)
    yield part(arch, 0, 0, 0.3, random.uniform(0, 360))
    for _ in range(BODIES):
        radius, (x, y, z) = random.uniform(0.15, 0.35) * size, random.uniform((-0.4, -0.4, 0.85), (0.4, 0.4, 1.1))
        body = Ball(radius) if random.integers(2) else Cuboid((radius, 0.8 * radius, radius), 0.2 * radius)
        yield part(body, x, y, z, random.uniform(0, 90), random.uniform(0, 90))
    yield part(Torus(0.3 * size, 0.06 * size), 0.5, 0, 0.9, random.uniform(-30, 30), 90)
    yield part(Cone(0.12 * size, 0.3 * size, 0.15 * size), -0.4, 0.2, 1.3)
    for x, y, turn, tilt in random.uniform((-0.3, -0.3, 0, 0), (0.3, 0.3, 60, 60), (2, 4)):
        yield part(Cylinder(THIN * size, 0.5 * size), x, y, 1.3, turn, tilt)


def background(stage: SyntheticStage, distance: float) -> Iterator[Object]:
    """Ground, and a ring of things at a distance behind the cameras."""
    random, (x, y) = np.random.default_rng(0x0BE4), middle_of(stage)[:2]
    floor, distance = stage.bounds[0][2], distance + distance_of(stage)
    yield Object(Plane(), Material(Mottle((0.52, 0.50, 0.42), (0.30, 0.38, 0.24), 0.5)), Pose.at(x, y, floor), "ground")
    for k in range(RING):
        turn, high = 360 * k / RING + random.uniform(-8, 8), random.uniform(0.08, 0.3) * distance
        away = sphere_point(math.radians(turn), 0.0, distance * random.uniform(1, 1.4))
        block = Cuboid((0.12 * distance, 0.1 * distance, high))
        paint = Material(textures(random, 0.06 * distance))
        yield Object(block, paint, Pose.at(x + away[0], y + away[1], floor + high, turn), "background")


def clutter(stage: SyntheticStage, count: int) -> Iterator[Object]:
    """Small things between cameras and the scene, in front of some and beside others."""
    random, cameras = np.random.default_rng((count, 0xC1)), stage.cameras["train"]
    places, size = cameras.position.double().numpy(), CLUTTER_SIZE * distance_of(stage)
    for k in evenly(range(len(places)), count):
        towards = middle_of(stage) - places[k]
        aside = random.normal(size=3) * CLUTTER_ASIDE * np.linalg.norm(towards)
        place = places[k] + CLUTTER_WAY * towards + aside
        if np.linalg.norm(places - place, axis=1).min() > 3 * size:  # no camera is inside
            yield Object(Ball(size), Material(textures(random, 0.6 * size)), Pose(tuple(place.tolist())), "clutter")


def carried(stage: SyntheticStage, turns: bool) -> SyntheticStage:
    """The stage before a background that goes with the camera. turns: exactly, as where an object turns before a still
    camera; else a board that is carried round, and sways."""
    random, middle = np.random.default_rng(0xB0A2), middle_of(stage)
    numbered, first = dict[str, Any](), 0
    for split, cameras in stage.cameras.items():
        if cameras.image_index is None:
            cameras = replace(cameras, image_index=torch.arange(first, first + len(cameras)))
        numbered[split], first = cameras, first + len(cameras)
    every = {
        number: stage.cameras[split][i]
        for split, cameras in numbered.items()
        for i, number in enumerate(cameras.image_index.tolist())
    }
    offsets = dict(zip(every, random.normal(0, 0 if turns else SWAY, (len(every), 3)), strict=True))
    paints = [Material(textures(np.random.default_rng((k, 0xB0)), 0.2)) for k in range(5)]

    def differing(index: int) -> World:
        camera = every[index]
        axes, eye = camera.pose[0, :, :3].double().numpy(), camera.position[0].double().numpy()
        away = float(np.linalg.norm(middle - eye))
        # Of the camera's frame: a wall behind the object, and things on shelves before it.
        things = [(Cuboid((BOARD_SIZE * away, BOARD_SIZE * away, 0.01)), np.array([0, 0, (1 + BOARD_WAY) * away]))]
        if turns:
            shelf, side = ((-0.5, -0.3), (0.5, -0.1), (-0.4, 0.4), (0.45, 0.45)), 0.12 * away
            things += [(Cuboid((side, side, side)), away * np.array([a, b, 1 + 0.8 * BOARD_WAY])) for a, b in shelf]
        world, tilt = stage.world_of(camera), rotation_about((0, 1, 0), 20 * offsets[index][0])
        places = [eye + axes @ (place + away * offsets[index]) for _, place in things]
        added = tuple(
            Object(shape, paint, Pose(tuple(place.tolist()), nested(axes @ tilt)), "backdrop")
            for (shape, _), place, paint in zip(things, places, paints, strict=False)
        )
        return replace(world, objects=(*world.objects, *added), sky=replace(world.sky, visible=True))

    reach = max(stage.reach, (2 * BOARD_SIZE + 1) * distance_of(stage))
    return replace(stage, cameras=numbered, differing=differing, called=None, reach=reach)


def disturbed(capture: Capture, asked: Nuisances) -> Capture:
    """The capture with the nuisances of its photographs, their poses and what is known of their pixels."""
    train = [shot for shot in capture.shots if shot.split == "train"]
    kept = train[:: asked.step]
    kept = evenly(kept, asked.few) if asked.few else kept
    names = {shot.name for shot in kept}
    shots = [shot for shot in capture.shots if shot.split != "train" or shot.name in names]
    shots = [disturbed_shot(shot, asked, number) for number, shot in enumerate(shots)]
    if asked.order:
        numbers = np.random.default_rng(0x0D).permutation(len(shots))
        shots = [replace(shot, name=f"IMG_{number:04d}") for shot, number in zip(shots, numbers, strict=True)]
        shots.sort(key=lambda shot: shot.name)
    capture = replace(capture, shots=shots)
    return moved(capture, asked.scale, asked.offset) if (asked.scale, asked.offset) != (1.0, 0.0) else capture


def disturbed_shot(shot: Shot, asked: Nuisances, number: int) -> Shot:
    """One photograph, with random numbers of its own."""
    random, planes = np.random.default_rng((number, 0xD157)), dict(shot.planes)
    if shot.split == "train":
        if asked.exposure or asked.white_balance or asked.blur:
            gains = 2 ** (asked.exposure * random.uniform(-1, 1)) * (
                1 + asked.white_balance / 100 * random.uniform(-1, 1, 3)
            )
            way = asked.blur * random.uniform(0.5, 1) * sphere_point(random.uniform(0, math.pi), 0.0)[:2]
            assert callable(shot.image)
            identity = shot.identity and f"{shot.identity} {gains.tolist()} {way.tolist()}"
            shot = replace(shot, image=partial(photographed, shot.image, gains, way), identity=identity)
        if asked.poses:
            axis = shot.pose[:, :3] @ np.append(sphere_point(random.uniform(0, 2 * math.pi), 0.0)[:2], 0)
            assert isinstance(shot.lens, Pinhole)
            angle = math.degrees(asked.poses * random.normal() / float(shot.lens.focal[0, 0]))
            turned = np.concatenate([rotation_about(tuple(axis), angle) @ shot.pose[:, :3], shot.pose[:, 3:]], 1)
            shot = replace(shot, pose=turned, about={TRUE_POSE: shot.pose} | shot.about)
        if asked.labels and "labels" in planes:
            if random.uniform() < asked.labels / 100:
                del planes["labels"]
            else:
                planes["labels"] = changed(planes["labels"], partial(mislabelled, asked.labels / 100, number))
    elif asked.poses:
        shot = replace(shot, about={TRUE_POSE: shot.pose} | shot.about)
    if "depth" in planes and (asked.holes or asked.noise):
        unknown = planes["depth"].unknown[0] if planes["depth"].unknown else math.nan
        planes["depth"] = changed(planes["depth"], partial(worse_depth, asked, unknown, number))
    return replace(shot, planes=planes)


def changed(plane: PixelPlane, change: Callable[[np.ndarray], np.ndarray]) -> PixelPlane:
    """A plane with its numbers changed when they are read."""
    assert callable(values := plane.values)
    return replace(plane, values=lambda: change(values()).astype(plane.dtype), identity=None)


def photographed(picture: Callable[[], np.ndarray], gains: np.ndarray, way: np.ndarray) -> np.ndarray:
    """A picture in another exposure and white balance, moved along `way` (pixels) while the shutter was open."""
    pixels = picture().astype(np.float64) / 255
    alpha = pixels[..., 3:] if pixels.shape[-1] == 4 else np.ones_like(pixels[..., :1])
    light = np.concatenate([linear_from_srgb(pixels[..., :3]) * gains * alpha, alpha], -1)
    if steps := math.ceil(np.abs(way).max()):
        moments = [share * way for share in np.linspace(-0.5, 0.5, steps + 1)]
        light = np.mean([shift(light, (y, x, 0), order=1, mode="nearest") for x, y in moments], 0)
    straight = srgb_from_linear(light[..., :3] / np.maximum(light[..., 3:], 1e-6))
    found = np.concatenate([straight, light[..., 3:]], -1)[..., : pixels.shape[-1]]
    return np.round(255 * found.clip(0, 1)).astype(np.uint8)


def mislabelled(share: float, seed: int, labels: np.ndarray) -> np.ndarray:
    """Labels with a share of their square patches replaced by other labels of the picture."""
    random, (height, width) = np.random.default_rng((seed, 0x1AB)), labels.shape
    patches = [math.ceil(side / LABEL_BLOCK) for side in (height, width)]
    wrong, other = random.uniform(size=patches) < share, random.choice(np.unique(labels), patches)
    wrong, other = (np.kron(x, np.ones((LABEL_BLOCK, LABEL_BLOCK), int))[:height, :width] for x in (wrong, other))
    return np.where(wrong.astype(bool), other, labels)


def worse_depth(asked: Nuisances, unknown: float, seed: int, stored: np.ndarray) -> np.ndarray:
    """Depth as other sensors store it."""
    depth, random = stored.astype(np.float64), np.random.default_rng((seed, 0xDE))
    sure = np.isfinite(depth) & (depth != unknown)
    if not sure.any():
        return stored
    if asked.noise == "quantised":
        step = depth[sure].max() / LEVELS
        depth[sure] = step * np.rint(depth[sure] / step).clip(1)
    elif asked.noise == "scaled":
        depth[sure] *= WRONG_SCALE
    elif asked.noise == "returns":  # some pixels hold the distance of what is beside them
        beside = np.roll(depth, max(depth.shape[1] // 16, 1), 1)
        depth = np.where(sure & np.roll(sure, 1, 1) & (random.uniform(size=depth.shape) < SECOND_RETURN), beside, depth)
    rows, columns = np.indices(depth.shape)
    lost = np.zeros(depth.shape, bool)
    if asked.holes == "grid":  # depth registered to a picture of twice its size
        lost = (rows % 2 == 1) | (columns % 2 == 1)
    elif asked.holes == "columns":
        lost = columns % 3 == 1
    elif asked.holes == "borders":
        width = BORDER * depth.shape[1]
        lost = np.minimum(columns, depth.shape[1] - 1 - columns) < width
        for axis in (0, 1):
            jump = np.abs(np.diff(depth, axis=axis, append=np.take(depth, [-1], axis)))
            lost |= ~(jump < JUMP * depth)
    elif asked.holes == "far":
        lost = depth > np.median(depth[sure])
    return np.where(lost, unknown, depth)


def moved(capture: Capture, scale: float, offset: float) -> Capture:
    """The capture in another unit, its origin far away. Raises LumigraphError for a block world, whose unit is an edge
    of its blocks."""
    if capture.blocks is not None:
        raise LumigraphError(f"{capture.source}: a block world has one unit; leave scale and offset out")
    motion = Similarity.make(scale, translation=torch.full((3,), offset, dtype=torch.float64))

    def pose_of(pose: np.ndarray) -> np.ndarray:
        return np.concatenate([pose[:, :3], scale * pose[:, 3:] + offset], 1)

    placed = {TRUE_POSE: pose_of, TRACKED: lambda points: scale * points + offset}
    shots = [
        replace(
            shot,
            pose=pose_of(shot.pose),
            planes={
                name: replace(plane, scale=scale * plane.scale) if plane.encoding in ("distance", "z-depth") else plane
                for name, plane in shot.planes.items()
            },
            about=shot.about
            | {name: change(shot.about[name]) for name, change in placed.items() if name in shot.about},
        )
        for shot in capture.shots
    ]
    assert capture.bounds is not None and capture.reach is not None and capture.near is not None
    (a, b, c), (d, e, f) = ([scale * x + offset for x in corner] for corner in capture.bounds)
    return replace(
        capture,
        shots=shots,
        bounds=((a, b, c), (d, e, f)),
        reach=scale * capture.reach,
        near=scale * capture.near,
        metric=capture.metric and scale == 1,
        tracks=tuple(track.transformed(motion) for track in capture.tracks),
        skeleton=capture.skeleton and capture.skeleton.transformed(motion),
    )
