"""Georeferencing by control points: places that a surveyor has measured and that photographs show."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..files import read_text
from ..files.names import counted
from ..files.reading import reading
from ..geometry import Similarity, unit
from ..method import Method
from ..readers.finding import paired
from ..readers.points import umeyama

COLUMNS = ("image", "u", "v", "x", "y", "z")  # of the file; u and v are pixels of the photograph in its own size
MIN_POINTS = 3
MIN_ANGLE = 1.0  # degrees between rays, below which depth places a point
MIN_SPREAD = 1e-3  # least share of their length by which points must leave a line


@dataclass(frozen=True)
class ControlPoint:
    """A measured place, and the pixels that show it: photograph, u, v."""

    place: tuple[float, float, float]
    seen: list[tuple[str, float, float]]


@dataclass(frozen=True)
class Survey:
    """Result of georeferencing.

    world_from_source: from the frame of the photographs to that of the control points
    residuals: of each point, in the control points' unit
    by_depth: number of points that one photograph alone shows, placed by the model's depth
    """

    world_from_source: Similarity
    points: list[ControlPoint]
    residuals: Float[np.ndarray, "point 3"]
    by_depth: int

    @property
    def rms(self) -> float:
        """Root of the mean squared distance."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))


def read_control_points(path: Path) -> list[ControlPoint]:
    """Control points of a table: image, u, v, x, y, z on each line, between commas, semicolons or tabs. Raises
    LumigraphError for another file."""
    text = read_text(path)
    mark = max(";\t,", key=text.count)
    seen: dict[tuple[float, float, float], list[tuple[str, float, float]]] = {}
    for number, row in enumerate(csv.reader(io.StringIO(text), delimiter=mark), 1):
        words = [word.strip() for word in row]
        if (
            not any(words)
            or words[0].startswith("#")
            or (number == 1 and [w.lower() for w in words[:3]] == [*COLUMNS[:3]])
        ):
            continue
        with reading(f"{path}, line {number}", f"is not {', '.join(COLUMNS)}", "correct it"):
            image, (u, v, x, y, z) = words[0], (float(word) for word in words[1:6])
        seen.setdefault((x, y, z), []).append((image, u, v))
    return [ControlPoint(place, pixels) for place, pixels in seen.items()]


def georeferenced(points: Sequence[ControlPoint], scene: Scene, method: Method, path: Path) -> Survey:
    """The similarity that leads the scene onto control points, least squares.

    Raises LumigraphError for fewer than MIN_POINTS, for points on a line, and for photographs that the scene lacks.
    """
    if len(points) < MIN_POINTS:
        raise LumigraphError(
            f"{path} has {counted(len(points), 'control point')}, and {MIN_POINTS} are the least; add more"
        )
    numbers = {name: i for i, name in enumerate(scene.names)}
    asked = {image for point in points for image, _, _ in point.seen}
    found = {name: name for name in asked if name in numbers} | by_end(asked - numbers.keys(), scene.names)
    if missing := sorted(asked - found.keys()):
        raise LumigraphError(
            f"{path} names {missing[0]}, and the scene has no such photograph; it has {scene.names[0]}"
        )
    places, by_depth = [], 0
    for point in points:
        shown = [(numbers[found[image]], u, v) for image, u, v in point.seen]
        place, measured = located(shown, scene, method)
        places.append(place)
        by_depth += measured
    source = scene.frame.to_source.points(torch.tensor(np.array(places))).numpy()
    target = np.array([point.place for point in points])
    spread = np.linalg.svd(target - target.mean(0), compute_uv=False)
    if spread[1] < MIN_SPREAD * max(spread[0], 1e-300):
        raise LumigraphError(f"The control points of {path} lie on a line, which leaves a turn open; add one beside it")
    matrix = umeyama(source, target)
    world = Similarity.of(matrix.tolist())
    residuals = world.points(torch.tensor(source)).numpy() - target
    return Survey(world, list(points), residuals, by_depth)


def by_end(asked: set[str], names: Sequence[str]) -> dict[str, str]:
    """Photographs that are named by the end of their path, or without the folder of all."""
    pairs = paired(asked, names)
    for name in asked - pairs.keys():
        ends = [other for other in names if other.endswith(f"/{name}") or Path(other).name == name]
        pairs |= {name: ends[0]} if len(ends) == 1 else {}
    return pairs


def located(
    shown: Sequence[tuple[int, float, float]], scene: Scene, method: Method
) -> tuple[Float[np.ndarray, " 3"], bool]:
    """Place of a point in the scene's frame: by the rays of all its pixels or, where they have one direction, by the
    model's depth. True for the second."""
    rays = []
    for number, u, v in shown:
        camera = scene.cameras[number]
        pixel = torch.tensor([[u, v]]) * camera.size[0] / own_size(scene, number)
        rays.append((camera, pixel, camera.rays(pixel)))
    origins = torch.cat([ray.origins for _, _, ray in rays]).double()
    directions = unit(torch.cat([ray.directions for _, _, ray in rays]).double())
    if float((directions @ directions.T).amin()) < math.cos(math.radians(MIN_ANGLE)):
        across = torch.eye(3, dtype=torch.float64) - directions[:, :, None] * directions[:, None, :]
        return torch.linalg.solve(across.sum(0), (across @ origins[:, :, None]).sum(0))[:, 0].numpy(), False
    camera, pixel, _ = rays[0]
    depth = method.render(camera).depth.cpu()
    last = torch.tensor(depth.shape).flip(0) - 1
    x, y = torch.minimum(pixel[0].long().clamp_min(0), last).tolist()
    if not math.isfinite(float(depth[y, x])):
        raise LumigraphError(
            f"{scene.names[shown[0][0]]} alone shows a control point, where the model has nothing; name a second "
            "photograph"
        )
    return (origins[0] + depth[y, x].double() * directions[0]).numpy(), True


def own_size(scene: Scene, number: int) -> Int[torch.Tensor, " 2"]:
    """Width and height of a photograph before it was reduced."""
    sizes = scene.full_sizes
    return scene.cameras.size[number] if sizes is None else sizes[number]
