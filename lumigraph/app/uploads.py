"""Uploads: photographs and videos that a browser sends in pieces. Names, types, sizes and room are checked, and a file
takes its name once it is whole and is what it says."""

from __future__ import annotations

import errno
import re
import shutil
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ..errors import LumigraphError
from ..files import explained, remove
from ..files.names import counted
from ..files.reading import reason_of

MAX_PIECE_BYTES = 16 << 20  # bytes of one request
MAX_FILE_BYTES = {"photograph": 1 << 30, "video": 32 << 30}
MAX_FILES = 5000  # of one project
MAX_NAME_BYTES, MAX_FOLDERS = 180, 4
RESERVED_BYTES = 256 << 20  # of the disk, which stay free
PARTIAL = ".{}.part"  # name of a file that is not whole yet
DEVICE_NAME = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")  # of Windows, in any folder
# The first bytes of containers. FFmpeg would also open lists of other files (HLS, concat) by their content.
CONTAINERS = (
    (4, b"ftyp"), (4, b"moov"), (4, b"mdat"), (4, b"wide"), (4, b"free"), (4, b"skip"),  # MP4, MOV, 3GP
    (0, b"\x1aE\xdf\xa3"), (0, b"RIFF"), (0, b"\x00\x00\x01\xba"), (0, b"\x00\x00\x01\xb3"),  # MKV, AVI, MPEG
    (0, b"G"), (4, b"G"), (0, b"OggS"), (0, b"FLV"), (0, b"0&\xb2u\x8ef\xcf\x11"),  # TS, M2TS, OGG, FLV, WMV
)  # fmt: skip


class DiskFullError(LumigraphError):
    """The disk has no room for an upload."""


class MisplacedError(LumigraphError):
    """A piece that does not continue the file. have: bytes that are there"""

    def __init__(self, have: int):
        super().__init__(f"The upload goes on from byte {have}")
        self.have = have


@dataclass(frozen=True)
class Upload:
    """A file on its way into a folder.

    folder: photographs of a project; name: below it, with "/"; size: bytes of the whole file
    """

    folder: Path
    name: str
    size: int

    @property
    def place(self) -> Path:
        return self.folder / self.name

    @property
    def partial(self) -> Path:
        return self.place.with_name(PARTIAL.format(self.place.name))

    def have(self) -> int:
        """Bytes that have arrived."""
        if self.place.is_file() and self.place.stat().st_size == self.size:
            return self.size
        return self.partial.stat().st_size if self.partial.is_file() else 0

    async def take(self, offset: int, pieces: AsyncIterator[bytes]) -> int:
        """Add a piece that begins at an offset. Returns the bytes that have arrived; at `size` the file has its name.

        Raises MisplacedError, DiskFullError, or LumigraphError with one sentence for a file that is refused.
        """
        if self.have() == self.size and self.place.is_file():
            return self.size
        if offset != self.have():
            raise MisplacedError(self.have())
        check_room(self.folder, self.size - offset)
        with explained(self.place):
            self.place.parent.mkdir(parents=True, exist_ok=True)
        arrived = 0
        try:
            with open(self.partial, "ab") as file:
                async for piece in pieces:
                    arrived += len(piece)
                    if arrived > MAX_PIECE_BYTES or offset + arrived > self.size:
                        raise LumigraphError(f"{self.name} is larger than announced; drop it again")
                    file.write(piece)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise full(self.folder) from error
            raise LumigraphError(f"{self.name} could not be written ({error.strerror}); drop it again") from error
        if (have := offset + arrived) == self.size:
            self.finish()
        return have

    def finish(self) -> None:
        """Give a whole file its name. Raises LumigraphError, and deletes it, if it is not what it says."""
        if fault := fault_of(self.partial, self.name):
            remove(self.partial)
            raise LumigraphError(fault)
        with explained(self.place):
            self.partial.replace(self.place)


