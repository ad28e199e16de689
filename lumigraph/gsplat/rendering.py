"""Rendering with the names of gsplat.rendering (Ye 2024): 3-D Gaussians, and 2-D Gaussians in plain PyTorch."""

from __future__ import annotations

from math import prod
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from ..errors import LumigraphError
from ..gaussians.rasterization import MIN_OPACITY, MODES, RasterizeMode, RenderMode, SplatInfo, rasterization
from ..gaussians.surfels import normals_from_depth
from ..gaussians.tile_lists import isect_offset_encode, isect_tiles
from .stages import fully_fused_projection_2dgs, rasterize_to_pixels_2dgs, spherical_harmonics

__all__ = ["RasterizeMode", "RenderMode", "rasterization", "rasterization_2dgs"]


def rasterization_2dgs(
    means: Float[Tensor, "*batch gaussian 3"],
    quats: Float[Tensor, "*batch gaussian 4"],
    scales: Float[Tensor, "*batch gaussian 3"],
    opacities: Float[Tensor, "*batch gaussian"],
    colors: Tensor,
    viewmats: Float[Tensor, "*batch camera 4 4"],
    Ks: Float[Tensor, "*batch camera 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Float[Tensor, "*batch camera channel"] | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
    depth_mode: str = "expected",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, SplatInfo]:
    """Render 2-D Gaussians (Huang 2024): colours, opacities, normals, normals of the depth, distortion, median depth.

    Parameters are those of `rasterization`; eps2d has no effect, as in gsplat. Normals are in the world. Those of the
    depth need a mode with colours and depth, and distortion a depth. info["gradient_2dgs"] receives the gradient that
    strategies read. Raises LumigraphError for absgrad and unknown modes.
    """
    if render_mode not in MODES or depth_mode not in ("expected", "median") or absgrad:
        raise LumigraphError(
            f"rasterization_2dgs() has no absgrad, modes {', '.join(MODES)}, and depth_mode expected or median; "
            f"render_mode={render_mode!r}, depth_mode={depth_mode!r}, absgrad={absgrad} is not among them"
        )
    if distloss and "D" not in render_mode:
        raise LumigraphError(f"distloss needs depth, and render_mode={render_mode!r} has none; take RGB+ED")
    lead, cameras, grid = means.shape[:-2], viewmats.shape[-3], (-(-width // tile_size), -(-height // tile_size))
    found = fully_fused_projection_2dgs(means, quats, scales, viewmats, Ks, width, height, eps2d, near_plane,
                                        far_plane, radius_clip, packed)  # fmt: skip
    ids: dict[str, Any] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    image, alphas = None, opacities.float()[..., None, :].expand(*lead, cameras, -1)
    if packed:
        ids = dict(zip(ids, found[:3], strict=True))
        image = ids["batch_ids"] * cameras + ids["camera_ids"]
        alphas, found = alphas.flatten(0, -2)[image, ids["gaussian_ids"]], found[4:]
    radii, centres, depths, transforms, normals = found
    tiles = isect_tiles(centres, radii, depths, tile_size, *grid, packed=packed, image_ids=image)
    offsets = isect_offset_encode(tiles[1], prod(lead) * cameras, *grid).view(*lead, cameras, *reversed(grid))
    values = [values_of(colors, means, viewmats, sh_degree, ids, image)] if "RGB" in render_mode else []
    values += [depths[..., None]] if "D" in render_mode else []
    if backgrounds is not None:
        backgrounds = pad(backgrounds.float(), (0, 1)) if "D" in render_mode else backgrounds.float()
        backgrounds = backgrounds if "RGB" in render_mode else None
    densify = torch.zeros_like(centres).requires_grad_()
    picture, opacity, normal, distortion, median = rasterize_to_pixels_2dgs(
        centres, transforms, torch.cat(values, -1), alphas, normals, densify, width, height, tile_size, offsets,
        tiles[2], backgrounds, packed=packed)  # fmt: skip
    if "ED" in render_mode:
        picture = torch.cat([picture[..., :-1], picture[..., -1:] / opacity.clamp_min(MIN_OPACITY)], -1)
    surfaces = None
    if "RGB" in render_mode and "D" in render_mode:
        z = median[..., 0] if depth_mode == "median" else picture[..., -1]
        each = zip(z.flatten(0, -3), viewmats.flatten(0, -3), Ks.flatten(0, -3), strict=True)
        surfaces = torch.stack([normals_from_depth(*x) for x in each]).view_as(normal)
    info = SplatInfo(ids, radii=radii, means2d=centres, depths=depths, ray_transforms=transforms, opacities=alphas,
                normals=normals, isect_offsets=offsets, width=width, height=height, tile_size=tile_size,
                tile_width=grid[0], tile_height=grid[1], n_cameras=cameras, n_batches=prod(lead),
                render_distort=distortion, gradient_2dgs=densify)  # fmt: skip
    info |= zip(SplatInfo.LISTS, tiles, strict=False)
    world = normal @ viewmats[..., None, :3, :3].to(normal)
    return picture, opacity, world, surfaces, distortion, median, info


def values_of(
    colors: Tensor, means: Tensor, viewmats: Tensor, degree: int | None, ids: dict[str, Any], image: Tensor | None
) -> Float[Tensor, "*rows channel"]:
    """Colours of each pair of a camera and a Gaussian, or with `image` of packed rows."""
    lead, cameras = means.shape[:-2], viewmats.shape[-3]
    if degree is not None:
        own = colors.float() if image is None else colors.float()[ids["gaussian_ids"]]
        return (spherical_harmonics(degree, means.float(), viewmats.float(), own, None, **ids) + 0.5).clamp_min(0.0)
    whole = colors if colors.ndim == means.ndim + 1 else colors[..., None, :, :].expand(*lead, cameras, -1, -1)
    return whole.float() if image is None else whole.float().flatten(0, -3)[image, ids["gaussian_ids"]]
