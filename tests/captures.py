"""One tiny scene, written to disk in every layout that is read: the same cameras, pictures and points each time."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

WIDTH, HEIGHT, FOCAL = 48, 36, 60.0
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray | None = None) -> np.ndarray:
    """A 4x4 pose, camera-to-world, +y down and +z forward."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, np.array([0.0, 0.0, 1.0]) if up is None else up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, position], -1)
    return pose


@dataclass
class Tiny:
    """Cameras on a ring around a few points, each picture a gradient with its number in blue."""

    count: int = 10
    names: list[str] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    pictures: list[np.ndarray] = field(default_factory=list)
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    colours: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))

    def __post_init__(self) -> None:
        random = np.random.default_rng(3)
        for i in range(self.count):
            angle = 2 * math.pi * i / self.count
            position = np.array([4 * math.cos(angle), 4 * math.sin(angle), 1 + 0.5 * math.sin(3 * angle)])
            self.names.append(f"view_{i:02d}.png")
            self.poses.append(look_at(position, random.normal(0, 0.1, 3)))
            y, x = np.mgrid[:HEIGHT, :WIDTH]
            self.pictures.append(np.stack([5 * x, 7 * y, np.full_like(x, 10 * i)], -1).astype(np.uint8))
        self.points = random.uniform(-1, 1, (200, 3))
        self.colours = random.integers(0, 255, (200, 3), dtype=np.uint8)

    def write_images(self, folder: Path, times: int = 1) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        for name, picture in zip(self.names, self.pictures, strict=True):
            image = Image.fromarray(picture)
            image.resize((WIDTH // times, HEIGHT // times), Image.Resampling.BOX).save(folder / name)

    def frames(self, prefix: str, suffix: str = "") -> list[dict[str, Any]]:
        pairs = zip(self.names, self.poses, strict=True)
        stems = ((name if suffix else name.removesuffix(".png"), pose) for name, pose in pairs)
        return [{"file_path": prefix + name, "transform_matrix": (pose @ OPENGL).tolist()} for name, pose in stems]


def write_blender(folder: Path, tiny: Tiny) -> Path:
    """Every image in both splits' folders, but the first three listed for testing and the rest for training."""
    tiny.write_images(folder / "all")
    frames = tiny.frames("./all/")
    angle = 2 * math.atan(0.5 * WIDTH / FOCAL)
    for split, part in (("train", frames[3:]), ("test", frames[:3])):
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": part})
    return folder


def write_ngp(folder: Path, tiny: Tiny, **extra: Any) -> Path:
    tiny.write_images(folder / "images")
    shared = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "aabb_scale": 4}
    write_json(folder / "transforms.json", {**shared, "frames": tiny.frames("images/", ".png"), **extra})
    return folder


def write_nsvf(folder: Path, tiny: Tiny, split: bool = True) -> Path:
    """Lines of SRN for the camera; names of NSVF, with the last of two pictures for tests."""
    tiny.write_images(folder / "rgb")
    (folder / "pose").mkdir()
    for i, (path, pose) in enumerate(zip(sorted((folder / "rgb").iterdir()), tiny.poses, strict=True)):
        path = path.rename(path.with_name(f"{2 * (i % 2)}_{path.name}")) if split else path
        np.savetxt(folder / "pose" / f"{path.stem}.txt", pose.reshape(1, 16) if i % 2 else pose)
    camera = f"{FOCAL} {WIDTH / 2} {HEIGHT / 2} 0.\n0. 0. 0.\n0.\n1.\n{HEIGHT} {WIDTH}\n"
    (folder / "intrinsics.txt").write_text(camera)
    (folder / "bbox.txt").write_text("-1 -1 -1 1 1 1 0.4\n")
    return folder


def write_nerfstudio(folder: Path, tiny: Tiny, **extra: Any) -> Path:
    """Intrinsics frame by frame, points in a PLY file."""
    tiny.write_images(folder / "images")
    intrinsics = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "k1": 0.0}
    frames = [{**frame, **intrinsics} for frame in tiny.frames("images/", ".png")]
    whole = {"camera_model": "OPENCV", "ply_file_path": "sparse.ply", "frames": frames, **extra}
    write_json(folder / "transforms.json", whole)
    properties = "".join(f"property {kind}\n" for kind in ("float x", "float y", "float z"))
    properties += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    rows = (" ".join(map(str, [*p, *c])) for p, c in zip(tiny.points.tolist(), tiny.colours.tolist(), strict=True))
    header = f"ply\nformat ascii 1.0\nelement vertex {len(tiny.points)}\n{properties}end_header\n"
    (folder / "sparse.ply").write_text(header + "\n".join(rows) + "\n")
    return folder


