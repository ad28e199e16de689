"""Projection of Gaussians for any camera model, in plain PyTorch: local affine (Zwicker 2002) or by the unscented
transform (Wan and van der Merwe 2000; Wu 2025, arXiv 2412.12507).

`kernels.project` is the fast way for pinhole cameras; this one takes covariances, other cameras and distortion too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..errors import LumigraphError
from ..geometry import to_matrix
from ..kernels.project import MIN_ALPHA
from .splatting import IMAGE_MARGIN

CameraModel = Literal["pinhole", "ortho", "fisheye"]
CAMERA_MODELS = "pinhole", "ortho", "fisheye"
RADIUS_DEVIATIONS = 3.33  # of a footprint at most; there exp(-r^2 / 2) is 1/255
MIN_COMPENSATION = 0.005  # floor of the factor on opacity that `compensation` gives
MIN_DETERMINANT = 1e-10
MIN_SPREAD = 1.2e-7  # scale and squared length of a quaternion, below which the unscented transform has no answer
MIN_DISTORTION_FACTOR = 0.8  # of a radial distortion; beyond it a lens may fold


@dataclass(frozen=True)
class UnscentedTransformParameters:
    """Numbers of the unscented transform; the defaults are those of Wan and van der Merwe (2000).

    in_image_margin_factor: of the picture's size beyond its edges, within which a sigma point is valid
    require_all_sigma_points_valid: whether one invalid sigma point removes the Gaussian; otherwise all do
    """

    alpha: float = 0.1
    beta: float = 2.0
    kappa: float = 0.0
    in_image_margin_factor: float = 0.1
    require_all_sigma_points_valid: bool = False

    def __post_init__(self) -> None:
        if self.alpha**2 * (3 + self.kappa) <= 0:
            raise LumigraphError(f"alpha^2 (3 + kappa) must be positive, and alpha={self.alpha}, kappa={self.kappa}")


@dataclass(frozen=True)
class Distortion:
    """Coefficients of one lens, in OpenCV's order, as the camera model has them.

    radial: k1 to k6 of a rational pinhole (fewer are zero), or k1 to k4 of a fisheye
    tangential: p1, p2;  thin_prism: s1 to s4
    """

    radial: Float[Tensor, " coefficient"] | None = None
    tangential: Float[Tensor, " 2"] | None = None
    thin_prism: Float[Tensor, " 4"] | None = None


@dataclass(frozen=True)
class Footprints:
    """Projected Gaussians; rows of Gaussians that are not visible are zero.

    radii: half width and height of the footprint, in whole pixels
    compensation: factor on opacity, so that the blur adds no light (Yu 2024, eq. 9), at least MIN_COMPENSATION
    """

    radii: Int[Tensor, "gaussian 2"]
    centres: Float[Tensor, "gaussian 2"]
    depths: Float[Tensor, " gaussian"]
    conics: Float[Tensor, "gaussian 3"]
    compensation: Float[Tensor, " gaussian"]


def covariances_of(
    quats: Float[Tensor, "*gaussian 4"], scales: Float[Tensor, "*gaussian 3"], power: float = 1.0
) -> Float[Tensor, "*gaussian 3 3"]:
    """Q diag(scale)^(2 power) Q^T; power -1 gives precisions."""
    rotation = to_matrix(quats)
    return rotation * scales.pow(2 * power)[..., None, :] @ rotation.mT


def affine(
    points: Float[Tensor, "gaussian 3"],
    covariances: Float[Tensor, "gaussian 3 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    model: str = "pinhole",
) -> tuple[Float[Tensor, "gaussian 2"], Float[Tensor, "gaussian 2 2"]]:
    """Centres and covariances in pixels, J Sigma J^T with the Jacobian J at the centre, in the camera's frame.

    The Jacobian of a pinhole is that of the picture's edge, with a margin, beyond it.
    """
    x, y, z = points.unbind(-1)
    focal, centre, zero = K[..., [0, 1], [0, 1]], K[..., :2, 2], torch.zeros_like(x)
    fx, fy = focal[..., :1], focal[..., 1:]
    if model == "ortho":
        rows = [fx + zero, zero, zero, zero, fy + zero, zero]
        centres = points[..., :2] * focal[..., None, :] + centre[..., None, :]
    elif model == "fisheye":
        r = torch.hypot(x, y).clamp_min(1e-7)
        theta, square = torch.atan2(r, z), r * r + z * z
        along, across = z / square, theta / r  # change of the angle outwards and sideways
        c, s = x / r, y / r
        rows = [fx * (c * c * along + s * s * across), fx * c * s * (along - across), -fx * x / square,
                fy * c * s * (along - across), fy * (s * s * along + c * c * across), -fy * y / square]  # fmt: skip
        centres = focal[..., None, :] * across[..., None] * points[..., :2] + centre[..., None, :]
    else:
        z = torch.where(z.abs() > 1e-12, z, 1e-12)
        flat = points[..., :2] / z[..., None]
        edge = points.new_tensor(size)
        margin = IMAGE_MARGIN * edge / focal
        low, high = -centre / focal - margin, (edge - centre) / focal + margin
        u, v = flat.clamp(low[..., None, :], high[..., None, :]).unbind(-1)
        rows = [fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z]
        centres = (points @ K[..., :2, :].mT) / z[..., None]
    jacobian = torch.stack(rows, -1).unflatten(-1, (2, 3))
    return centres, jacobian @ covariances @ jacobian.mT


def pixels_of(
    points: Float[Tensor, "*point 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    model: str,
    lens: Distortion,
    margin: float,
) -> tuple[Float[Tensor, "*point 2"], Bool[Tensor, "*point"]]:
    """Pixels of points in the camera's frame, and whether each is in front, in the picture with its margin (a share of
    the size), and where the distortion does not fold."""
    allowed = {"pinhole": ("radial", "tangential", "thin_prism"), "fisheye": ("radial",)}.get(model, ())
    if named := [name for name, value in vars(lens).items() if value is not None and name not in allowed]:
        raise LumigraphError(f"camera_model={model!r} has no {', '.join(named)} coefficients; leave them out")
    z = points[..., 2]
    front = z > 0
    flat = points[..., :2] if model == "ortho" else points[..., :2] / torch.where(front, z, 1.0)[..., None]
    valid = front
    if model == "fisheye":
        k = flat.new_zeros(4) if lens.radial is None else lens.radial
        r = points[..., :2].norm(dim=-1).clamp_min(1e-7)
        theta = torch.atan2(r, z)
        t = theta * theta
        bent = theta * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))))
        slope = 1 + t * (3 * k[0] + t * (5 * k[1] + t * (7 * k[2] + t * 9 * k[3])))
        valid = valid & (slope > 0)
        flat = points[..., :2] * (bent / r)[..., None]
    elif model == "pinhole" and lens != Distortion():
        flat, factor = distorted(flat, lens)
        valid = valid & (factor > MIN_DISTORTION_FACTOR)
    pixels = torch.where(front[..., None], flat * K[[0, 1], [0, 1]] + K[:2, 2], 0.0)
    edge = pixels.new_tensor(size)
    inside = ((pixels >= -margin * edge) & (pixels < (1 + margin) * edge)).all(-1)
    return pixels, valid & inside


def distorted(
    flat: Float[Tensor, "*point 2"], lens: Distortion
) -> tuple[Float[Tensor, "*point 2"], Float[Tensor, "*point"]]:
    """Points of the plane z = 1 after OpenCV's distortion with thin prism, and the radial factor."""
    k = (
        torch.nn.functional.pad(lens.radial, (0, 6 - len(lens.radial)))
        if lens.radial is not None
        else flat.new_zeros(6)
    )
    p = flat.new_zeros(2) if lens.tangential is None else lens.tangential
    s = flat.new_zeros(4) if lens.thin_prism is None else lens.thin_prism
    x, y = flat.unbind(-1)
    r = x * x + y * y
    factor = (1 + r * (k[0] + r * (k[1] + r * k[2]))) / (1 + r * (k[3] + r * (k[4] + r * k[5])))
    dx = 2 * p[0] * x * y + p[1] * (r + 2 * x * x) + r * (s[0] + r * s[1])
    dy = p[0] * (r + 2 * y * y) + 2 * p[1] * x * y + r * (s[2] + r * s[3])
    return flat * factor[..., None] + torch.stack([dx, dy], -1), factor


