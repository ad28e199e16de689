"""Drives in the layouts of KITTI's benchmarks of tracking and of odometry (Geiger et al. 2012).

    image_02/0006/000000.png     the left colour camera, rectified
    label_02/0006.txt            a line for each thing on each photograph: frame, track, type, truncated, occluded,
                                 angle, box in the picture (4), height, width, length, place of the lower side's
                                 middle (3), turn about the camera's vertical
    calib/0006.txt               P0 to P3, and the rotations and places of the cameras, the laser and the inertial unit
    oxts/0006.txt                latitude, longitude, altitude, roll, pitch, yaw and more of each photograph

Odometry: sequences/00/image_2/000000.png, calib.txt and maybe times.txt (seconds) in it, and poses/00.txt or poses.txt
in it: camera-to-world (3x4, rows) of camera 0 for each photograph.

Name the folder of a sequence, or one that holds these four of a single sequence. Lengths are metres, moments are
numbers of photographs. Places of things are in the rectified frame of camera 0. Without oxts the camera stands still.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..camera.lens import Pinhole
from ..datasets.scene import GeographicOrigin
from ..datasets.tracks import BoxTrack
from ..errors import LumigraphError
from ..files import read_text
from ..files.reading import reading
from ..geometry import to_quaternion
from .capture import Capture, Shot
from .pictures import list_images

EXPECTED_FILES = {
    "KITTI's tracking": ("image_02/", "label_02/", "calib/"),
    "KITTI's odometry": ("image_2/", "calib.txt", "poses.txt"),
}
ODOMETRY_PICTURES, SIDE = "image_2", 4  # and columns of a pose
PICTURES, LABELS, CALIBRATION, INERTIAL = "image_02", "label_02", "calib", "oxts"
IGNORED_TYPE = "DontCare"
MAX_NUMBER = 1e9  # in any file, whatever its unit
LABEL_COLUMNS, OXTS_COLUMNS = 17, 6  # that are read, of a line
MAX_LATITUDE = 89.0  # degrees, of Mercator's projection
EARTH_RADIUS = 6378137.0  # metres, WGS 84's equator
REACH = 80.0  # metres from the middle of what is looked at, within which the street is modelled
NEAR = 2.0  # metres in front of the camera, within which there is nothing


def recognises(folder: Path) -> bool:
    if (folder / ODOMETRY_PICTURES).is_dir() and (folder / "calib.txt").is_file():
        return odometry(folder) is not None
    if folder.parent.name == PICTURES:
        return (folder.parent.parent / LABELS / f"{folder.name}.txt").is_file()
    return all((folder / name).is_dir() for name in (PICTURES, LABELS, CALIBRATION))


def read(folder: Path) -> Capture:
    """Photographs of the left colour camera, with the tracks of all labelled objects. Raises LumigraphError for several
    sequences, and for malformed files."""
    if (poses := odometry(folder)) is not None:
        return read_odometry(folder, poses)
    root, name = sequence(folder)
    pictures = [root / PICTURES / name / x for x in list_images(root / PICTURES / name)]
    matrices = read_calibration(root / CALIBRATION / f"{name}.txt")
    inertial = root / INERTIAL / f"{name}.txt"
    drive, origin = read_drive(inertial, matrices) if inertial.is_file() else (None, None)
    shots = shots_of(pictures, root / CALIBRATION / f"{name}.txt", matrices["P2"], inertial, drive)
    tracks = read_labels(root / LABELS / f"{name}.txt", drive)
    up = (0.0, -1.0, 0.0) if drive is None else (0.0, 0.0, 1.0)
    return Capture(str(folder), shots, up=up, reach=REACH, near=NEAR, origin=origin, tracks=tracks, metric=True)


def shots_of(
    pictures: list[Path], calibration: Path, projection: np.ndarray, source: Path, drive: list[np.ndarray] | None
) -> list[Shot]:
    """Photographs of camera 2. drive: poses of camera 0 by number, from `source`; None: it stands still"""
    fx, fy, cx, cy = (float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    lens = Pinhole(torch.tensor([[fx, fy]]), torch.tensor([[cx + 0.5, cy + 0.5]]))
    with reading(calibration, "has a P2 that is no projection", "restore the file"):
        aside = -np.linalg.solve(projection[:, :3], projection[:, 3])  # camera 2 in the frame of camera 0
    shots = []
    for path in pictures:
        frame = frame_number(path)
        if drive is not None and frame >= len(drive):
            raise LumigraphError(f"{source} has {len(drive)} lines, and none for {path.name}; give one for each")
        pose = np.eye(4) if drive is None else drive[frame]
        pose = np.concatenate([pose[:3, :3], (pose[:3, :3] @ aside + pose[:3, 3])[:, None]], 1)
        shots.append(Shot(path.name, pose, lens, None, {1: path}, time=float(frame)))
    return shots


def odometry(folder: Path) -> Path | None:
    """Poses of a sequence of the odometry benchmark; None without any, and for another layout."""
    if not (folder / ODOMETRY_PICTURES).is_dir():
        return None
    places = folder / "poses.txt", *(x / "poses" / f"{folder.name}.txt" for x in (folder.parent.parent, folder.parent))
    return next((path for path in places if path.is_file()), None)


def read_odometry(folder: Path, poses: Path) -> Capture:
    """Photographs of the left colour camera along its drive, at times in seconds if they are known."""
    rows = read_rows(poses, 3 * SIDE)
    drive = [whole(np.array(row[: 3 * SIDE], np.float64).reshape(3, SIDE)) for row in rows]
    pictures = [folder / ODOMETRY_PICTURES / x for x in list_images(folder / ODOMETRY_PICTURES)]
    calibration, times = folder / "calib.txt", folder / "times.txt"
    shots = shots_of(pictures, calibration, read_calibration(calibration)["P2"], poses, drive)
    seconds = [float(row[0]) for row in read_rows(times, 1)] if times.is_file() else []
    if len(seconds) >= len(drive):
        shots = [replace(shot, time=seconds[int(shot.time or 0)]) for shot in shots]
    return Capture(str(folder), shots, up=(0.0, -1.0, 0.0), reach=REACH, near=NEAR, metric=True)


def sequence(folder: Path) -> tuple[Path, str]:
    """Folder of all sequences, and name of the requested one."""
    if folder.parent.name == PICTURES:
        return folder.parent.parent, folder.name
    names = sorted(path.name for path in (folder / PICTURES).iterdir() if path.is_dir())
    if len(names) != 1:
        which = f"name one of them: {folder / PICTURES / names[0]}" if names else "restore its pictures"
        raise LumigraphError(f"{folder} holds {len(names)} sequences in {PICTURES}; {which}")
    return folder, names[0]


def frame_number(path: Path) -> int:
    """Number of a photograph in its sequence, by its name."""
    if not path.stem.isdecimal():
        raise LumigraphError(f"{path} has no number for a name, as KITTI's photographs have; rename it to 000000.png")
    return int(path.stem)


def read_rows(path: Path, columns: int, words: tuple[int, ...] = ()) -> list[list[str]]:
    """Words of the lines of a file. words: columns that are not numbers"""
    rows = [line.split() for line in read_text(path).splitlines() if line.strip()]
    for row in rows:
        with reading(path, f"holds {' '.join(row)[:120]!r}, where {columns} columns were looked for", "correct it"):
            numbers = [float(x) for i, x in enumerate(row[:columns]) if i not in words]
            if len(numbers) != columns - len(words) or not all(abs(number) <= MAX_NUMBER for number in numbers):
                raise ValueError("a number is missing, not finite or too large")
    return rows


def read_calibration(path: Path) -> dict[str, np.ndarray]:
    """Matrices by name. Raises LumigraphError for a missing one."""
    found = {}
    for line in read_text(path).splitlines():
        name, *numbers = line.replace(":", " ").split() or [""]
        with reading(path, f"has {name[:20]} with something besides numbers", "correct it"):
            values = np.array([float(x) for x in numbers])
            if not (np.abs(values) <= MAX_NUMBER).all():
                raise ValueError("a number is not finite or too large")
        if len(values) in (9, 12):
            found[name.replace("R0_rect", "R_rect").replace("_to_", "_")] = values.reshape(3, -1)
    if found.get("P2", np.zeros((3, 3))).shape != (3, 4):
        raise LumigraphError(f"{path} has no P2, the left colour camera's projection; restore the file")
    return found


def read_drive(path: Path, matrices: dict[str, np.ndarray]) -> tuple[list[np.ndarray], GeographicOrigin]:
    """Poses (4, 4) of camera 0, rectified, in metres east, north and up of the first position."""
    for name in ("R_rect", "Tr_velo_cam", "Tr_imu_velo"):
        if name not in matrices:
            raise LumigraphError(
                f"{path} gives the path of the inertial unit, and the calibration lacks {name}; restore it"
            )
    camera_from_imu = whole(matrices["R_rect"]) @ whole(matrices["Tr_velo_cam"]) @ whole(matrices["Tr_imu_velo"])
    with reading(path, "needs a calibration of rotations and places", "restore that file"):
        imu_from_camera = np.linalg.inv(camera_from_imu)
    rows = [[float(x) for x in row[:OXTS_COLUMNS]] for row in read_rows(path, OXTS_COLUMNS)]
    if not rows or not all(abs(row[0]) < MAX_LATITUDE for row in rows):
        raise LumigraphError(f"{path} has no line, or a latitude beyond {MAX_LATITUDE:g} degrees; restore the file")
    scale = EARTH_RADIUS * math.cos(math.radians(rows[0][0]))
    poses, first = [], None
    for latitude, longitude, altitude, roll, pitch, yaw in rows:  # Mercator's projection, as the benchmark has it
        north = scale * math.log(math.tan(math.radians(0.5 * (90 + latitude))))
        place = np.array([scale * math.radians(longitude), north, altitude])
        first = place if first is None else first
        pose = np.eye(4)
        pose[:3, :3] = about(2, yaw) @ about(1, pitch) @ about(0, roll)
        pose[:3, 3] = place - first
        poses.append(pose @ imu_from_camera)
    return poses, GeographicOrigin(*rows[0][:3])


def whole(matrix: np.ndarray) -> np.ndarray:
    """A 4 x 4 matrix from one of 3 x 3 or 3 x 4."""
    found = np.eye(4)
    found[:3, : matrix.shape[1]] = matrix
    return found


def about(axis: int, angle: float) -> np.ndarray:
    """Rotation about an axis by radians."""
    i, j = ((axis + 1) % 3, (axis + 2) % 3)
    found = np.eye(3)
    found[[i, j], [i, j]] = math.cos(angle)
    found[i, j], found[j, i] = -math.sin(angle), math.sin(angle)
    return found


def read_labels(path: Path, drive: list[np.ndarray] | None) -> tuple[BoxTrack, ...]:
    """Tracks of all labelled objects, in the frame of the poses. drive: poses of camera 0; None for a static camera"""
    boxes: dict[tuple[str, str], dict[float, tuple[np.ndarray, tuple[float, float, float]]]] = {}
    for row in read_rows(path, LABEL_COLUMNS, words=(2,)):
        frame, track, kind = int(float(row[0])), row[1], row[2]
        if kind == IGNORED_TYPE or (drive is not None and not 0 <= frame < len(drive)):
            continue
        height, width, length, x, y, z, turn = map(float, row[10:17])
        forward, up = np.array([math.cos(turn), 0.0, -math.sin(turn)]), np.array([0.0, -1.0, 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([forward, np.cross(up, forward), up], 1)
        pose[:3, 3] = x, y - 0.5 * height, z
        seen = pose if drive is None else drive[frame] @ pose
        boxes.setdefault((kind, track), {})[float(frame)] = seen, (length, width, height)
    tracks = []
    for (kind, track), found in boxes.items():
        times = sorted(found)
        poses = np.stack([found[t][0] for t in times])
        rotations = to_quaternion(torch.from_numpy(poses[:, :3, :3])).tolist()
        size, positions = found[times[0]][1], tuple(map(tuple, poses[:, :3, 3].tolist()))
        tracks.append(BoxTrack(f"{kind} {track}", kind, size, tuple(times), positions, tuple(map(tuple, rotations))))
        if min(size) <= 0:
            raise LumigraphError(f"{path}: the box of {kind} {track} has no size; correct columns 11 to 13")
    return tuple(tracks)
