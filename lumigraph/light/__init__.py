"""Environment light: radiance from all directions as an equirectangular map, and suns at infinity.

Orientation of the map, in the scene's frame, where +z points up. It is the view of an upright camera that looks along
+y, so it is not mirrored: the middle column looks along +y, a quarter of the width further right along +x, the edges
along -y; the top row looks along +z. An azimuth is the longitude on the map: 0 is +y, 90 degrees +x.
All values are linear sRGB. 1 is the radiance of a fully lit white diffuse surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from .. import files
from ..color.srgb import linear_from_srgb
from ..errors import LumigraphError
from ..files.exr import read_exr
from ..files.radiance import read_radiance
from ..files.reading import reading
from ..kernels import spherical_harmonics

SUFFIXES = (".hdr", ".exr", ".npy", ".png")
MIN_ROWS, MIN_COLUMNS = 4, 8
SKY_ROWS = 16  # of a map that is made up
SKY, HORIZON, GROUND = (0.45, 0.68, 1.0), (0.85, 0.92, 1.0), (0.30, 0.27, 0.24)  # colours of a clear sky, linear
SUN_COLOUR, LOW_SUN_COLOUR = (1.0, 0.95, 0.88), (1.0, 0.62, 0.32)  # high above, and at the horizon
LOW_SUN = 20.0  # degrees of elevation below which the sun turns red


@dataclass(frozen=True, eq=False)
class EnvironmentLight:
    """Radiance from each direction.

    radiance:   of the map, from the zenith row downwards
    toward:     unit directions to suns
    irradiance: of each sun on a surface that faces it
    """

    radiance: Float[Tensor, "row column 3"]
    toward: Float[Tensor, "sun 3"] = torch.zeros(0, 3)
    irradiance: Float[Tensor, "sun 3"] = torch.zeros(0, 3)

    @staticmethod
    def open(path: Path | str) -> EnvironmentLight:
        """Read a map from Radiance HDR, OpenEXR, NumPy (all linear) or PNG (sRGB-encoded).

        Raises LumigraphError for an invalid file.
        """
        path = files.expanded(path)
        if not files.is_file(path):
            raise LumigraphError(f"{path} does not exist; name an environment map ({', '.join(SUFFIXES)})")
        if path.suffix.lower() not in SUFFIXES:
            raise LumigraphError(f"{path} is no environment map by its name; they end in {', '.join(SUFFIXES)}")
        with reading(path, "cannot be read as an environment map", "export it again"):
            return EnvironmentLight.checked(_values(path), str(path))

    @staticmethod
    def checked(values: np.ndarray, source: str) -> EnvironmentLight:
        """A map of numbers (row, column, channel). Raises LumigraphError for invalid radiance."""
        rows, columns = values.shape[:2] if values.ndim == 3 else (0, 0)
        if rows < MIN_ROWS or columns < MIN_COLUMNS or columns != 2 * rows:
            raise LumigraphError(
                f"{source} has {columns} x {rows} pixels{shape_of(rows, columns)}; an environment map is "
                f"equirectangular, twice as wide as high, of at least {MIN_COLUMNS} x {MIN_ROWS}, so convert it"
            )
        values = np.repeat(values, 3, -1) if values.shape[2] == 1 else values[..., :3]
        if values.shape[2] != 3 or not np.isfinite(values).all() or values.min() < 0:
            bad = int((~(values >= 0) | ~np.isfinite(values)).sum())
            raise LumigraphError(
                f"{source} has {bad:,} values that are negative or not finite; radiance is not, so clip them to 0"
            )
        return EnvironmentLight(torch.from_numpy(np.ascontiguousarray(values, np.float32)))

    @staticmethod
    def uniform(radiance: float = 1.0) -> EnvironmentLight:
        """The same radiance from everywhere (a white furnace)."""
        return EnvironmentLight(torch.full((SKY_ROWS, 2 * SKY_ROWS, 3), radiance))

    @staticmethod
    def outdoors(
        azimuth: float, elevation: float, sun: float = 1.0, sky: float = 0.4, width: float = 0.0
    ) -> EnvironmentLight:
        """A clear sky with a sun.

        azimuth, elevation: of the sun, degrees
        sun: radiance of a white diffuse surface that faces the sun, from it alone; sky: the same of level ground and
             sky
        width: half of the sun's, degrees; above 0 it is seven suns, one in the middle of six
        """
        height = math.sin(math.radians(elevation))
        low = max(0.0, 1 - max(elevation, 0.0) / LOW_SUN)
        colour = (1 - low) * torch.tensor(SUN_COLOUR) + low * torch.tensor(LOW_SUN_COLOUR)
        light = EnvironmentLight(torch.zeros(SKY_ROWS, 2 * SKY_ROWS, 3))
        z = light.directions[..., 2:]
        gradient = torch.tensor(HORIZON) + (1 - (1 - z.clamp_min(0)) ** 3) * (torch.tensor(SKY) - torch.tensor(HORIZON))
        radiance = torch.where(z > 0, gradient, torch.tensor(GROUND))
        level = (radiance.mean(-1, keepdim=True) * z.clamp_min(0) * light.solid_angles[..., None]).sum() / math.pi
        toward = disc(azimuth, elevation, width)
        power = math.pi * sun / len(toward) if height > 0 else 0.0
        return EnvironmentLight(radiance * (sky / level), toward, (power * colour).expand(len(toward), 3))

    # Geometry of the map

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.radiance.shape[0], self.radiance.shape[1]

    @cached_property
    def directions(self) -> Float[Tensor, "row column 3"]:
        """Unit direction of each pixel's centre."""
        return directions(*self.shape)

    @cached_property
    def solid_angles(self) -> Float[Tensor, "row column"]:
        """Solid angle of each pixel, steradians; they sum to 4 pi."""
        return solid_angles(*self.shape)

    def at(self, directions: Float[Tensor, "direction 3"]) -> Float[Tensor, "direction 3"]:
        """Radiance of the map in directions, bilinear between pixels; without suns."""
        rows, columns = self.shape
        x, y, z = directions.unbind(-1)
        column = (torch.atan2(x, y) / (2 * math.pi) + 0.5) * columns - 0.5
        row = ((z.clamp(-1, 1).acos() / math.pi) * rows - 0.5).clamp(0, rows - 1)
        left, top = column.floor(), row.floor()
        total = torch.zeros_like(directions)
        for i in (0, 1):
            for j in (0, 1):
                share = (1 - (row - top - i).abs()) * (1 - (column - left - j).abs())
                at_row = (top.long() + i).clamp(max=rows - 1)
                total += share[:, None] * self.radiance[at_row, (left.long() + j) % columns]
        return total

    def resized(self, rows: int, columns: int) -> EnvironmentLight:
        """The map at another resolution, each pixel with the mean radiance over its solid angle."""
        across = _overlap(torch.linspace(0, 1, self.shape[1] + 1), torch.linspace(0, 1, columns + 1))
        edges = [0.5 * (1 - torch.cos(math.pi * torch.linspace(0, 1, n + 1))) for n in (self.shape[0], rows)]
        return replace(self, radiance=torch.einsum("rs,stk,ct->rck", _overlap(*edges), self.radiance, across))

    def turned(self, degrees: float) -> EnvironmentLight:
        """The light rotated about the vertical axis: azimuths grow by `degrees`."""
        angle = math.radians(degrees)
        c, s = math.cos(angle), math.sin(angle)
        back = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # anticlockwise from above: azimuths shrink
        shift = degrees / 360 * self.shape[1]
        whole = math.floor(shift)
        first, second = (self.radiance.roll(whole + k, 1) for k in (0, 1))
        radiance = first + (shift - whole) * (second - first)
        return replace(self, radiance=radiance, toward=self.toward @ back)

    def scaled(self, factor: float) -> EnvironmentLight:
        """The light scaled by a factor."""
        return replace(self, radiance=factor * self.radiance, irradiance=factor * self.irradiance)

    # Light on surfaces

    @property
    def lamps(self) -> tuple[Float[Tensor, "lamp 3"], Float[Tensor, "lamp 3"]]:
        """The light as distant lamps: directions of pixels and suns, and irradiance of each on a surface facing it."""
        power = (self.radiance * self.solid_angles[..., None]).reshape(-1, 3)
        return torch.cat([self.directions.reshape(-1, 3), self.toward]), torch.cat([power, self.irradiance])

    def harmonics(self, bands: int = 3) -> Float[Tensor, "coefficient 3"]:
        """Spherical harmonics of the radiance, L_lm = integral of L Y_lm over the sphere (Ramamoorthi and Hanrahan
        2001, eq. 3), in the order and signs of `kernels.spherical_harmonics`. Suns are included."""
        directions, power = self.lamps
        return spherical_harmonics(directions, bands).T @ power

    def irradiance_on(self, normals: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Irradiance of unoccluded surfaces."""
        directions, power = self.lamps
        return (normals @ directions.T).clamp_min(0) @ power


def direction(azimuth: float, elevation: float) -> Float[Tensor, " 3"]:
    """Unit vector of an azimuth and an elevation above the horizon, degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return torch.tensor([math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)])


