"""Sensor depth: weight of each pixel, and checks of a capture's depth."""

import json
import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Lens
from ..datasets.scene import Scene
from ..geometry import evenly
from . import loops
from .depth_map import DepthMap

REACH = 4  # pixels to the next known one, of which a normal is made: depth that is registered to colours has holes
MIN_FACING = 0.1  # cosine between ray and normal below which a pixel is not trusted
CHECKED_VIEWS = 8  # depth maps that are looked at
MAX_ROOM = 100.0  # metres, units of the capture: sensors measure less
MIN_ROOM = 0.02
MAX_RATIO = 3.0  # between measured depth and that of sparse points, either way


def trust_of(seen: DepthMap, trusted: float, farthest: float) -> Float[Tensor, "height width"]:
    """Weight of each pixel: the cosine of the viewing angle, times (trusted / depth)^4 beyond `trusted`.

    The error of triangulated depth grows with its square (Khoshelham and Elberink 2012), so its inverse variance falls
    with the fourth power. 0 for unmeasured pixels, at grazing angles and beyond `farthest`.
    trusted: 0 for no falloff
    """
    depth, facing = seen.depth.contiguous(), torch.empty_like(seen.depth)
    width, height = seen.camera.size[0].tolist()
    towards = directions(json.dumps(seen.camera.lens.to_json()), width, height)
    loops.incidence(depth.numpy(), towards.numpy(), REACH, facing.numpy())
    weight = torch.where((facing > MIN_FACING) & (depth < farthest), facing, 0.0)
    if trusted > 0:
        weight = weight * (trusted / depth.nan_to_num(math.inf).clamp_min(1e-9)).clamp(max=1).pow(4)
    return weight.nan_to_num(0.0, 0.0)


def release_weight(
    seen: DepthMap, unit: float, sample: float, span: tuple[float, float], farthest: float
) -> Float[Tensor, "height width"]:
    """Weight of each pixel in the program of VoxelHashing, by its depth z along the axis; 0 beyond `farthest`.

        w = max(1.5 sample (1 - (z - near) / (far - near)), 1)

    unit: scene units of a metre; span: near and far, metres; farthest: metres
    """
    width, height = seen.camera.size[0].tolist()
    along = directions(json.dumps(seen.camera.lens.to_json()), width, height)[..., 2] * seen.depth / unit
    weight = (1.5 * sample * (1 - (along - span[0]) / (span[1] - span[0]))).clamp_min(1)
    return torch.where((along > 0) & (along < farthest), weight, 0.0)


@lru_cache(maxsize=4)
def directions(lens: str, width: int, height: int) -> Float[Tensor, "height width 3"]:
    """Unit directions of all pixels in the camera's frame. lens: as JSON"""
    camera = Camera(torch.eye(3, 4)[None], Lens.from_json(json.loads(lens)), torch.tensor([[width, height]]))
    return camera.lens.unproject(camera.pixels()).view(height, width, 3).contiguous()


def sensor_faults(scene: Scene) -> list[str]:
    """Warnings of depth in a wrong unit, by the scene's sparse points or the range of sensors.

    Raises LumigraphError for a scene without depth.
    """
    layer = scene.layer("depth")
    known = [i for i in scene.splits["train"].tolist() if layer.planes[i] is not None]
    told = []
    if missing := len(scene.splits["train"]) - len(known):
        told.append(
            f"{scene.source}: {missing} of {len(scene.splits['train'])} photographs have no depth, and are left out"
        )
    ratios, medians = [], []
    for i in evenly(known, CHECKED_VIEWS):
        photograph = scene.photograph(i, ("depth",))
        depth = photograph.extra["depth"]
        if not (measured := depth[depth.isfinite()]).numel():
            continue
        medians.append(float(measured.median()) * scene.frame.to_source.scale)
        if scene.points is not None and len(scene.points):
            ratios += _ratios(photograph.camera, depth, scene.points)
    if not medians:
        told.append(f"{scene.source}: nothing was measured in {len(known)} depth maps; check the files and their unit")
        return told
    ratio = float(torch.tensor(ratios).median()) if ratios else 1.0
    if not 1 / MAX_RATIO < ratio < MAX_RATIO:
        factor = 10 ** round(abs(math.log10(ratio)))
        told.append(
            f"{scene.source}: depth is {ratio:.3g} times as large as the sparse points are far away; its unit is "
            f"probably wrong by a factor of {factor:,}, so correct that, or the poses' unit"
        )
    typical = float(torch.tensor(medians).median())
    if 1 / MAX_RATIO < ratio < MAX_RATIO and not MIN_ROOM < typical < MAX_ROOM:  # points may be of the same depth
        told.append(
            f"{scene.source}: the median depth is {typical:.3g} metres, which no depth camera measures; its unit is "
            "probably wrong by a factor of 1000, so correct it"
        )
    return told


def _ratios(camera: Camera, depth: Float[Tensor, "height width"], points: Float[Tensor, "point 3"]) -> list[float]:
    """Measured depth over the distance of sparse points, where both are known."""
    places, inside = camera.locate(points)
    away = (points - camera.position).norm(dim=-1)
    ratio = (depth[places[:, 0], places[:, 1]] / away)[inside]
    return ratio[ratio.isfinite()].tolist()
