"""Procedural scenes with full ground truth, rendered by a ray tracer.

    stage = scenes.stage("still-life")                    a world and its cameras
    render(stage.world, stage.cameras["test"][0])         picture, exact depth, normals, masks, albedo
    signed_distance(stage.world, points)                  exact geometry
    open_scene("procedural:still-life,size=400")          the same as any other capture
    open_scene("procedural:tourists,jitter_poses=2")      with pose errors of 2 degrees and 2 %
    render(stage.world_of(camera), camera)                of a dynamic scene: `jelly`, `clockwork`, `street`, `swing`
    scene_flow(stage, camera, later)                      position of each pixel's surface point at another time
    write_blender(stage, folder)                          the same for other tools

    open_scene("procedural:city,crossings=6")             scenes may have options of their own
    open_scene("procedural:walker,jitter_bones=5")        a character and its skeleton, with bone errors of 5 degrees
    open_scene("procedural:character,file=fox.glb")       the same of a skinned mesh
    open_scene("procedural:room,depth,views=300")         a depth camera's film, in metres; `exact_depth` is the truth
    open_scene("procedural:room,depth,holes=grid,step=5") less kind data; see `nuisances`

    open_dataset("procedural:toys,count=200")             a Collection of objects, see `members`
    open_dataset("procedural:toys,count=20,turned=1")     the same, each in a random pose

A new scene is a new file in `scenes/`, a new category of objects one in `categories/`; nothing is compiled for it.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Pinhole
from ..color.tags import save_srgb
from ..datasets.world import BlockLabels
from ..geometry import Similarity
from ..readers.capture import Capture, PixelPlane, Shot
from ..readers.raw import RawPhoto, facts, planes
from ..readers.unposed import TRUE_POSE
from ..system import kernel_cache as kernel_cache
from . import categories as categories
from . import scenes as scenes
from .block_stage import blocks_about_middle, stage_of
from .depth_camera import MILLIMETRES, UNMEASURED
from .members import is_category as is_category
from .members import is_collection as is_collection
from .members import member_stage
from .members import members_of as members_of
from .nuisances import disturbed, staged
from .rendering import eight_bits, open_sky, photograph, radiance, roughness
from .rendering import lit as lit
from .rendering import render as render
from .rendering import scattered as scattered
from .rendering import signed_distance as signed_distance
from .rendering import trace as trace
from .rendering import unoccluded as unoccluded
from .stage import Nuisances, nuisances_of, told
from .stage import SyntheticStage as SyntheticStage
from .world import Fog as Fog
from .world import Lamp as Lamp
from .world import Material as Material
from .world import Object as Object
from .world import Pose as Pose
from .world import Sky as Sky
from .world import Sun as Sun
from .world import World as World
from .world import rotation_about

TURN = "turn"  # of `Scene.about`: rotation from an object's upright frame to the source's; see `Stage.turn`
TRACER = 1  # of the pictures that are kept: another number traces them anew
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def is_block_world(request: str) -> bool:
    """True for a block world, whose labels are `Capture.blocks`."""
    name = request.partition(",")[0]
    return not is_category(request) and name in scenes.available() and hasattr(scenes.scene(name), "blocks")


def confirm(request: str) -> None:
    """Raise LumigraphError for an unknown name."""
    if not is_category(request):
        scenes.scene(request.partition(",")[0])


def read(request: str) -> Capture:
    """The capture of a procedural name, with options after commas: "still-life", "still-life,size=400,seed=1".

    Pictures are rendered when they are read. Raises LumigraphError for an unknown name or option.
    """
    plain, disturbances = nuisances_of(request)
    nuisances = told(Nuisances, ",".join([plain.partition(",")[0], *disturbances]))[1]
    return disturbed(undisturbed(plain, request, nuisances), nuisances)


def undisturbed(plain: str, request: str, nuisances: Nuisances) -> Capture:
    """The capture of a name with options but nuisances, of which those of the stage are in the world already."""
    if is_category(plain):
        return capture(staged(member_stage(plain), nuisances), f"procedural:{request}", kept=True)
    name, options = told(scenes.options(plain.partition(",")[0]), plain)
    asked = asdict(options)
    amount = asked.pop("jitter_poses")
    stage = staged(scenes.stage(name, **asked), nuisances)
    off = jittered(stage, amount, options.seed) if amount else None
    found = capture(stage, f"procedural:{request}", off, kept=stage.differing is None or stage.called is not None)
    if is_block_world(plain):
        found = replace(found, blocks=blocks_about_middle(scenes.scene(name).blocks(options)))
    return found


def block_capture(blocks: BlockLabels, source: str, size: int = 128, views: int = 60, seed: int = 0) -> Capture:
    """Pictures of blocks with exact labels and depth; lengths of the source are blocks.

    size: of the square pictures, pixels; views: number of training pictures; seed: position of their cameras
    """
    found = capture(stage_of(blocks, size, views, seed, source), source, kept=True)
    return replace(found, blocks=blocks_about_middle(blocks))


def capture(stage: SyntheticStage, source: str, found: dict[str, Camera] | None = None, kept: bool = False) -> Capture:
    """A stage as photographs with known poses.

    found: cameras with pose errors, if they differ; `about` then has each `true_pose`
    kept:  whether rendered pictures may be cached
    """
    visible = stage.world.sky.visible
    said = found or stage.cameras
    shots = [
        Shot(
            name=f"{split}_{i:04d}",
            pose=in_source(stage, said[split].pose[i]),
            lens=cameras.lens[i],
            size=(int(cameras.size[i, 0]), int(cameras.size[i, 1])),
            image=partial(picture, stage, cameras[i]),
            split=split,
            planes=known_planes(stage, cameras[i]),
            time=None if cameras.time is None else float(cameras.time[i]),
            about=known_facts(stage, cameras[i], jittered=found is not None),
            identity=identity(stage, cameras[i]) if kept else None,
        )
        for split, cameras in stage.cameras.items()
        for i in range(len(cameras))
    ]
    background = (0.0, 0.0, 0.0) if visible else (1.0, 1.0, 1.0)
    (a, b, c), (d, e, f) = ([stage.unit * x for x in corner] for corner in stage.bounds)
    return Capture(
        source,
        shots,
        bounds=((a, b, c), (d, e, f)),
        reach=stage.unit * stage.reach,
        near=stage.unit * stage.near,
        background=background,
        tracks=tuple(track.transformed(Similarity.make(stage.unit)) for track in stage.tracks),
        skeleton=None if stage.skeleton is None else stage.skeleton.transformed(Similarity.make(stage.unit)),
        kept=kept,
        metric=stage.depth_camera is not None and stage.depth_camera.unit == stage.unit,
    )


def in_source(stage: SyntheticStage, pose: Tensor) -> np.ndarray:
    """A pose in the source's frame and unit."""
    found = pose.double().numpy().copy()
    found[:, 3] *= stage.unit
    return found