def upload(folder: Path, name: str, size: int) -> Upload:
    """An upload into a project's photographs. Raises LumigraphError for names and sizes that are refused."""
    name = checked_name(name)
    kind = kind_of_file(name)
    if kind is None:
        raise LumigraphError(f"{name} is no photograph and no video; drop JPEG, PNG, HEIC, raw files or a video")
    if not 0 < size <= MAX_FILE_BYTES[kind]:
        much = f"{MAX_FILE_BYTES[kind] >> 30} GB are the most for a {kind}"
        raise LumigraphError(f"{name} {'is empty' if size < 1 else f'has {size:,} bytes, and {much}'}; leave it out")
    place = free_name(folder, name, size)
    there = listed(folder)
    if place not in there and len(there) >= MAX_FILES:
        raise LumigraphError(f"{counted(MAX_FILES, 'file')} are the most of one scene; make another one of the rest")
    return Upload(folder, place, size)


def checked_name(name: str) -> str:
    """A file's name below a folder of photographs. Raises LumigraphError for one that leads out of it, or that a system
    would read in another way."""
    parts = PurePosixPath(name).parts
    unsafe = any(part in ("..", ".", "/") or part.startswith(".") or DEVICE_NAME.fullmatch(part) for part in parts)
    unsafe = unsafe or not parts or bool(re.search(r'[\\:*?"<>|\x00-\x1f\x7f]', name)) or not name.isprintable()
    if unsafe or len(name.encode()) > MAX_NAME_BYTES or len(parts) > MAX_FOLDERS or any(p.endswith(" ") for p in parts):
        raise LumigraphError(f"{ascii(name[:60])} cannot be the name of a photograph here; rename it and drop it again")
    return "/".join(parts)


def kind_of_file(name: str) -> str | None:
    """ "photograph" or "video" by a name's ending; None for any other file."""
    from ..capture.photos.gather import PHOTOGRAPHS
    from ..capture.photos.video import VIDEOS
    from ..capture.raw.library import RAW_SUFFIXES

    ending = PurePosixPath(name).suffix.lower()
    if ending in VIDEOS:
        return "video"
    return "photograph" if ending in PHOTOGRAPHS or ending in RAW_SUFFIXES else None


def free_name(folder: Path, name: str, size: int) -> str:
    """The name itself; for another file of that name one with a number behind it."""
    place, number = PurePosixPath(name), 1
    while (there := folder / name).exists() and there.stat().st_size != size:
        number += 1
        name = place.with_stem(f"{place.stem}-{number}").as_posix()
    return name


def listed(folder: Path) -> list[str]:
    """Names of the whole files in a project's photographs, without hidden ones."""
    found = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return [path.as_posix() for path in found if not any(part.startswith(".") for part in path.parts)]


def check_room(folder: Path, size: int) -> None:
    """Raise DiskFullError unless so many bytes fit on the disk and some remain."""
    if shutil.disk_usage(folder).free - size < RESERVED_BYTES:
        raise full(folder)


def full(folder: Path) -> DiskFullError:
    return DiskFullError(f"The disk of {folder} is full; free some space, and the upload goes on")


def fault_of(path: Path, name: str) -> str | None:
    """A sentence for a file whose content is not what its name says; None for a good one."""
    if kind_of_file(name) == "video":
        with open(path, "rb") as file:
            begin = file.read(16)
        known = any(begin[at : at + len(mark)] == mark for at, mark in CONTAINERS)
        return None if known else f"{name} is no video that can be read; export it as MP4 and drop it again"
    return fault_of_photograph(path, name)


def fault_of_photograph(path: Path, name: str) -> str | None:
    from PIL import Image

    from ..capture.pictures import reads_heic
    from ..capture.raw.library import RAW_SUFFIXES

    if PurePosixPath(name).suffix.lower() in RAW_SUFFIXES:
        return None  # opened by its own library, in the process of the capture
    reads_heic()
    try:
        with Image.open(path):  # refuses pictures of more pixels than memory holds, before anything is decoded
            return None
    except Exception as fault:  # image libraries raise anything for a damaged file
        return f"{name} is no photograph that can be read ({reason_of(fault)}); copy it again, or leave it out"
