"""rasterization(): render Gaussians with the signature and the conventions of gsplat (Ye 2024, arXiv 2409.06765).

Code that calls `gsplat.rasterization` runs without CUDA by importing it from here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, prod, sqrt
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .. import kernels
from ..camera import Camera
from ..camera.lens import Pinhole
from ..color.blending import over
from ..errors import LumigraphError
from ..geometry import to_matrix
from ..system.work import at_work
from .projection import (
    MIN_COMPENSATION,
    MIN_SPREAD,
    RADIUS_DEVIATIONS,
    Distortion,
    UnscentedTransformParameters,
    affine,
    check_model,
    covariances_of,
    footprints_of,
    unscented,
)
from .splatting import view_of
from .tile_lists import isect_offset_encode, isect_tiles

MIN_OPACITY = 1e-10  # of a pixel whose depth is divided by it
STOP = 1e-4  # transmittance at which a ray ends
MAX_DEGREE = 4  # of harmonics; the kernel has three
K40, K41, K42 = 3 / (16 * sqrt(pi)), 3 / 4 * sqrt(5 / (2 * pi)), 3 / 8 * sqrt(5 / pi)
K43, K44 = 3 / 4 * sqrt(35 / (2 * pi)), 3 / 16 * sqrt(35 / pi)
MODES = "RGB", "D", "ED", "RGB+D", "RGB+ED"
RenderMode = Literal["RGB", "d", "Ed", "D", "ED", "RGB-d", "RGB-Ed", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]
TILE_SIDE = 16  # pixels of the tiles that the dictionary lists; the kernels have their own


class SplatInfo(dict[str, Any]):
    """Dictionary of projected Gaussians. The lists of tiles are made when one of LISTS is first asked for."""

    LISTS: ClassVar[tuple[str, ...]] = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")

    def __missing__(self, name: str) -> Any:
        if name not in self.LISTS:
            raise KeyError(name)
        images, grid = self["n_batches"] * self["n_cameras"], (self["tile_width"], self["tile_height"])
        packed = self["camera_ids"] is not None
        image = self["batch_ids"] * self["n_cameras"] + self["camera_ids"] if packed else None
        shapes = self["means2d"], self["radii"], self["depths"]
        ellipses = {"conics": self["conics"], "opacities": self["opacities"]}
        found = isect_tiles(*shapes, self["tile_size"], *grid, packed=packed, image_ids=image, **ellipses)
        offsets = isect_offset_encode(found[1], images, *grid)
        self.update(zip(self.LISTS, (*found, offsets.view(*self["images"], *offsets.shape[1:])), strict=True))
        return self[name]

    def __contains__(self, name: object) -> bool:
        return name in self.LISTS or super().__contains__(name)

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default


@dataclass(frozen=True)
class Projecting:
    """Options of projection. by_distance: sort by distance from the eye; transform: None for the affine way"""

    size: tuple[int, int]
    near: float
    far: float
    radius_clip: float
    blur: float
    compensate: bool
    model: str
    transform: UnscentedTransformParameters | None
    by_distance: bool


@dataclass(frozen=True)
class CloudViews:
    """Clouds and cameras in single precision, with one axis for the batch. dims: axes of the batch in the call"""

    dims: tuple[int, ...]
    means: Float[Tensor, "batch gaussian 3"]
    quats: Float[Tensor, "batch gaussian 4"] | None
    scales: Float[Tensor, "batch gaussian 3"] | None
    covars: Float[Tensor, "batch gaussian 3 3"] | None
    opacities: Float[Tensor, "batch gaussian"] | None
    viewmats: Float[Tensor, "batch camera 4 4"]
    Ks: Float[Tensor, "batch camera 3 3"]
    lenses: dict[str, Tensor | None]

    @classmethod
    def of(cls, tensors: dict[str, Tensor | None], lenses: dict[str, Tensor | None]) -> CloudViews:
        """CloudViews of a call's tensors, whose leading axes are those of the means and cameras."""
        means, viewmats = tensors["means"], tensors["viewmats"]
        assert means is not None and viewmats is not None
        dims, cameras = means.shape[:-2], viewmats.shape[-3:-2]
        own = {"opacities": 1, "covars": 3, "viewmats": 3, "Ks": 3}
        flat: dict[str, Any] = {}
        for name, x in (*tensors.items(), *lenses.items()):
            axes = own.get(name, 2)
            lead = dims + (cameras if name in ("viewmats", "Ks", *lenses) else means.shape[-2:-1])
            if x is not None and (x.ndim != len(dims) + axes or x.shape[: len(lead)] != lead):
                raise LumigraphError(f"{name} has the shape {tuple(x.shape)}, not {tuple(lead)} and its own axes")
            flat[name] = None if x is None else x.float().reshape(prod(dims), *x.shape[len(dims) :])
        return cls(tuple(dims), **{name: flat[name] for name in tensors}, lenses={name: flat[name] for name in lenses})

    @property
    def images(self) -> tuple[int, ...]:
        """Leading axes of pictures."""
        return (*self.dims, self.viewmats.shape[1])

    def __len__(self) -> int:
        return prod(self.viewmats.shape[:2])

    def place(self, image: int) -> tuple[int, int]:
        """Batch and camera of an image."""
        return divmod(image, self.viewmats.shape[1])

    def projected(self, image: int, how: Projecting) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Centres, conics, depths, opacities and radii of one image."""
        b, c = self.place(image)
        means, quats, scales, covars, opacities = self.cloud(b)
        viewmat, K = self.viewmats[b, c], self.Ks[b, c]
        plain = how.model == "pinhole" and how.transform is None and covars is None and K[0, 1] == 0
        if plain and not viewmat.requires_grad:  # the kernel has no gradient in poses
            assert quats is not None and scales is not None and opacities is not None
            return by_kernel(means, quats, scales, opacities, viewmat, K, how)
        return by_definition(means, quats, scales, covars, opacities, viewmat, K, how, self.lens(image))

    def cloud(self, batch: int) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
        """Means, quats, scales, covars and opacities."""
        own = (None if x is None else x[batch] for x in (self.quats, self.scales, self.covars, self.opacities))
        return self.means[batch], *own  # type: ignore[return-value]

    def lens(self, image: int) -> Distortion:
        """Distortion of one image."""
        b, c = self.place(image)
        return Distortion(**{name: None if x is None else x[b, c] for name, x in self.lenses.items()})


@at_work()
def rasterization(
    means: Float[Tensor, "*batch gaussian 3"],
    quats: Float[Tensor, "*batch gaussian 4"] | None,
    scales: Float[Tensor, "*batch gaussian 3"] | None,
    opacities: Float[Tensor, "*batch gaussian"],
    colors: Tensor | None,
    viewmats: Float[Tensor, "*batch camera 4 4"],
    Ks: Float[Tensor, "*batch camera 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = None,
    backgrounds: Float[Tensor, "*batch camera channel"] | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Float[Tensor, "*batch gaussian 3 3"] | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    radial_coeffs: Float[Tensor, "*batch camera coefficient"] | None = None,
    tangential_coeffs: Float[Tensor, "*batch camera 2"] | None = None,
    thin_prism_coeffs: Float[Tensor, "*batch camera 4"] | None = None,
    ftheta_coeffs: Any = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    ut_params: UnscentedTransformParameters | None = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
    include_last: bool = False,
) -> tuple[Float[Tensor, "*batch camera height width value"], Float[Tensor, "*batch camera height width 1"], SplatInfo]:
    """Render Gaussians for several cameras; differentiable in all tensors but `Ks` and coefficients of lenses.

    quats:      (w, x, y, z) of any length but zero
    scales:     standard deviations, world units
    opacities:  in [0, 1], at the centre
    colors:     ([camera,] N, D); with sh_degree coefficients ([[batch,] camera,] N, K, D), K >= (sh_degree + 1)^2
    viewmats:   world to camera, +x right, +y down, +z forward
    Ks:         intrinsics in pixels, pixel centres at + 0.5
    far_plane:  Gaussians with centres beyond are not rendered
    radius_clip: nor are those of at most so many pixels
    eps2d:      square pixels added to each footprint
    sh_degree:  0 to 4
    packed: the dictionary has a row for each pair of a camera and a Gaussian that it sees, else (C, N, ...)
    backgrounds: colours; depth has none
    render_mode: one of MODES: colours, accumulated depth D, expected depth ED = D / alpha; depth is the last channel
    absgrad: the backward pass fills `info["means2d"].absgrad`; beyond three channels it sums groups of three
    rasterize_mode: "classic" or "antialiased" (Yu 2024, eq. 9)
    camera_model: "pinhole", "ortho" or "fisheye"
    covars: covariances in place of quats and scales
    with_ut: project by the unscented transform, with radial, tangential and thin prism coefficients in OpenCV's order
    global_z_order: False sorts by distance and renders it as depth, with_ut
    extra_signals: further channels, rendered to `info["render_extra_signals"]`
    include_last: keep the Gaussian that ends a ray (Kerbl 2023); gsplat leaves it out
    sparse_grad, tile_size, channel_chunk, segmented, renderer_config: without effect on pictures; gradients are dense

    Returns pictures, opacities, and a dictionary: "means2d", which may retain its gradient, "radii" in whole pixels,
    "depths", "conics", "opacities", "width", "height", "n_cameras" and what strategies of gsplat read. Packed, it has
    "batch_ids", "camera_ids" and "gaussian_ids" of its rows; otherwise these are None, and Gaussians that are
    invisible to a camera have zeros. All are float32. Raises LumigraphError for options that are not there.
    """
    wants = Wants(render_mode, sh_degree, extra_signals_sh_degree, absgrad, packed, include_last)
    lenses = {"radial": radial_coeffs, "tangential": tangential_coeffs, "thin_prism": thin_prism_coeffs}
    wants.check(colors, lenses, with_ut, rasterize_mode, {
        "distributed": distributed, "with_eval3d": with_eval3d, "return_normals": return_normals, "rays": rays,
        "ftheta_coeffs": ftheta_coeffs, "lidar_coeffs": lidar_coeffs, "viewmats_rs": viewmats_rs,
        "external_distortion_coeffs": external_distortion_coeffs,
        "rolling_shutter": getattr(rolling_shutter, "name", rolling_shutter) not in (None, "GLOBAL"),
        "sparse_grad without packed": sparse_grad and not packed,
        "global_z_order=False without with_ut": not global_z_order and not with_ut,
        "covars with with_ut": covars is not None and with_ut})  # fmt: skip
    check_model(camera_model)
    shapes = (None, None) if covars is not None else (quats, scales)
    views = CloudViews.of({"means": means, "quats": shapes[0], "scales": shapes[1], "covars": covars,
                      "opacities": opacities, "viewmats": viewmats, "Ks": Ks}, lenses)  # fmt: skip
    antialiased, transform = rasterize_mode == "antialiased", ut_params or UnscentedTransformParameters()
    how = Projecting((width, height), near_plane, far_plane, radius_clip, eps2d, antialiased, camera_model,
                     transform if with_ut else None, not global_z_order)  # fmt: skip
    info, rows = information(views, how, packed, tile_size or TILE_SIDE)
    return rendered(views, info, rows, colors, extra_signals, backgrounds, wants)


@dataclass(frozen=True)
class Wants:
    """Options of rendering."""

    mode: str
    degree: int | None
    extra_degree: int | None
    absgrad: bool
    packed: bool
    include_last: bool

    def check(
        self, colors: Tensor | None, lenses: dict[str, Any], with_ut: bool, rasterize_mode: str, refused: dict[str, Any]
    ) -> None:
        """Raises LumigraphError for options that are unknown, or that `rasterization` does not have."""
        choices = {"render_mode": (self.mode, MODES), "rasterize_mode": (rasterize_mode, ("classic", "antialiased")),
                   "sh_degree": (self.degree, (None, *range(MAX_DEGREE + 1))),
                   "extra_signals_sh_degree": (self.extra_degree, (None, *range(MAX_DEGREE + 1)))}  # fmt: skip
        for name, (value, allowed) in choices.items():
            if value not in allowed:
                raise LumigraphError(
                    f"{name}={value!r} is not one of {', '.join(map(str, allowed))}; take one of these"
                )
        refused = refused | {
            f"{name}_coeffs without with_ut": x is not None and not with_ut for name, x in lenses.items()
        }
        if named := [name for name, value in refused.items() if value is not None and value is not False]:
            raise LumigraphError(f"rasterization() has no {', '.join(named)}; leave it out")
        if colors is None and "RGB" in self.mode:
            raise LumigraphError(f"render_mode={self.mode!r} shows colours, and colors is None; give them, or take D")


def information(views: CloudViews, how: Projecting, packed: bool, side: int) -> tuple[SplatInfo, list[Any]]:
    """Dictionary of the projected Gaussians, and the Gaussians of each image in it."""
    columns = zip(*(views.projected(i, how) for i in range(len(views))), strict=True)
    found = {name: torch.stack(x) for name, x in zip(("means2d", "conics", "depths", "opacities", "radii"), columns,
                                                     strict=True)}  # fmt: skip
    (width, height), cameras = how.size, views.images[-1]
    info = SplatInfo(width=width, height=height, n_cameras=cameras, n_batches=len(views.means), tile_size=side,
                tile_width=-(-width // side), tile_height=-(-height // side), images=views.images,
                batch_ids=None, camera_ids=None, gaussian_ids=None)  # fmt: skip
    if not packed:
        info |= {name: x.unflatten(0, views.images) for name, x in found.items()}
        return info, [slice(None)] * len(views)
    image, gaussian = (found["radii"] > 0).all(-1).nonzero().unbind(-1)
    info |= {name: x[image, gaussian] for name, x in found.items()}
    info |= {"batch_ids": image // cameras, "camera_ids": image % cameras, "gaussian_ids": gaussian}
    return info, list(gaussian.split(torch.bincount(image, minlength=len(views)).tolist()))


def rendered(
    views: CloudViews,
    info: SplatInfo,
    rows: list[Any],
    colors: Tensor | None,
    extra: Tensor | None,
    backgrounds: Tensor | None,
    wants: Wants,
) -> tuple[Tensor, Tensor, SplatInfo]:
    """Pictures, opacities and the dictionary of `rasterization`."""
    shares, has_colours = [len(x) for x in rows] if wants.packed else [], "RGB" in wants.mode

    def parts(x: Tensor) -> Sequence[Tensor]:
        return x.split(shares) if wants.packed else x.flatten(0, len(views.images) - 1).unbind()

    spread: Any = [None] * len(views)
    if wants.absgrad:
        info["means2d"].absgrad = torch.zeros_like(info["means2d"])
        spread = parts(info["means2d"].absgrad)
    columns = [parts(info[name]) for name in ("means2d", "conics", "opacities", "depths")]
    pictures, opaque, further = [], [], []
    for i in range(len(views)):
        own = [colours(colors, views, i, rows[i], wants.degree)] if has_colours and colors is not None else []
        channels = sum(x.shape[-1] for x in own)
        own += [] if extra is None else [colours(extra, views, i, rows[i], wants.extra_degree, False)]
        values = torch.cat([*own, columns[3][i].new_zeros(len(columns[3][i]), 0)], -1)
        size = (info["width"], info["height"])
        seen, depth, alpha = composited([x[i] for x in columns], values, size, wants.include_last, spread[i])
        picture = seen[..., :channels]
        further.append(seen[..., channels:])
        if backgrounds is not None and has_colours:
            picture = over(picture, alpha, backgrounds.float().reshape(len(views), -1)[i])
        if "ED" in wants.mode:
            depth = depth / alpha.clamp_min(MIN_OPACITY)
        pictures.append(torch.cat([picture, depth[..., None]], -1) if "D" in wants.mode else picture)
        opaque.append(alpha[..., None])
    if extra is not None:
        info["render_extra_signals"] = torch.stack(further).unflatten(0, views.images)
    return torch.stack(pictures).unflatten(0, views.images), torch.stack(opaque).unflatten(0, views.images), info


def by_kernel(
    means: Float[Tensor, "gaussian 3"],
    quats: Float[Tensor, "gaussian 4"],
    scales: Float[Tensor, "gaussian 3"],
    opacities: Float[Tensor, " gaussian"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    how: Projecting,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Centres, conics, depths, opacities and radii of Gaussians in a pinhole camera, by the kernel."""
    camera = camera_of(viewmat, K, *how.size)
    view, unused = view_of(camera, how.near).to(means.device), means.new_zeros(len(means), 1, 3)
    centres, conics, depths, _, alphas = kernels.project(means, quats, scales, opacities, unused, view, 1, how.blur)
    if how.compensate:
        alphas = alphas * compensation_of(conics, how.blur)
    radii = radii_of(conics.detach(), alphas.detach())
    shown = (depths < how.far) & (radii.amax(-1) > how.radius_clip) if len(means) else alphas > 0
    return centres, conics, depths, torch.where(shown, alphas, 0.0), radii * shown[:, None]


