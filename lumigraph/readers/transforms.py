"""transforms.json, as instant-ngp and nerfstudio write it: one file with a pose, and maybe a lens, for each photograph.

Its cameras look along -z with +y up (OpenGL). Published splits are nerfstudio's train_filenames, test_filenames and
val_filenames.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from ..camera.lens import Equirectangular, Fisheye, Lens, OpenCV, Pinhole, ThinPrism
from ..datasets.scene import GeographicOrigin
from ..errors import LumigraphError, LumigraphWarning
from ..files import from_json, is_file, read_bytes, read_json
from ..files.names import counted
from ..files.ranges import Coordinate, Name, Point, Positive, Row, between, typed
from ..files.reading import reading, reads
from . import colmap
from .capture import Capture, PixelPlane, Shot
from .finding import find_named, paired
from .pictures import reductions, upright_size, versions
from .points import SparsePoints, read_ply, similarity

RESULT_FILE = "capture.json"  # of a folder that `lumigraph capture` made
EXPECTED_FILES = {"instant-ngp, nerfstudio": ("transforms.json",)}
OPENCV_FROM_OPENGL = np.array([1.0, -1.0, -1.0])  # signs of the camera's axes
NGP_SCALE = 0.33  # instant-ngp's unit cube is 1 / 0.33 of the file's units wide
LAST_ROW_TOLERANCE = 1e-3  # of a pose's last row
MAX_FACT_NUMBERS = 10_000  # numbers per fact of one photograph

# Of a layer, what a frame may call its file: nerfstudio's name or instant-ngp's, and what annotated captures say.
PLANES = {
    "depth": ("depth_file_path", "depth_path"),
    "labels": ("labels_file_path", "semantics_path"),
    "normals": ("normals_file_path",),
}
WITHOUT_EFFECT = (  # keys of other programs that describe how the file was made, or concern their training
    "aabb", "applied_scale", "applied_transform", "auto_scale_poses_override", "colmap_im_id", "enable_depth_loading",
    "from_na", "integer_id", "n_extra_learnable_dims", "n_frames", "offset", "orientation_override", "render_aabb",
    "sharpness", "white_transparent", "black_transparent", "mask_color", "fix_premult", "is_hdr", "train_file_names",
)  # fmt: skip
POINTS_BESIDE = "sparse_pc.ply", "points3D.ply", "init.ply"  # nerfstudio's and Brush's, in the frame of the poses
FACTS = ("exposure", "boxes", "body")  # of a photograph
BLENDER_EMPTY_DEPTHS = (1e10, 65504.0)  # depth that Blender writes for background pixels, in floats and in halves

WITHOUT_BENDS = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
WITH_BENDS = ("OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL")
FISHEYES = ("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE")
LARGEST_RADIUS, BEYOND = 4.0, 1.05  # where a lens is fitted, at most; and times the radius of the picture's corner
RIDGE = 1e-10  # singular values that count as none, of the largest

NO_NUMBER = re.compile(rb"(?<=[\[,:\s])-?(?:NaN|Infinity)\b")  # as Python writes them, and JSON has none
Json = dict[str, Any]
Across = Annotated[float, between(1, 1e5)]  # pixels
Focal = Annotated[float, between(1e-2, 1e7)]  # pixels
Centre = Annotated[float, between(-1e7, 1e7)]  # pixels
Bend = Annotated[float, between(-1e4, 1e4)]
Degrees = Annotated[float, between(1e-4, 179.9)]
Angle = Annotated[float, between(1e-6, 3.14159)]  # radians


@dataclass(frozen=True)
class Whole:
    """Fields of a file besides lenses. Paths may lead anywhere: many captures name ../images, some absolute paths."""

    frames: list[Json]
    aabb_scale: Positive | None = None
    scale: Positive = NGP_SCALE
    up: Point | None = None
    ply_file_path: Name | None = None
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None


@dataclass(frozen=True)
class GpsRecord:
    """Field `gps` of capture.json: whether the axes point east, north and up, in metres, and their origin."""

    used: bool = False
    origin: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Made:
    """Fields of capture.json: source of a scene, method of its creation, warnings, photographs without a pose with the
    reason, and its position on Earth."""

    sources: list[str] = field(default_factory=list)
    key: str = ""
    warnings: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    gps: GpsRecord | None = None

    @property
    def origin(self) -> GeographicOrigin | None:
        """Origin of the frame on Earth, if GPS has determined it."""
        if self.gps is None or not self.gps.used or self.gps.origin is None:
            return None
        return GeographicOrigin(*self.gps.origin)


@dataclass(frozen=True)
class Posed:
    """A frame, with the file's fields for all frames as defaults."""

    file_path: Name
    transform_matrix: list[Row]
    w: Across | None = None
    h: Across | None = None
    camera_model: str = "OPENCV"
    is_fisheye: bool | float | None = None
    fl_x: Focal | None = None
    fl_y: Focal | None = None
    intrinsic_matrix: list[Row] | None = None
    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
    x_fov: Degrees | None = None
    y_fov: Degrees | None = None
    fisheye_crop_radius: Across | None = None
    rolling_shutter: list[Coordinate] | None = None
    cx: Centre | None = None
    cy: Centre | None = None
    k1: Bend | None = None
    k2: Bend | None = None
    k3: Bend | None = None
    k4: Bend | None = None
    k5: Bend | None = None
    k6: Bend | None = None
    p1: Bend | None = None
    p2: Bend | None = None
    sx1: Bend | None = None
    sy1: Bend | None = None
    time: Coordinate | None = None
    mask_path: Name | None = None
    depth_file_path: Name | None = None
    depth_path: Name | None = None
    labels_file_path: Name | None = None
    semantics_path: Name | None = None
    normals_file_path: Name | None = None
    depth_unit_scale_factor: Positive | None = None
    integer_depth_scale: Positive | None = None
    is_euclidean_depth: bool | float | None = None