def disc(azimuth: float, elevation: float, width: float) -> Float[Tensor, "place 3"]:
    """Directions to the centre of a disc and, if it has a width (degrees), to six points at two thirds of it."""
    middle = direction(azimuth, elevation)
    if width == 0:
        return middle[None]
    side, up = direction(azimuth + 90, 0), direction(azimuth, elevation + 90)
    turn = math.pi / 3 * torch.arange(6)[:, None]
    ring = middle + math.tan(math.radians(width)) * 2 / 3 * (turn.cos() * side + turn.sin() * up)
    return torch.cat([middle[None], ring / ring.norm(dim=-1, keepdim=True)])


def directions(rows: int, columns: int) -> Float[Tensor, "row column 3"]:
    """Unit direction of the middle of each pixel of a map."""
    polar = math.pi * (torch.arange(rows) + 0.5) / rows
    longitude = 2 * math.pi * ((torch.arange(columns) + 0.5) / columns - 0.5)
    level = polar.sin()[:, None]
    return torch.stack(
        [level * longitude.sin(), level * longitude.cos(), polar.cos()[:, None].expand(rows, columns)], -1
    )


def solid_angles(rows: int, columns: int) -> Float[Tensor, "row column"]:
    """Solid angle of each pixel of a map, steradians."""
    edges = torch.cos(math.pi * torch.linspace(0, 1, rows + 1, dtype=torch.float64))
    return ((edges[:-1] - edges[1:]) * (2 * math.pi / columns)).float()[:, None].expand(rows, columns)


