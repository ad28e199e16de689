"""Lenses: maps from directions to pixels (project) and back (unproject).

A lens works in the camera's own frame: +x right, +y down, +z forward. It is a value with one row of numbers per
camera of a batch. A new kind of lens is a new subclass with `unproject` and `project`; nothing else changes.
"""

from __future__ import annotations

import math
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..errors import LumigraphError
from ..files.ranges import Tally, typed
from . import loops

FOLD_SAMPLES = 1024  # angles from the axis at which a distortion is tested for folding over
MAX_FLAT_ANGLE = math.radians(89.0)  # from the axis, on a flat image plane: tan is still harmless in float32
MIN_OMEGA = 1e-3  # radians, of a FieldOfView; a smaller one is no distortion
NEWTON_STEPS = 20  # usually three are enough; more only beside a fold
CONVERGED_STEP = 3e-5  # after a Newton step this small the remaining error is about its square
# What the numbers of lenses that exist lie between; in pixels, but for distortion and for the offset of an eye.
PARAMETER_RANGES = {"focal": (1e-2, 1e7), "centre": (-1e7, 1e7), "size": (1.0, 1e7), "distortion": (-1e4, 1e4)}
PARAMETER_RANGES |= {"offset": (-1e6, 1e6), "alpha": (0.0, 1.0), "beta": (1e-3, 1e3)}
DEFAULT_RANGE = (-1e9, 1e9)  # for further parameters of a new kind of lens
Distorted = tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]  # (x', y') and its Jacobian, row by row
NO_INDEX = torch.empty(0, dtype=torch.int64)


@dataclass(frozen=True)
class Named:
    """Fields of a lens in a file that all kinds share."""

    kind: str


@dataclass(frozen=True)
class MixedParts:
    """Fields of lenses of several kinds in a file; see `Mixed`."""

    parts: list[Any]
    part: list[Tally]


