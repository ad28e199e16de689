"""A still life of known materials under an environment map: albedo, roughness, normals and visibility are exact.
`light=1` chooses another light, `bounces=1` adds interreflections.

Light 0 to 4: a studio with two soft boxes, a sun in the morning, a low sun, an overcast sky, a room with a window.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any

import numpy as np
import torch

from ...files.ranges import between
from ...light import EnvironmentLight, direction, directions
from ..cameras import dome, pinhole, spiral
from ..shapes import Arch, Ball, Cone, Cuboid, Cylinder, Torus
from ..stage import Pictures, SyntheticStage
from ..textures import Checker, Mottle, Plain, Rings, Stripes, Wood
from ..world import Material, Object, Pose, Sky, World

ROWS = 32  # of a map
LIGHT_COUNT = 5
RADIUS, FIELD_OF_VIEW = 3.4, 36.0  # of the cameras' dome, scene units and degrees


@dataclass(frozen=True)
class Options(Pictures):
    """light: number of the environment light; bounces: reflections of light between surfaces"""

    light: Annotated[int, between(0, LIGHT_COUNT - 1)] = 0
    bounces: Annotated[int, between(0, 1)] = 0


def satin(texture, roughness: float) -> Material:
    return Material(texture, gloss=1.0, roughness=roughness)


def world() -> World:
    """Objects of six roughnesses on a slab, centred, within [-1, 1]^3."""
    wood = satin(Wood((0.80, 0.62, 0.42), (0.62, 0.42, 0.25), ring=0.09, seed=1.0), 0.6)
    slab = satin(Mottle((0.72, 0.70, 0.66), (0.60, 0.58, 0.55), size=0.4), 0.75)
    checks = satin(Checker((0.85, 0.80, 0.70), (0.25, 0.30, 0.38), size=0.11, shift=0.055), 0.45)
    stripes = satin(Stripes((0.80, 0.58, 0.20), (0.75, 0.72, 0.66), period=0.12), 0.35)
    rings = satin(Rings((0.25, 0.42, 0.55), (0.80, 0.76, 0.68), period=0.1), 0.4)
    glaze = satin(Plain((0.20, 0.48, 0.50)), 0.3)
    clay = satin(Plain((0.72, 0.34, 0.24)), 0.8)
    leaf = satin(Plain((0.42, 0.58, 0.34)), 0.5)
    objects = (
        Object(Cylinder(0.98, 0.06, rounding=0.02), slab, Pose.at(0, 0, -0.06), "slab"),
        Object(Cuboid((0.2, 0.2, 0.2), rounding=0.02), checks, Pose.at(-0.36, 0.26, 0.2, turn=24), "cube"),
        Object(Ball(0.14), glaze, Pose.at(-0.36, 0.26, 0.54), "marble"),
        Object(Ball(0.22), clay, Pose.at(0.34, -0.34, 0.22), "clay"),
        Object(Cylinder(0.13, 0.3, rounding=0.02), stripes, Pose.at(0.42, 0.3, 0.3), "pillar"),
        Object(Cone(0.2, 0.0, 0.2, rounding=0.01), leaf, Pose.at(0.02, 0.62, 0.21), "cone"),
        Object(Torus(0.2, 0.075), rings, Pose.at(-0.3, -0.36, 0.075), "torus"),
        Object(
            Arch((0.26, 0.09, 0.2), 0.13, spring=0.05, rounding=0.01), wood, Pose.at(0.08, -0.7, 0.2, turn=18), "arch"
        ),
    )
    upright = World(objects, sky=Sky(visible=False))
    low, high = upright.bounds()
    return upright.transformed(Pose((0.0, 0.0, -0.5 * float(low[2] + high[2]))))


def panel(toward: torch.Tensor, middle: tuple[float, float], width: float) -> torch.Tensor:
    """Weight of a soft-edged round panel; middle: azimuth and elevation, width: of half of it, degrees."""
    angle = torch.rad2deg((toward @ direction(*middle)).clamp(-1, 1).acos())
    return ((width - angle) / 6 + 0.5).clamp(0, 1)[..., None]


@cache
def environment(number: int) -> EnvironmentLight:
    """One of the lights."""
    d = directions(ROWS, 2 * ROWS)
    z = d[..., 2:]
    if number == 0:
        key, fill = panel(d, (-50, 45), 24) * 9.0, panel(d, (95, 30), 20) * 3.0
        radiance = key * torch.tensor([1.0, 0.96, 0.9]) + fill * torch.tensor([0.85, 0.93, 1.0]) + 0.12
    elif number in (1, 2):
        azimuth, elevation, sun = ((140.0, 38.0, 0.9), (250.0, 16.0, 1.2))[number - 1]
        sky = EnvironmentLight.outdoors(azimuth, elevation, sun, 0.35).resized(ROWS, 2 * ROWS)
        disc = panel(d, (azimuth, elevation), 5.0)
        level = (disc[..., 0] * sky.solid_angles).sum()
        radiance = sky.radiance + disc * sky.irradiance[0] / level
    elif number == 3:
        radiance = (0.35 + 0.65 * (0.5 + 0.5 * z).square()) * torch.tensor([0.92, 0.97, 1.05]) * (0.25 + 0.75 * (z > 0))
    else:
        window = panel(d, (20, 12), 22) * torch.tensor([0.8, 0.95, 1.15]) * 6.0
        lamp = panel(d, (-120, 55), 9) * torch.tensor([1.2, 0.85, 0.5]) * 14.0
        radiance = window + lamp + torch.tensor([0.14, 0.12, 0.1]) * (1 + 0.3 * z)
    return EnvironmentLight(radiance.expand(ROWS, 2 * ROWS, 3).contiguous())


def stage(size: int = 200, views: int = 100, seed: int = 0, light: int = 0, bounces: int = 0) -> SyntheticStage:
    """Training views from a dome; held-out ones climb around the still life."""
    random = np.random.default_rng(seed)
    held_out = max(views * 2 // 5, 1)
    shown = environment(light)
    poses = np.concatenate([dome(views, RADIUS, random), spiral(held_out, RADIUS, random)])
    cameras = pinhole(poses, size, FIELD_OF_VIEW)
    cameras = replace(cameras, image_index=torch.arange(len(cameras)))

    def facts(_: int) -> dict[str, Any]:
        return {"environment": shown.resized(16, 32).radiance.numpy()}

    return SyntheticStage(
        replace(world(), environment=shown, bounces=bounces),
        {"train": cameras[:views], "test": cameras[views:]},
        ((-1.0, -1.0, -0.5), (1.0, 1.0, 0.5)),
        reach=1.0,
        near=1.2,
        facts=facts,
        called=lambda _: f"materials {light} {bounces}",
    )