def recognises(folder: Path) -> bool:
    return (folder / "transforms.json").is_file()


@reads()
def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError for malformed JSON, unusable poses, and unknown lenses."""
    path = folder / "transforms.json"
    whole, plain = read_frames_file(path)
    splits = published_splits(whole)
    shots, missing = read_shots(path, plain)
    shots, notes = once_each(shots, path)
    if splits:
        shots = [replace(shot, split=splits[shot.name]) for shot in shots if shot.name in splits]
        missing = [name for name in missing if name in splits]
    points = find_points(folder, whole, shots, missing)
    reach = None
    if points is None and whole.aabb_scale is not None:
        reach = 0.5 * whole.aabb_scale / whole.scale
    if whole.up is not None and not any(whole.up):
        raise LumigraphError(f'{path}: "up" points nowhere; correct it or remove it')
    cloud = {} if points is None else vars(points)
    made = read_json(folder / RESULT_FILE, Made) if (folder / RESULT_FILE).is_file() else Made()
    notes += [f"{folder}: {warning}" for warning in made.warnings if "folded" in warning] + about_dialect(path, plain)
    return Capture(
        str(folder), shots, missing=missing, reach=reach, up=whole.up, origin=made.origin, notes=notes, **cloud
    )


def once_each(shots: list[Shot], path: Path) -> tuple[list[Shot], list[str]]:
    """The first frame of each file and moment, and a sentence on further ones."""
    first: dict[tuple[str, float | None], Shot] = {}
    for shot in shots:
        first.setdefault((str(shot.image), shot.time), shot)
    if not (more := len(shots) - len(first)):
        return shots, []
    double = next(a for a, b in zip(shots, [*first.values(), None], strict=False) if a is not b)
    moved = any((shot.pose != first[str(shot.image), shot.time].pose).any() for shot in shots)
    text = f"{path} lists {counted(more, 'photograph')} more than once, such as {double.name}; each counts once"
    return [*first.values()], [text + (", with the first of its poses" if moved else "")]


def about_dialect(path: Path, plain: Json) -> list[str]:
    """Sentences on what a file says and is not used, or has a meaning of one program."""
    said = set(plain) | {key for frame in plain["frames"] for key in frame}
    known = {x.name for kind in (Whole, Posed) for x in fields(kind)} | {*FACTS, *WITHOUT_EFFECT}
    found = []
    if unknown := sorted(said - known):
        found.append(f"{path}: passed over: {', '.join(unknown)}")
    shared = {name: value for name, value in plain.items() if name != "frames"}
    frames = [
        typed(Posed, given(shared | frame), path) for frame in plain["frames"] if said & {"k4", "rolling_shutter"}
    ]
    if any(means_power(frame) for frame in frames):
        found.append(
            f"{path}: k4 without k5 and k6 is read as nerfstudio's, the coefficient of r^8; give all three for OpenCV's"
        )
    if any(any(frame.rolling_shutter or []) for frame in frames):
        found.append(f"{path}: the rolling shutter is not modelled, so each photograph has one pose")
    return found


def read_frames_file(path: Path) -> tuple[Whole, Json]:
    """Contents of a file: parsed fields of the whole file, and raw JSON."""
    plain = from_json(NO_NUMBER.sub(b"null", read_bytes(path)), path)
    typed(Whole, plain, path)
    placed = [frame for frame in plain["frames"] if not unplaced(frame.get("transform_matrix", 0))]
    if len(placed) < len(plain["frames"]):
        count = counted(len(plain["frames"]) - len(placed), "photograph")
        text = f"{path} has {count} whose pose is null or NaN, as programs write one that they lost; they are left out"
        warnings.warn(text, LumigraphWarning, stacklevel=2)
        plain["frames"] = placed
    return typed(Whole, plain, path), plain


def unplaced(matrix: Any) -> bool:
    """True for no matrix, and for one with a number that is none."""
    rows = matrix if isinstance(matrix, list) else []
    return matrix is None or any(x is None for row in rows for x in (row if isinstance(row, list) else [row]))


def read_shots(path: Path, whole: Json, split: str | None = None) -> tuple[list[Shot], list[str]]:
    """Photographs of a file that exist, and the names of missing ones.

    whole: raw JSON of the file. Its lens fields are defaults for every frame
    """
    folder, shots, missing = path.parent, [], []
    shared = {name: value for name, value in whole.items() if name != "frames"}
    said = [typed(Posed, given(shared | x), f"{path}: {called(x, i)}") for i, x in enumerate(whole["frames"])]
    names = [about.file_path for about in said]
    for name, frame, about, files in zip(names, whole["frames"], said, find_versions(folder, names), strict=True):
        if not files:
            missing.append(name)
            continue
        where = f"{path}: {called(frame)}"
        stated = None if about.w is None or about.h is None else (round(about.w), round(about.h))
        size = stated or upright_size(files)
        lens = read_lens(about, size, where)
        shots.append(
            Shot(
                name=name,
                pose=read_pose(about, where),
                lens=lens,
                size=size,
                image=files,
                mask=named_mask(folder, about.mask_path, missing) or within_circle(about, lens, size),
                split=split,
                time=about.time,
                planes=read_planes(folder, about, lens, missing),
                about={name: fact(frame[name], name, where) for name in FACTS if frame.get(name) is not None},
            )
        )
    return shots, missing


def named_mask(folder: Path, name: str | None, missing: list[str]) -> Path | None:
    """Mask of the name that a frame gives; a name of none is added to `missing`."""
    if not name or is_file(found := find_named(folder, name)):
        return found if name else None
    missing.append(name)
    return None


def given(fields_of_frame: Json) -> Json:
    """Fields without those that are null."""
    return {name: value for name, value in fields_of_frame.items() if value is not None}


def within_circle(about: Posed, lens: Lens, size: tuple[int, int]) -> np.ndarray | None:
    """Mask of the pixels in the circle that a fisheye's file gives; None without one."""
    if about.fisheye_crop_radius is None or not isinstance(lens, Fisheye | OpenCV | Pinhole):
        return None
    centres = lens.centre[0].tolist()
    x, y = (np.arange(pixels) + 0.5 - centre for pixels, centre in zip(size, centres, strict=True))
    return np.hypot(x, y[:, None]) <= about.fisheye_crop_radius