class Lens(ABC):
    """Base class of lenses. Subclasses are frozen dataclasses of tensors with leading axis camera. In every method
    `index` names the camera of each pixel or point; None means camera 0 for all."""

    kinds: ClassVar[dict[str, type[Lens]]] = {}
    in_pixels: ClassVar[tuple[str, ...]] = ("focal", "centre")  # what scales with the picture

    def __init_subclass__(cls) -> None:
        Lens.kinds[cls.__name__.lower()] = cls

    @abstractmethod
    def unproject(
        self, pixels: Float[Tensor, "ray 2"], index: Int[Tensor, " ray"] | None = None
    ) -> Float[Tensor, "ray 3"]:
        """Unit directions in the camera's frame. A pixel outside the lens's range gets its outermost direction."""

    @abstractmethod
    def project(
        self, points: Float[Tensor, "point 3"], index: Int[Tensor, " point"] | None = None
    ) -> tuple[Float[Tensor, "point 2"], Bool[Tensor, " point"]]:
        """Pixels of points in the camera's frame, and a mask of valid projections.

        False behind the camera and beyond a distortion's fold-over; their pixels are finite but meaningless. The mask
        does not test whether a pixel lies inside the picture.
        """

    def origins(
        self, pixels: Float[Tensor, "ray 2"], index: Int[Tensor, " ray"] | None = None
    ) -> Float[Tensor, "ray 3"] | None:
        """Origins of rays in the camera's frame, in scene units; None for rays from the camera's centre."""
        return None

    def solid_angle(
        self,
        pixels: Float[Tensor, "ray 2"],
        directions: Float[Tensor, "ray 3"],
        index: Int[Tensor, " ray"] | None = None,
    ) -> Float[Tensor, " ray"]:
        """Solid angle of each pixel, in steradians. directions: from `unproject`"""
        half_x, half_y = 0.5 * torch.eye(2, dtype=pixels.dtype, device=pixels.device)
        across = self.unproject(pixels + half_x, index) - self.unproject(pixels - half_x, index)
        down = self.unproject(pixels + half_y, index) - self.unproject(pixels - half_y, index)
        return torch.linalg.cross(across, down).norm(dim=-1)

    def resized(self, scale: Float[Tensor, "#camera 2"]) -> Lens:
        """The same lens for a picture scaled by (x, y)."""
        return type(self)(**{k: v * scale if k in self.in_pixels else v for k, v in self._numbers().items()})

    def enlarged(self, scale: float) -> Lens:
        """The same lens in a world scaled by a factor."""
        return self

    def __len__(self) -> int:
        return len(next(iter(self._numbers().values())))

    def __getitem__(self, index: int | np.integer | slice | Tensor) -> Lens:
        """The lenses of some cameras; an int gives a batch of one."""
        return self._map(lambda x: x[one_or_more(index)])

    def to(self, device: torch.device | str) -> Lens:
        """The same lenses on a device; tensors that are there already are not copied."""
        return self._map(lambda x: x.to(device))

    @property
    def device(self) -> torch.device:
        """Device of the intrinsics."""
        return next(iter(self._numbers().values())).device

    def to_json(self) -> dict[str, Any]:
        """Plain lists and a name, the exact inverse of `Lens.from_json`."""
        return {"kind": type(self).__name__.lower(), **{k: v.tolist() for k, v in self._numbers().items()}}

    @staticmethod
    def from_json(data: Any, where: Any = "a lens") -> Lens:
        """Read the lenses of cameras from a file's JSON. Raises LumigraphError, naming `where`, for invalid ones."""
        kind = Lens.kinds.get(typed(Named, data, where).kind)
        if kind is None:
            raise LumigraphError(f"{where} has a lens of kind {data['kind']!r}; there are {', '.join(Lens.kinds)}")
        return kind._from_json(data, where)

    @classmethod
    def _from_json(cls, data: dict[str, Any], where: Any) -> Lens:
        found = {}
        for name, shape in typing.get_type_hints(cls).items():
            if name in data and hasattr(shape, "dim_str"):  # as in "camera 2", or "camera" alone
                _, *numbers = shape.dim_str.split()
                row: Any = tuple[(float,) * int(numbers[0])] if numbers else float  # type: ignore[misc]
                found[name] = torch.tensor(typed(list[row], data[name], f"{where}: {name}"), dtype=torch.float32)
        lacking = [x.name for x in fields(cls) if x.name not in found and x.default is MISSING]  # type: ignore[arg-type]
        if lacking or len({len(values) for values in found.values()}) != 1:
            raise LumigraphError(
                f"{where} has lenses without all the numbers of their kind, {data['kind']}; correct it"
            )
        lens = cls(**found)
        if (fault := lens.fault()) is not None:
            raise LumigraphError(f"{where} has a lens whose {fault}; correct it")
        return lens

    def fault(self) -> str | None:
        """Describe the first invalid parameter in a few words; None if all are valid."""
        for name, values in self._numbers().items():
            least, most = PARAMETER_RANGES.get(name, DEFAULT_RANGE)
            bad = ~((values >= least) & (values <= most))
            if bad.any():
                return f"{name} is {float(values[bad][0]):g}, which is not between {least:g} and {most:g}"
        return None

    @staticmethod
    def cat(lenses: Sequence[Lens]) -> Lens:
        """Concatenate lenses; different kinds become `Mixed`."""
        first = lenses[0]
        if isinstance(first, Mixed) or any(type(lens) is not type(first) for lens in lenses):
            return mix([one for lens in lenses for one in (lens[i] for i in range(len(lens)))])
        return type(first)(**{k: torch.cat([getattr(lens, k) for lens in lenses]) for k in first._numbers()})

    def _numbers(self) -> dict[str, Tensor]:
        return {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]

    def _map(self, change: Callable[[Tensor], Tensor]) -> Lens:
        return type(self)(**{k: change(v) for k, v in self._numbers().items()})


@dataclass(frozen=True)
class Pinhole(Lens):
    """Pinhole camera: (u, v) = f (x, y) / z + c.

    focal, centre: pixels
    """

    focal: Float[Tensor, "camera 2"]
    centre: Float[Tensor, "camera 2"]

    def unproject(self, pixels, index=None):
        x, y = ((pixels - rows(self.centre, index)) / rows(self.focal, index)).unbind(-1)
        return through_plane(x, y)

    def project(self, points, index=None):
        plane, valid = onto_plane(points)
        return plane * rows(self.focal, index) + rows(self.centre, index), valid

    def solid_angle(self, pixels, directions, index=None):
        # A pixel is 1 / (fx fy) of the plane z = 1, seen obliquely and from further away: cos^3.
        z = directions[:, 2]
        return z * z * z / area(self.focal, index)


