"""Contact of a hand and a can from their Gaussians, against exact distances of surfaces.

    python benchmarks/grasp.py --steps 1200

Trains articulated-splatting on procedural:grasp. Places spread over the can's surface touch the hand if it is within
the contact distance of them, by exact signed distances; and in the map, if the nearest solid Gaussian of the can is
within that gap of one of the hand. IoU is of the two sets, at moments of training. OUTPUT/contact.png has, for each
moment, a rendering, the map of contact, and the exact map.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Bool
from PIL import Image
from scipy.spatial import cKDTree
from torch import Tensor

from lumigraph import methods
from lumigraph.camera.rays import Rays
from lumigraph.figures import ramp, to_bytes
from lumigraph.files import write_json
from lumigraph.geometry import Similarity
from lumigraph.methods.articulated_splatting import ArticulatedSplatting
from lumigraph.methods.articulated_splatting.contact import SOLID_OPACITY, gaps
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.synthetic import SyntheticStage, World, scenes, signed_distance, trace
from lumigraph.synthetic.scenes.grasp import CAN, CAN_HALF, CAN_RADIUS
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

PLACES = 4000  # over the can's surface


@dataclass(frozen=True)
class Options:
    size: int = 200  # pixels a side
    views: int = 80  # photographs of the moving camera
    steps: int = 1200
    distance: float = 0.02  # of contact, scene units
    moments: tuple[float, ...] = (0.3, 0.4, 0.5)
    output: Path = Path("grasp")


def main(options: Options) -> None:
    options.output.mkdir(parents=True, exist_ok=True)
    scene = open_scene(f"procedural:grasp,size={options.size},views={options.views}")
    stage = scenes.stage("grasp", size=options.size, views=options.views)
    kind = methods.find("articulated-splatting")
    config = replace(kind.cpu_preset(), contact_distance=options.distance)
    method = build(kind, scene.frame, config, torch.device("cpu"), 0, learning=True)
    begin = time.process_time()
    go_on_unless(fit(method, scene, steps=options.steps, show=False).signal)
    spent = time.process_time() - begin
    method.eval()
    assert isinstance(method, ArticulatedSplatting)
    learnt = scene.cameras.time[scene.splits["train"]]
    rows, strips = [], []
    for moment in options.moments:
        now = float(learnt[(learnt - moment).abs().argmin()])
        rows.append({"moment": now} | contact(method, stage, scene.frame.to_source, now, options.distance))
        strips.append(pictures(method, stage, scene, now, options.distance))
        print(rows[-1], flush=True)
    Image.fromarray(np.concatenate(strips)).save(options.output / "contact.png")
    write_json(options.output / "grasp.json", {"processor seconds": spent, "moments": rows})


def without(world: World, name: str, there: bool) -> World:
    """The can alone, or all but it."""
    return World(tuple(o for o in world.objects if (o.name == name) == there), world.lights, world.sky)


def touched(world: World, points: Tensor, distance: float) -> Bool[Tensor, " point"]:
    """Mask of points of the can within a distance of the hand."""
    return signed_distance(without(world, CAN, False), points) < distance


@torch.no_grad()
def contact(
    method: ArticulatedSplatting, stage: SyntheticStage, to_source: Similarity, now: float, distance: float
) -> dict[str, float]:
    """IoU of the map of contact with the exact one over the can's surface, and shares of it that touch."""
    assert stage.moving is not None
    world = stage.moving(now)
    points = surface(without(world, CAN, True))
    truth = touched(world, points, distance * to_source.scale)
    canonical = method.filtered()
    cloud, body = method.given(time=now).gaussians(), method.body_of(canonical)
    can = len(method.bones.skeleton.names) - 1
    assert method.bones.skeleton.names[can] == CAN
    own = (body == body.max()) & (cloud.opacities.sigmoid() > SOLID_OPACITY)
    means = to_source.points(cloud.means[own])
    nearest = torch.from_numpy(cKDTree(means.numpy()).query(points.numpy())[1])
    found = (gaps(cloud, body)[own] < distance)[nearest]
    both, either = (found & truth).sum(), (found | truth).sum()
    return {
        "IoU": float(both / either.clamp_min(1)),
        "touching": float(truth.float().mean()),
        "found": float(found.float().mean()),
    }


def surface(can: World) -> Tensor:
    """Places spread over the surface of the can, by rays from all around towards it."""
    random = np.random.default_rng(0)
    (thing,) = can.objects
    out = random.normal(size=(PLACES, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    around = torch.from_numpy(out * 3 + np.array(thing.pose.position)).float()
    along = random.uniform(-1, 1, (PLACES, 3)) * [CAN_RADIUS, CAN_RADIUS, CAN_HALF]
    goal = torch.from_numpy(thing.pose.applied(along)).float()
    rays = Rays(around, torch.nn.functional.normalize(goal - around, dim=1), torch.zeros(PLACES))
    seen = trace(can, rays, shaded=False)
    hit = torch.from_numpy(seen.identity >= 0)
    return (rays.origins + torch.from_numpy(seen.depth).float()[:, None] * rays.directions)[hit]


@torch.no_grad()
def pictures(method: ArticulatedSplatting, stage: SyntheticStage, scene, now: float, distance: float) -> np.ndarray:
    """A held-out camera's rendering, map of contact, and exact map, side by side."""
    found = []
    for index in scene.splits["test"].tolist()[:4]:
        camera = replace(scene.cameras[index], time=torch.tensor([now]))
        found += [method.render(camera).rgb, method.given(show="contact").render(camera).rgb]
        taken = replace(stage.cameras["test"][scene.splits["test"].tolist().index(index)], time=torch.tensor([now]))
        found.append(exact(stage, taken, distance * scene.frame.to_source.scale))
    return np.concatenate([to_bytes(picture) for picture in found], 1)


def exact(stage: SyntheticStage, camera, distance: float) -> Tensor:
    """The exact map of contact, of hand and can alike."""
    world, rays = stage.world_of(camera), camera.rays(camera.pixels())
    seen = trace(world, rays, shaded=False)
    points = rays.origins + torch.from_numpy(seen.depth).float()[:, None] * rays.directions
    share = torch.zeros(len(points))
    for there in (True, False):
        own = torch.from_numpy(np.array([n >= 0 and (world.names[n] == CAN) == there for n in seen.identity]))
        away = signed_distance(without(world, CAN, not there), points[own])
        share[own] = ((3 - away / distance) / 2).clamp(0, 1)
    rgb = ramp(share)
    rgb[torch.from_numpy(seen.identity < 0)] = 1
    width, height = camera.size[0].tolist()
    return rgb.view(height, width, 3)


if __name__ == "__main__":
    main(tyro.cli(Options))
