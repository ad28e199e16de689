"""Captures of a person in a ring of cameras, as ZJU-MoCap publishes them (Peng et al. 2021).

annots.npy has cameras (K, D, R, T in millimetres) and names of photographs; new_params/N.npy or params/N.npy the
pose of frame N: rotation vectors of 24 joints in their parents, Rh and Th from the body to the world. lbs/joints.npy
and lbs/parents.npy (Peng 2021, Animatable NeRF) have the joints at rest; no body model is read. The first camera's
photographs train; every 30th frame of the others tests. Masks are in mask_cihp/ or mask/: labels, 0 is the background.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ..camera.lens import OpenCV
from ..datasets.skeleton import BonePose, Skeleton, posed, rigid_product
from ..errors import LumigraphError
from ..files import is_file
from ..files.reading import reading
from ..geometry import rotated
from .capture import Capture, Shot
from .numbers import load_array
from .pickled import load_pickled
from .pictures import readable, stat

EXPECTED_FILES = {"ZJU-MoCap": ("annots.npy", "new_params/ or params/")}
MILLIMETRES = 1000.0
MAX_NUMBER = 1e9  # in any file, whatever its unit
TEST_INTERVAL = 30  # frames between those of cameras that test (Peng 2021)
PARAMS = "new_params", "params"
MASKS = "mask_cihp", "mask"
JOINTS = (  # of the body, in the files' order
    "pelvis", "left hip", "right hip", "spine 1", "left knee", "right knee", "spine 2", "left ankle", "right ankle",
    "spine 3", "left foot", "right foot", "neck", "left collar", "right collar", "head", "left shoulder",
    "right shoulder", "left elbow", "right elbow", "left wrist", "right wrist", "left hand", "right hand",
)  # fmt: skip


def recognises(folder: Path) -> bool:
    return is_file(folder / "annots.npy") and any((folder / name).is_dir() for name in PARAMS)


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for damaged files, and without joints at rest."""
    path = folder / "annots.npy"
    said = load_pickled(path)
    with reading(path, "does not hold cameras as ZJU-MoCap's does"):
        cameras = said["cams"]
        matrices, bends, turns, shifts = (finite(cameras[name], name) for name in "KDRT")
        lists = [list(map(text, one["ims"])) for one in said["ims"]]
        count = len(matrices)
        matrices, turns = matrices.reshape(count, 3, 3), turns.reshape(count, 3, 3)
        bends, shifts = bends.reshape(count, -1)[:, :5], shifts.reshape(count, 3) / MILLIMETRES
        bends = np.pad(bends, ((0, 0), (0, 8 - bends.shape[1])))
    shots, missing, frames = [], [], set()
    for names in lists:
        for camera, name in enumerate(names[:count]):
            frame = frame_of(name)
            if camera and frame % TEST_INTERVAL:
                continue
            if not is_file(folder / name) or params_file(folder, frame) is None:
                missing.append(name)
                continue
            frames.add(frame)
            pose = np.concatenate([turns[camera].T, -turns[camera].T @ shifts[camera][:, None]], 1)
            k = matrices[camera]
            values = (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]), bends[camera]
            lens = OpenCV(*(torch.from_numpy(np.array([x])).float() for x in values))
            with readable(folder / name), Image.open(folder / name) as image:
                size = image.size
            mask = next(
                (file for kind in MASKS if is_file(file := folder / kind / Path(name).with_suffix(".png"))), None
            )
            shots.append(
                Shot(
                    name,
                    pose,
                    lens,
                    size,
                    {1: folder / name} if mask is None else partial(masked, folder / name, mask),
                    split="test" if camera else "train",
                    time=float(frame),
                    identity=None if mask is None else f"masked {folder / name} {stat(folder / name)} {stat(mask)}",
                )
            )
    skeleton = skeleton_of(folder, sorted(frames)) if frames else None
    return Capture(str(folder), shots, missing=missing, up=(0.0, 0.0, 1.0), skeleton=skeleton)


def text(name: Any) -> str:
    """A name, possibly bytes of Python 2."""
    return name.decode("latin-1") if isinstance(name, bytes) else str(name)