@dataclass(frozen=True)
class OpenCV(Lens):
    """Pinhole with rational radial and tangential distortion (OpenCV's camera model; Brown 1971).

        (x, y) -> (x, y) q(r^2) + (2 p1 xy + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 xy)
        q(s) = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)

    focal, centre: pixels
    distortion:    k1 k2 p1 p2 k3 k4 k5 k6, in OpenCV's order; zeros where a calibration has none
    """

    focal: Float[Tensor, "camera 2"]
    centre: Float[Tensor, "camera 2"]
    distortion: Float[Tensor, "camera 8"]

    @cached_property
    def fold(self) -> Float[Tensor, "camera 1"]:
        """Radius on the plane z = 1 up to which radial distortion is monotonic."""
        r = torch.linspace(0, MAX_FLAT_ANGLE, FOLD_SAMPLES, dtype=torch.float64, device=self.focal.device).tan()
        k1, k2, _, _, k3, k4, k5, k6 = self.distortion.double().T[:, :, None]
        s = r * r
        bent = r * (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        return last_growing(r, bent).to(self.focal.dtype)

    def unproject(self, pixels, index=None):
        if self._by_loop(pixels):
            directions = torch.empty(len(pixels), 3)
            inputs = (pixels, NO_INDEX if index is None else index, self.focal, self.centre, self.distortion, self.fold)
            # Each ray stops by itself here, so one beside a fold, where steps merely halve, costs the others no steps.
            loops.undistort(*(x.numpy() for x in inputs), NEWTON_STEPS, 0.03 * CONVERGED_STEP, directions.numpy())
            return directions
        target = (pixels - rows(self.centre, index)) / rows(self.focal, index)
        target_x, target_y = target.T.contiguous()
        distortion, (limit,) = columns(self.distortion, index), columns(self.fold, index)
        return through_plane(*straightened(target_x, target_y, limit, lambda x, y: bend(x, y, distortion)))

    def project(self, points, index=None):
        plane, valid = onto_plane(points)
        x, y = plane.unbind(-1)
        inside = torch.hypot(x, y) <= rows(self.fold, index)[:, 0]
        bent, _ = bend(x, y, columns(self.distortion, index))
        pixels = torch.stack(bent, -1) * rows(self.focal, index) + rows(self.centre, index)
        return pixels, valid & inside

    def solid_angle(self, pixels, directions, index=None):
        if self._by_loop(directions):
            angle = torch.empty(len(directions))
            tensors = directions, NO_INDEX if index is None else index, self.focal, self.distortion, angle
            loops.solid_angle(*(x.numpy() for x in tensors))
            return angle
        x, y, z = directions.T.contiguous()
        _, (xx, xy, yx, yy) = bend(x / z, y / z, columns(self.distortion, index))
        return z * z * z / ((xx * yy - xy * yx).clamp_min(1e-3) * area(self.focal, index))

    def _by_loop(self, given: Tensor) -> bool:
        """True if the faster CPU loops apply: single precision, no gradients."""
        tensors = (given, *self._numbers().values())
        return all(x.is_cpu and x.dtype == torch.float32 and not x.requires_grad for x in tensors)


@dataclass(frozen=True)
class Fisheye(Lens):
    """Fisheye lens: distance from the centre is a polynomial of the angle from the axis (Kannala & Brandt 2006).

        distance = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

    As OpenCV's fisheye model, but also valid beyond 90 degrees.
    focal, centre: pixels
    distortion:    k1 k2 k3 k4
    """

    focal: Float[Tensor, "camera 2"]
    centre: Float[Tensor, "camera 2"]
    distortion: Float[Tensor, "camera 4"]

    @cached_property
    def fold(self) -> Float[Tensor, "camera 1"]:
        """Angle from the axis up to which the distance from the centre is monotonic, at most pi."""
        return fisheye_fold(self.distortion)

    def unproject(self, pixels, index=None):
        target = (pixels - rows(self.centre, index)) / rows(self.focal, index)
        distortion, (limit,) = columns(self.distortion, index), columns(self.fold, index)
        distance = target.square().sum(-1).sqrt()
        theta = torch.minimum(distance, limit)
        for _ in range(NEWTON_STEPS):
            value, slope = stretch(theta, distortion)
            step = (value - distance) / slope.clamp_min(1e-3)
            theta = torch.minimum((theta - step).clamp_min(0), limit)
            if small(step):
                break
        sideways = target * (theta.sin() / distance.clamp_min(1e-12))[:, None]
        return torch.cat([sideways, theta.cos()[:, None]], -1)

    def project(self, points, index=None):
        sideways = points[:, :2]
        away = sideways.norm(dim=-1)
        theta = torch.atan2(away, points[:, 2])
        distance, _ = stretch(theta, columns(self.distortion, index))
        plane = sideways * (distance / away.clamp_min(1e-12))[:, None]
        valid = (theta <= rows(self.fold, index)[:, 0]) & ((away > 0) | (points[:, 2] > 0))
        return plane * rows(self.focal, index) + rows(self.centre, index), valid

    def solid_angle(self, pixels, directions, index=None):
        # sin(theta) dtheta dphi of the sphere becomes distance ddistance dphi of the picture.
        away = directions[:, :2].norm(dim=-1).clamp_min(1e-6)
        theta = torch.atan2(away, directions[:, 2])
        distance, slope = stretch(theta, columns(self.distortion, index))
        return away / (distance * slope.clamp_min(1e-3) * area(self.focal, index))


@dataclass(frozen=True)
class ThinPrism(Fisheye):
    """Fisheye lens with tangential distortion and a thin prism (COLMAP's THIN_PRISM_FISHEYE; Weng 1992).

    With (x, y) = theta (cos phi, sin phi), s = theta^2 and q(s) = 1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4:

        (x, y) -> (x, y) q(s) + (2 p1 xy + p2 (s + 2 x^2) + a s, p1 (s + 2 y^2) + 2 p2 xy + b s)

    distortion: k1 k2 k3 k4 p1 p2 a b
    """

    distortion: Float[Tensor, "camera 8"]
    radial_count = 4

    @cached_property
    def fold(self) -> Float[Tensor, "camera 1"]:
        """Angle from the axis up to which the radial part is monotonic."""
        return fisheye_fold(self.distortion[:, : self.radial_count])

    def unproject(self, pixels, index=None):
        target_x, target_y = ((pixels - rows(self.centre, index)) / rows(self.focal, index)).unbind(-1)
        distortion, (limit,) = columns(self.distortion, index), columns(self.fold, index)
        x, y = straightened(target_x, target_y, limit, lambda x, y: self.distort(x, y, distortion))
        theta = torch.hypot(x, y)
        share = theta.sin() / theta.clamp_min(1e-12)
        return torch.stack([x * share, y * share, theta.cos()], -1)

    def project(self, points, index=None):
        away = points[:, :2].norm(dim=-1)
        theta = torch.atan2(away, points[:, 2])
        x, y = (points[:, :2] * (theta / away.clamp_min(1e-12))[:, None]).unbind(-1)
        bent, _ = self.distort(x, y, columns(self.distortion, index))
        valid = (theta <= rows(self.fold, index)[:, 0]) & ((away > 0) | (points[:, 2] > 0))
        return torch.stack(bent, -1) * rows(self.focal, index) + rows(self.centre, index), valid

    def distort(self, x: Tensor, y: Tensor, distortion: Sequence[Tensor]) -> Distorted:
        return prism(x, y, distortion)

    solid_angle = Lens.solid_angle


@dataclass(frozen=True)
class RadialThinPrism(ThinPrism):
    """Fisheye lens of Project Aria (FisheyeRadTanThinPrism; COLMAP's RAD_TAN_THIN_PRISM_FISHEYE).

    With (x, y) = theta (cos phi, sin phi) q(theta^2), q(s) = 1 + k1 s + ... + k6 s^6, and s = x^2 + y^2:

        (x, y) -> (x, y) (1 + 2 (p1 x + p2 y)) + (p1 s + a s + b s^2, p2 s + c s + d s^2)

    distortion: k1 ... k6 p1 p2 a b c d
    """

    distortion: Float[Tensor, "camera 12"]
    radial_count = 6

    def distort(self, x, y, distortion):
        return radial_prism(x, y, distortion)


@dataclass(frozen=True)
class FieldOfView(Lens):
    """Fisheye lens of one parameter (Devernay and Faugeras 2001; COLMAP's FOV), on the plane z = 1:

    r -> atan(2 r tan(omega / 2)) / omega
    """

    focal: Float[Tensor, "camera 2"]
    centre: Float[Tensor, "camera 2"]
    omega: Float[Tensor, "camera 1"]

    def unproject(self, pixels, index=None):
        plane = (pixels - rows(self.centre, index)) / rows(self.focal, index)
        r = plane.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        return through_plane(*(plane * (self.straight(r, index) / r)).unbind(-1))

    def project(self, points, index=None):
        plane, valid = onto_plane(points)
        r = plane.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        bent, seen = self.bent(r, index)
        return plane * (bent / r) * rows(self.focal, index) + rows(self.centre, index), valid & seen[:, 0]

    def straight(self, r: Tensor, index: Tensor | None) -> Tensor:
        """Radius without distortion, of that on the picture in focal lengths."""
        omega = rows(self.omega, index).clamp_min(MIN_OMEGA)
        wide = 2 * (0.5 * omega).tan()
        return torch.minimum(r * omega, (wide * math.tan(MAX_FLAT_ANGLE)).atan()).tan() / wide

    def bent(self, r: Tensor, index: Tensor | None) -> tuple[Tensor, Tensor]:
        """Radius on the picture in focal lengths, of that without distortion, and a mask of those that it has."""
        omega = rows(self.omega, index).clamp_min(MIN_OMEGA)
        return (2 * r * (0.5 * omega).tan()).atan() / omega, r < math.tan(MAX_FLAT_ANGLE)


@dataclass(frozen=True)
class Division(FieldOfView):
    """Lens whose distortion is a division (Fitzgibbon 2001; COLMAP's DIVISION), on the plane z = 1:

    r of the picture -> r / (1 + k r^2) without distortion.    omega: k
    """

    def straight(self, r: Tensor, index: Tensor | None) -> Tensor:
        k = rows(self.omega, index)
        r = torch.minimum(r, k.clamp_min(1e-12).rsqrt())  # where it stops growing, for k > 0
        return r / (1 + k * r * r).clamp_min(r / math.tan(MAX_FLAT_ANGLE))

    def bent(self, r: Tensor, index: Tensor | None) -> tuple[Tensor, Tensor]:
        root = 1 - 4 * rows(self.omega, index) * r * r
        return 2 * r / (1 + root.clamp_min(0).sqrt()), (root >= 0) & (r < math.tan(MAX_FLAT_ANGLE))


@dataclass(frozen=True)
class EnhancedUnified(Lens):
    """Wide lens of two parameters (Khomutenko et al. 2016; COLMAP's EUCM), from (x, y, z) to the plane:

    (x, y) -> (x, y) / (alpha d + (1 - alpha) z),    d^2 = beta (x^2 + y^2) + z^2
    """

    focal: Float[Tensor, "camera 2"]
    centre: Float[Tensor, "camera 2"]
    alpha: Float[Tensor, "camera 1"]
    beta: Float[Tensor, "camera 1"]

    def unproject(self, pixels, index=None):
        plane = (pixels - rows(self.centre, index)) / rows(self.focal, index)
        alpha, beta = rows(self.alpha, index), rows(self.beta, index)
        bent = beta * (2 * alpha - 1)  # over 0 where the plane ends, at a radius of bent^-1/2
        plane = plane * (bent.clamp_min(1e-12).rsqrt() / plane.norm(dim=-1, keepdim=True).clamp_min(1e-6)).clamp_max(1)
        s = plane.square().sum(-1, keepdim=True)
        z = (1 - beta * alpha**2 * s) / (alpha * (1 - bent * s).clamp_min(0).sqrt() + 1 - alpha).clamp_min(1e-6)
        return torch.nn.functional.normalize(torch.cat([plane, z], -1), dim=-1)

    def project(self, points, index=None):
        alpha, beta = rows(self.alpha, index), rows(self.beta, index)
        z = points[:, 2:]
        d = (beta * points[:, :2].square().sum(-1, keepdim=True) + z * z).sqrt()
        below = alpha * d + (1 - alpha) * z
        share = torch.minimum(alpha, 1 - alpha) / torch.maximum(alpha, 1 - alpha)
        valid = (z > -share * d) & (below > 1e-6 * d)
        pixels = points[:, :2] / torch.where(valid, below, 1) * rows(self.focal, index) + rows(self.centre, index)
        return pixels, valid[:, 0]


@dataclass(frozen=True)
class Equirectangular(Lens):
    """Equirectangular panorama: longitude across, latitude down. The top looks along -y.

    size:   (width, height) in pixels of 360 by 180 degrees
    centre: the pixel that looks along +z; half the size by default. Another one shows a part of the sphere
    """

    in_pixels: ClassVar[tuple[str, ...]] = ("size", "centre")
    size: Float[Tensor, "camera 2"]
    centre: Float[Tensor, "camera 2"] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.centre is None:
            object.__setattr__(self, "centre", self.size / 2)  # type: ignore[unreachable]

    def unproject(self, pixels, index=None):
        share = (pixels - rows(self.centre, index)) / rows(self.size, index)
        longitude, latitude = 2 * math.pi * share[:, 0], math.pi * share[:, 1]
        level = latitude.cos()
        return torch.stack([level * longitude.sin(), latitude.sin(), level * longitude.cos()], -1)

    def project(self, points, index=None):
        x, y, z = points.unbind(-1)
        pixels = self._at(torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z)), index)
        return pixels, (points != 0).any(-1)

    def solid_angle(self, pixels, directions, index=None):
        level = (1 - directions[:, 1] ** 2).clamp_min(1e-12).sqrt()
        return 2 * math.pi**2 * level / area(self.size, index)

    def _at(self, longitude: Tensor, latitude: Tensor, index: Tensor | None) -> Tensor:
        """The pixel of each longitude and latitude, radians."""
        share = torch.stack([longitude / (2 * math.pi), latitude / math.pi], -1)
        return share * rows(self.size, index) + rows(self.centre, index)


