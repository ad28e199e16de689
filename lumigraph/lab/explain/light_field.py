"""Sampling of light fields (Chai et al. 2000): epipolar-plane images, and cameras needed against layers of depth."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from ...camera import Camera
from ...errors import LumigraphError
from ...export.light_field import grid_of
from ...figures import Row, contact_sheet, save_picture
from ...figures.charts import Series, line_chart, standalone
from ...files import write_bytes, write_json
from ...method import Method
from ...metrics import psnr
from ...system.progress import track

INTERVALS = 32  # between the cameras of the whole row
STRIDES = (32, 16, 8, 4, 2)  # of the cameras that are kept; those between are interpolated
LAYERS = (1, 2, 4, 8, 16)  # planes of depth, evenly in 1 / z
MAX_DISPARITY = 2.0  # pixels between neighbouring cameras over a layer's depth, at a bandwidth of half a pixel
QUALITY_LOSS = 3.0  # dB below the best, at which cameras are counted
EPI_HEIGHT = 192  # pixels, for the picture


@dataclass(frozen=True)
class Sampling:
    """Quality of interpolated views between `cameras` cameras on one line, for numbers of depth layers.

    disparity: range of disparity over the line, in pixels: f t (1 / near - 1 / far)
    psnr:      of interpolated views, for each number of layers and of cameras
    """

    layers: tuple[int, ...]
    cameras: tuple[int, ...]
    near: float
    far: float
    disparity: float
    psnr: list[list[float]]

    @property
    def target(self) -> float:
        """Quality that counts as sufficient."""
        return max(max(row) for row in self.psnr) - QUALITY_LOSS

    def needed(self) -> list[float]:
        """Number of cameras at which each number of layers reaches the target, interpolated in the logarithm of their
        distances; infinity if it does not."""
        return [reached([n - 1 for n in self.cameras], row, self.target) + 1 for row in self.psnr]

    def bound(self) -> list[float]:
        """Minimum number of cameras by the light field's spectrum (Chai 2000, eq. 14)."""
        return [self.disparity / (MAX_DISPARITY * n) + 1 for n in self.layers]


@dataclass(frozen=True)
class CameraRow:
    """Views of a row of cameras, and distances along the axis in each; shared focal plane.

    focal: pixels; spacing: scene units between neighbours
    """

    rgb: Float[Tensor, "view height width 3"]
    z: Float[Tensor, "view height width"]
    focal: float
    spacing: float
    focus: float

    def disparity(self, z: Tensor) -> Tensor:
        """Disparity at depth z, pixels per camera."""
        return self.focal * self.spacing * (1 / z - 1 / self.focus)


def seen_along(method: Method, camera: Camera, span: float, focus: float) -> CameraRow:
    """Render the row of cameras, sheared to the focal plane."""
    spacing = span / INTERVALS
    cameras = grid_of(camera, 1, INTERVALS + 1, spacing, focus)[0]
    rgb, depth = [], []
    for one in track(cameras, "Rendering a row of cameras", len(cameras)):
        seen = method.render(one).cpu()
        cosine = (one.rays(one.pixels()).directions @ one.forward[0]).cpu().view(seen.depth.shape)
        rgb.append(seen.rgb)
        depth.append(seen.depth * cosine)
    focal = float(camera.lens.focal[0, 0])  # type: ignore[attr-defined]
    return CameraRow(torch.stack(rgb), torch.stack(depth), focal, spacing, focus)