def by_definition(
    means: Float[Tensor, "gaussian 3"],
    quats: Float[Tensor, "gaussian 4"] | None,
    scales: Float[Tensor, "gaussian 3"] | None,
    covars: Float[Tensor, "gaussian 3 3"] | None,
    opacities: Float[Tensor, " gaussian"] | None,
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    how: Projecting,
    lens: Distortion,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The same for any camera, in plain PyTorch; without opacities these are the factors of antialiasing."""
    rotation = viewmat[:3, :3]
    points = means @ rotation.T + viewmat[:3, 3]
    z = points[:, 2]
    visible, depths = (z > how.near) & (z < how.far), points.norm(dim=-1) if how.by_distance else z
    if how.transform is not None:
        assert quats is not None and scales is not None
        axes = rotation @ (to_matrix(quats) * scales[:, None])
        centres, spread, valid = unscented(points, axes, K, how.size, how.model, lens, how.transform)
        visible = visible & valid & (quats.square().sum(-1) > MIN_SPREAD) & (scales > MIN_SPREAD).all(-1)
    else:
        if covars is None:
            assert quats is not None and scales is not None
            covars = covariances_of(quats, scales)
        centres, spread = affine(points, rotation @ covars @ rotation.T, K, how.size, how.model)
    seen = footprints_of(centres, spread, depths, visible, how.size, how.blur, opacities, how.radius_clip,
                         how.compensate)  # fmt: skip
    alphas = torch.where((seen.radii > 0).all(-1), 1.0 if opacities is None else opacities, 0.0)
    factor = seen.compensation if how.compensate or opacities is None else 1.0
    return seen.centres, seen.conics, seen.depths, alphas * factor, seen.radii


def compensation_of(conics: Float[Tensor, "gaussian 3"], blur: float) -> Float[Tensor, " gaussian"]:
    """sqrt(det(C - blur I) / det C) of footprints' inverses C^-1, at least MIN_COMPENSATION (Yu 2024, eq. 9)."""
    xx, xy, yy = conics.unbind(-1)
    share = (1 - blur * xx) * (1 - blur * yy) - (blur * xy).square()
    return share.clamp_min(MIN_COMPENSATION**2).sqrt()


def colours(
    colors: Tensor, views: CloudViews, image: int, rows: Any, degree: int | None, clamp: bool = True
) -> Float[Tensor, "gaussian channel"]:
    """Values of some Gaussians for one image: unchanged, or from harmonics, 1/2 + sum_k Y_k(d) h_k, at least zero.

    colors: with leading axes of the batch, of the batch and cameras, or (harmonics) of neither
    """
    (b, c), lead = views.place(image), colors.ndim - (2 if degree is None else 3)
    own = colors.float()
    if lead == len(views.images):
        own = own.reshape(len(views), *colors.shape[lead:])[image]
    elif lead == len(views.dims) and lead:
        own = own.reshape(-1, *colors.shape[lead:])[b]
    if own.ndim != (2 if degree is None else 3) or len(own) != views.means.shape[1]:
        raise LumigraphError(
            f"colors has the shape {tuple(colors.shape)}, which does not fit {tuple(views.means.shape)}"
        )
    own = own[rows]
    if degree is None:
        return own
    if own.shape[1] < (degree + 1) ** 2:
        raise LumigraphError(f"sh_degree={degree} needs {(degree + 1) ** 2} coefficients, and there are {own.shape[1]}")
    viewmat = views.viewmats[b, c]
    directions = torch.nn.functional.normalize(views.means[b][rows] + viewmat[:3, :3].T @ viewmat[:3, 3], dim=-1)
    basis = harmonics(directions, degree)
    values = 0.5 + torch.einsum("nk,nkc->nc", basis, own[:, : basis.shape[-1]])
    return values.clamp_min(0.0) if clamp else values


def harmonics(directions: Float[Tensor, "ray 3"], degree: int) -> Float[Tensor, "ray coefficient"]:
    """Real spherical harmonics up to degree 4, with the signs of the kernel, which has three (Sloan 2013)."""
    basis = kernels.spherical_harmonics(directions, min(degree, MAX_DEGREE - 1) + 1)
    if degree < MAX_DEGREE:
        return basis
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    band = [4 * x * y * (xx - yy), -y * (3 * xx - yy) * z, 2 * x * y * (7 * zz - 1), -y * z * (7 * zz - 3),
            35 * zz * zz - 30 * zz + 3, -x * z * (7 * zz - 3), (xx - yy) * (7 * zz - 1),
            -x * (xx - 3 * yy) * z, xx * (xx - 3 * yy) - yy * (3 * xx - yy)]  # fmt: skip
    scales = [K44, K43, K42, K41, K40, K41, K42, K43, K44]
    return torch.cat([basis, torch.stack([k * p for k, p in zip(scales, band, strict=True)], -1)], -1)


def camera_of(viewmat: Float[Tensor, "4 4"], intrinsics: Float[Tensor, "3 3"], width: int, height: int) -> Camera:
    """A Camera of a world-to-camera matrix and its intrinsics."""
    rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
    pose = torch.cat([rotation.T, -(rotation.T @ shift)[:, None]], 1)
    intrinsics = intrinsics.detach()
    lens = Pinhole(intrinsics[[0, 1], [0, 1]][None].clone(), intrinsics[:2, 2][None].clone())
    return Camera(pose[None], lens, torch.tensor([[width, height]], device=pose.device))


def matrices_of(
    cameras: Camera,
) -> tuple[Float[Tensor, "camera 4 4"], Float[Tensor, "camera 3 3"]]:
    """World-to-camera matrices and intrinsics of pinhole cameras, for `rasterization`."""
    lens = cameras.lens
    if not isinstance(lens, Pinhole):
        raise LumigraphError(
            f"rasterization() takes pinhole cameras, and these are {type(lens).__name__}; undistort them"
        )
    rotation = cameras.pose[:, :, :3].mT
    viewmats, Ks = (torch.eye(n, device=rotation.device).repeat(len(rotation), 1, 1) for n in (4, 3))
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3:] = -rotation @ cameras.pose[:, :, 3:]
    Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2] = lens.focal, lens.centre
    return viewmats, Ks