@dataclass(frozen=True)
class OmnidirectionalStereo(Equirectangular):
    """One eye's omnidirectional stereo panorama: rays are tangents of a level circle, the viewing circle (Peleg 2001).

    The eyes are side by side in every viewing direction: a ray of longitude a begins at s (cos a, 0, -sin a).
    A point at a distance R from the vertical axis appears rotated by asin(s / R) compared with the circle's centre.

    offset: s in scene units, from the middle between the eyes to this one, positive to the right
    """

    offset: Float[Tensor, "camera 1"] = field(kw_only=True)

    def enlarged(self, scale):
        return replace(self, offset=self.offset * scale)

    def origins(self, pixels, index=None):
        longitude = 2 * math.pi * ((pixels - rows(self.centre, index)) / rows(self.size, index))[:, 0]
        right = torch.stack([longitude.cos(), torch.zeros_like(longitude), -longitude.sin()], -1)
        return rows(self.offset, index) * right

    def project(self, points, index=None):
        x, y, z = points.unbind(-1)
        (offset,) = columns(self.offset, index)
        beyond = x * x + z * z - offset * offset
        away = beyond.clamp_min(0).sqrt()  # level distance along the ray
        longitude = torch.atan2(x * away - z * offset, z * away + x * offset)
        return self._at(longitude, torch.atan2(y, away), index), (beyond > 0) | ((offset == 0) & (y != 0))