def shape_of(rows: int, columns: int) -> str:
    """Kind of another map by its shape, as the rest of a sentence."""
    cubes = ((6, 1), (1, 6), (4, 3), (3, 4), (3, 2), (2, 3))
    if rows and any(columns * high == rows * wide for wide, high in cubes):
        return ", as the faces of a cube map have"
    return ", as a mirrored ball or an octahedral map has" if rows and rows == columns else ""


def _overlap(source: Float[Tensor, " edge"], target: Float[Tensor, " end"]) -> Float[Tensor, "target source"]:
    """Share of each target interval in each source interval; edges ascend from 0 to 1."""
    low = torch.maximum(source[None, :-1], target[:-1, None])
    high = torch.minimum(source[None, 1:], target[1:, None])
    return (high - low).clamp_min(0) / (target[1:] - target[:-1])[:, None]


def _values(path: Path) -> np.ndarray:
    """Numbers of a file (row, column, channel), linear."""
    suffix = path.suffix.lower()
    if suffix == ".npy":
        values = np.load(path, allow_pickle=False)
        if values.dtype.kind not in "fiu":
            raise ValueError(f"it holds {values.dtype}, where radiance is numbers")
        values = values.astype(np.float32)
    elif suffix == ".png":
        with Image.open(path) as image:
            values = linear_from_srgb(np.asarray(image.convert("RGB")) / 255)
    else:
        values = read_exr(path).astype(np.float32) if suffix == ".exr" else read_radiance(path)
    return values if values.ndim == 3 else values[..., None]
