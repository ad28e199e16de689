"""A scene's folder: photographs, COLMAP's model and transforms.json, in other programs' layout."""

import os
import shutil
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..errors import LumigraphError
from ..files import claim as claim_file
from ..files import claim_folder, read_json, refuse_links, remove, replacing, replacing_folder, write_json
from ..files.marks import is_ours
from ..files.ply import write_rows
from ..readers.masks import MASKS as MASKS
from ..readers.pictures import list_images, read_grey
from ..readers.raw import RAW_FILE
from ..readers.transforms import OPENCV_FROM_OPENGL, Made
from ..readers.transforms import RESULT_FILE as RESULT_FILE
from ..system.library import pycolmap
from .photos import Photo
from .photos.photo import Track

WORK_FOLDER = "work"
SOURCES_FILE = "sources.json"  # inside WORK_FOLDER: the sources of the folder
POINTS_FILE = "points.ply"
DRAWING_FILES = "capture.png", "photographs.png"
PANORAMA_FILE = "panorama.jpg"  # of photographs from one place, which are no scene
WRITTEN_FILES = (RESULT_FILE, "transforms.json", POINTS_FILE, RAW_FILE, PANORAMA_FILE, *DRAWING_FILES)

# COLMAP's parameters by the names that transforms.json has for them.
NAMES = {"SIMPLE_RADIAL": ("fl_x", "cx", "cy", "k1"), "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")}


def claim(folder: Path, sources: Sequence[Path]) -> Path:
    """Create or recognise the folder of these photographs' scene. Returns the working folder. Raises LumigraphError for
    a folder with other contents."""
    work, wanted = folder / WORK_FOLDER, [str(path.resolve()) for path in sources]
    for path in sources:
        if (path / WORK_FOLDER / SOURCES_FILE).is_file():
            began = " ".join(read_json(path / WORK_FOLDER / SOURCES_FILE, list[str]))
            raise LumigraphError(
                f"{path} is an unfinished capture; go on with: lumigraph capture {began} --output {path}"
            )
    if any(path.resolve() == folder.resolve() for path in sources):
        raise LumigraphError(f"{folder} holds the photographs themselves; name another folder by --output")
    refuse_links(folder)
    if folder.is_dir() and any(folder.iterdir()):
        owner, result = work / SOURCES_FILE, folder / RESULT_FILE
        if owner.is_file():
            made_of = read_json(owner, list[str])
        elif result.is_file():
            made_of = read_json(result, Made).sources
        else:
            raise LumigraphError(f"{folder} exists and is no capture; name another folder by --output")
        if made_of != wanted:
            raise LumigraphError(
                f"{folder} was made from other photographs ({', '.join(made_of or ['unknown'])}); delete it, or name "
                f"another folder by --output"
            )
    # Beside a folder called sparse lie no bare photographs: so those of a scene that lies among them are passed over.
    (folder / "sparse").mkdir(parents=True, exist_ok=True)
    write_json(work / SOURCES_FILE, wanted, ours=True)
    return work


def claim_results(folder: Path) -> None:
    """Raise LumigraphError unless all results of a capture may be written into its folder."""
    for name in WRITTEN_FILES:
        claim_file(folder / name, "capture")
    claim_folder(folder / "sparse", "capture")


def copy_photographs(photos: Sequence[Photo], images: Path, track: Track) -> None:
    """Copy photographs with their dates; existing copies stay, obsolete copies are deleted."""
    remove_copies(images, {photo.name for photo in photos})
    for photo in track(photos, "Copying photographs", len(photos)):
        target = images / photo.name
        if not target.is_file() or stamp(target) != stamp(photo.path):
            with replacing(target, "capture") as partial:
                shutil.copy2(photo.path, partial)


def remove_copies(folder: Path, kept: Container[str]) -> None:
    """Delete an earlier capture's files in a folder, except names to keep and others' files."""
    for name in list_images(folder):
        if name not in kept and is_ours(folder / name, "capture"):
            remove(folder / name)


