"""Checks of clouds (all numbers are finite) and of files: declared sizes against their bytes and free memory; a Bundle
reads files of a folder or a .zip within these limits."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from ..errors import LumigraphError, LumigraphWarning
from ..files.ranges import format_value
from ..files.reading import reading
from ..gaussians import Gaussians
from ..system.memory import free_memory

NO_ROTATION = "no rotation"
DISPLAY_NAMES = {"means": "means", "quaternions": "rotations", "log_scales": "scales", "harmonics": "colours"}
FLATNESS = 0.01  # thickness of flat Gaussians, of a longer axis
MAX_LOGIT = 20.0  # a logit whose sigmoid is 1 in float32
BYTES_PER_NUMBER = 28  # bytes of memory for each number of a Gaussian while its file is read
MAX_RATIO, SMALL_BYTES = 100, 1 << 26  # largest compression of a cloud; unpacked bytes below which it is not checked


def check_room(path: Path, count: int, harmonics: int = 1, packed: int | None = None, unpacked: int = 0) -> None:
    """Raise LumigraphError for a cloud that exceeds memory, or that its file is too short to contain.

    count, harmonics: declared number of Gaussians, and coefficients of each
    packed, unpacked: bytes of a compressed file, before and after decompression
    """
    if packed is not None and unpacked > max(SMALL_BYTES, MAX_RATIO * packed):
        raise LumigraphError(
            f"{path} promises {count:,} Gaussians in {packed:,} bytes, which no cloud can be packed into; "
            "copy or download it again"
        )
    needed, free = BYTES_PER_NUMBER * (11 + 3 * harmonics) * count, free_memory()
    if needed > free:
        raise LumigraphError(
            f"{path} promises {count:,} Gaussians, which take {needed / 1e9:.1f} GB to read, and {free / 1e9:.1f} GB "
            "are free; reduce it with an editor of splats, or take a larger machine"
        )


def checked(gaussians: Gaussians, subject: str, way_out: str) -> Gaussians:
    """The same cloud, with infinite logits of opacity as ±20 and quaternions of length zero as the identity.

    Raises LumigraphError, which begins with `subject` and ends with `way_out`, for numbers that are not finite.
    """
    check_harmonics(gaussians, subject)
    faults = find_faults(gaussians)
    nowhere = faults.pop(NO_ROTATION)[:, None]
    if bad := int(torch.stack(list(faults.values())).any(0).sum()):
        raise LumigraphError(f"{subject} holds {bad} of {len(gaussians)} Gaussians with {describe(faults)}; {way_out}")
    quaternions = torch.where(nowhere, gaussians.quaternions.new_tensor([1, 0, 0, 0]), gaussians.quaternions)
    return replace(finite_logits(gaussians), quaternions=quaternions)


def with_thin_axes(gaussians: Gaussians) -> Gaussians:
    """Axes of length zero, whose logarithm is infinite, with FLATNESS of the longest one's length."""
    longest = gaussians.log_scales.amax(-1, keepdim=True)
    flat = (gaussians.log_scales == -torch.inf) & longest.isfinite()
    return (
        replace(gaussians, log_scales=torch.where(flat, longest + math.log(FLATNESS), gaussians.log_scales))
        if flat.any()
        else gaussians
    )


def finite_logits(gaussians: Gaussians) -> Gaussians:
    return replace(gaussians, opacities=gaussians.opacities.nan_to_num(float("nan"), MAX_LOGIT, -MAX_LOGIT))


def without_unsound(gaussians: Gaussians, path: Path) -> tuple[Gaussians, Bool[Tensor, " gaussian"] | None]:
    """The cloud of a file without Gaussians that are none, of which it warns, and a mask of the others; None for all.

    Raises LumigraphError where none is left.
    """
    check_harmonics(gaussians, str(path))
    gaussians = with_thin_axes(gaussians)
    faults = find_faults(gaussians)
    good = ~torch.stack(list(faults.values())).any(0)
    if not good.all():
        text = f"{path} holds {int((~good).sum())} of {len(gaussians)} Gaussians with {describe(faults)}"
        if not good.any():
            raise LumigraphError(f"{text}, and no other; write it again")
        warnings.warn(f"{text}; they are left out", LumigraphWarning, stacklevel=2)
        gaussians = gaussians[good]
    return finite_logits(gaussians), None if good.all() else good


def check_harmonics(gaussians: Gaussians, subject: str) -> None:
    if (count := gaussians.harmonics.shape[1]) not in (1, 4, 9, 16):
        raise LumigraphError(f"{subject} has {count} harmonics per Gaussian; bring them to 1, 4, 9 or 16")


def find_faults(gaussians: Gaussians) -> dict[str, Bool[Tensor, " gaussian"]]:
    """Masks of the Gaussians that are none, by the fault."""
    faults = {what: ~getattr(gaussians, name).isfinite().flatten(1).all(-1) for name, what in DISPLAY_NAMES.items()}
    return faults | {
        "opacities": gaussians.opacities.isnan(),
        NO_ROTATION: (gaussians.quaternions == 0).all(-1),
    }


def describe(faults: dict[str, Bool[Tensor, " gaussian"]]) -> str:
    """Faults and numbers of Gaussians as text: "no rotation (a half-written file?): 3"."""
    counts = {what: int(bad.sum()) for what, bad in faults.items() if bad.any()}
    none = counts.pop(NO_ROTATION, 0)
    parts = (
        [f"numbers that are not finite ({', '.join(f'{what}: {n}' for what, n in counts.items())})"] if counts else []
    )
    return " and ".join(parts + ([f"{NO_ROTATION}: {none} (is the file half written?)"] if none else []))


DATE = (1980, 1, 1, 0, 0, 0)  # the earliest of the format, constant so that equal files have equal bytes


class Bundle:
    """Files of a folder or .zip by name, and their total size. Raises LumigraphError for an invalid archive."""

    def __init__(self, path: Path):
        self.path, self._archive = path, None
        if path.is_dir():
            self.size = sum(file.stat().st_size for file in path.iterdir() if file.is_file())
            return
        data = path.read_bytes()
        self.size = len(data)
        with reading(path, "is no archive, or a part of one", "copy it again"):
            self._archive = zipfile.ZipFile(io.BytesIO(data))
        folders = {name.rpartition("/")[0] for name in self._archive.namelist() if not name.startswith("__MACOSX/")}
        self._folder = f"{folder}/" if len(folders) == 1 and (folder := folders.pop()) else ""  # that was zipped whole

    def read(self, name: str) -> bytes:
        """Read a top-level file. Raises LumigraphError if it is missing, damaged or unpacks to an implausible size."""
        if self._archive is None:
            file = self.path / name
            if Path(name).name != name or file.is_symlink() or not file.is_file():
                raise LumigraphError(f"{self.path} lacks the file {format_value(name)}; copy the whole folder again")
            return file.read_bytes()
        inner = self._folder + name
        if inner not in self._archive.namelist():
            raise LumigraphError(f"{self.path} lacks the file {format_value(name)}; copy or download it again")
        with reading(f"{self.path}: {format_value(name)}", "is damaged", "download it again"):
            about = self._archive.getinfo(inner)
            if about.file_size > max(SMALL_BYTES, MAX_RATIO * self.size):
                size = f"{about.file_size:,} bytes"
                raise LumigraphError(f"{self.path}: {format_value(name)} would unpack to {size}; download it again")
            with self._archive.open(about) as stream:
                return stream.read(about.file_size)  # no more, whatever is there


def zipped(files: dict[str, bytes]) -> bytes:
    """A deterministic archive of compressed files."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, DATE), data)
    return held.getvalue()
