"""Stages of splatting as functions, with the names, parameters and shapes of gsplat (Ye 2024).

Plain PyTorch but for `rasterize_to_pixels`, which is the kernel.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..color.blending import over
from ..errors import LumigraphError
from ..gaussians.projection import UnscentedTransformParameters, affine, check_model, covariances_of
from ..gaussians.rasterization import CloudViews, Projecting, by_definition, composited, harmonics
from ..gaussians.surfels import composited_discs, discs_of
from ..gaussians.tile_lists import tiles_of
from ..kernels.tile import Tiles

TRIANGLE = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])  # rows and columns of the upper triangle
SQUARE = [0, 1, 2, 1, 3, 4, 2, 4, 5]  # the inverse


def quat_scale_to_covar_preci(
    quats: Float[Tensor, "*batch 4"],
    scales: Float[Tensor, "*batch 3"],
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Covariances Q diag(scale)^2 Q^T and their inverses, or upper triangles (..., 6) of both; None if not asked."""

    def form(power: float) -> Tensor:
        found = covariances_of(quats.reshape(-1, 4), scales.reshape(-1, 3), power).view(*quats.shape[:-1], 3, 3)
        return found[..., TRIANGLE[0], TRIANGLE[1]] if triu else found

    return form(1.0) if compute_covar else None, form(-1.0) if compute_preci else None


def world_to_cam(
    means: Float[Tensor, "*batch gaussian 3"],
    covars: Float[Tensor, "*batch gaussian 3 3"],
    viewmats: Float[Tensor, "*batch camera 4 4"],
) -> tuple[Float[Tensor, "*batch camera gaussian 3"], Float[Tensor, "*batch camera gaussian 3 3"]]:
    """Means and covariances in each camera's frame."""
    rotation = viewmats[..., None, :3, :3]
    points = (rotation @ means[..., None, :, :, None])[..., 0] + viewmats[..., None, :3, 3]
    return points, rotation @ covars[..., None, :, :, :] @ rotation.mT


def proj(
    means: Float[Tensor, "*batch camera gaussian 3"],
    covars: Float[Tensor, "*batch camera gaussian 3 3"],
    Ks: Float[Tensor, "*batch camera 3 3"],
    width: int,
    height: int,
    camera_model: str = "pinhole",
) -> tuple[Float[Tensor, "*batch camera gaussian 2"], Float[Tensor, "*batch camera gaussian 2 2"]]:
    """Centres and covariances in pixels, from those in the cameras' frames."""
    check_model(camera_model)
    flat = zip(means.flatten(0, -3), covars.flatten(0, -4), Ks.flatten(0, -3), strict=True)
    found = [affine(m, s, K, (width, height), camera_model) for m, s, K in flat]
    centres, spread = (torch.stack(x) for x in zip(*found, strict=True))
    return centres.view(*means.shape[:-1], 2), spread.view(*means.shape[:-1], 2, 2)


def fully_fused_projection(
    means: Float[Tensor, "*batch gaussian 3"],
    covars: Float[Tensor, "*batch gaussian 6"] | None,
    quats: Float[Tensor, "*batch gaussian 4"] | None,
    scales: Float[Tensor, "*batch gaussian 3"] | None,
    viewmats: Float[Tensor, "*batch camera 4 4"],
    Ks: Float[Tensor, "*batch camera 3 3"],
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    opacities: Float[Tensor, "*batch gaussian"] | None = None,
) -> tuple[Any, ...]:
    """Radii, centres, depths, conics and compensations (None if not asked) of all cameras' Gaussians.

    covars:  upper triangles, in place of quats and scales;  opacities: for tighter radii
    packed:  of visible pairs only, behind batch_ids, camera_ids, gaussian_ids and the first pair of each image
    """
    check_model(camera_model)
    full = None if covars is None else covars[..., SQUARE].unflatten(-1, (3, 3))
    given = {"means": means, "quats": None if covars is not None else quats,
             "scales": None if covars is not None else scales, "covars": full, "opacities": opacities,
             "viewmats": viewmats, "Ks": Ks}  # fmt: skip
    how = Projecting((width, height), near_plane, far_plane, radius_clip, eps2d, calc_compensations, camera_model,
                     None, False)  # fmt: skip
    return _projected(CloudViews.of(given, {}), how, packed)