def unscented(
    points: Float[Tensor, "gaussian 3"],
    axes: Float[Tensor, "gaussian 3 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    model: str,
    lens: Distortion,
    numbers: UnscentedTransformParameters,
) -> tuple[Float[Tensor, "gaussian 2"], Float[Tensor, "gaussian 2 2"], Bool[Tensor, " gaussian"]]:
    """Mean and covariance, in pixels, of seven sigma points of each Gaussian, and whether they are valid.

    points, axes: centre, and columns of Q diag(scale), in the camera's frame
    """
    share = numbers.alpha**2 * (3 + numbers.kappa)  # 3 + lambda
    reach = share**0.5 * axes.mT
    sigma = torch.cat([points[:, None], points[:, None] + reach, points[:, None] - reach], 1)
    pixels, valid = pixels_of(sigma, K, size, model, lens, numbers.in_image_margin_factor)
    weight = points.new_full((7,), 1 / (2 * share))
    weight[0] = 1 - 3 / share
    both = weight.expand_as(pixels[..., 0])
    if numbers.require_all_sigma_points_valid:
        both = both * valid.cumprod(-1)
    centre = (both[..., None] * pixels).sum(1)
    off = pixels - centre[:, None]
    spread = torch.einsum("nk,nki,nkj->nij", both, off, off)
    extra = 1 - numbers.alpha**2 + numbers.beta
    spread = spread + extra * valid_first(both, weight)[:, None, None] * off[:, 0, :, None] * off[:, 0, None]
    seen = valid.all(-1) if numbers.require_all_sigma_points_valid else valid.any(-1)
    return centre, spread, seen


def valid_first(both: Float[Tensor, "gaussian 7"], weight: Float[Tensor, " 7"]) -> Float[Tensor, " gaussian"]:
    """1 where a Gaussian's centre counts."""
    return both[:, 0] / weight[0]


def footprints_of(
    centres: Float[Tensor, "gaussian 2"],
    covariances: Float[Tensor, "gaussian 2 2"],
    depths: Float[Tensor, " gaussian"],
    visible: Bool[Tensor, " gaussian"],
    size: tuple[int, int],
    blur: float,
    opacities: Float[Tensor, " gaussian"] | None = None,
    radius_clip: float = 0.0,
    compensate: bool = False,
) -> Footprints:
    """Footprints with blur, without those that are too small, too faint or outside the picture.

    visible: Gaussians between the near and the far plane;  compensate: whether opacity is multiplied by it
    """
    a, b, c = covariances[:, 0, 0], (covariances[:, 0, 1] + covariances[:, 1, 0]) / 2, covariances[:, 1, 1]
    narrow, a, c = a * c - b * b, a + blur, c + blur
    raw = a * c - b * b
    determinant = raw.clamp_min(MIN_DETERMINANT)
    compensation = (narrow / determinant).clamp_min(MIN_COMPENSATION**2).sqrt()
    reach = torch.full_like(depths, RADIUS_DEVIATIONS)
    if opacities is not None:
        alphas = (opacities * compensation if compensate else opacities).detach()
        visible = visible & (alphas >= MIN_ALPHA)
        reach = (2 * (alphas / MIN_ALPHA).clamp_min(1).log()).sqrt().clamp_max(RADIUS_DEVIATIONS)
    extent = (reach[:, None] * torch.stack([a, c], -1).detach().clamp_min(0).sqrt()).ceil()
    edge = extent.new_tensor(size)
    inside = ((centres + extent > 0) & (centres - extent < edge)).all(-1)
    visible = visible & inside & (extent.amax(-1) > radius_clip) & (raw > 0) & (a > 0) & (c > 0)
    conics = torch.stack([c, -b, a], -1) / determinant[:, None]
    one = depths.new_zeros(())
    return Footprints(
        (extent * visible[:, None]).int(),
        torch.where(visible[:, None], centres, one),
        torch.where(visible, depths, one),
        torch.where(visible[:, None], conics, one),
        torch.where(visible, compensation, one),
    )


def check_model(model: str) -> None:
    """Raises LumigraphError for camera models without a projection here."""
    if model not in CAMERA_MODELS:
        raise LumigraphError(f"camera_model={model!r} is not one of {', '.join(CAMERA_MODELS)}; take one of these")