def finite(values: Any, name: str) -> np.ndarray:
    """Numbers in double precision. Raises ValueError for others."""
    found = np.array(values, float)
    if not (np.abs(found) <= MAX_NUMBER).all():
        raise ValueError(f"{name} has numbers that are not finite or beyond {MAX_NUMBER:g}")
    return found


def masked(photograph: Path, mask: Path) -> np.ndarray:
    """Pixels of a photograph with opacity 0 where the mask's label is 0, or its colour black."""
    with readable(photograph), Image.open(photograph) as image:
        rgb = np.asarray(image.convert("RGB"))
    with readable(mask), Image.open(mask) as image:
        labels = np.asarray(image)
        if labels.shape[:2] != rgb.shape[:2]:
            raise ValueError(f"its size is not that of {photograph.name}")
    body = labels.reshape(*labels.shape[:2], -1)[..., :3].any(-1)
    return np.concatenate([rgb, np.where(body, 255, 0)[..., None].astype(np.uint8)], -1)


def frame_of(name: str) -> int:
    """Number of the frame in the name of its photograph: 000012.jpg, or CoreView_313_Camera_(1)_0012_2019-...jpg."""
    stem = Path(name).stem
    found = re.search(r"Camera_\(\d+\)_(\d+)_", stem) or re.search(r"(\d+)$", stem)
    if found is None:
        raise LumigraphError(f"{name} has no number of a frame in its name; restore the names of ZJU-MoCap")
    return int(found[1])


def params_file(folder: Path, frame: int) -> Path | None:
    return next((file for kind in PARAMS if is_file(file := folder / kind / f"{frame}.npy")), None)


def skeleton_of(folder: Path, frames: list[int]) -> Skeleton:
    """The skeleton in the world, at rest as in its first frame. Raises LumigraphError for invalid files."""
    files = folder / "lbs" / "joints.npy", folder / "lbs" / "parents.npy"
    if not all(map(is_file, files)):
        raise LumigraphError(
            f"{folder} has a skeleton without a bind pose, for lbs/joints.npy or lbs/parents.npy is missing; copy the "
            "folder lbs of Animatable NeRF's release beside annots.npy"
        )
    with reading(files[0], "does not hold 24 joints of 3 coordinates"):
        joints = finite(load_array(files[0]), "the array").reshape(len(JOINTS), 3)
    with reading(files[1], "does not hold the parents of 24 joints"):
        parents = np.array(load_array(files[1]), int).reshape(len(JOINTS)).tolist()
        above = (-1, *parents[1:])  # the file has a number for the root, too
        if not all(0 <= parent < number for number, parent in enumerate(above) if number):
            raise ValueError("a joint comes before its parent, or has none")
    local = np.concatenate([np.broadcast_to(np.eye(3), (24, 3, 3)), joints[:, :, None]], -1)
    local[1:, :, 3] -= joints[list(above[1:])]
    poses, first = [], None
    for frame in frames:
        file = params_file(folder, frame)
        assert file is not None
        place, turns = body_pose(file)
        first = place if first is None else first
        moved = torch.from_numpy(local.copy())
        moved[:, :, :3] = turns
        poses.append(BonePose.of(rigid_product(place.expand(24, 3, 4), posed(above, moved))))
    at_rest = torch.from_numpy(np.concatenate([np.broadcast_to(np.eye(3), (24, 3, 3)), joints[:, :, None]], -1))
    assert first is not None
    rest = BonePose.of(rigid_product(first.expand(24, 3, 4), at_rest))
    return Skeleton(JOINTS, above, rest, tuple(map(float, frames)), tuple(poses))


def body_pose(file: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """From the body to the world (3, 4), and rotations of joints in their parents (joint, 3, 3)."""
    said: Any = load_pickled(file)
    with reading(file, "does not hold a pose as ZJU-MoCap's files do"):
        turns = torch.from_numpy(finite(said["poses"], "poses").reshape(24, 3))
        rh, th = (torch.from_numpy(finite(said[name], name).reshape(1, 3)) for name in ("Rh", "Th"))
    return torch.cat([matrices_of(rh)[0], th.T], -1), matrices_of(turns)


def matrices_of(omega: torch.Tensor) -> torch.Tensor:
    """Rotation matrices of rotation vectors."""
    axes = [rotated(torch.eye(3, dtype=omega.dtype)[i].expand(len(omega), 3), omega) for i in range(3)]
    return torch.stack(axes, -1)
