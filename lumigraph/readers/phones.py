"""Captures of phones with a depth sensor, as Polycam and Record3D export them.

Polycam, raw data: keyframes/cameras/N.json or keyframes/corrected_cameras/N.json (rows t_00 to t_23 of camera-to-world,
focal lengths, centre, size), keyframes/images/N.jpg or keyframes/corrected_images/N.jpg, keyframes/depth/N.png (16
bits, millimetres). Record3D, RGBD: metadata.json (K by columns, poses as qx qy qz qw x y z, size of the depth) and
rgbd/N.jpg, rgbd/N.depth (float32 metres, compressed by LZFSE). Camera axes are OpenGL's, y is up, depth is along the
optical axis, 0 and NaN where nothing was measured. Lengths are metres. Of confidence (keyframes/confidence/N.png, 0 to
255; rgbd/N.conf, 0 to 2) the lowest is left out; the others become the layer `depth_deviation`.

Stray Scanner: odometry.csv (timestamp, frame, x, y, z, qx, qy, qz, qw, or the last seven; +y down, +z forward),
camera_matrix.csv, depth/000000.png or .npy (millimetres), confidence/000000.png (0 to 2), and
the film rgb.mp4, of which `lumigraph capture FOLDER` writes frames, as rgb/000000.jpg.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..camera.lens import Pinhole
from ..errors import LumigraphError
from ..files import is_file, read_bytes, read_json, read_text
from ..files.names import natural
from ..files.ranges import Coordinate, Positive, Side
from ..files.reading import reading
from ..geometry import to_matrix
from .capture import Capture, PixelPlane, Shot
from .numbers import read_numbers
from .pictures import find_file, list_images, measure, readable, stat

EXPECTED_FILES = {
    "Polycam, raw data": ("keyframes/cameras/",),
    "Record3D": ("metadata.json", "rgbd/"),
    "Stray Scanner": ("odometry.csv", "rgb.mp4"),
}
OPENCV = np.diag([1.0, -1.0, -1.0])  # from OpenGL's camera axes
UP = (0.0, 1.0, 0.0)
MILLIMETRES = 1e-3
TRUSTED = 0, 1, 1  # factor of depth by its confidence, 0 to 2
DEVIATIONS = 0, 0.03, 0.01  # standard deviation of depth by its confidence, as a share of the depth
STRAY_FILES = "odometry.csv", "camera_matrix.csv"


@dataclass(frozen=True)
class PolycamCamera:
    """A pose and a lens of one picture."""

    t_00: Coordinate
    t_01: Coordinate
    t_02: Coordinate
    t_03: Coordinate
    t_10: Coordinate
    t_11: Coordinate
    t_12: Coordinate
    t_13: Coordinate
    t_20: Coordinate
    t_21: Coordinate
    t_22: Coordinate
    t_23: Coordinate
    fx: Positive
    fy: Positive
    cx: Coordinate
    cy: Coordinate
    width: Side | None = None
    height: Side | None = None

    @property
    def size(self) -> tuple[int, int] | None:
        return None if self.width is None or self.height is None else (self.width, self.height)

    @property
    def pose(self) -> np.ndarray:
        return np.array([[getattr(self, f"t_{i}{j}") for j in range(4)] for i in range(3)])


@dataclass(frozen=True)
class Record3DMetadata:
    """K: by columns; poses: qx qy qz qw x y z of each picture; dw, dh: size of the depth"""

    w: Side
    h: Side
    K: list[Coordinate]
    poses: list[list[Coordinate]]
    dw: Side
    dh: Side
    perFrameIntrinsicCoeffs: list[list[Coordinate]] | None = None  # noqa: N815 (fx fy cx cy)


def recognises(folder: Path) -> bool:
    return (
        is_polycam(folder) or is_stray(folder) or ((folder / "metadata.json").is_file() and (folder / "rgbd").is_dir())
    )


def is_polycam(folder: Path) -> bool:
    return any((folder / "keyframes" / name).is_dir() for name in ("cameras", "corrected_cameras"))


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for malformed files."""
    if is_stray(folder):
        return read_stray(folder)
    return read_polycam(folder) if is_polycam(folder) else read_record3d(folder)


