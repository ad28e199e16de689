"""Categories: procedural objects of one kind, any number of them, with random proportions, colours and materials. One
file each, found by its name, with `objects(random)` and the common `BOUNDS`. The rotation of the first object is the
deviation from the category's common orientation."""

import importlib
import pkgutil
from dataclasses import replace

import numpy as np

from ..cameras import dome, pinhole, spiral
from ..stage import SyntheticStage
from ..world import Lamp, Object, Sky, Vector, World

CAMERA_DISTANCE, FIELD_OF_VIEW = 3.2, 34.0  # scene units from the centre; field of view, degrees
MIN_ELEVATION, MAX_ELEVATION = 8.0, 60.0  # degrees of the cameras above the horizon
KEY = Lamp((-2.8, -1.5, 3.2), radius=0.42, power=16.0, colour=(1.0, 0.95, 0.87))
FILL = Lamp((3.0, 0.6, 2.2), radius=0.8, power=4.0, colour=(0.86, 0.93, 1.0))
SKY = Sky((0.84, 0.91, 1.0), (0.95, 0.94, 0.92), (0.70, 0.62, 0.54), light=0.45)


def available() -> list[str]:
    return sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__) if module.name != "parts")


def stage(name: str, member: int, size: int, views: int, seed: int) -> SyntheticStage:
    """One object of a category, seen from a dome; held-out views climb around it. The object depends only on seed and
    member.

    size: of the square pictures, pixels; views: training views
    """
    category = importlib.import_module(f".{name.replace('-', '_')}", __name__)
    random = np.random.default_rng((seed, member))
    objects = tuple(category.objects(random))
    surroundings = surrounded(objects, category.BOUNDS, size, views, random)
    return replace(surroundings, turn=objects[0].pose.rotation)


def surrounded(
    objects: tuple[Object, ...], bounds: tuple[Vector, Vector], size: int, views: int, random: np.random.Generator
) -> SyntheticStage:
    """Objects in the categories' common light, seen from a dome; held-out views climb around them."""
    world = World(objects, (KEY, FILL), SKY)
    cameras = {
        "train": pinhole(dome(views, CAMERA_DISTANCE, random, MIN_ELEVATION, MAX_ELEVATION), size, FIELD_OF_VIEW),
        "test": pinhole(
            spiral(max(views * 2 // 5, 1), CAMERA_DISTANCE, random, MIN_ELEVATION, MAX_ELEVATION), size, FIELD_OF_VIEW
        ),
    }
    reach = max(abs(x) for corner in bounds for x in corner)
    return SyntheticStage(world, cameras, bounds, reach=reach, near=1.5)