def copy_masks(photos: Sequence[Photo], masks: Path, track: Track) -> Path | None:
    """Write masks for COLMAP: image.jpg.png, black and white, of the photographs' size. None without masks.

    Raises LumigraphError for a mask of another aspect ratio than its photograph.
    """
    having = [photo for photo in photos if photo.mask is not None]
    if not having:
        return None
    remove_copies(masks, {f"{photo.name}.png" for photo in having})
    for photo in track(having, "Copying masks", len(having)):
        assert photo.mask is not None
        target = masks / f"{photo.name}.png"
        if target.is_file() and target.stat().st_mtime_ns == photo.mask.stat().st_mtime_ns:
            continue
        trusted = np.asarray(Image.fromarray(read_grey(photo.mask, photo.size, True)).resize(photo.size)) > 127
        with replacing(target, "capture") as partial:
            Image.fromarray(trusted).save(partial, "PNG")
            about = photo.mask.stat()
            os.utime(partial, ns=(about.st_atime_ns, about.st_mtime_ns))
    return masks


def stamp(path: Path) -> tuple[int, int]:
    """Modification time of a file in nanoseconds, and its size in bytes."""
    about = path.stat()
    return about.st_mtime_ns, about.st_size


def write_model(
    folder: Path, model: pycolmap.Reconstruction, photos: Sequence[Photo], z_up: bool, moving: bool = False
) -> None:
    """Write sparse/0, points.ply and transforms.json, all in the model's frame; frames in the order of `photos`.

    z_up:   whether +z is reliably up, not only by camera orientations
    moving: whether to write times of frames, in seconds from the first on
    """
    with replacing_folder(folder / "sparse", "capture") as partial:
        (partial / "0").mkdir(parents=True)
        model.write(partial / "0")
    write_points(folder / POINTS_FILE, model)
    by_name = {image.name: image for image in model.images.values() if image.has_pose}
    up = {"up": [0.0, 0.0, 1.0]} if z_up else {}
    placed = [p for p in photos if p.name in by_name]
    made = up | transforms(model, [by_name[p.name] for p in placed])
    if moving:
        first = min(p.time or 0.0 for p in placed)
        for frame, photo in zip(made["frames"], placed, strict=True):
            frame["time"] = (photo.time or 0.0) - first
    write_json(folder / "transforms.json", made, "capture")


def transforms(model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image]) -> dict[str, Any]:
    """Contents of transforms.json: the lens once if all frames share it, otherwise with each frame."""
    shared = len({image.camera_id for image in images}) == 1
    frames = []
    for image in images:
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        pose[:3, :3] *= OPENCV_FROM_OPENGL
        own = {} if shared else lens(model.cameras[image.camera_id])
        frames.append({"file_path": f"images/{image.name}", **own, "transform_matrix": pose.tolist()})
    common = lens(model.cameras[images[0].camera_id]) if shared else {"camera_model": "OPENCV"}
    return {**common, "ply_file_path": POINTS_FILE, "frames": frames}


def lens(camera: pycolmap.Camera) -> dict[str, Any]:
    numbers = dict(zip(NAMES[camera.model.name], camera.params.tolist(), strict=True))
    numbers.setdefault("fl_y", numbers["fl_x"])
    return {"camera_model": "OPENCV", "w": camera.width, "h": camera.height, **numbers}


def write_points(path: Path, model: pycolmap.Reconstruction) -> None:
    """Positions, colours, and how many photographs show each point."""
    points = list(model.points3D.values())
    kinds = [(k, "f4") for k in "xyz"] + [(k, "u1") for k in ("red", "green", "blue")] + [("sightings", "i4")]
    rows = np.array([(*p.xyz, *p.color, p.track.length()) for p in points], kinds)
    write_rows(path, "capture", {"vertex": rows})
