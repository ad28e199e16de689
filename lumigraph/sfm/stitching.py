"""Panorama of photographs from a single position, which have no parallax.

Photographs differ by a rotation, K R K⁻¹ between their pixels (Szeliski 2006, "Image Alignment and Stitching"). The
rotations follow from the strongest pairs and are then adjusted together with the focal length.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from ..color.tags import save_srgb
from ..files import replacing
from ..geometry import evenly
from ..readers.pictures import read_image
from ..system.library import pycolmap
from .diagnosis import MIN_MATCHES, calibration, deviation_from_turn

MAX_WIDTH = 6000  # pixels of a whole turn
PAIR_MATCHES = 40  # matches of each pair that take part in the adjustment
ROBUST_ANGLE = 0.003  # radians between two rays of one point, from which on it counts less
FEATHER_POWER = 2.0  # of the distance from the edge, by which photographs fade into each other
JPEG_QUALITY = 92


@dataclass(frozen=True)
class TurnedPair:
    """Two photographs by their numbers, pixels of their matches, and their homography."""

    first: int
    second: int
    pixels: tuple[Float[np.ndarray, "match 2"], Float[np.ndarray, "match 2"]]
    homography: Float[np.ndarray, "3 3"]


def stitch(database: Path, images: Path, target: Path) -> int:
    """Write a panorama of the photographs in a database, an equirectangular JPEG cropped to their coverage. Returns the
    number of photographs in it; 0, and nothing is written, if fewer than two fit together."""
    names, sizes, pairs = turned_pairs(database)
    if not pairs:
        return 0
    _, ratio = deviation_from_turn([(p.homography, sizes[p.first], sizes[p.second]) for p in pairs])
    rotations = chained(pairs, sizes, ratio)
    ratio = adjust(rotations, pairs, sizes, ratio)
    level(rotations)
    width = min(MAX_WIDTH, 2 * round(math.pi * ratio * max(max(sizes[i]) for i in rotations)))
    picture = blended({images / names[i]: turn for i, turn in rotations.items()}, ratio, width)
    with replacing(target, "capture") as partial:
        save_srgb(Image.fromarray(picture), partial, "JPEG", quality=JPEG_QUALITY)
    return len(rotations)


def turned_pairs(database: Path) -> tuple[list[str], list[tuple[int, int]], list[TurnedPair]]:
    """Names and sizes of photographs, and the pairs with a homography."""
    with closing(pycolmap.Database.open(database)) as opened:
        images, cameras = opened.read_all_images(), {c.camera_id: c for c in opened.read_all_cameras()}
        place = {image.image_id: i for i, image in enumerate(images)}
        sizes = [(cameras[i.camera_id].width, cameras[i.camera_id].height) for i in images]
        pixels = [opened.read_keypoints(image.image_id)[:, :2].astype(float) for image in images]
        kinds, pairs = pycolmap.TwoViewGeometryConfiguration, []
        for number, found in zip(*opened.read_two_view_geometries(), strict=True):
            turned = found.config in (kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
            if turned and len(found.inlier_matches) >= MIN_MATCHES:
                i, j = (place[k] for k in pycolmap.pair_id_to_image_pair(number))
                a, b = found.inlier_matches.T
                pairs.append(TurnedPair(i, j, (pixels[i][a], pixels[j][b]), np.array(found.H)))
    return [image.name for image in images], sizes, pairs


def chained(pairs: Sequence[TurnedPair], sizes: Sequence[tuple[int, int]], ratio: float) -> dict[int, np.ndarray]:
    """Rotations, camera-to-world, of the largest connected component, chained along its strongest pairs."""
    ratios, between = np.array([ratio]), {}
    for pair in pairs:
        first, second = (calibration(sizes[i], ratios)[0] for i in (pair.first, pair.second))
        motion = np.linalg.inv(second) @ pair.homography @ first
        u, _, vt = np.linalg.svd(motion / np.cbrt(np.linalg.det(motion)))
        between[pair.first, pair.second] = vt.T @ u.T  # first-from-second
    rows, columns = np.array(list(between)).T
    strength = np.array([1 / len(pair.pixels[0]) for pair in pairs])
    tree = minimum_spanning_tree(csr_array(coo_array((strength, (rows, columns)), (len(sizes), len(sizes)))))
    starts = set(rows.tolist())
    group: dict[int, np.ndarray] = {}
    while starts:
        order, before = breadth_first_order(tree, starts.pop(), directed=False)
        found = {int(order[0]): np.eye(3)}
        for i in order[1:].tolist():
            j = int(before[i])
            found[i] = found[j] @ (between[j, i] if (j, i) in between else between[i, j].T)
        starts -= found.keys()
        group = found if len(found) > len(group) else group
    return group


def adjust(
    rotations: dict[int, np.ndarray], pairs: Sequence[TurnedPair], sizes: Sequence[tuple[int, int]], ratio: float
) -> float:
    """Bundle-adjust rotations, in place, and the focal length. Returns the focal length in terms of the longer side."""
    place = {number: i for i, number in enumerate(rotations)}
    inside = [pair for pair in pairs if pair.first in place]
    chosen = [evenly(range(len(pair.pixels[0])), PAIR_MATCHES) for pair in inside]

    def one_side(numbers: Sequence[int], pixels: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Index of the photograph of each match, and its pixel from the centre in terms of the longer side."""
        scaled = [
            (p[k] - np.array(sizes[i]) / 2) / max(sizes[i]) for p, k, i in zip(pixels, chosen, numbers, strict=True)
        ]
        return np.repeat([place[i] for i in numbers], [len(k) for k in chosen]), np.concatenate(scaled)

    sides = [
        one_side([pair.first for pair in inside], [pair.pixels[0] for pair in inside]),
        one_side([pair.second for pair in inside], [pair.pixels[1] for pair in inside]),
    ]
    begun = Rotation.from_matrix(np.stack(list(rotations.values())))

    def turned(x: np.ndarray) -> Rotation:
        return begun * Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), x[1:].reshape(-1, 3)]))

    def residuals(x: np.ndarray) -> np.ndarray:
        now, rays = turned(x), []
        for numbers, pixels in sides:
            ray = np.concatenate([pixels, np.full((len(pixels), 1), ratio * math.exp(x[0]))], 1)
            rays.append(now[numbers].apply(ray / np.linalg.norm(ray, axis=1, keepdims=True)))
        return (rays[0] - rays[1]).ravel()

    count, each = len(sides[0][0]), np.arange(3)
    moved = np.zeros((3 * count, 3 * len(rotations) + 1))[:, : 3 * len(rotations) - 2]
    moved[:, 0] = 1
    for numbers, _ in sides:
        for row in np.flatnonzero(numbers):  # the first photograph stays
            moved[3 * row : 3 * row + 3, 3 * numbers[row] - 2 + each] = 1
    start = np.zeros(3 * len(rotations) - 2)
    found = least_squares(residuals, start, loss="soft_l1", f_scale=ROBUST_ANGLE, jac_sparsity=csr_array(moved))
    rotations.update(zip(rotations, turned(found.x).as_matrix(), strict=True))
    return ratio * math.exp(found.x[0])


