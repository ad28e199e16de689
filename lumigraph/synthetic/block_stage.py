"""Block worlds as stages: cuboids for the tracer, and cameras that walk above the ground."""

import hashlib
import math

import numpy as np
from jaxtyping import Bool, Float, Int

from ..datasets.world import LABELS, BlockLabels
from .cameras import look_at, pinhole
from .rendering import trace
from .shapes import Cuboid
from .stage import SyntheticStage
from .textures import Mottle
from .world import Material, Object, Pose, Sky, Sun, World

# Two colours of each label's blocks, as the game's textures have them, sRGB.
COLOURS = {
    "grass": ((0.33, 0.55, 0.20), (0.42, 0.64, 0.27)),
    "dirt": ((0.45, 0.32, 0.22), (0.56, 0.41, 0.29)),
    "stone": ((0.43, 0.43, 0.43), (0.55, 0.55, 0.55)),
    "sand": ((0.82, 0.77, 0.58), (0.90, 0.85, 0.68)),
    "water": ((0.16, 0.32, 0.70), (0.22, 0.40, 0.78)),
    "tree": ((0.13, 0.33, 0.09), (0.22, 0.44, 0.14)),
    "snow": ((0.92, 0.94, 0.97), (0.98, 0.98, 0.99)),
}
FIELD_OF_VIEW = 70.0  # degrees
EYE_HEIGHTS = (2.5, 9.0)  # above the highest block around, blocks
PITCHES, PITCH_SPREAD = (-35.0, 2.0), 0.1  # of cameras, degrees; deviation of the slope towards what they look at
WALK_HEIGHT = 3.5  # of the walk above the highest block around, blocks
WALK_RADIUS = 0.28  # of the walk around the middle, share of the world's longer side
CLEARANCE = 2  # blocks around a camera above which it must be
MIN_ENTROPY, MIN_DISTANCE = 0.75, 2.0  # of labels in a picture, nats; mean depth, blocks (Hao 2021, published code)
PROBE = 12  # pixels a side of the picture that these are measured in
MAX_TRIES = 20  # cameras drawn for one that passes


def blocks_about_middle(blocks: BlockLabels) -> BlockLabels:
    """The blocks in a frame centred at their box."""
    x, y, z = (-n / 2 for n in blocks.labels.shape)
    return BlockLabels(blocks.labels, (x, y, z))