@dataclass(frozen=True)
class Mixed(Lens):
    """Lenses of several kinds in one batch.

    parts: one batch of lenses for each kind
    part:  index into `parts` of each camera; the cameras of one part are in its order
    """

    parts: tuple[Lens, ...]
    part: Int[Tensor, " camera"]

    @property
    def row(self) -> Int[Tensor, " camera"]:
        """Each camera's index within its part."""
        mine = self.part[:, None] == torch.arange(len(self.parts), device=self.part.device)
        return (mine.cumsum(0) - 1).gather(1, self.part[:, None])[:, 0]

    def unproject(self, pixels, index=None):
        return self._by_part(lambda lens, row, pixels: (lens.unproject(pixels, row),), index, pixels)[0]

    def project(self, points, index=None):
        pixels, valid = self._by_part(lambda lens, row, points: lens.project(points, row), index, points)
        return pixels, valid

    def origins(self, pixels, index=None):
        if all(lens.origins(pixels[:0]) is None for lens in self.parts):
            return None

        def ask(lens: Lens, row: Tensor, pixels: Tensor) -> tuple[Tensor]:
            begin = lens.origins(pixels, row)
            return (pixels.new_zeros(len(pixels), 3) if begin is None else begin,)

        return self._by_part(ask, index, pixels)[0]

    def solid_angle(self, pixels, directions, index=None):
        return self._by_part(lambda lens, row, *x: (lens.solid_angle(*x, row),), index, pixels, directions)[0]

    def enlarged(self, scale):
        return Mixed(tuple(lens.enlarged(scale) for lens in self.parts), self.part)

    def resized(self, scale):
        scale = scale.expand(len(self), 2)
        return Mixed(tuple(lens.resized(scale[self.part == k]) for k, lens in enumerate(self.parts)), self.part)

    def to(self, device):
        return Mixed(tuple(lens.to(device) for lens in self.parts), self.part.to(device))

    def to_json(self):
        return {"kind": "mixed", "parts": [lens.to_json() for lens in self.parts], "part": self.part.tolist()}

    @classmethod
    def _from_json(cls, data, where):
        parts = tuple(Lens.from_json(part, where) for part in typed(MixedParts, data, where).parts)
        part = torch.tensor(typed(MixedParts, data, where).part, dtype=torch.int64)
        if sorted(part.tolist()) != [k for k, lens in enumerate(parts) for _ in range(len(lens))]:
            raise LumigraphError(f"{where} has lenses of several kinds that do not fit together; correct it")
        return cls(parts, part)

    def fault(self):
        return next(filter(None, (lens.fault() for lens in self.parts)), None)

    def __len__(self) -> int:
        return len(self.part)

    def __getitem__(self, index: int | np.integer | slice | Tensor) -> Lens:
        kept = one_or_more(index)
        pairs = zip(self.part[kept].tolist(), self.row[kept].tolist(), strict=True)
        return mix([self.parts[part][row] for part, row in pairs])

    def _by_part(self, ask: Callable[..., tuple[Tensor, ...]], index: Tensor | None, *inputs: Tensor) -> list[Tensor]:
        """Apply a function to each part's rows of the inputs, and merge the results in the original order."""
        if index is None:
            index = self.part.new_zeros(len(inputs[0]))
        part, row = self.part[index], self.row[index]
        places = [(part == k).nonzero()[:, 0] for k in range(len(self.parts))]
        answers = [ask(self.parts[k], row[at], *(x[at] for x in inputs)) for k, at in enumerate(places)]
        order = torch.cat(places).argsort()
        return [torch.cat(column)[order] for column in zip(*answers, strict=True)]