def level(rotations: dict[int, np.ndarray]) -> None:
    """Rotate all, in place, so that photographs are level on average, and their mean direction is ahead: x right, y
    down, z ahead in the world too."""
    stacked = np.stack(list(rotations.values()))
    down = np.linalg.eigh(np.einsum("nij,nkj->ik", stacked[:, :, :1], stacked[:, :, :1]))[1][:, 0]
    down *= 1.0 if down @ stacked[:, :, 1].sum(0) > 0 else -1.0
    ahead = stacked[:, :, 2].sum(0)
    right = np.cross(down, ahead)
    if np.linalg.norm(right) < 1e-3 * len(stacked):  # all around
        right = np.cross(down, stacked[0, :, 2])
    right /= np.linalg.norm(right)
    world = np.stack([right, down, np.cross(right, down)])
    rotations.update(zip(rotations, world @ stacked, strict=True))


def blended(turns: Mapping[Path, np.ndarray], ratio: float, width: int) -> np.ndarray:
    """Photographs blended on a sphere `width` pixels around, cropped to their coverage: uint8 (height, width, 3)."""
    height, density = width // 2, width / (2 * math.pi)  # pixels per radian
    total, weight = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    for path, turn in turns.items():
        with Image.open(path) as image:
            own = image.size
        times = min(1.0, density / (ratio * max(own)))
        size = max(round(own[0] * times), 1), max(round(own[1] * times), 1)
        picture = read_image(path, False, size)[..., :3].astype(np.float32)
        focal = ratio * max(size)
        reach = math.atan(math.hypot(*size) / 2 / focal) + 2 / density  # of the corner from the axis
        pitch, heading = math.asin(np.clip(turn[1, 2], -1, 1)), math.atan2(turn[0, 2], turn[2, 2])
        rows = np.arange(height)
        rows = rows[np.abs((rows + 0.5) / density - math.pi / 2 - pitch) < reach]
        pole = abs(pitch) + reach >= math.pi / 2
        half = math.pi if pole else math.asin(min(math.sin(min(reach, math.pi / 2)) / math.cos(pitch), 1.0))
        first = round((heading + math.pi - half) * density)
        columns = np.arange(first, first + min(round(2 * half * density) + 1, width)) % width
        longitude, latitude = (columns + 0.5) / density - math.pi, (rows + 0.5) / density - math.pi / 2
        around, up = np.meshgrid(longitude, latitude)
        rays = np.stack([np.cos(up) * np.sin(around), np.sin(up), np.cos(up) * np.cos(around)], -1) @ turn
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (focal * rays[..., k] / rays[..., 2] + size[k] / 2 for k in (0, 1))
        inside = (rays[..., 2] > 0) & (x > 0) & (x < size[0]) & (y > 0) & (y < size[1])
        at = np.stack([y[inside], x[inside]]) - 0.5
        edge = np.minimum(np.minimum(x, size[0] - x) / size[0], np.minimum(y, size[1] - y) / size[1])[inside]
        counts = (edge.astype(np.float32) + 1e-3) ** FEATHER_POWER
        place = tuple(index[inside] for index in np.meshgrid(rows, columns, indexing="ij"))
        colours = np.stack([map_coordinates(picture[..., k], at, order=1, mode="nearest") for k in range(3)], -1)
        total[place] += counts[:, None] * colours
        weight[place] += counts
    seen = weight > 0
    picture = np.where(seen[..., None], total / np.maximum(weight, 1e-12)[..., None], 0).round().astype(np.uint8)
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    return picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