def measure(line: CameraRow) -> Sampling:
    """Interpolate views between fewer and fewer cameras, with depth quantised to fewer and fewer layers."""
    known = line.z[line.z.isfinite()]
    if not len(known):
        raise LumigraphError("The row of cameras sees no surface; choose another --view")
    near, far = np.quantile(known.numpy(), (0.02, 0.98)).tolist()
    if far < 1.001 * near:
        raise LumigraphError("The row of cameras sees a single depth, which one camera shows; choose another --view")
    disparity = line.focal * line.spacing * INTERVALS * (1 / near - 1 / far)
    found = [[quality(line, stride, layers, near, far) for stride in STRIDES] for layers in LAYERS]
    cameras = tuple(INTERVALS // stride + 1 for stride in STRIDES)
    return Sampling(LAYERS, cameras, near, far, float(disparity), found)


def quality(line: CameraRow, stride: int, layers: int, near: float, far: float) -> float:
    """PSNR of interpolated views halfway between cameras."""
    middles = range(stride // 2, INTERVALS, stride)
    found = torch.stack([between(line, middle, stride // 2, layers, near, far) for middle in middles])
    return float(psnr(found, line.rgb[list(middles)]))


def between(
    line: CameraRow, view: int, reach: int, layers: int, near: float, far: float
) -> Float[Tensor, "height width 3"]:
    """A view interpolated from the two at `reach` on either side."""
    left, right = (warped(line, view, view + side, layers, near, far) for side in (-reach, reach))
    return 0.5 * (left + right)


def warped(
    line: CameraRow, view: int, camera: int, layers: int, near: float, far: float, rows: slice = slice(None)
) -> Float[Tensor, "height width 3"]:
    """Rows of a view warped from another camera's, each pixel at the middle of its depth layer."""
    share = (1 / line.z[view, rows].nan_to_num(far, far).clamp(near, far) - 1 / far) / (1 / near - 1 / far)
    layer = ((share * layers).floor().clamp(max=layers - 1) + 0.5) / layers
    shift = line.disparity(1 / (layer * (1 / near - 1 / far) + 1 / far)) * (camera - view)
    height, width = shift.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    at = torch.stack([2 * (x - shift) / width - 1, 2 * y / height - 1], -1)
    source = line.rgb[camera, rows].movedim(-1, 0)[None]
    return grid_sample(source, at[None], padding_mode="border", align_corners=False)[0].movedim(0, -1)


def reached(gaps: Sequence[float], values: Sequence[float], target: float) -> float:
    """Position at which rising values first reach a target; infinity if they do not."""
    if values[0] >= target:
        return gaps[0]
    for (a, low), (b, high) in pairwise(zip(gaps, values, strict=True)):
        if high >= target > low:
            return math.exp(math.log(a) + (target - low) / (high - low) * (math.log(b) - math.log(a)))
    return math.inf


def spectrum(epi: Float[Tensor, "view width 3"]) -> Float[Tensor, "view width"]:
    """Log magnitude of an epipolar-plane image's spectrum, from 0 to 1; zero frequency in the middle. Its support lies
    between two lines through the middle, with slopes by the nearest and the farthest depth."""
    grey = epi.mean(-1)
    window = torch.hann_window(grey.shape[0])[:, None] * torch.hann_window(grey.shape[1])
    size = torch.fft.fftshift(torch.fft.fft2((grey - grey.mean()) * window).abs())
    return ((size / size.max()).clamp_min(1e-4).log10() / 4 + 1).clamp(0, 1)


def draw(folder: Path, name: str, line: CameraRow, found: Sampling, row: int) -> dict[str, Any]:
    """Write lightfield.png (epipolar-plane images and their spectrum), lightfield.svg (cameras against layers) and
    lightfield.json, the figures, which are returned."""
    epi = line.rgb[:, row]
    marked = line.rgb[INTERVALS // 2].clone()
    marked[row] = torch.tensor([1.0, 0.2, 0.1])
    pictures = [marked, stretched(epi), stretched(spectrum(epi)[..., None].expand(-1, -1, 3))]
    rows = [Row(["the middle view, one line marked", "that line, camera by camera", "its spectrum"], pictures)]
    for layers in (LAYERS[0], LAYERS[2]):
        made = [interpolated_epi(line, stride, layers, found, row) for stride in (16, 8, 4)]
        names = [f"{INTERVALS // stride + 1} cameras" for stride in (16, 8, 4)]
        rows.append(Row([f"{x}, {layers} layer{'s' * (layers > 1)}" for x in names], [stretched(x) for x in made]))
    save_picture(folder / "lightfield.png", contact_sheet(f"{name}: epipolar-plane images", [""] * 3, rows), "figure")
    bound, needed = found.bound(), found.needed()
    finite = [i for i, n in enumerate(needed) if math.isfinite(n)]
    series = [
        Series("Chai's bound", found.layers, bound),
        Series(f"measured, {found.target:.1f} dB", [found.layers[i] for i in finite], [needed[i] for i in finite]),
    ]
    chart = line_chart(series, "layers of depth", "cameras", True, True, True, False, x_ticks=found.layers)
    write_bytes(folder / "lightfield.svg", standalone(chart), "figure")
    about = asdict(found) | {"target": found.target, "bound": bound}
    about["needed"] = [n if math.isfinite(n) else None for n in needed]
    write_json(folder / "lightfield.json", about, "figure")
    return about


def interpolated_epi(
    line: CameraRow, stride: int, layers: int, found: Sampling, row: int
) -> Float[Tensor, "view width 3"]:
    """Epipolar-plane image with only every `stride`-th camera given and the others interpolated."""
    rows = []
    for view in range(INTERVALS + 1):
        left = view // stride * stride
        if left == view:
            rows.append(line.rgb[view, row])
            continue
        share = (view - left) / stride
        given = layers, found.near, found.far, slice(row, row + 1)
        first, second = (warped(line, view, camera, *given)[0] for camera in (left, left + stride))
        rows.append((1 - share) * first + share * second)
    return torch.stack(rows)


def stretched(epi: Float[Tensor, "view width 3"]) -> Float[Tensor, "height width 3"]:
    """Rows repeated to make an epipolar-plane image visible."""
    return epi.repeat_interleave(max(1, EPI_HEIGHT // len(epi)), 0)