def called(frame: Json, number: int = 0) -> str:
    """A frame's display name."""
    return f"frame {frame.get('file_path', number)}"


def fact(value: Any, name: str, where: str) -> np.ndarray:
    """Value of a photograph: a number, or a small array of them. Raises LumigraphError for anything else."""
    with reading(where, f'has "{name}", which is no number and no array of them', "correct it"):
        numbers = np.asarray(value, np.float64)
    if numbers.size > MAX_FACT_NUMBERS:
        raise LumigraphError(f'{where} has "{name}" of {numbers.size} numbers; {MAX_FACT_NUMBERS} are the most')
    return numbers


def read_planes(folder: Path, about: Posed, lens: Lens, missing: list[str]) -> dict[str, PixelPlane]:
    """Depth, labels and normals of the files that a frame names; missing ones are added to `missing`."""
    found = {}
    for kind, keys in PLANES.items():
        key = next((key for key in keys if getattr(about, key) is not None), None)
        if key is None:
            continue
        name = getattr(about, key)
        file = find_named(folder, name)
        if not is_file(file):
            missing.append(name)
        elif kind == "depth":
            found[kind] = depth_plane(file, key, about, lens)
        else:
            found[kind] = PixelPlane(file, {"labels": "index", "normals": "direction"}[kind])
    return found


