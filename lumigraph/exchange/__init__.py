"""File formats of other programs: clouds of Gaussians, octrees, atlases; and packing, compressed tensors."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ..errors import LumigraphError, LumigraphWarning
from ..files import claim, claim_folder, exists, expanded, is_file, read_json, write_bytes, write_json
from ..files.marks import is_ours
from ..files.names import counted, natural
from ..files.partials import remove
from ..files.ply import read_header
from ..files.reading import reading, reads
from ..gaussians import Gaussians
from ..gaussians.cloud import as_precise_as_needed
from ..gaussians.moving import MovingGaussians
from ..system.memory import free_memory
from ..system.progress import counting
from . import compressed_ply, fourdgs, glb, moving_ply, ply, sog, splat, spz, streamed_sog, usd
from .checks import checked, without_unsound

WRITERS: dict[str, Callable[..., None]] = {
    ".compressed.ply": compressed_ply.write,
    ".ply": ply.write,
    ".splat": splat.write,
    ".spz": spz.write,
    ".sog": sog.write,
    ".glb": glb.write,
    **dict.fromkeys(usd.SUFFIXES, usd.write),
}
READERS = {".splat": splat.read, ".spz": spz.read, ".sog": sog.read, ".glb": glb.read}  # and two kinds of .ply
SUFFIXES = tuple(name for name in WRITERS if name not in usd.SUFFIXES)  # that are read as well
PLACED = (".glb", *usd.SUFFIXES)  # formats with a place of their own for an offset
FOLDERS = {streamed_sog.META: streamed_sog, sog.META: sog}  # by the name of their index
TRAINED = "point_cloud/iteration_*/point_cloud.ply"
SURFACES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")  # of files that may hold meshes
OFFSET = "offset.json"  # beside a file, or in a folder
REORDERED = ".compressed.ply", ".sog"  # formats that keep the set of Gaussians and not their order


def read_gaussians(path: Path | str) -> Gaussians:
    """Read the Gaussians in a file of one of SUFFIXES, or a folder of FOLDERS, on the CPU, in the axes of PLY files;
    for a streamed SOG the finest level.

    The header of a PLY file determines which of two layouts it has. Infinite logits of opacity become ±20. Gaussians
    with other numbers that are not finite, or without a rotation, are left out with a warning. Raises LumigraphError
    for what is no cloud.
    """
    path = place_of(expanded(path))
    layout = layout_of(path)
    suffix = "" if layout else check_ending(path)
    if suffix in usd.SUFFIXES:
        raise LumigraphError(f"{path} is OpenUSD, which is written and not read; read what it was made of")
    with reading(path, "is truncated or damaged", "copy or download it again"):
        if not layout:
            _check_file(path)
        with counting(f"Reading {path.name}"):
            if layout:
                gaussians = FOLDERS[layout].read(path)
            elif suffix in READERS:
                gaussians = READERS[suffix](path)
            else:
                header = read_header(path)
                gaussians = (compressed_ply if compressed_ply.recognises(header) else ply).read(path, header)
    gaussians = without_unsound(gaussians, path)[0]
    if is_file(beside := offset_file(path)):
        offset = torch.tensor(read_json(beside, Offset).offset, dtype=torch.float64)
        means = as_precise_as_needed(gaussians.means.double() + offset, gaussians.log_scales)
        gaussians = replace(gaussians, means=means)
    return gaussians


def is_moving(path: Path | str) -> bool:
    """True if `read_moving` accepts a path: .4dgs, existing or not; Spacetime Gaussians; numbered clouds."""
    path = expanded(path)
    return fourdgs.is_moving_file(path) or moving_ply.has_motion(path) or moving_ply.is_sequence(path)


@reads()
def read_moving(path: Path | str) -> MovingGaussians:
    """The moving cloud of a file or a folder. Raises LumigraphError for what it does not hold whole."""
    path = expanded(path)
    if fourdgs.is_moving_file(path):
        return fourdgs.read_moving(path)
    with counting(f"Reading {path.name}"):
        return moving_ply.read_sequence(path) if path.is_dir() else moving_ply.read_spacetime(path)


def write_gaussians(
    path: Path | str, gaussians: Gaussians, detail: streamed_sog.Detail | None = None, spz_version: int = 4
) -> None:
    """Write a cloud in the format of the suffix, atomically; to FOLDER/meta.json, a folder of SOG; to
    FOLDER/lod-meta.json, a streamed one, with the levels of `detail`. spz_version: 3 or 4

    `.ply` is lossless; docstrings of the others give their rounding. REORDERED formats keep the set of Gaussians and
    not their order, `.splat` neither harmonics beyond degree 0 nor `antialiased`. Raises LumigraphError for a suffix
    not in SUFFIXES, an invalid cloud, and a file that cannot be written.
    """
    path = expanded(path)
    ending = check_ending(path)
    claim_splats(path)
    sound = checked(gaussians, f"what is to be written to {path}", "remove them first")
    offset = None
    if sound.means.dtype == torch.float64 and ending != ".ply":
        offset = sound.means.detach().median(0).values.round()
        sound = replace(sound, means=(sound.means - offset).float())
    with counting(f"Writing {path.name}"):
        if path.name == streamed_sog.META:
            streamed_sog.write(path, sound, detail)
        elif ending == ".spz" and spz_version == 3:
            write_bytes(path, spz.gzipped(sound), "splats")
        elif ending in PLACED and offset is not None:
            WRITERS[ending](path, sound, offset.numpy())
        else:
            WRITERS[ending](path, sound)
    write_offset(path, None if offset is None or ending in PLACED else offset.tolist())


@dataclass(frozen=True)
class Offset:
    """Offset to add to the centres of a file, whose numbers are too coarse for them, in its units."""

    offset: tuple[float, float, float]


def offset_file(path: Path) -> Path:
    """The file that holds the offset of a file of Gaussians, or of a folder of them."""
    folder = path.parent if path.name in FOLDERS else path
    return folder / OFFSET if folder.is_dir() else path.with_name(f"{path.name}.{OFFSET}")


def write_offset(path: Path, offset: list[float] | None) -> None:
    """Write the offset of a new file beside it, or remove that of the file before it. Warns of what is beside."""
    beside = offset_file(path)
    if offset is not None:
        write_json(beside, {"offset": offset}, "splats")
        text = (
            f"{path} holds centres relative to {', '.join(f'{x:.0f}' for x in offset)}, for its numbers are too coarse "
        )
        warnings.warn(f"{text}so far from the origin; {beside.name} has that offset", LumigraphWarning, stacklevel=3)
    elif is_file(beside) and is_ours(beside, "splats"):
        remove(beside)


def claim_splats(path: Path, overwrite: bool | None = None, reads: Iterable[Path] = ()) -> None:
    """`files.claim` for a file of Gaussians, or for the whole folder of a path in one of FOLDERS."""
    if path.name not in FOLDERS:
        claim(path, "splats", overwrite, reads)
    elif any(exists(one) and exists(path) and place_of(one).samefile(path.parent) for one in reads):
        raise LumigraphError(f"{path.parent} would be replaced, and is what the command reads; choose another name")
    else:
        claim_folder(path.parent, "splats")


def is_splat_file(path: Path | str) -> bool:
    """True if `read_gaussians` accepts a path, by its name, existing or not. A .glb of meshes is no splat file; a
    folder is one if it has SOG, streamed or not."""
    path = place_of(expanded(path))
    if path.is_dir():
        return layout_of(path) is not None
    if path.name.lower().endswith(".glb") and path.is_file():
        with reading(path):
            return glb.recognises(path)
    return path.name.lower().endswith(SUFFIXES) and not moving_ply.has_motion(path)


def holds_points(path: Path | str) -> bool:
    """True for a .ply of points or triangles, which names no property of Gaussians."""
    path = expanded(path)
    if not (path.name.lower().endswith(".ply") and path.is_file()):
        return False
    here = {name for names in read_header(path).properties.values() for name in names}
    return not here & {*ply.COLOUR, *ply.OPACITY, *ply.SCALE, *ply.ROTATION, "packed_position"}


def refuse_several(folder: Path) -> None:
    """Raise LumigraphError for a folder that holds files of Gaussians and no other meshes or points."""
    found = sorted(folder.iterdir(), key=lambda file: natural(file.name)) if folder.is_dir() else []
    splats = [file for file in found if file.is_file() and is_splat_file(file) and not holds_points(file)]
    if splats and not any(file.suffix.lower() in SURFACES for file in {*found} - {*splats}):
        raise LumigraphError(
            f"{folder} holds {counted(len(splats), 'file')} of Gaussians, such as {splats[0].name}; name one, or "
            "several in `lumigraph compose`; frames of a moving cloud are numbered .ply files alone"
        )


def names_splats(path: Path | str) -> bool:
    """True if `write_gaussians` accepts a name, independent of existing files."""
    path = expanded(path)
    return path.name in FOLDERS or (path.name.lower().endswith(tuple(WRITERS)) and not path.is_dir())


def place_of(path: Path) -> Path:
    """Folder of SOG for a path to its meta.json or lod-meta.json; the last cloud in the output folder of 3D Gaussian
    splatting's own program; any other path unchanged."""
    if path.is_dir() and (made := sorted(path.glob(TRAINED), key=lambda one: natural(one.parent.name))):
        return made[-1]
    layout = FOLDERS.get(path.name)
    return path.parent if layout and (layout.recognises(path.parent) or not exists(path)) else path


