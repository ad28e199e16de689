"""Recordings of a depth camera without poses, for `lumigraph track`: a folder of colours and one of depth.

Pictures are paired by name, by times in their names, or by order. Depth is along the optical axis, registered to the
colours, 16 bits in millimetres, or 5000 to a metre where rgb.txt is (TUM's benchmark). The camera is in camera.txt: fx
fy cx cy, and the numbers of depth to a metre if they are others; or in a file of ScanNet, Open3D, RealSense or TUM.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ..camera.lens import Lens
from ..errors import LumigraphError
from ..files import is_file, read_json, read_text
from ..files.names import natural
from ..files.reading import reading
from . import tum
from .capture import Capture, PixelPlane, Shot
from .nice_slam import pinhole
from .pictures import list_images, measure, stem

EXPECTED_FILES = {"a recording without poses, for `lumigraph track`": ("color/ or rgb/", "depth/")}
COLOURS, DEPTHS = ("color", "colour", "rgb", "image", "images"), ("depth", "depths", "depth_images")
MATRICES = (
    "intrinsic/intrinsic_color.txt", "intrinsic_color.txt", "camera-intrinsics.txt", "intrinsics.txt", "intrinsic.txt",
    "K.txt", "cam_K.txt", "camera_matrix.csv",
)  # fmt: skip
RECORDS = "camera_intrinsic.json", "intrinsic.json", "intrinsics.json", "cam_params.json"
PER_METRE = 1000.0


def recognises(folder: Path) -> bool:
    return bool(pairs(folder))


def pairs(folder: Path) -> dict[Path, Path]:
    """Depth of each colour picture, in order. Raises LumigraphError for pictures that cannot be paired."""
    here = list_images(folder) if any(folder.glob("*.depth.*")) else []
    if here:
        names = {kind: [x for x in here if stem(x).endswith(f".{kind}")] for kind in ("color", "depth")}
        places = dict.fromkeys(names, folder)
    else:
        found = [next((folder / x for x in some if (folder / x).is_dir()), None) for some in (COLOURS, DEPTHS)]
        if found[0] is None or found[1] is None:
            return {}
        places = {"color": found[0], "depth": found[1]}
        names = {kind: sorted(list_images(place), key=natural) for kind, place in places.items()}
    colours, depths = (names[kind] for kind in ("color", "depth"))
    if not colours or not depths:
        return {}
    by_stem = {stem(x).removesuffix(".depth"): x for x in depths}
    if not any(stem(x).removesuffix(".color") in by_stem for x in colours):
        by_stem = by_time(colours, depths)
    both = {
        places["color"] / x: places["depth"] / by_stem[k]
        for x in colours
        if (k := stem(x).removesuffix(".color")) in by_stem
    }
    if not both:
        raise LumigraphError(
            f"{folder} has {len(colours)} pictures and {len(depths)} of depth, whose names do not belong together; "
            "give both of a frame one name"
        )
    return both


def by_time(colours: list[str], depths: list[str]) -> dict[str, str]:
    """Depth by the stem of its picture: of the nearest time, where the names are times, else in the same order."""
    try:
        times, others = (np.array([float(stem(x)) for x in some]) for some in (colours, depths))
    except ValueError:
        return dict(zip(map(stem, colours), depths, strict=True)) if len(colours) == len(depths) else {}
    nearest = {stem(x): tum.nearest(others, time) for x, time in zip(colours, times.tolist(), strict=True)}
    return {x: depths[i] for x, i in nearest.items() if i is not None}


def read(folder: Path) -> Capture:
    """The recording in a folder, all with one pose. Raises LumigraphError without a camera."""
    both, shots = pairs(folder), []
    size = measure(next(iter(both)))[0]
    lens, unit = camera_of(folder)
    for i, (picture, depth) in enumerate(both.items()):
        plane = PixelPlane(depth, "z-depth", 1 / unit, unknown=(0, 65535))
        name = picture.relative_to(folder).as_posix()
        shots.append(Shot(name, np.eye(3, 4), lens, size, {1: picture}, time=float(i), planes={"depth": plane}))
    return Capture(str(folder), shots, poseless=True, metric=True)


def camera_of(folder: Path) -> tuple[Lens, float]:
    """Lens of the colours, and numbers of depth to a metre. Raises LumigraphError without either."""
    unit = tum.DEPTH_PER_METRE if is_file(folder / "rgb.txt") else PER_METRE
    path = folder / "camera.txt"
    if is_file(path) and len(numbers := numbers_of(path)) in (4, 5):
        return pinhole(*numbers[:4]), float(numbers[4]) if len(numbers) == 5 else unit
    if is_file(path) or any(name in folder.resolve().name for name in tum.CAMERAS):
        return tum.read_lens(folder), unit
    for path in (folder / name for name in MATRICES if is_file(folder / name)):
        with reading(path, "holds no matrix of a camera, 3x3 or 4x4", "correct it"):
            side = {9: 3, 12: 4, 16: 4}[len(numbers := numbers_of(path))]
            return pinhole(*numbers.reshape(-1, side)[[0, 1, 0, 1], [0, 1, 2, 2]]), unit
    for path in (folder / name for name in RECORDS if is_file(folder / name)):
        with reading(path, "holds no camera that is known", "write camera.txt with fx fy cx cy"):
            said: dict[str, Any] = read_json(path)
            said = said.get("camera", said)
            unit = float(said.get("scale", said.get("depth_scale", unit)))
            unit = 1 / unit if 0 < unit < 1 else unit  # RealSense gives metres of a unit
            if "intrinsic_matrix" in said:  # column after column
                return pinhole(*np.array(said["intrinsic_matrix"]).reshape(3, 3)[[0, 1, 2, 2], [0, 1, 0, 1]]), unit
            cx, cy = (said[name if name in said else other] for name, other in (("cx", "ppx"), ("cy", "ppy")))
            return pinhole(said["fx"], said["fy"], cx, cy), unit
    raise LumigraphError(
        f"{folder} has colours and depth and does not say its camera: looked for camera.txt, {', '.join(MATRICES)} and "
        f"{', '.join(RECORDS)}; write {folder / 'camera.txt'} with fx fy cx cy in pixels, and behind them the "
        f"units of depth to a metre, if these are not 1000; then find its poses: lumigraph track splat-slam {folder}"
    )


def numbers_of(path: Path) -> np.ndarray:
    with reading(path, "holds something besides numbers", "write fx fy cx cy, or a matrix of 3x3"):
        return np.array(re.split(r"[,;\s]+", read_text(path).strip()), np.float64)