def fully_fused_projection_with_ut(
    means: Float[Tensor, "*batch gaussian 3"],
    quats: Float[Tensor, "*batch gaussian 4"],
    scales: Float[Tensor, "*batch gaussian 3"],
    opacities: Float[Tensor, "*batch gaussian"] | None,
    viewmats: Float[Tensor, "*batch camera 4 4"],
    Ks: Float[Tensor, "*batch camera 3 3"],
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    ut_params: UnscentedTransformParameters | None = None,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    global_z_order: bool = True,
    **refused: Any,
) -> tuple[Any, ...]:
    """The same by the unscented transform, with distortion; differentiable, where gsplat's is not."""
    check_model(camera_model)
    if named := [name for name, value in refused.items() if getattr(value, "name", value) not in (None, "GLOBAL")]:
        raise LumigraphError(f"fully_fused_projection_with_ut() has no {', '.join(named)}; leave it out")
    given = {"means": means, "quats": quats, "scales": scales, "covars": None, "opacities": opacities,
             "viewmats": viewmats, "Ks": Ks}  # fmt: skip
    lenses = {"radial": radial_coeffs, "tangential": tangential_coeffs, "thin_prism": thin_prism_coeffs}
    how = Projecting((width, height), near_plane, far_plane, radius_clip, eps2d, calc_compensations, camera_model,
                     ut_params or UnscentedTransformParameters(), not global_z_order)  # fmt: skip
    return _projected(CloudViews.of(given, lenses), how, False)


def _projected(views: CloudViews, how: Projecting, packed: bool) -> tuple[Any, ...]:
    found = []
    for i in range(len(views)):
        b, c = views.place(i)
        means, quats, scales, covars, opacities = views.cloud(b)
        camera = views.viewmats[b, c], views.Ks[b, c]
        centres, conics, depths, alphas, radii = by_definition(
            means, quats, scales, covars, opacities, *camera, how, views.lens(i)
        )
        if opacities is not None:  # the factors that they were multiplied by
            alphas = alphas / opacities.clamp_min(1e-12)
        found.append((radii, centres, depths, conics, alphas))
    columns = [torch.stack(x) for x in zip(*found, strict=True)]
    if not packed:
        *shapes, factors = (x.unflatten(0, views.images) for x in columns)
        return *shapes, factors if how.compensate else None
    image, gaussian = (columns[0] > 0).all(-1).nonzero().unbind(-1)
    first = torch.nn.functional.pad(torch.bincount(image, minlength=len(views)).cumsum(0), (1, 0))
    *shapes, factors = (x[image, gaussian] for x in columns)
    ids = image // views.images[-1], image % views.images[-1], gaussian, first
    return *(x.int() for x in ids), *shapes, factors if how.compensate else None