def identity(stage: SyntheticStage, camera: Camera) -> str:
    """Everything that a picture depends on, as a cache key."""
    if stage.called is not None and camera.image_index is not None:
        world = stage.called(int(camera.image_index))
    else:
        world = repr(stage.world_of(camera))
    taken = "" if stage.sensor is None else f" {stage.sensor} {camera.image_index}"
    return f"traced {TRACER} {world} {camera.pose.tolist()} {camera.lens.to_json()} {camera.size.tolist()}{taken}"


def known_planes(stage: SyntheticStage, camera: Camera) -> dict[str, PixelPlane]:
    """Layers of one photograph, rendered on request."""

    def plane(name: str, encoding: str, dtype: type, channels: int = 1, names: Sequence[str] = ()) -> PixelPlane:
        values = partial(known, stage, camera, name)
        return PixelPlane(values, encoding, dtype=np.dtype(dtype), channels=channels, names=tuple(names))

    clean = partial(without_passers_by, stage, camera)
    lasting = (
        {}
        if stage.lasting is None
        else {"clean": PixelPlane(clean, "sRGB", 1 / 255, dtype=np.dtype(np.uint8), channels=3)}
    )
    if stage.sensor is not None:
        light = partial(radiance, stage.world_of(camera), camera)
        truth = PixelPlane(light, "linear", dtype=np.dtype(np.float32), channels=3)
        lasting |= planes(taken_raw(stage, camera)) | {"radiance": truth}
    exact = {"depth": replace(plane("depth", "distance", np.float32), scale=stage.unit)}
    if stage.depth_camera is not None:
        values = partial(stage.depth_camera.measure, stage.world_of(camera), camera)
        millimetres = np.dtype(np.uint16)
        measured = PixelPlane(values, "z-depth", 1 / MILLIMETRES, unknown=(UNMEASURED,), dtype=millimetres)
        exact = {"depth": measured, "exact_depth": exact["depth"]}
    if stage.moving_things:
        lasting["moving"] = plane("moving", "index", np.int64, names=("still", "moving"))
    if stage.world.environment is not None:
        lasting |= {
            "raw": PixelPlane(
                partial(lit, stage.world_of(camera), camera), "linear", dtype=np.dtype(np.float32), channels=4
            ),
            "roughness": plane("roughness", "plain", np.float32),
            "visibility": plane("visibility", "plain", np.float32),
        }
    return lasting | {
        **exact,
        "normals": plane("normals", "direction", np.float32, 3),
        "labels": plane("labels", "index", np.int64, names=stage.world.names),
        "albedo": plane("albedo", "linear", np.float32, 3),
    }


def known_facts(stage: SyntheticStage, camera: Camera, jittered: bool) -> dict[str, Any]:
    """Values of one photograph. jittered: whether its pose is perturbed; the true one is then included"""
    known = {TRUE_POSE: in_source(stage, camera.pose[0])} if jittered else {}
    if stage.facts is not None and camera.image_index is not None:
        known |= stage.facts(int(camera.image_index))
    if stage.turn is not None:
        known[TURN] = np.array(stage.turn)
    if stage.sensor is None or camera.image_index is None:
        return known
    return known | facts(taken_raw(stage, camera), stage.sensor.brightness(int(camera.image_index)))


