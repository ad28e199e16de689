"""Pictures in rgb/, poses in pose/, a pinhole in intrinsics.txt: DeepVoxels, SRN and NSVF; NeRF++ has intrinsics/.

Poses are 4x4, camera-to-world, +z forward, in any number of lines. A pinhole is a matrix, or SRN's lines: f cx cy and a
number, then among others the height and width that they are for. NSVF's names begin with 0_ for training, 1_ for
validation and 2_ for tests; NeRF++ has folders of that meaning.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..camera.lens import Lens, Pinhole
from ..files import is_file, read_text
from ..files.names import natural
from ..files.reading import reading
from .capture import Capture, Shot
from .pictures import find_file, measure
from .seven_scenes import read_matrix
from .transforms import row

EXPECTED_FILES = {"SRN, NSVF, NeRF++": ("rgb/", "pose/*.txt", "intrinsics.txt or intrinsics/")}
PARTS = {".": None, "train": "train", "validation": "val", "val": "val", "test": "test"}
PREFIXES = {"0_": "train", "1_": "val", "2_": "test"}


def recognises(folder: Path) -> bool:
    return next(poses(folder), None) is not None


def poses(folder: Path) -> Iterator[tuple[Path, str | None]]:
    """Files of poses, and the split that their folder says."""
    for name, split in PARTS.items():
        part = folder / name
        if (part / "rgb").is_dir() and (is_file(part / "intrinsics.txt") or (part / "intrinsics").is_dir()):
            yield from ((path, split) for path in sorted((part / "pose").glob("*.txt"), key=lambda x: natural(x.name)))


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for files without a matrix."""
    found, shots, missing = list(poses(folder)), [], []
    prefixed = all(path.name[:2] in PREFIXES for path, _ in found)
    for path, split in found:
        part = path.parent.parent
        picture = find_file(part / "rgb" / path.stem)
        name = picture.relative_to(folder).as_posix()
        if not is_file(picture):
            missing.append(name)
            continue
        own = part / "intrinsics" / path.name
        lens, size = read_pinhole(own if is_file(own) else part / "intrinsics.txt")
        split = PREFIXES[path.name[:2]] if prefixed else split
        size = size or measure(picture)[0]
        shots.append(Shot(name, read_matrix(path, 4)[:3], lens, size, {1: picture}, split=split))
    box, bounds = folder / "bbox.txt", None
    if is_file(box):
        with reading(box, "holds no box, x y z of two corners", "correct or remove it"):
            x, y, z, right, bottom, far = np.array(read_text(box).split()[:6], np.float64).tolist()
            bounds = (x, y, z), (right, bottom, far)
    return Capture(str(folder), shots, missing=missing, bounds=bounds)


def read_pinhole(path: Path) -> tuple[Lens, tuple[int, int] | None]:
    """Lens of a file, and (width, height) of its pictures if it says that."""
    with reading(path, "holds neither a matrix of 4x4 or 3x3 nor f cx cy", "correct it"):
        lines = [np.array(line.split(), np.float64) for line in read_text(path).splitlines() if line.strip()]
        numbers = np.concatenate(lines)
        if len(lines[0]) in (3, 4) and len(lines) > len(lines[0]):  # SRN's; a matrix has as many lines as columns
            f, cx, cy = lines[0][:3]
            height, width = (int(x) for x in lines[-1])
            return Pinhole(row(f, f), row(cx, cy)), (width, height)
        if len(numbers) in (3, 4):
            return Pinhole(row(numbers[0], numbers[0]), row(*numbers[1:3])), None
        side = {9: 3, 16: 4}[len(numbers)]
        (fx, _, cx), (_, fy, cy) = numbers.reshape(side, side)[:2, :3]
        return Pinhole(row(fx, fy), row(cx, cy)), None