def fully_fused_projection_2dgs(
    means: Float[Tensor, "*batch gaussian 3"],
    quats: Float[Tensor, "*batch gaussian 4"],
    scales: Float[Tensor, "*batch gaussian 3"],
    viewmats: Float[Tensor, "*batch camera 4 4"],
    Ks: Float[Tensor, "*batch camera 3 3"],
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
) -> tuple[Any, ...]:
    """Radii, centres, depths, ray transforms and normals of discs; packed as in `fully_fused_projection`."""
    views = CloudViews.of({"means": means, "quats": quats, "scales": scales, "covars": None, "opacities": None,
                      "viewmats": viewmats, "Ks": Ks}, {})  # fmt: skip
    found = []
    for i in range(len(views)):
        b, c = views.place(i)
        assert views.quats is not None and views.scales is not None
        camera = views.viewmats[b, c], views.Ks[b, c], (width, height), near_plane, far_plane, radius_clip
        found.append(discs_of(views.means[b], views.quats[b], views.scales[b], *camera))
    names = ("radii", "centres", "depths", "transforms", "normals")
    columns = [torch.stack([getattr(x, name) for x in found]) for name in names]
    if not packed:
        return tuple(x.unflatten(0, views.images) for x in columns)
    image, gaussian = (columns[0] > 0).all(-1).nonzero().unbind(-1)
    first = torch.nn.functional.pad(torch.bincount(image, minlength=len(views)).cumsum(0), (1, 0))
    ids = image // views.images[-1], image % views.images[-1], gaussian, first
    return *(x.int() for x in ids), *(x[image, gaussian] for x in columns)


def spherical_harmonics(
    degrees_to_use: int,
    means: Float[Tensor, "*batch gaussian 3"],
    viewmats: Tensor,
    coeffs: Tensor | None = None,
    masks: Bool[Tensor, "*rows"] | None = None,
    batch_ids: Int[Tensor, " row"] | None = None,
    camera_ids: Int[Tensor, " row"] | None = None,
    gaussian_ids: Int[Tensor, " row"] | None = None,
) -> Float[Tensor, "*rows channel"]:
    """Sums of harmonics towards each Gaussian from each camera, (..., C, N, D); zero where a mask is False.

    Up to gsplat 1.5 the parameters were (degree, directions, coefficients (..., K, D), masks); both are understood.
    """
    if not 0 <= degrees_to_use <= 4:
        raise LumigraphError(f"There are harmonics of degree 0 to 4, not {degrees_to_use}; take one of these")
    if coeffs is None or not coeffs.is_floating_point():
        directions, coeffs, masks = means, viewmats, coeffs if masks is None else masks
    else:
        eyes = -(viewmats[..., :3, :3].mT @ viewmats[..., :3, 3:])[..., 0]
        if gaussian_ids is None:
            directions = means[..., None, :, :] - eyes[..., None, :]
        else:
            assert camera_ids is not None
            batch = torch.zeros_like(camera_ids) if batch_ids is None else batch_ids
            points, eyes = means.reshape(-1, *means.shape[-2:]), eyes.reshape(-1, *eyes.shape[-2:])
            directions = points[batch.long(), gaussian_ids.long()] - eyes[batch.long(), camera_ids.long()]
    unit = torch.nn.functional.normalize(directions, dim=-1).float()
    basis = harmonics(unit.reshape(-1, 3), degrees_to_use).view(*directions.shape[:-1], -1)
    found = (basis[..., None] * coeffs[..., : basis.shape[-1], :].float()).sum(-2)
    return found if masks is None else found * masks[..., None]


def rasterize_to_pixels(
    means2d: Float[Tensor, "*rows 2"],
    conics: Float[Tensor, "*rows 3"],
    colors: Float[Tensor, "*rows channel"],
    opacities: Float[Tensor, "*rows"],
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Int[Tensor, "*image down across"],
    flatten_ids: Int[Tensor, " pair"],
    backgrounds: Float[Tensor, "*image channel"] | None = None,
    masks: Bool[Tensor, "*image down across"] | None = None,
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Float[Tensor, "*image height width channel"], Float[Tensor, "*image height width 1"]]:
    """Composite colours of footprints by the lists of `isect_tiles`; a tile whose mask is False shows the background.

    absgrad: the backward pass fills means2d.absgrad
    """
    images, offsets = isect_offsets.shape[:-2], isect_offsets.reshape(-1, *isect_offsets.shape[-2:])
    flat = [x.reshape(-1, *tail) for x, tail in ((means2d, (2,)), (conics, (3,)), (opacities, ()))]
    values = colors.reshape(-1, colors.shape[-1])
    spread = torch.zeros_like(flat[0]) if absgrad else None
    if spread is not None:
        means2d.absgrad = spread.view_as(means2d)  # type: ignore[attr-defined]
    pictures, opaque = [], []
    for i, tiles, own in each_image(offsets, flatten_ids, masks, (image_width, image_height), tile_size):
        depths = torch.zeros_like(flat[2][own])
        part = None if spread is None else spread[own]
        shapes = [x[own] for x in flat]
        seen, _, alpha = composited([*shapes, depths], values[own], tiles.size, False, part, tiles)
        if backgrounds is not None:
            seen = over(seen, alpha, backgrounds.reshape(len(offsets), -1)[i])
        pictures.append(seen)
        opaque.append(alpha[..., None])
    return torch.stack(pictures).view(*images, *pictures[0].shape), torch.stack(opaque).view(*images, *opaque[0].shape)


