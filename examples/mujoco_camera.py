"""A MuJoCo arm in a scene of Gaussians: colours and metric depth of many cameras, and whichever is in front is shown.

    pip install "lumigraph[robot]"
    python examples/mujoco_camera.py [--scene sample:room] [--output arm.png] [--cameras 8] [--size 320 240]

The scene gives colours and depth in metres, MuJoCo's rays give the distance, the normal and the geom of the arm; pixel
by pixel the nearer one wins. Both measure along the same rays, so no conversion of depth is needed. Rays need no OpenGL
and no screen.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import mujoco
import numpy as np
import torch

import lumigraph
from lumigraph import Camera
from lumigraph.camera.rays import Rendering
from lumigraph.figures import to_image
from lumigraph.geometry import look_at

ARM = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 -1.0">
      <geom type="cylinder" size=".12 .25" pos="0 0 .25" rgba=".25 .27 .3 1"/>
      <body pos="0 0 .5"><joint name="turn" axis="0 0 1"/>
        <geom type="sphere" size=".11" rgba=".95 .45 .1 1"/>
        <body><joint name="shoulder" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0 0 .45" size=".07" rgba=".95 .45 .1 1"/>
          <body pos="0 0 .45"><joint name="elbow" axis="0 1 0"/>
            <geom type="capsule" fromto="0 0 0 0 0 .4" size=".055" rgba=".9 .9 .92 1"/>
            <geom type="box" size=".06 .03 .05" pos="0 0 .45" rgba=".15 .15 .17 1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
DISTANCE, HEIGHT, ANGLE = 1.0, 0.15, 75.0  # metres from the arm and above the origin; degrees across the height
LIGHT, AMBIENT = np.array([0.3, -0.5, 0.81]), 0.35  # direction towards the light; share of light from everywhere
Z_UP = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # to a splat file, whose y is down


def around(count: int, size: tuple[int, int]) -> Camera:
    """Cameras in a circle around the arm, in metres; +x right, +y down, +z forward."""
    angle = torch.arange(count) * (2 * math.pi / count)
    place = torch.stack([DISTANCE * angle.cos(), DISTANCE * angle.sin(), torch.full_like(angle, HEIGHT)], -1)
    pose = look_at(place, torch.tensor([0.0, 0.0, -0.15]) - place, torch.tensor([0.0, 0.0, 1.0]))
    return Camera.pinhole(pose, size, ANGLE)


def arm_seen(model: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours (height, width, 3) of the arm, and its distance along each ray in metres; infinity where it is not."""
    rays, (width, height) = camera.rays(camera.pixels()), camera.size[0].tolist()
    directions = rays.directions.double().numpy()
    count = len(directions)
    geom, distance, normal = np.empty(count, np.int32), np.empty(count), np.zeros((count, 3))
    origin = rays.origins[0].double().numpy()
    mujoco.mj_multiRay(
        model, data, origin, directions.reshape(-1), None, True, -1, geom, distance, normal.reshape(-1), count, 100.0
    )
    light = AMBIENT + (1 - AMBIENT) * np.clip(normal @ LIGHT, 0, 1)
    rgb = np.where((geom >= 0)[:, None], model.geom_rgba[geom, :3] * light[:, None], 0)
    far = np.where(geom >= 0, distance, np.inf)
    return torch.from_numpy(rgb).float().view(height, width, 3), torch.from_numpy(far).float().view(height, width)


def in_front(scene: Rendering, rgb: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """Colours of whatever is nearer at each pixel."""
    return torch.where((depth < scene.depth)[..., None], rgb, scene.rgb)


def observe(run: lumigraph.Model, model: mujoco.MjModel, data: mujoco.MjData, cameras: Camera) -> dict[str, np.ndarray]:
    """Observation of a gymnasium environment: colours (camera, height, width, 3) in bytes, and depth in metres."""
    scene = run.render(run.placed(cameras.transformed(Z_UP)))
    arm = [arm_seen(model, data, cameras[i]) for i in range(len(cameras))]
    rgb, depth = (torch.stack(values) for values in zip(*arm, strict=True))
    colours = in_front(scene, rgb, depth).clamp(0, 1).mul(255).round().byte()
    return {"rgb": colours.numpy(), "depth": torch.minimum(scene.depth, depth).numpy()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="sample:room", help="a run or splat file in metres, y down")
    parser.add_argument("--metres", type=float, help="to a unit of the scene, where it knows none")
    parser.add_argument("--output", type=Path, default=Path("arm.png"))
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    parser.add_argument("--steps", type=int, default=3, help="observations, of which the last is written")
    asked = parser.parse_args()
    run, model = lumigraph.open(asked.scene, asked.metres), mujoco.MjModel.from_xml_string(ARM)
    data, cameras = mujoco.MjData(model), around(asked.cameras, tuple(asked.size))
    data.qpos[:] = 0.6, 0.7, 1.1  # radians
    mujoco.mj_forward(model, data)
    observe(run, model, data, cameras[:1])  # compiles
    for _ in range(asked.steps):
        data.qpos[0] += 0.2
        mujoco.mj_forward(model, data)
        begin = time.perf_counter()
        seen = observe(run, model, data, cameras)
        seconds = time.perf_counter() - begin
        print(f"{asked.cameras} cameras in {seconds:.2f} s, {asked.cameras / seconds:.1f} per second")
    print(f"depth in {run.depth_unit} from {seen['depth'].min():.2f} to {np.quantile(seen['depth'], 0.99):.2f}")
    rows = np.array_split(seen["rgb"], max(1, asked.cameras // 4))
    to_image(torch.from_numpy(np.concatenate([np.concatenate(list(row), 1) for row in rows])) / 255).save(asked.output)
    print(asked.output)


if __name__ == "__main__":
    main()