def depth_plane(file: Path, key: str, about: Posed, lens: Lens) -> PixelPlane:
    """Depth as nerfstudio stores it, thousandths of a unit by default, or as instant-ngp does."""
    stated = about.integer_depth_scale if key == "depth_path" else about.depth_unit_scale_factor
    scale = stated if stated is not None else 1.0 if file.suffix.lower() in (".exr", ".pfm") else 1e-3
    along_ray = isinstance(lens, Equirectangular) or bool(about.is_euclidean_depth)
    whole = file.suffix.lower() in (".png", ".tif", ".tiff")
    unknown, empty = ((0.0, 65535.0), ()) if whole else ((0.0,), BLENDER_EMPTY_DEPTHS)
    return PixelPlane(file, "distance" if along_ray else "z-depth", scale, unknown, empty)


def find_versions(folder: Path, names: list[str]) -> list[dict[int, Path]]:
    """Each photograph's own file, and reduced ones where it lies in `images` and there are images_2, images_4..."""
    files = [find_named(folder, name) for name in names]
    found = [{1: path} if is_file(path) else {} for path in files]
    inside = [i for i, path in enumerate(files) if path.parent == folder / "images"]
    for i, more in zip(inside, versions(reductions(folder / "images"), [files[i].name for i in inside]), strict=True):
        found[i] |= more
    return found


def read_pose(about: Posed, where: str) -> np.ndarray:
    if len(about.transform_matrix) not in (3, 4):
        raise LumigraphError(f"{where} has no 4x4 transform_matrix of numbers; correct it or remove the frame")
    if not np.allclose([*about.transform_matrix[3:], (0, 0, 0, 1)][0], (0, 0, 0, 1), atol=LAST_ROW_TOLERANCE):
        last = ", ".join(f"{x:.4g}" for x in about.transform_matrix[3])
        raise LumigraphError(
            f"{where} has a transform_matrix whose last row is {last}, not 0, 0, 0, 1; transpose it, or write it again"
        )
    pose = np.array(about.transform_matrix[:3], np.float64)
    pose[:, :3] *= OPENCV_FROM_OPENGL
    return pose


