"""A stage written out as Blender's synthetic scenes are (Mildenhall et al. 2020), for tests and other tools.

FOLDER/transforms_train.json, transforms_test.json ...    poses, OpenGL convention (x right, y up, z backward);
                                                          "time" where things move, as in D-NeRF (Pumarola 2021)
FOLDER/train/r_0000.png                                   RGBA, or RGB where the sky is visible
FOLDER/train/r_0000_truth.npz                             depth (along the ray), normals, ids, albedo, names
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from ..camera import Camera
from ..camera.lens import Pinhole
from .rendering import eight_bits, render
from .stage import SyntheticStage

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_blender(stage: SyntheticStage, folder: Path, truth: bool = True) -> None:
    """Render every camera of a stage into a new folder.

    truth: also write what is exactly known about every pixel
    Raises FileExistsError if the folder exists, ValueError for lenses that the format cannot express.
    """
    folder.mkdir(parents=True)
    for split, cameras in stage.cameras.items():
        (folder / split).mkdir()
        frames = []
        for i in range(len(cameras)):
            seen = render(stage.world_of(cameras[i]), cameras[i])
            path = f"{split}/r_{i:04d}"
            pixels = eight_bits(seen.rgb.numpy(), seen.opacity.numpy(), alpha=not stage.world.sky.visible)
            Image.fromarray(pixels).save(folder / f"{path}.png")
            if truth:
                known = {k: v.numpy() for k, v in (("depth", seen.depth), *seen.extra.items())}
                known["names"] = np.array(stage.world.names)
                np.savez_compressed(folder / f"{path}_truth.npz", allow_pickle=False, **known)
            pose = np.vstack([cameras.pose[i].double().numpy(), [0, 0, 0, 1]]) @ OPENGL
            beside = {f"{name}_file_path": f"./{path}_truth.npz" for name in ("depth", "labels", "normals") if truth}
            when = {} if cameras.time is None else {"time": float(cameras.time[i])}
            frames.append({"file_path": f"./{path}", **when, "transform_matrix": pose.tolist(), **beside})
        units = {"depth_unit_scale_factor": 1.0, "is_euclidean_depth": True} if truth else {}
        listed = {"camera_angle_x": angle_across(cameras), **units, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(listed, indent=1))


def angle_across(cameras: Camera) -> float:
    """The field of view that all cameras share, radians: all that the format says about lenses."""
    lens = cameras.lens
    if not isinstance(lens, Pinhole):
        raise ValueError(f"Blender's format knows pinhole cameras only, not {type(lens).__name__}")
    focal, centre, size = lens.focal, lens.centre, cameras.size
    if not ((focal == focal[0, 0]).all() and (size == size[0]).all() and (2 * centre == size).all()):
        raise ValueError("Blender's format wants all cameras alike, with square pixels and the centre in the middle")
    return 2 * math.atan(float(cameras.size[0, 0]) / (2 * float(focal[0, 0])))