def layout_of(folder: Path) -> str | None:
    """Entry of FOLDERS that a folder matches; `None` for any other, and for a file."""
    return next((name for name, layout in FOLDERS.items() if folder.is_dir() and layout.recognises(folder)), None)


def size_of(path: Path | str) -> int:
    """Bytes of a file of Gaussians, or of all files of a folder such as SOG, which may change meanwhile."""
    place, total = place_of(expanded(path)), 0
    inner = (Path(folder, name) for folder, _, names in os.walk(place) for name in names)
    for file in [place] if place.is_file() else inner:
        with suppress(OSError):
            total += file.stat().st_size
    return total


def check_ending(path: Path) -> str:
    """Suffix of a name, one of SUFFIXES. Raises LumigraphError for any other."""
    if path.name in FOLDERS:
        return ".sog"
    for suffix in WRITERS:
        if path.name.lower().endswith(suffix):
            return suffix
    raise LumigraphError(f"{path} does not end like a file of Gaussians; name one that ends in {', '.join(SUFFIXES)}")


def _check_file(path: Path) -> None:
    if exists(path) and not path.is_file():
        what = "a folder" if path.is_dir() else "no ordinary file"
        raise LumigraphError(f"{path} is {what}; name a file that ends in {', '.join(SUFFIXES)}")
    if path.stat().st_size == 0:
        raise LumigraphError(f"{path} is empty; copy or download it again")
    if path.stat().st_size > free_memory():
        raise LumigraphError(f"{path} is larger than the memory that is free; take a larger machine")