def composited(
    footprints: Sequence[Tensor],
    values: Float[Tensor, "gaussian channel"],
    size: tuple[int, int],
    include_last: bool = False,
    spread: Float[Tensor, "gaussian 2"] | None = None,
    tiles: kernels.Tiles | None = None,
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Values, depth and opacity of each pixel. The kernel composites three values at a time.

    footprints: centres, conics, opacities and depths of the Gaussians
    spread:     receives sums of absolute gradients of the centres;  tiles: None for those that footprints touch
    """
    centres, conics, alphas, depths = (x.contiguous() for x in footprints)
    channels = values.shape[-1]
    tiles = tiles or kernels.tile(centres, conics, alphas, depths, size)
    triples = torch.nn.functional.pad(values, (0, -channels % 3)) if channels else values.new_zeros(len(values), 3)
    seen = [
        kernels.rasterize(centres, conics, alphas, x.contiguous(), depths, tiles, STOP, not include_last, spread)
        for x in triples.split(3, -1)
    ]
    return torch.cat([picture for picture, _, _ in seen], -1)[..., :channels], seen[0][1], seen[0][2]


def radii_of(conics: Float[Tensor, "gaussian 3"], alphas: Float[Tensor, " gaussian"]) -> Int[Tensor, "gaussian 2"]:
    """Half width and height of each footprint where it adds 1/255, at most RADIUS_DEVIATIONS, in whole pixels; zero for
    an empty one."""
    xx, xy, yy = conics.unbind(-1)
    determinant = xx * yy - xy * xy
    variance = torch.stack([yy, xx], -1) / determinant.clamp_min(1e-30)[:, None]
    reach = (2 * (alphas * 255).clamp_min(1).log()).sqrt().clamp_max(RADIUS_DEVIATIONS)
    return torch.where(determinant[:, None] > 0, (reach[:, None] * variance.sqrt()).ceil(), 0.0).int()