def stage_of(blocks: BlockLabels, size: int, views: int, seed: int, called: str) -> SyntheticStage:
    """A world of blocks in a box from -1 to 1 along its longest side, and cameras above its ground.

    Training cameras are random, held-out ones walk around the middle. called: cache name of the pictures
    """
    labels = blocks.labels
    unit = max(labels.shape) / 2
    world = World(tuple(cuboids(labels, unit)), (Sun((0.5, -0.35, 0.8), 0.02, 0.75, (1.0, 0.97, 0.92)),), SKY)
    random = np.random.default_rng([seed, 3])
    x, y, z = (n / 2 / unit for n in labels.shape)
    cameras = {
        "train": pinhole(np.stack(anywhere(world, labels, views, unit, random)), size, FIELD_OF_VIEW),
        "test": pinhole(walk(labels, max(views // 4, 2), unit), size, FIELD_OF_VIEW),
    }
    high = max(z, float(max(c.pose[:, 2, 3].max() for c in cameras.values())))
    bounds = ((-x, -y, -z), (x, y, min(high, 1.0)))
    key = f"{called} {hash_of(labels)}"
    return SyntheticStage(world, cameras, bounds, 1.0, 0.5 / unit, called=lambda _: key, unit=unit)


SKY = Sky((0.45, 0.65, 0.95), (0.80, 0.88, 0.96), (0.72, 0.76, 0.80), light=0.5, visible=True, reach=0.05)


def hash_of(labels: np.ndarray) -> str:
    return hashlib.sha256(labels.tobytes() + str(labels.shape).encode()).hexdigest()[:16]


def cuboids(labels: np.ndarray, unit: float):
    """Cuboids of merged blocks of one label, along z, y, then x, in the tracer's unit, without hidden blocks."""
    middle = np.array(labels.shape) / 2
    for label, name in enumerate(LABELS[1:], 1):
        low, high = COLOURS[name]
        material = Material(Mottle(low, high, size=1 / unit), roughness=0.9)
        mask = (labels == label) & exposed(labels)
        for start, end in joined_boxes(mask):
            half, centre = (end - start) / 2 / unit, ((start + end) / 2 - middle) / unit
            yield Object(Cuboid(tuple(half.tolist())), material, Pose(tuple(centre.tolist())), name)


def exposed(labels: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Mask of the blocks with air at one of their six sides."""
    air = np.pad(labels == 0, 1, constant_values=True)
    inner = slice(1, -1)
    found = np.zeros(labels.shape, bool)
    for axis in range(3):
        for step in (0, 2):
            index = [inner] * 3
            index[axis] = slice(step, step + labels.shape[axis])
            found |= air[tuple(index)]
    return found & (labels > 0)


def joined_boxes(mask: Bool[np.ndarray, "x y z"]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Lowest and highest corners of boxes that cover a mask without overlap."""
    edges = np.diff(np.pad(mask, ((0, 0), (0, 0), (1, 1))).astype(np.int8), axis=2)
    start, end = np.argwhere(edges == 1), np.argwhere(edges == -1)
    boxes = np.stack([start, end + np.array([1, 1, 0])], 1)
    if not len(boxes):
        return []
    for axis in (1, 0):
        other = [a for a in range(3) if a != axis]
        keys = (boxes[:, 0, axis], *(boxes[:, k, a] for k in (0, 1) for a in other))
        boxes = boxes[np.lexsort(keys)]
        same = (boxes[1:, :, other] == boxes[:-1, :, other]).all((1, 2)) & (boxes[1:, 0, axis] == boxes[:-1, 1, axis])
        first = np.flatnonzero(np.r_[True, ~same])
        ends = boxes[np.r_[first[1:], len(boxes)] - 1, 1, axis]
        boxes = boxes[first]
        boxes[:, 1, axis] = ends
    return [(low.astype(float), high.astype(float)) for low, high in boxes]


def tops(labels: np.ndarray) -> Int[np.ndarray, "x y"]:
    """Height of the highest block of each column; 0 for a column of air."""
    there = labels > 0
    return np.where(there.any(2), labels.shape[2] - there[:, :, ::-1].argmax(2), 0)


def clear_height(height: np.ndarray, x: float, y: float, reach: int = CLEARANCE) -> float:
    """Height of the highest block around a position."""
    i, j = int(x), int(y)
    around = height[max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1]
    return float(around.max()) if around.size else 0.0


def anywhere(world: World, labels: np.ndarray, count: int, unit: float, random: np.random.Generator):
    """Random poses above the ground. Pictures with too few labels, or too close to a block, are rejected."""
    height, middle, poses = tops(labels), np.array(labels.shape) / 2, []
    for _ in range(count):
        for _ in range(MAX_TRIES):
            x, y = random.uniform(0.05, 0.95, 2) * labels.shape[:2]
            low, high = np.log(EYE_HEIGHTS)
            eye = np.array([x, y, clear_height(height, x, y) + math.exp(random.uniform(low, high)) - 1])
            # Towards a place in the world, so that pictures at its border are not of the sky alone.
            i, j = random.uniform(0.15, 0.85, 2) * labels.shape[:2]
            ahead = np.array([i - x, j - y])
            drop = height[int(i), int(j)] - eye[2] + random.normal(0, PITCH_SPREAD) * np.linalg.norm(ahead)
            pose = aimed(eye, ahead, drop, float(np.linalg.norm(ahead)), middle, unit)
            if worth_seeing(world, pose, unit):
                break
        poses.append(pose)
    return poses


def worth_seeing(world: World, pose: np.ndarray, unit: float) -> bool:
    """False for a picture with little variety of labels or a mean depth below `MIN_DISTANCE`."""
    camera = pinhole(pose[None], PROBE, FIELD_OF_VIEW)
    seen = trace(world, camera.rays(camera.pixels()), shaded=False)
    share = np.unique(seen.identity, return_counts=True)[1] / len(seen.identity)
    hit = seen.identity >= 0
    near = hit.any() and seen.depth[hit].mean() * unit < MIN_DISTANCE
    return bool(-(share * np.log(share)).sum() > MIN_ENTROPY and not near)


def walk(labels: np.ndarray, count: int, unit: float) -> Float[np.ndarray, "camera 3 4"]:
    """Poses of a closed walk around the middle of a world, at a height that follows the ground smoothly, looking ahead
    and inward."""
    height, middle = tops(labels), np.array(labels.shape) / 2
    fine = 64
    angle = 2 * math.pi * np.arange(fine) / fine
    radius = WALK_RADIUS * max(labels.shape[:2]) * (1 + 0.25 * np.sin(3 * angle))
    place = middle[:2] + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    floor = np.array([clear_height(height, *p) for p in place])
    # The mean of the highest ground within a sixteenth of the walk, which is nowhere below the ground.
    wide = np.max([np.roll(floor, k) for k in range(-4, 5)], 0)
    level = np.mean([np.roll(wide, k) for k in range(-4, 5)], 0) + WALK_HEIGHT
    path, centre = np.concatenate([place, level[:, None]], -1), clear_height(height, *middle[:2])
    poses = []
    for share in np.arange(count) / count:
        eye, ahead = (periodic(path, share + step) for step in (0.0, 0.02))
        flat = ahead[:2] - eye[:2]
        inward = middle[:2] - eye[:2]
        flat = flat / np.linalg.norm(flat) + 0.8 * inward / np.linalg.norm(inward)
        poses.append(aimed(eye, flat, centre - eye[2], float(np.linalg.norm(inward)), middle, unit))
    return np.stack(poses)


def aimed(
    eye: np.ndarray, ahead: np.ndarray, drop: float, distance: float, middle: np.ndarray, unit: float
) -> Float[np.ndarray, "3 4"]:
    """Pose of a camera in blocks, converted to the tracer's unit.

    ahead: horizontal direction, any length; drop, distance: of the point of interest, below the eye and ahead of it
    """
    low, high = map(math.radians, PITCHES)
    pitch = min(max(math.atan2(drop, max(distance, 1.0)), low), high)
    flat = ahead / max(float(np.linalg.norm(ahead)), 1e-6) * math.cos(pitch)
    place = (eye - middle) / unit
    return look_at(place, place + np.array([*flat, math.sin(pitch)]))


def periodic(path: Float[np.ndarray, "point 3"], share: float) -> Float[np.ndarray, " 3"]:
    """Point of a closed path at a share of its length, by linear interpolation."""
    at = share % 1 * len(path)
    k = int(at)
    return path[k % len(path)] + (at - k) * (path[(k + 1) % len(path)] - path[k % len(path)])