def write_colmap(folder: Path, tiny: Tiny, text: bool = False, place: str = "sparse/0", cameras: Any = None) -> Path:
    """cameras: pycolmap's, image i was taken by number i modulo their count; one pinhole if None."""
    tiny.write_images(folder / "images")
    if cameras is None:
        cameras = [pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, 24, 18])]
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras):
        camera.camera_id = number + 1
        model.add_camera_with_trivial_rig(camera)
    for number, (name, pose) in enumerate(zip(tiny.names, tiny.poses, strict=True)):
        features = [pycolmap.Point2D(np.array([1.0 + k, 2.0])) for k in range(len(tiny.points))]
        image = pycolmap.Image(name=name, camera_id=number % len(cameras) + 1, image_id=number + 1)
        image.points2D = pycolmap.Point2DList(features)
        world_to_camera = np.linalg.inv(pose)[:3]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world_to_camera))
    for number, (point, colour) in enumerate(zip(tiny.points, tiny.colours, strict=True)):
        track = pycolmap.Track()
        for image in range(1, 4):
            track.add_element(image, number)
        model.add_point3D(point, track, colour)
    (folder / place).mkdir(parents=True, exist_ok=True)
    if text:
        model.write_text(folder / place)
    else:
        model.write_binary(folder / place)
    return folder


def write_llff(folder: Path, tiny: Tiny) -> Path:
    """The table, and images reduced twice only, as published captures often come."""
    tiny.write_images(folder / "images_2", times=2)
    rows = []
    for pose in tiny.poses:
        right, down, forward, position = pose[:3].T
        matrix = np.stack([down, right, -forward, position, [HEIGHT, WIDTH, FOCAL]], -1)
        rows.append([*matrix.ravel(), 2.0, 6.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_nerfies(folder: Path, tiny: Tiny) -> Path:
    """Two sizes of each photograph, moments in steps of two, units of a tenth, and points of the background."""
    tiny.write_images(folder / "rgb/1x")
    tiny.write_images(folder / "rgb/2x", times=2)
    ids = [name.removesuffix(".png") for name in tiny.names]
    split = {"val_ids": ids[:3], "train_ids": ids[3:]}
    write_json(folder / "dataset.json", {"count": len(ids), "ids": ids, **split})
    write_json(folder / "metadata.json", {name: {"warp_id": 2 * i, "camera_id": 0} for i, name in enumerate(ids)})
    write_json(folder / "scene.json", {"scale": 0.1, "center": [0.0, 0.0, 0.0], "near": 0.2, "far": 0.6})
    for name, pose in zip(ids, tiny.poses, strict=True):
        camera = {"orientation": pose[:3, :3].T.tolist(), "position": pose[:3, 3].tolist(), "focal_length": FOCAL}
        camera |= {"principal_point": [WIDTH / 2, HEIGHT / 2], "image_size": [WIDTH, HEIGHT]}
        write_json(folder / "camera" / f"{name}.json", camera)
    np.save(folder / "points.npy", tiny.points)
    return folder


def write_nr_nerf(folder: Path, tiny: Tiny) -> Path:
    tiny.write_images(folder / "images")
    poses = []
    for pose in tiny.poses:
        right, down, forward, position = pose[:3].T
        poses.append(np.stack([right, -down, -forward, position, [HEIGHT, WIDTH, FOCAL]], -1).tolist())
    write_json(folder / "precomputed.json", {"poses": poses, "bds": [[2.0, 6.0]] * len(poses), "i_test": 2})
    return folder


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


WRITERS = {
    "blender": write_blender,
    "instant-ngp": write_ngp,
    "nerfstudio": write_nerfstudio,
    "colmap binary": write_colmap,
    "colmap text": lambda folder, tiny: write_colmap(folder, tiny, text=True),
    "llff": write_llff,
    "nerfies": write_nerfies,
    "nr-nerf": write_nr_nerf,
}