def read_lens(about: Posed, size: tuple[int, int], where: str) -> Lens:
    width, height = size
    model = model_of(about)
    if about.intrinsic_matrix is not None and about.fl_x is None:
        with reading(where, "has an intrinsic_matrix that is not 3x3 or more", "correct it"):
            (fx, _, cx), (_, fy, cy) = (line[:3] for line in about.intrinsic_matrix[:2])
        about = replace(about, fl_x=fx, fl_y=fy, cx=cx, cy=cy)
    if model in ("EQUIRECTANGULAR", "SPHERICAL"):
        return Equirectangular(row(width, height))
    if model not in (*WITHOUT_BENDS, *WITH_BENDS, *FISHEYES):
        known = ", ".join((*WITHOUT_BENDS[:2], *WITH_BENDS, *FISHEYES))
        raise LumigraphError(
            f"{where} has camera_model {model}; only {known} and EQUIRECTANGULAR are known, so undistort the "
            "photographs first"
        )
    radians = [None if angle is None else math.radians(angle) for angle in (about.x_fov, about.y_fov)]
    focal_x = about.fl_x or focal_from_angle(about.camera_angle_x or radians[0], width)
    if focal_x is None:
        raise LumigraphError(f'{where} has neither "fl_x" nor "camera_angle_x"; add the focal length in pixels')
    focal_y = about.fl_y or focal_from_angle(about.camera_angle_y or radians[1], height) or focal_x
    centre_x, centre_y = (half if x is None else x for x, half in ((about.cx, width / 2), (about.cy, height / 2)))
    focal, centre = row(focal_x, focal_y), row(centre_x, centre_y)
    if model == "OPENCV_FISHEYE":
        return Fisheye(focal, centre, row(*(getattr(about, f"k{i}") or 0.0 for i in (1, 2, 3, 4))))
    if model == "THIN_PRISM_FISHEYE":
        names = ("k1", "k2", "k3", "k4", "p1", "p2", "sx1", "sy1")
        return ThinPrism(focal, centre, row(*(getattr(about, name) or 0.0 for name in names)))
    bends = [getattr(about, key) or 0.0 for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    if model in WITHOUT_BENDS or not any(bends):
        return Pinhole(focal, centre)
    if means_power(about):
        corner = math.hypot(max(centre_x, width - centre_x) / focal_x, max(centre_y, height - centre_y) / focal_y)
        k1, k2, p1, p2, k3, k4, *_ = bends
        bends = [*rational([k1, k2, k3, k4], (p1, p2), corner)]
    return OpenCV(focal, centre, row(*bends))


def means_power(about: Posed) -> bool:
    """True where k4 is nerfstudio's, the coefficient of r^8, and not OpenCV's, of the denominator, which has three."""
    return bool(about.k4) and about.k5 is None and about.k6 is None and model_of(about) in ("OPENCV", "RADIAL")


def model_of(about: Posed) -> str:
    return "OPENCV_FISHEYE" if about.is_fisheye else about.camera_model.upper()


def rational(powers: Sequence[float], tangential: tuple[float, float], corner: float) -> tuple[float, ...]:
    """OpenCV's coefficients k1 k2 p1 p2 k3 k4 k5 k6 of a lens whose radial factor is 1 + k1 r^2 + ... + k4 r^8.

    corner: the largest radius on the picture, as bent
    """
    r = np.linspace(0, LARGEST_RADIUS, 4096)
    factor = np.polynomial.Polynomial([1, *powers])(r**2)
    beyond = np.flatnonzero((r * factor > BEYOND * corner) | (np.gradient(r * factor) <= 0))
    r, factor = (x[: max(beyond[0] if len(beyond) else len(r), 16)] for x in (r, factor))
    columns = [r**2, r**4, r**6, -factor * r**2, -factor * r**4, -factor * r**6]
    k1, k2, k3, k4, k5, k6 = np.linalg.lstsq(np.stack(columns, 1) * r[:, None], (factor - 1) * r, rcond=RIDGE)[0]
    return k1, k2, *tangential, k3, k4, k5, k6


def focal_from_angle(angle: float | None, pixels: int) -> float | None:
    return None if angle is None else 0.5 * pixels / math.tan(0.5 * angle)


def row(*numbers: float) -> torch.Tensor:
    return torch.tensor([numbers], dtype=torch.float32)


def published_splits(whole: Whole) -> dict[str, str]:
    """nerfstudio's lists of file names, as name to split."""
    lists = {"train": whole.train_filenames, "val": whole.val_filenames, "test": whole.test_filenames}
    if not any(lists.values()):
        return {}
    if not lists["test"]:
        lists["test"], lists["val"] = lists["val"], None
    return {name: split for split, names in lists.items() for name in names or []}


def find_points(folder: Path, whole: Whole, shots: list[Shot], missing: list[str]) -> SparsePoints | None:
    """The points a file names, else those of the photographs' COLMAP model, in this file's frame."""
    if (name := whole.ply_file_path) is not None:
        if is_file(found := find_named(folder, name)):
            return read_ply(found)
        missing.append(name)
    place = colmap.model_folder(folder)
    if place is None:
        beside = next(filter(is_file, (folder / x for x in POINTS_BESIDE)), None)
        return None if beside is None else read_ply(beside)
    positions = {shot.name: shot.pose[:, 3] for shot in shots}
    model = colmap.read_model(place)
    poses = colmap.poses_of(model)
    both = paired(positions, poses)
    matrix = similarity(np.array([poses[k][:, 3] for k in both.values()]), np.array([positions[k] for k in both]))
    if matrix is None:
        return None
    cloud = colmap.read_points(place, model)
    return replace(cloud, points=cloud.points @ matrix[:3, :3].T + matrix[:3, 3])