def is_stray(folder: Path) -> bool:
    return all((folder / name).is_file() for name in STRAY_FILES)


def stray_path(folder: Path) -> dict[int, list[float]]:
    """Position and quaternion x y z w of each frame of Stray Scanner, by number."""
    path = folder / STRAY_FILES[0]
    with reading(path, "has lines that are no poses", "export it again"):
        words = [line.split(",") for line in read_text(path).splitlines() if line.strip()]
        titled = not words[0][0].strip().lstrip("-")[:1].isdigit()
        rows = [list(map(float, row)) for row in (words[1:] if titled else words)]
        return {int(row[1]) if len(row) > 8 else i: row[-7:] for i, row in enumerate(rows)}


def read_stray(folder: Path) -> Capture:
    """Frames that are pictures, with depth of confidence 1 and more. Raises LumigraphError for a film alone."""
    pictures = {int(Path(x).stem): folder / "rgb" / x for x in list_images(folder / "rgb") if Path(x).stem.isdecimal()}
    if not pictures:
        raise LumigraphError(
            f"{folder} is a recording of Stray Scanner, whose pictures are in its film; write frames of it, with the "
            f"recorded poses and depth: lumigraph capture {folder}"
        )
    path = folder / STRAY_FILES[1]
    with reading(path, "holds no 3x3 matrix", "export it again"):
        k = np.array([line.split(",") for line in read_text(path).split()], np.float64).reshape(3, 3)
    lens, shots = Pinhole(torch.tensor([[k[0, 0], k[1, 1]]]).float(), torch.tensor([[k[0, 2], k[1, 2]]]).float()), []
    for number, (*place, qx, qy, qz, qw) in stray_path(folder).items():
        if number in pictures:
            rotation = to_matrix(torch.tensor([[qw, qx, qy, qz]], dtype=torch.float64))[0].numpy()
            pose = np.concatenate([rotation, np.array(place)[:, None]], 1)
            files = {kind: find_measured(folder / kind, number) for kind in ("depth", "confidence")}
            planes = beside_picture(files["depth"], files["confidence"])
            size = measure(pictures[number])[0]
            shots.append(Shot(f"rgb/{number:06}", pose, lens, size, {1: pictures[number]}, planes=planes))
    return Capture(str(folder), shots, up=UP, metric=True)


def find_measured(folder: Path, number: int) -> Path | None:
    return next((x for suffix in (".png", ".npy") if (x := folder / f"{number:06}{suffix}").is_file()), None)


def sure_planes(
    depth: Callable[[], np.ndarray], confidence: Callable[[], np.ndarray], identity: str, scale: float, kind: Any
) -> dict[str, PixelPlane]:
    """Depth without the pixels of confidence 0, and its standard deviation."""
    kinds = {"depth": (TRUSTED, np.dtype(kind)), "depth_deviation": (DEVIATIONS, np.dtype(np.float32))}
    return {
        name: PixelPlane(
            partial(by_confidence, depth, confidence, shares), "z-depth", scale, (0,), dtype=dtype,
            identity=f"{identity} {name}",
        )
        for name, (shares, dtype) in kinds.items()
    }  # fmt: skip


def by_confidence(
    depth: Callable[[], np.ndarray], confidence: Callable[[], np.ndarray], shares: tuple[float, ...]
) -> np.ndarray:
    """Depth times a factor for each confidence: 0 to 2 as ARKit has it, or grey levels up to 255 as Polycam."""
    found, sure = depth(), confidence()
    if sure.shape != found.shape:
        raise LumigraphError(f"Depth is {found.shape} and its confidence {sure.shape} pixels large; export both again")
    return found * np.array(shares)[np.digitize(sure, (1, 2 if sure.max() <= 2 else 255))]


def file_numbers(path: Path) -> np.ndarray:
    with readable(path):
        return read_numbers(path, "depth" if path.parent.name == "depth" else "")


