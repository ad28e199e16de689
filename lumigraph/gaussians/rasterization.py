"""rasterization(): render Gaussians with the signature and the conventions of gsplat (Ye 2024, arXiv 2409.06765).

Code that calls `gsplat.rasterization` runs without CUDA by importing it from here.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import kernels
from ..camera import Camera
from ..camera.lens import Pinhole
from ..color.blending import over
from ..errors import LumigraphError
from ..geometry import multiply, to_quaternion
from ..system.work import at_work
from .splatting import view_of

MAX_DEGREE = 3
RADIUS_DEVIATIONS = 3.33  # of a footprint at most, as meta["radii"] counts; there exp(-r^2 / 2) is 1/255
MIN_OPACITY = 1e-10  # of a pixel whose depth is divided by it
FOOTPRINT = "means2d", "conics", "opacities", "depths"  # entries of the dictionary that are composited
MODES = "RGB", "D", "ED", "RGB+D", "RGB+ED"


@at_work()
def rasterization(
    means: Float[Tensor, "gaussian 3"],
    quats: Float[Tensor, "gaussian 4"],
    scales: Float[Tensor, "gaussian 3"],
    opacities: Float[Tensor, " gaussian"],
    colors: Tensor,
    viewmats: Float[Tensor, "camera 4 4"],
    Ks: Float[Tensor, "camera 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Float[Tensor, "camera channel"] | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    **further: Any,
) -> tuple[Float[Tensor, "camera height width value"], Float[Tensor, "camera height width 1"], dict[str, Any]]:
    """Render Gaussians for several cameras; differentiable in all tensors but `Ks`.

    quats:      (w, x, y, z) of any length but zero
    scales:     standard deviations, world units
    opacities:  in [0, 1], at the centre
    colors:     (N, D) or (C, N, D); with sh_degree coefficients (N, K, 3) or (C, N, K, 3), K >= (sh_degree + 1)^2
    viewmats:   world to camera, +x right, +y down, +z forward
    Ks:         intrinsics in pixels, pixel centres at + 0.5
    far_plane:  Gaussians with centres beyond are not rendered
    radius_clip: nor are those of at most so many pixels
    eps2d:      square pixels added to each footprint
    render_mode: one of MODES: colours, accumulated depth D, expected depth ED = D / alpha; depth is the last channel
    rasterize_mode: "classic" or "antialiased" (Yu 2024, eq. 9)
    packed: the dictionary has a row for each pair of a camera and a Gaussian that it sees, else (C, N, ...)
    sparse_grad, tile_size, channel_chunk, segmented: accepted, and without effect on the result

    Returns pictures, opacities, and a dictionary: "means2d", which may retain its gradient, "radii" in whole pixels,
    "depths", "conics", "opacities", "width", "height", "n_cameras" and what strategies of gsplat read. Packed, it has
    "camera_ids" and "gaussian_ids" of its rows; otherwise these are None, and Gaussians that are invisible to a camera
    have zeros. Opacity of one Gaussian at a pixel is at most 0.99 (Kerbl 2023), where gsplat has 0.999.
    Raises LumigraphError for options that the kernels do not have.
    """
    refused = {
        f"render_mode={render_mode!r}": render_mode not in MODES,
        f"rasterize_mode={rasterize_mode!r}": rasterize_mode not in ("classic", "antialiased"),
        "absgrad": absgrad,
        "distributed": distributed,
        f"camera_model={camera_model!r}": camera_model != "pinhole",
        "covars": covars is not None,
        "a batch of clouds": means.ndim != 2,
        "skewed Ks": bool((Ks[..., 0, 1] != 0).any()),
        f"sh_degree={sh_degree}": sh_degree is not None and sh_degree > MAX_DEGREE,
        **{name: value is not None and value is not False for name, value in further.items()},
    }
    if named := [name for name, asked in refused.items() if asked]:
        raise LumigraphError(f"rasterization() has no {', '.join(named)}; leave it out")
    count = len(viewmats)
    if backgrounds is not None and "RGB" not in render_mode:
        raise LumigraphError(f"backgrounds are colours, and render_mode={render_mode!r} has none; leave them out")

    projected = []
    for viewmat, K in zip(viewmats, Ks, strict=True):
        poses = viewmat.requires_grad
        seen = in_camera(means, quats, viewmat) if poses else (means, quats)
        camera = camera_of(torch.eye(4).to(viewmat) if poses else viewmat, K, width, height)
        view = view_of(camera, near_plane).to(means.device)
        unused = means.new_zeros(len(means), 1, 3)
        compensate = rasterize_mode == "antialiased"
        centres, conics, depths, _, alphas = kernels.project(
            *seen, scales, opacities, unused, view, 1, eps2d, compensate
        )
        radii = radii_of(conics.detach(), alphas.detach())
        shown = (depths < far_plane) & (radii.amax(-1) > radius_clip) if len(means) else alphas > 0
        projected.append((centres, conics, depths, torch.where(shown, alphas, 0.0), radii * shown[:, None]))
    centres, conics, depths, alphas, radii = (torch.stack(each) for each in zip(*projected, strict=True))
    meta: dict[str, Any] = {"means2d": centres, "radii": radii, "depths": depths, "conics": conics, "opacities": alphas}
    meta |= dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    rows: list[Any] = [slice(None)] * count
    if packed:
        cameras, gaussians = (radii > 0).all(-1).nonzero().unbind(-1)
        meta = {name: value if value is None else value[cameras, gaussians] for name, value in meta.items()}
        meta |= {"batch_ids": torch.zeros_like(cameras), "camera_ids": cameras, "gaussian_ids": gaussians}
        shares = torch.bincount(cameras, minlength=count).tolist()
        rows = list(gaussians.split(shares))
    parts = [meta[name].split(shares) if packed else meta[name] for name in FOOTPRINT]

    pictures, opaque = [], []
    for i in range(count):
        values = [colours(colors, means, viewmats[i], i, sh_degree)] if "RGB" in render_mode else []
        own = torch.cat([*values, means.new_zeros(len(means), 0)], -1)[rows[i]]
        picture, depth, alpha = composited([part[i] for part in parts], own, (width, height))
        if backgrounds is not None:
            picture = over(picture, alpha, backgrounds[i])
        if "ED" in render_mode:
            depth = depth / alpha.clamp_min(MIN_OPACITY)
        pictures.append(torch.cat([picture, depth[..., None]], -1) if "D" in render_mode else picture)
        opaque.append(alpha[..., None])
    tiles = {"tile_size": tile_size, "tile_width": -(-width // tile_size), "tile_height": -(-height // tile_size)}
    meta |= {"width": width, "height": height, "n_cameras": count, "n_batches": 1, **tiles}
    return torch.stack(pictures), torch.stack(opaque), meta


def camera_of(viewmat: Float[Tensor, "4 4"], intrinsics: Float[Tensor, "3 3"], width: int, height: int) -> Camera:
    """A Camera of a world-to-camera matrix and its intrinsics."""
    rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
    pose = torch.cat([rotation.T, -(rotation.T @ shift)[:, None]], 1)
    intrinsics = intrinsics.detach()
    lens = Pinhole(intrinsics[[0, 1], [0, 1]][None].clone(), intrinsics[:2, 2][None].clone())
    return Camera(pose[None], lens, torch.tensor([[width, height]], device=pose.device))


def in_camera(
    means: Float[Tensor, "gaussian 3"], quats: Float[Tensor, "gaussian 4"], viewmat: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "gaussian 3"], Float[Tensor, "gaussian 4"]]:
    """Means and rotations in a camera's frame, differentiable in its pose, which is a constant for the kernels.

    The camera's rotation is exp(w) R with w = 0, acting on quaternions to first order, so gradients in viewmats are
    those of rotations.
    """
    rotation = viewmat[:3, :3]
    change = rotation @ rotation.detach().T
    axis = 0.5 * torch.stack([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]])
    small = torch.cat([torch.ones_like(axis[:1]), axis / 2])
    turn = multiply(small[None], to_quaternion(rotation.detach()).to(quats)[None])
    return means @ rotation.T + viewmat[:3, 3], multiply(turn, quats)


def colours(
    colors: Tensor, means: Float[Tensor, "gaussian 3"], viewmat: Float[Tensor, "4 4"], camera: int, degree: int | None
) -> Float[Tensor, "gaussian channel"]:
    """Values of the Gaussians for one camera: unchanged, or from harmonics, max(0, 1/2 + sum_k Y_k(d) h_k)."""
    plain = 2 if degree is None else 3
    own = colors if colors.ndim == plain else colors[camera]
    if degree is None:
        return own
    rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
    directions = torch.nn.functional.normalize(means + rotation.T @ shift, dim=-1)
    basis = kernels.spherical_harmonics(directions, degree + 1)
    return (0.5 + torch.einsum("nk,nkc->nc", basis, own[:, : basis.shape[-1]])).clamp_min(0.0)


def composited(
    footprints: Sequence[Tensor], values: Float[Tensor, "gaussian channel"], size: tuple[int, int]
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Values, depth and opacity of each pixel. The kernel composites three values at a time.

    footprints: centres, conics, opacities and depths of the Gaussians
    """
    centres, conics, alphas, depths = footprints
    channels = values.shape[-1]
    tiles = kernels.tile(centres, conics, alphas, depths, size)
    triples = torch.nn.functional.pad(values, (0, -channels % 3)) if channels else values.new_zeros(len(values), 3)
    seen = [kernels.rasterize(centres, conics, alphas, x.contiguous(), depths, tiles) for x in triples.split(3, -1)]
    return torch.cat([picture for picture, _, _ in seen], -1)[..., :channels], seen[0][1], seen[0][2]


def radii_of(conics: Float[Tensor, "gaussian 3"], alphas: Float[Tensor, " gaussian"]) -> Int[Tensor, "gaussian 2"]:
    """Half width and height of each footprint where it adds 1/255, at most RADIUS_DEVIATIONS, in whole pixels; zero for
    an empty one."""
    xx, xy, yy = conics.unbind(-1)
    determinant = xx * yy - xy * xy
    variance = torch.stack([yy, xx], -1) / determinant.clamp_min(1e-30)[:, None]
    reach = (2 * (alphas * 255).clamp_min(1).log()).sqrt().clamp_max(RADIUS_DEVIATIONS)
    return torch.where(determinant[:, None] > 0, (reach[:, None] * variance.sqrt()).ceil(), 0.0).int()
