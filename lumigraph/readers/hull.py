"""Bounding box of an object from its silhouettes, by a coarse visual hull (Laurentini 1994)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from ..camera import Camera
from ..camera.lens import OpenCV, Pinhole
from ..datasets.images import ImageStore
from ..datasets.scene import Vector

MAX_VIEWS = 24
GRID_SIDES = (32, 32, 64)  # cells along each side of the searched box; each round searches the result of the last
MAX_DOUBLINGS = 2  # of the first box, while the hull touches its walls
MIN_OPACITY = 8  # of 255: a pixel of higher opacity, or further from the background, belongs to the object
BORDER_SHARE = 0.97  # of the pixels at the pictures' edges have one colour, where there is a plain background
MIN_VIEW_SHARE = 0.5  # share of the views that must have a point inside their picture
MAX_DISAGREEMENTS = (0.0, 0.1)  # share of the views: first none, then some, because masks are seldom perfect
MOVING_DISAGREEMENTS = (0.8,)  # the same of what moves, and is in one place in few of the views


@dataclass(frozen=True)
class Silhouette:
    """Silhouette of the object in one camera."""

    camera: Camera
    inside: Bool[Tensor, "height width"]


def silhouettes(
    cameras: Camera, images: ImageStore, views: list[int], centre: Float[np.ndarray, " 3"]
) -> tuple[list[Silhouette], Vector] | None:
    """Silhouettes of an object that has alpha or a plain backdrop. None for other photographs.

    centre: rough point of interest
    Returns also the background colour: that of the photographs, or white for alpha.
    """
    position = cameras.position[views].double().numpy() - centre
    position /= np.linalg.norm(position, axis=-1, keepdims=True).clip(min=1e-9)
    chosen = [views[i] for i in farthest(position, MAX_VIEWS)]
    if images.has_alpha:
        return [Silhouette(cameras[i], images[i][..., 3] > MIN_OPACITY) for i in chosen], (1.0, 1.0, 1.0)
    if not isinstance(cameras.lens, Pinhole | OpenCV):
        return None  # the black around a fisheye's circle is no background
    edges = torch.cat([border(images[i]) for i in chosen]).int()
    colour = edges.median(0).values
    if not differs(edges, colour).float().mean() <= 1 - BORDER_SHARE:
        return None
    red, green, blue = (colour / 255).tolist()
    return [Silhouette(cameras[i], filled(differs(images[i], colour))) for i in chosen], (red, green, blue)


def differs(pixels: Tensor, colour: Tensor) -> Tensor:
    return (pixels.int() - colour).abs().amax(-1) > MIN_OPACITY


def border(picture: Tensor) -> Tensor:
    """The pixels along a picture's four edges."""
    return torch.cat([picture[0], picture[-1], picture[:, 0], picture[:, -1]])


def filled(inside: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Mask filled between inside pixels of a row or a column, where an object may look like the background."""

    def between(x: Tensor, axis: int) -> Tensor:
        before, after = x.cummax(axis).values, x.flip(axis).cummax(axis).values.flip(axis)
        return before & after

    x = inside.int()
    return (between(x, 0) | between(x, 1)).bool()


def hull_box(
    outlines: list[Silhouette], centre: Float[np.ndarray, " 3"], half: float, moves: bool = False
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]] | None:
    """Two corners of the box around the object, which lies within about `half` of `centre`. None for an empty or
    unbounded
    hull. moves: whether the views have different times"""
    for slack in MOVING_DISAGREEMENTS if moves else MAX_DISAGREEMENTS:
        low, high = centre - half, centre + half
        for _ in range(MAX_DOUBLINGS + 1):
            found = carve(outlines, low, high, GRID_SIDES[0], slack)
            if found is None or ends_inside(found, low, high):
                break
            low, high = centre + 2 * (low - centre), centre + 2 * (high - centre)
        else:
            return None
        for grid in GRID_SIDES[1:]:
            if found is not None:
                found = carve(outlines, found[0] - found[2], found[1] + found[2], grid, slack)
        if found is not None:
            return found[:2]
    return None


def ends_inside(found: tuple[np.ndarray, np.ndarray, np.ndarray], low: np.ndarray, high: np.ndarray) -> bool:
    """True if the box is at least a cell inside the searched box."""
    inner_low, inner_high, cell = found
    return bool((inner_low > low + cell).all() and (inner_high < high - cell).all())


def carve(
    outlines: list[Silhouette], low: np.ndarray, high: np.ndarray, grid: int, slack: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Bounding box of the grid cells inside all silhouettes, and a cell's size."""
    cell = (high - low) / grid
    axes = [torch.from_numpy(low[k] + cell[k] * (np.arange(grid) + 0.5)).float() for k in range(3)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    radius = 0.5 * float(np.linalg.norm(cell))  # so that no part of a cell is lost
    seen, missed = torch.zeros(len(points)), torch.zeros(len(points))
    for outline in outlines:
        places, inside_picture = outline.camera.locate(points)
        pooled, times = widened(outline, points.mean(0), radius)
        seen += inside_picture
        missed += inside_picture & ~pooled[(places // times).unbind(-1)]
        keep = missed <= slack * len(outlines)
        points, seen, missed = points[keep], seen[keep], missed[keep]
        if not len(points):
            return None
    points = points[seen >= MIN_VIEW_SHARE * len(outlines)]
    if not len(points):
        return None
    lowest, highest = (x.double().numpy() for x in points.aminmax(dim=0))
    return lowest - 0.5 * cell, highest + 0.5 * cell, cell


def widened(outline: Silhouette, where: Tensor, radius: float) -> tuple[Tensor, int]:
    """The silhouette dilated by a cell's radius, on a coarser grid, and the reduction factor."""
    sideways = outline.camera.pose[0, :, 0]
    ends, _ = outline.camera.project(torch.stack([where, where + radius * sideways]))
    pixels = float((ends[1] - ends[0]).norm())
    times = max(1, int(pixels / 2))
    grow = int(np.ceil(pixels / times))
    mask = outline.inside[None, None].float()
    coarse = functional.max_pool2d(mask, times, ceil_mode=True)
    return functional.max_pool2d(coarse, 2 * grow + 1, 1, grow)[0, 0] > 0, times


def farthest(points: Float[np.ndarray, "point 3"], count: int) -> list[int]:
    """Indices of points by farthest-point sampling."""
    chosen = [0]
    away = np.linalg.norm(points - points[0], axis=-1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=-1))
    return chosen
