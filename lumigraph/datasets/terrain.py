"""Procedural terrain: heights, ground and trees of a square of land, for block worlds and for landscapes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter, map_coordinates

from .world import LABELS

SKY, GRASS, DIRT, STONE, SAND, WATER, TREE, SNOW = range(len(LABELS))
WATER_LEVEL, BEACH, SNOW_LINE = 4.0, 1.0, 15.0  # heights, blocks
RELIEF = 16.0  # between the lowest and the highest ground, blocks
STEEP = 0.85  # slope from which on stone shows, blocks to a block
HILLS = 44.0  # blocks from one hill to the next
OCTAVES, ROUGHNESS = 6, 0.42  # of the hills, and the share of each in the one before
TREE_SPACING = 5  # blocks, of the grid in which each cell may have a tree
TREE_HEIGHTS, CROWNS = (4.0, 6.5), (1.6, 2.6)  # blocks: from the ground to the top, and radii


@dataclass(frozen=True)
class Terrain:
    """A square of land. Rows go along x, columns along y; positions are in blocks from its corner.

    ground: height of the surface without trees, also under water, blocks
    label:  index into `LABELS` of the surface without trees
    trees:  x, y, height of the top above the ground, radius of the crown, blocks
    fine:   points to a block
    """

    ground: Float[np.ndarray, "x y"]
    label: Int[np.ndarray, "x y"]
    trees: Float[np.ndarray, "tree 4"]
    fine: int

    @property
    def surface(self) -> tuple[Float[np.ndarray, "x y"], Int[np.ndarray, "x y"]]:
        """Height and label of the upper surface: water and crowns of trees included."""
        height, label = np.maximum(self.ground, WATER_LEVEL), self.label.copy()
        axis = (np.arange(len(height)) + 0.5) / self.fine
        for x, y, top, radius in self.trees:
            i, j = (np.flatnonzero(np.abs(axis - centre) < radius) for centre in (x, y))
            if not len(i) or not len(j):
                continue
            part = np.ix_(i, j)
            off = ((axis[i, None] - x) ** 2 + (axis[None, j] - y) ** 2) / radius**2
            base = height[
                int(np.clip(x * self.fine, 0, len(height) - 1)), int(np.clip(y * self.fine, 0, len(height) - 1))
            ]
            crown = np.where(off < 1, base + top * (0.45 + 0.55 * np.sqrt(np.maximum(1 - off, 0))), -np.inf)
            label[part] = np.where(crown > height[part], TREE, label[part])
            height[part] = np.maximum(height[part], crown)
        return height, label


def terrain(width: int, seed: int, fine: int = 1) -> Terrain:
    """Land of `width` blocks a side with `fine` points to a block. Finer points lie on the same land."""
    random = np.random.default_rng([seed, 41])

    def noise(period: float, octaves: int, gain: float) -> Float[np.ndarray, "x y"]:
        return fractal(width, fine, period, octaves, gain, random)

    ridges = 1 - np.abs(noise(1.3 * HILLS, OCTAVES, ROUGHNESS))
    ground = WATER_LEVEL + RELIEF * (0.5 * noise(HILLS, OCTAVES, ROUGHNESS) + 0.6 * ridges - 0.17)
    ground = np.where(ground < WATER_LEVEL, WATER_LEVEL - 2 + 2 * np.exp((ground - WATER_LEVEL) / 2), ground)
    bare, forest = (noise(22.0, 4, 0.5) for _ in range(2))
    slope = np.hypot(*np.gradient(gaussian_filter(ground, 0.7 * fine), 1 / fine))
    label = np.full(ground.shape, GRASS)
    label[bare > 0.6] = DIRT
    label[ground > SNOW_LINE + 3 * bare] = SNOW
    label[slope > STEEP + 0.2 * bare] = STONE
    label[ground < WATER_LEVEL + BEACH] = SAND
    label[ground < WATER_LEVEL] = WATER
    trees = []
    for x in range(0, width, TREE_SPACING):
        for y in range(0, width, TREE_SPACING):
            place = np.array([x, y]) + random.uniform(0.5, TREE_SPACING - 0.5, 2)
            size, chance = random.uniform(), random.uniform()
            i, j = np.minimum((place * fine).astype(int), len(ground) - 1)
            if place.max() < width and label[i, j] == GRASS and chance < 0.25 + 1.6 * forest[i, j]:
                low, high = np.array([TREE_HEIGHTS, CROWNS]).T
                trees.append([*place, *(low + size * (high - low))])
    return Terrain(ground, label, np.array(trees).reshape(-1, 4), fine)


def fractal(
    width: int, fine: int, period: float, octaves: int, gain: float, random: np.random.Generator
) -> Float[np.ndarray, "x y"]:
    """Fractal noise of several octaves over a square, most of it in [-1, 1].

    width: of the square; fine: points to a unit; period: of the first octave, units; gain: amplitude ratio of
    successive octaves
    """
    at, total, amplitude = (np.arange(width * fine) + 0.5) / fine, np.zeros((width * fine,) * 2), 1.0
    for octave in range(octaves):
        scale = 2**octave / period
        lattice = random.uniform(-1, 1, (int(width * scale) + 4,) * 2)
        places = np.stack(np.meshgrid(at * scale + 1, at * scale + 1, indexing="ij"))
        total += amplitude * map_coordinates(lattice, places, order=3, mode="nearest")
        amplitude *= gain
    return total