def rasterize_to_pixels_2dgs(
    means2d: Float[Tensor, "*rows 2"],
    ray_transforms: Float[Tensor, "*rows 3 3"],
    colors: Float[Tensor, "*rows channel"],
    opacities: Float[Tensor, "*rows"],
    normals: Float[Tensor, "*rows 3"],
    densify: Float[Tensor, "*rows 2"],
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Int[Tensor, "*image down across"],
    flatten_ids: Int[Tensor, " pair"],
    backgrounds: Float[Tensor, "*image channel"] | None = None,
    masks: Bool[Tensor, "*image down across"] | None = None,
    packed: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Composite discs: colours, opacities, normals, distortion and median of the last channel.

    densify: zeros, whose gradient strategies read
    """
    if absgrad:
        raise LumigraphError("rasterize_to_pixels_2dgs() has no absgrad; leave it out")
    images, offsets = isect_offsets.shape[:-2], isect_offsets.reshape(-1, *isect_offsets.shape[-2:])
    tensors = (means2d, (2,)), (nudged(ray_transforms, densify), (3, 3)), (normals, (3,)), (opacities, ())
    centres, transforms, towards, alphas = (x.reshape(-1, *tail) for x, tail in tensors)
    values, outputs = colors.reshape(-1, colors.shape[-1]), []
    for i, tiles, own in each_image(offsets, flatten_ids, masks, (image_width, image_height), tile_size):
        rows = centres[own], transforms[own], towards[own], alphas[own], values[own]
        picture, further = composited_discs(*rows, tiles)
        normal, opacity, distortion, median = further.split((3, 1, 1, 1), -1)
        if backgrounds is not None:
            picture = over(picture, opacity[..., 0], backgrounds.reshape(len(offsets), -1)[i])
        outputs.append((picture, opacity, normal, distortion, median))
    stacked = (torch.stack(x) for x in zip(*outputs, strict=True))
    return tuple(x.view(*images, *x.shape[1:]) for x in stacked)  # type: ignore[return-value]


def each_image(
    offsets: Int[Tensor, "image down across"], ids: Tensor, masks: Tensor | None, size: tuple[int, int], tile_size: int
) -> Iterator[tuple[int, Tiles, slice]]:
    """Number of each image, its tiles, and its rows."""
    for i in range(len(offsets)):
        mask = None if masks is None else masks.reshape(offsets.shape)[i]
        tiles, first, last = tiles_of(offsets, ids, i, size, tile_size, mask)
        yield i, tiles, slice(first, last)


def nudged(transforms: Float[Tensor, "*rows 3 3"], densify: Float[Tensor, "*rows 2"]) -> Float[Tensor, "*rows 3 3"]:
    """Ray transforms plus zero, so that `densify` gets their gradient in the centre, times its depth."""
    shift = torch.nn.functional.pad(densify * transforms[..., 2, 2:].detach(), (0, 1))
    return transforms + torch.nn.functional.pad(shift[..., None], (2, 0))
