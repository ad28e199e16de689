"""Resizing of pixel values: area averages of light, nearest values of everything else."""

import math

import numpy as np
from jaxtyping import Bool, Int, Shaped
from PIL import Image

Size = tuple[int, int]
AVERAGED_ENCODINGS = ("sRGB", "linear", "linear premultiplied")  # see `Layer`


def resized(
    values: np.ndarray, size: Size, encoding: str, known: Bool[np.ndarray, "height width"] | None = None
) -> np.ndarray:
    """Values (height, width) or (height, width, channels) at a size (width, height), in their own type.

    Light is averaged over each new pixel's area, over known values alone, weighted by a fourth channel's alpha. A
    mosaic stays one (`in_phase`). Anything else is never mixed: the value at the new pixel's centre, or if unknown, the
    nearest known one within the new pixel. Offsets in pixels are scaled with the size.
    """
    height, width = values.shape[:2]
    if (width, height) == size:
        return values
    if encoding in AVERAGED_ENCODINGS and size[0] <= width and size[1] <= height:
        return averaged(values, size, known, straight=encoding != "linear premultiplied")
    if encoding == "mosaic":
        return in_phase(values, size)
    if encoding == "filter":
        return np.tile(values[:2, :2], (-(-size[1] // 2), -(-size[0] // 2)))[: size[1], : size[0]]
    index = picked((width, height), size, known)
    found = values.reshape(height * width, *values.shape[2:])[index].reshape(size[1], size[0], *values.shape[2:])
    return (
        (found * np.array([size[0] / width, size[1] / height])).astype(values.dtype) if encoding == "pixels" else found
    )


def in_phase(values: Shaped[np.ndarray, "height width"], size: Size) -> np.ndarray:
    """A mosaic at another size: means over pixels under the same filter of the 2 x 2 pattern; NaN for none."""
    found = np.empty(size[::-1], values.dtype)
    for phase in np.ndindex(2, 2):
        own = tuple(slice(first, None, 2) for first in phase)
        there = np.zeros(values.shape, bool)
        there[own] = True
        found[own] = averaged(values, size, there, straight=True)[own]
    return found


def averaged(values: np.ndarray, size: Size, known: np.ndarray | None, straight: bool) -> np.ndarray:
    """Means over areas. straight: whether colours are not premultiplied by the alpha in their fourth channel"""
    planes = values.astype(np.float32).reshape(*values.shape[:2], -1)
    weight = np.ones(values.shape[:2], np.float32) if known is None else known.astype(np.float32)
    planes = np.where(weight[..., None] > 0, planes, 0)
    colours, alpha = (planes[..., :3], planes[..., 3]) if straight and planes.shape[-1] == 4 else (planes, None)
    share = weight if alpha is None else weight * alpha
    means = [box(colours[..., i] * share, size) for i in range(colours.shape[-1])]
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = box(share, size)
        found = [mean / whole if alpha is None else np.where(whole > 0, mean / whole, 0) for mean in means]
        found += [] if alpha is None else [box(weight * alpha, size) / box(weight, size)]
    stacked = np.stack(found, -1).reshape(size[1], size[0], *values.shape[2:])
    return stacked.astype(values.dtype) if values.dtype.kind == "f" else np.rint(stacked).astype(values.dtype)


def box(plane: np.ndarray, size: Size) -> np.ndarray:
    return np.asarray(Image.fromarray(np.ascontiguousarray(plane, np.float32)).resize(size, Image.Resampling.BOX))


def picked(own: Size, size: Size, known: Bool[np.ndarray, "height width"] | None) -> Int[np.ndarray, " pixel"]:
    """Nearest known source pixel, as a row-major index, for each pixel of another size."""
    width = own[0]
    (x, left, right), (y, top, bottom) = (middles(n, m) for n, m in zip(own, size, strict=True))
    index = y[:, None] * width + x
    if known is None:
        return index.reshape(-1)
    missing = ~known[y[:, None], x]
    reach = [math.ceil(n / m) for n, m in zip(own, size, strict=True)]
    around = [(dx, dy) for dy in range(-reach[1], reach[1] + 1) for dx in range(-reach[0], reach[0] + 1)]
    for dx, dy in sorted(around, key=lambda d: d[0] ** 2 + d[1] ** 2):
        if not missing.any():
            break
        column, row = x + dx, y + dy
        inside = ((column >= left) & (column < right)) & ((row >= top) & (row < bottom))[:, None]
        there = missing & inside
        there[there] = known[
            np.broadcast_to(row[:, None], there.shape)[there], np.broadcast_to(column, there.shape)[there]
        ]
        index[there] += dy * width + dx
        missing &= ~there
    return index.reshape(-1)


def middles(own: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source pixels of each of `count` pixels along an axis: the one at its centre, and the range inside."""
    edges = np.arange(count + 1) * (own / count)
    first = np.ceil(edges - 0.5).astype(np.int64)
    centre = np.minimum(((edges[:-1] + edges[1:]) / 2).astype(np.int64), own - 1)
    return centre, first[:-1], first[1:]