def mix(lenses: Sequence[Lens]) -> Lens:
    """One batch of single lenses: of their common kind, else Mixed."""
    kinds = sorted({type(lens) for lens in lenses}, key=lambda kind: kind.__name__)
    parts = tuple(Lens.cat([lens for lens in lenses if type(lens) is kind]) for kind in kinds)
    if len(parts) == 1:
        return parts[0]
    return Mixed(parts, torch.tensor([kinds.index(type(lens)) for lens in lenses], device=parts[0].device))


def rows(table: Tensor, index: Tensor | None) -> Tensor:
    """One row for each ray; without an index row 0, to be broadcast."""
    return table[:1] if index is None else table.index_select(0, index)


def columns(table: Tensor, index: Tensor | None) -> tuple[Tensor, ...]:
    """Columns of `rows`, each contiguous, which is faster to compute with."""
    return table[:1].T.unbind() if index is None else table.T.contiguous().index_select(1, index).unbind()


def area(sides: Tensor, index: Tensor | None) -> Tensor:
    """Product of both columns for each ray."""
    return columns(sides.prod(-1, keepdim=True), index)[0]


def one_or_more(index: int | np.integer | slice | Tensor) -> slice | Tensor:
    """An index that keeps the camera axis: an integer, also NumPy's or a tensor, becomes a slice of length one."""
    if getattr(index, "ndim", 0 if isinstance(index, int) else 1) == 0:
        index = int(index)  # type: ignore[arg-type]
        return slice(index, index + 1 if index != -1 else None)
    return index  # type: ignore[return-value]


