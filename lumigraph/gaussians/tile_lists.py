"""Lists of the Gaussians of each tile in the layout of gsplat (Ye 2024), in plain PyTorch."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..kernels.project import MIN_ALPHA
from ..kernels.tile import Tiles

DEPTH_BITS = 32  # of an intersection's number, below those of its tile


def tile_bits(across: int, down: int) -> int:
    """Bits of a tile's number."""
    return (across * down - 1).bit_length()


@torch.no_grad()
def isect_tiles(
    means2d: Float[Tensor, "*rows 2"],
    radii: Int[Tensor, "*rows 2"],
    depths: Float[Tensor, "*rows"],
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Int[Tensor, " row"] | None = None,
    gaussian_ids: Int[Tensor, " row"] | None = None,
    conics: Float[Tensor, "*rows 3"] | None = None,
    opacities: Float[Tensor, "*rows"] | None = None,
) -> tuple[Int[Tensor, "*rows"], Int[Tensor, " pair"], Int[Tensor, " pair"]]:
    """Tiles that each footprint's rectangle touches; with conics and opacities, those that its ellipse touches.

    means2d:  pixels, of (image, gaussian) or packed rows;  radii: pixels
    packed:   rows have their images in image_ids;  segmented: accepted, and without effect on the result

    Returns the number of tiles of each row; for each pair of a tile and a row image | tile | bits of the depth, sorted
    near to far within a tile; and the row of each pair, numbered from 0 through all images.
    """
    rows = radii.shape[:-1]
    centre, reach, depth = means2d.reshape(-1, 2), radii.reshape(-1, 2).to(means2d), depths.reshape(-1).float()
    if image_ids is None:
        of_image = rows[-1] if rows else 1
        image_ids = torch.arange(len(centre), device=centre.device) // max(of_image, 1)
    edge = centre.new_tensor([tile_width, tile_height])
    low = torch.minimum(((centre - reach) / tile_size).floor().clamp_min(0), edge).long()
    high = torch.minimum(((centre + reach) / tile_size).ceil().clamp_min(0), edge).long()
    span = (high - low) * (reach > 0).all(-1, keepdim=True)
    count = span.prod(-1)
    row = torch.arange(len(centre), device=centre.device).repeat_interleave(count)
    place = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count)[row]
    x, y = low[row, 0] + place % span[row, 0], low[row, 1] + place // span[row, 0]
    if conics is not None and opacities is not None:
        near = touched(centre[row], conics.reshape(-1, 3)[row], opacities.reshape(-1)[row], x, y, tile_size)
        row, x, y = row[near], x[near], y[near]
        count = torch.bincount(row, minlength=len(centre))
    tile = (image_ids.long()[row] << tile_bits(tile_width, tile_height)) | (y * tile_width + x)
    pairs = (tile << DEPTH_BITS) | (depth.view(torch.int32)[row].long() & 0xFFFFFFFF)
    if sort:
        pairs, order = pairs.sort(stable=True)
        row = row[order]
    return count.view(rows).int(), pairs, row.int()


def touched(
    centres: Float[Tensor, "pair 2"],
    conics: Float[Tensor, "pair 3"],
    opacities: Float[Tensor, " pair"],
    x: Int[Tensor, " pair"],
    y: Int[Tensor, " pair"],
    side: int,
) -> Tensor:
    """True where opacity exp(-q / 2) reaches 1/255 in tile (x, y); q is least inside, or on an edge of the tile."""
    a, b, c = conics.unbind(-1)
    x0, y0 = x * side - centres[:, 0], y * side - centres[:, 1]
    x1, y1 = x0 + side, y0 + side
    inside = (x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0)
    ways = [(u, torch.maximum(torch.minimum(-b * u / c, y1), y0)) for u in (x0, x1)]
    ways += [(torch.maximum(torch.minimum(-b * v / a, x1), x0), v) for v in (y0, y1)]
    least = torch.stack([a * u * u + 2 * b * u * v + c * v * v for u, v in ways]).amin(0)
    return torch.where(inside, 0.0, least) <= 2 * (opacities / MIN_ALPHA).clamp_min(1e-30).log()


@torch.no_grad()
def isect_offset_encode(
    isect_ids: Int[Tensor, " pair"], n_images: int, tile_width: int, tile_height: int
) -> Int[Tensor, "image down across"]:
    """Position of each tile's first pair among all pairs of `isect_tiles`."""
    images = torch.arange(n_images, device=isect_ids.device)[:, None] << tile_bits(tile_width, tile_height)
    tiles = images | torch.arange(tile_width * tile_height, device=isect_ids.device)
    found = torch.searchsorted(isect_ids >> DEPTH_BITS, tiles.flatten())
    return found.view(n_images, tile_height, tile_width).int()


def tiles_of(
    offsets: Int[Tensor, "image down across"],
    flatten_ids: Int[Tensor, " pair"],
    image: int,
    size: tuple[int, int],
    side: int,
    mask: Tensor | None = None,
) -> tuple[Tiles, int, int]:
    """Tile lists of one image for the kernels, and the first row and the row after the last that they name.

    mask: (down, across), False for tiles that are left empty
    """
    ends = torch.cat([offsets.flatten().long(), offsets.new_tensor([len(flatten_ids)]).long()])
    per_image = offsets[0].numel()
    starts = ends[image * per_image : (image + 1) * per_image + 1]
    order = flatten_ids[int(starts[0]) : int(starts[-1])]
    counts = starts.diff()
    if mask is not None:
        order, counts = order[mask.flatten().repeat_interleave(counts)], counts * mask.flatten()
    starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    first, last = (int(order.min()), int(order.max()) + 1) if len(order) else (0, 0)
    return Tiles(order.int() - first, starts, size, side), first, last
