"""Clouds of Gaussians as files that other programs know: one format, one file; the suffix says which."""

from __future__ import annotations

from pathlib import Path

from ..errors import LumigraphError
from ..files import claim, explained
from ..gaussians import Gaussians
from ..progress import counting
from . import compressed_ply, ply, splat, spz
from .checks import checked
from .ply_header import read_header

WRITERS = {".compressed.ply": compressed_ply.write, ".ply": ply.write, ".splat": splat.write, ".spz": spz.write}
SUFFIXES = tuple(WRITERS)


def read_gaussians(path: Path | str) -> Gaussians:
    """The Gaussians in a .ply, .compressed.ply, .splat or .spz file, on the CPU, in the axes that PLY files keep.

    Which of its two layouts a PLY file has, its header says. Infinite logits of opacity become ±20, rotations of
    length zero none at all. Raises LumigraphError for anything else that keeps the file from being a sound cloud.
    """
    path = Path(path).expanduser()
    suffix = check_ending(path)
    with explained(path):
        _refuse_folder(path)
        if path.stat().st_size == 0:
            raise LumigraphError(f"{path} is empty; copy or download it again")
        with counting(f"Reading {path.name}"):
            gaussians = _read(path, suffix)
    return checked(gaussians, str(path), "restore it from a copy, or remove them with an editor of splats")


def write_gaussians(path: Path | str, gaussians: Gaussians) -> None:
    """Write a cloud in the format that the suffix names, whole or not at all.

    `.ply` keeps every number as it is; what the others round is said in their files. `.compressed.ply` keeps the set of
    Gaussians and not their order, `.splat` neither harmonics beyond the plain colour nor `antialiased`. Raises
    LumigraphError where the suffix is none of SUFFIXES, the cloud is not sound or the disk refuses.
    """
    path = Path(path).expanduser()
    write = WRITERS[check_ending(path)]
    claim(path, "splats")
    with counting(f"Writing {path.name}"):
        write(path, checked(gaussians, f"what is to be written to {path}", "remove them first"))


def is_splat_file(path: Path | str) -> bool:
    """Whether a name is one that `read_gaussians` takes: known by its suffix, whether there or not, but no folder."""
    path = Path(path).expanduser()
    return path.name.lower().endswith(SUFFIXES) and not path.is_dir()


def _read(path: Path, suffix: str) -> Gaussians:
    if suffix == ".splat":
        return splat.read(path)
    if suffix == ".spz":
        return spz.read(path)
    header = read_header(path)
    return (compressed_ply if compressed_ply.recognises(header) else ply).read(path, header)


def check_ending(path: Path) -> str:
    """The one of SUFFIXES that a name has. Raises LumigraphError if it has none."""
    for suffix in SUFFIXES:
        if path.name.lower().endswith(suffix):
            return suffix
    raise LumigraphError(f"{path} does not end like a file of Gaussians; name one that ends in {', '.join(SUFFIXES)}")


def _refuse_folder(path: Path) -> None:
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "no ordinary file"
        raise LumigraphError(f"{path} is {what}; name a file that ends in {', '.join(SUFFIXES)}")