def small(step: Tensor) -> bool:
    """True where Newton's method has converged."""
    return not len(step) or step.detach().abs().max().item() < CONVERGED_STEP


def through_plane(x: Float[Tensor, " ray"], y: Float[Tensor, " ray"]) -> Float[Tensor, "ray 3"]:
    """Unit directions through points (x, y, 1)."""
    z = torch.rsqrt(1 + x * x + y * y)
    return torch.stack([x * z, y * z, z], -1)


def onto_plane(points: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, "point 2"], Bool[Tensor, " point"]]:
    """Points projected onto the plane z = 1, and a mask of those in front of it."""
    z = points[:, 2:]
    valid = z > 1e-6 * points.norm(dim=-1, keepdim=True)
    return points[:, :2] / torch.where(valid, z, 1), valid[:, 0]


def within(x: Tensor, y: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    """Points of the plane, clamped to a disc of a radius."""
    shrink = (limit * torch.rsqrt((x * x + y * y).clamp_min(1e-12))).clamp_max(1)
    return x * shrink, y * shrink


def polynomial(s: Tensor, *coefficients: Tensor | float) -> Tensor:
    """c0 + c1 s + c2 s^2 + ... (Horner)."""
    *lower, value = coefficients
    for c in reversed(lower):
        value = c + s * value
    return torch.as_tensor(value)


def straightened(
    target_x: Tensor, target_y: Tensor, limit: Tensor, distort: Callable[[Tensor, Tensor], Distorted]
) -> tuple[Tensor, Tensor]:
    """Points within a disc that a distortion moves to the targets, by Newton's method."""
    x, y = within(target_x, target_y, limit)
    for _ in range(NEWTON_STEPS):
        (bent_x, bent_y), (xx, xy, yx, yy) = distort(x, y)
        off_x, off_y = bent_x - target_x, bent_y - target_y
        share = 1 / (xx * yy - xy * yx).clamp_min(1e-3)  # the determinant is positive up to the fold
        step_x, step_y = share * (yy * off_x - xy * off_y), share * (xx * off_y - yx * off_x)
        x, y = within(x - step_x, y - step_y, limit)
        if small(step_x) and small(step_y):
            break
    return x, y


def bend(x: Tensor, y: Tensor, distortion: Sequence[Tensor]) -> Distorted:
    """OpenCV's distortion of (x, y, 1); its Jacobian is symmetric."""
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    s = x * x + y * y
    below = polynomial(s, 1, k4, k5, k6)
    q = polynomial(s, 1, k1, k2, k3) / below
    slope = 2 * (polynomial(s, k1, 2 * k2, 3 * k3) - q * polynomial(s, k4, 2 * k5, 3 * k6)) / below  # 2 dq/ds
    across, down = p1 * y + p2 * x, p1 * x + p2 * y
    bent_x, bent_y = x * (q + 2 * across) + p2 * s, y * (q + 2 * across) + p1 * s
    xx = q + x * x * slope + 2 * across + 4 * p2 * x
    yy = q + y * y * slope + 2 * across + 4 * p1 * y
    xy = x * y * slope + 2 * down
    return (bent_x, bent_y), (xx, xy, xy, yy)


def prism(x: Tensor, y: Tensor, distortion: Sequence[Tensor]) -> Distorted:
    """Distortion of ThinPrism."""
    k1, k2, k3, k4, p1, p2, a, b = distortion
    s = x * x + y * y
    q, slope = polynomial(s, 1, k1, k2, k3, k4), 2 * polynomial(s, k1, 2 * k2, 3 * k3, 4 * k4)  # and 2 dq/ds
    across, down = 2 * (p1 * y + p2 * x), 2 * (p1 * x + p2 * y)
    bent = x * (q + across) + (p2 + a) * s, y * (q + across) + (p1 + b) * s
    xx, yy = q + x * x * slope + across + (4 * p2 + 2 * a) * x, q + y * y * slope + across + (4 * p1 + 2 * b) * y
    return bent, (xx, x * y * slope + down + 2 * a * y, x * y * slope + down + 2 * b * x, yy)


def radial_prism(x: Tensor, y: Tensor, distortion: Sequence[Tensor]) -> Distorted:
    """Distortion of RadialThinPrism."""
    *radial, p1, p2, a, b, c, d = distortion
    s = x * x + y * y
    q = polynomial(s, 1, *radial)
    slope = 2 * polynomial(s, *((i + 1) * k for i, k in enumerate(radial)))  # 2 dq/ds
    u, v, uu, uv, vv = x * q, y * q, q + x * x * slope, x * y * slope, q + y * y * slope
    s, along = u * u + v * v, 1 + 2 * (p1 * u + p2 * v)
    right, down = 2 * (p1 + a + 2 * b * s), 2 * (p2 + c + 2 * d * s)
    bent = u * along + (p1 + a + b * s) * s, v * along + (p2 + c + d * s) * s
    xu, xv = along + (2 * p1 + right) * u, 2 * p2 * u + right * v
    yu, yv = 2 * p1 * v + down * u, along + (2 * p2 + down) * v
    return bent, (xu * uu + xv * uv, xu * uv + xv * vv, yu * uu + yv * uv, yu * uv + yv * vv)


def stretch(theta: Tensor, distortion: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Distance from the fisheye's centre at each angle, and its derivative."""
    s = theta * theta
    slopes = ((2 * i + 3) * k for i, k in enumerate(distortion))
    return theta * polynomial(s, 1, *distortion), polynomial(s, 1, *slopes)


def fisheye_fold(radial: Float[Tensor, "camera term"]) -> Float[Tensor, "camera 1"]:
    """Angle from the axis up to which a fisheye's distance from the centre is monotonic, at most pi."""
    theta = torch.linspace(0, math.pi, FOLD_SAMPLES, dtype=torch.float64, device=radial.device)
    distance, _ = stretch(theta, radial.double().T[:, :, None].unbind())
    return last_growing(theta, distance).to(radial.dtype)


def last_growing(at: Float[Tensor, " sample"], values: Float[Tensor, "camera sample"]) -> Float[Tensor, "camera 1"]:
    """Last sample before a curve first stops growing."""
    growing = (values.diff(dim=-1) > 0).cumprod(-1).sum(-1, keepdim=True)
    return at[growing]