def taken_raw(stage: SyntheticStage, camera: Camera) -> RawPhoto:
    """Raw photograph by the stage's sensor; rendered when its pixels are read."""
    assert stage.sensor is not None and camera.image_index is not None
    width, height = camera.size[0].tolist()
    light = partial(radiance, stage.world_of(camera), camera)
    return stage.sensor.photograph(light, (width, height), int(camera.image_index))


def without_passers_by(stage: SyntheticStage, camera: Camera) -> np.ndarray:
    """The photograph in its own light without transient objects, bytes (height, width, 3)."""
    assert stage.lasting is not None and camera.image_index is not None
    return eight_bits(*photograph(stage.lasting(int(camera.image_index)), camera), alpha=False)


def known(stage: SyntheticStage, camera: Camera, name: str) -> np.ndarray:
    """Ground-truth layers along the rays through pixel centres, from `render`."""
    width, height = camera.size[0].tolist()
    world, rays = stage.world_of(camera), camera.rays(camera.pixels())
    if name in ("roughness", "visibility"):
        values = (roughness if name == "roughness" else open_sky)(world, rays)
        return values.astype(np.float32).reshape(height, width)
    seen = trace(world, rays, shaded=False)
    values = {
        "depth": seen.depth,
        "normals": seen.normal,
        "labels": seen.identity,
        "albedo": seen.reflectance,
        "moving": np.isin(seen.identity, stage.moving_things).astype(np.int64),
    }[name]
    values = values if values.dtype == np.int64 else values.astype(np.float32)
    return values.reshape(height, width, *values.shape[1:])


def scene_flow(stage: SyntheticStage, camera: Camera, time: float) -> np.ndarray:
    """Scene flow (height, width, 3): displacement of each pixel's surface point from the camera's time to another,
    scene units. NaN for the background. Optical flow is its projection."""
    assert stage.moving is not None, "nothing moves"
    width, height = camera.size[0].tolist()
    now, rays = stage.world_of(camera), camera.rays(camera.pixels())
    seen = trace(now, rays, shaded=False)
    points = rays.origins.double().numpy() + seen.depth[:, None] * rays.directions.double().numpy()
    points[seen.identity < 0] = np.nan
    return (now.carried(points, seen.identity, stage.moving(time)) - points).reshape(height, width, 3)


def picture(stage: SyntheticStage, camera: Camera) -> np.ndarray:
    """Bytes (height, width, 3), or (height, width, 4) with straight alpha where the background is transparent."""
    if stage.sensor is not None and camera.image_index is not None:
        return taken_raw(stage, camera).developed(stage.sensor.brightness(int(camera.image_index)))
    return eight_bits(*photograph(stage.world_of(camera), camera), alpha=not stage.world.sky.visible)


def jittered(stage: SyntheticStage, amount: float, seed: int) -> dict[str, Camera]:
    """The stage's cameras with pose errors: training ones rotated by `amount` degrees about a random axis and shifted
    by `amount` percent of the longest side of the box of interest, or of `Stage.error`, in a random direction. Held-out
    ones are unchanged."""
    random = np.random.default_rng([seed, 0x9E3779B9])
    low, high = (np.array(corner) for corner in stage.bounds)
    shift = amount / 100 * (stage.error or float((high - low).max()))
    cameras = stage.cameras["train"]
    pose = cameras.pose.double().numpy().copy()
    for one in pose:
        axis, way = random.normal(size=(2, 3))
        one[:, :3] = rotation_about(tuple(axis), amount) @ one[:, :3]
        one[:, 3] += shift * way / np.linalg.norm(way)
    return stage.cameras | {"train": replace(cameras, pose=torch.from_numpy(pose).to(cameras.pose))}


def write_blender(stage: SyntheticStage, folder: Path, truth: bool = True) -> None:
    """Render every camera of a stage into a new folder, in the layout of Blender's synthetic scenes (Mildenhall et al.
    2020).

    FOLDER/transforms_train.json, transforms_test.json ...    poses, OpenGL convention (x right, y up, z backward);
                                                              "time" for dynamic scenes, as in D-NeRF (Pumarola 2021)
    FOLDER/train/r_0000.png                                   RGBA, or RGB where the sky is visible
    FOLDER/train/r_0000_truth.npz                             depth (along the ray), normals, ids, albedo, names

    truth: also write the ground truth of every pixel
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
            save_srgb(Image.fromarray(pixels), folder / f"{path}.png")
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
    """Field of view common to all cameras, radians: the format's only lens parameter."""
    lens = cameras.lens
    if not isinstance(lens, Pinhole):
        raise ValueError(f"Blender's format has pinhole cameras only, not {type(lens).__name__}")
    focal, centre, size = lens.focal, lens.centre, cameras.size
    if not ((focal == focal[0, 0]).all() and (size == size[0]).all() and (2 * centre == size).all()):
        raise ValueError("Blender's format requires all cameras alike, with square pixels and the centre in the middle")
    return 2 * math.atan(float(cameras.size[0, 0]) / (2 * float(focal[0, 0])))