def beside_picture(depth: Path | None, confidence: Path | None) -> dict[str, PixelPlane]:
    """Depth in millimetres and confidence of two files, where they exist."""
    if depth is None or not depth.is_file():
        return {}
    if confidence is None or not confidence.is_file():
        return {"depth": PixelPlane(depth, "z-depth", MILLIMETRES, unknown=(0,))}
    identity = f"{depth.resolve()} {stat(depth)} {stat(confidence)}"
    return sure_planes(
        partial(file_numbers, depth), partial(file_numbers, confidence), identity, MILLIMETRES, np.uint16
    )


def opencv(pose: np.ndarray) -> np.ndarray:
    return np.concatenate([pose[:, :3] @ OPENCV, pose[:, 3:]], 1)


def read_polycam(folder: Path) -> Capture:
    """Polycam's optimised poses with their pictures, if there are any, else the original ones."""
    frames = folder / "keyframes"
    corrected = "corrected_" if (frames / "corrected_cameras").is_dir() else ""
    shots, missing = [], []
    for path in sorted((frames / f"{corrected}cameras").glob("*.json"), key=lambda path: natural(path.name)):
        said, picture = read_json(path, PolycamCamera), find_file(frames / f"{corrected}images" / path.stem)
        if not picture.is_file():
            missing.append(f"keyframes/{corrected}images/{path.stem}")
            continue
        lens = Pinhole(torch.tensor([[said.fx, said.fy]]), torch.tensor([[said.cx, said.cy]]))
        planes = beside_picture(*(frames / kind / f"{path.stem}.png" for kind in ("depth", "confidence")))
        size = said.size
        if size is None and is_file(
            first := frames / "cameras" / path.name
        ):  # present Polycam leaves it out of the others
            size = read_json(first, PolycamCamera).size
        shots.append(Shot(path.stem, opencv(said.pose), lens, size, {1: picture}, planes=planes))
    return Capture(str(folder), shots, missing=missing, up=UP, metric=True)


def read_record3d(folder: Path) -> Capture:
    path = folder / "metadata.json"
    said = read_json(path, Record3DMetadata)
    if len(said.K) != 9 or any(len(pose) != 7 for pose in said.poses):
        raise LumigraphError(f"{path} has a camera of other than 9 numbers or a pose of other than 7; export it again")
    own, shots, missing = said.perFrameIntrinsicCoeffs, [], []
    for i, (qx, qy, qz, qw, *place) in enumerate(said.poses):
        picture, depth = find_file(folder / "rgbd" / f"{i}"), folder / "rgbd" / f"{i}.depth"
        if not picture.is_file():
            missing.append(f"rgbd/{i}")
            continue
        fx, fy, cx, cy = (said.K[0], said.K[4], said.K[6], said.K[7]) if own is None or i >= len(own) else own[i]
        rotation = to_matrix(torch.tensor([[qw, qx, qy, qz]], dtype=torch.float64))[0].numpy()
        pose = opencv(np.concatenate([rotation, np.array(place)[:, None]], 1))
        lens = Pinhole(torch.tensor([[fx, fy]]), torch.tensor([[cx, cy]]))
        shape, sure = (said.dh, said.dw), depth.with_suffix(".conf")
        values = partial(unpacked, depth, shape, np.float32)
        about = str(depth), 1.0, np.dtype(np.float32)
        plane = PixelPlane(values, "z-depth", unknown=(0.0,), dtype=about[2], identity=about[0])
        planes = {"depth": plane} if depth.is_file() else {}
        if planes and sure.is_file():
            planes = sure_planes(values, partial(unpacked, sure, shape, np.uint8), *about)
        shots.append(Shot(f"rgbd/{i}", pose, lens, (said.w, said.h), {1: picture}, planes=planes))
    return Capture(str(folder), shots, missing=missing, up=UP, metric=True)


def unpacked(path: Path, shape: tuple[int, int], kind: Any) -> np.ndarray:
    """Depth or confidence of a Record3D file. Raises LumigraphError without the LZFSE library, or for another size."""
    try:
        import liblzfse
    except ImportError as fault:
        raise LumigraphError(
            f"{path} is compressed by LZFSE; install what unpacks it: pip install 'lumigraph[record3d]'"
        ) from fault
    height, width = shape
    with reading(path, f"holds no {width}x{height} numbers", "export it again"):
        return np.frombuffer(liblzfse.decompress(read_bytes(path)), kind).reshape(shape)
