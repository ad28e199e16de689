"""Uploads: photographs and videos that a browser sends in chunks. Names, types, sizes and disk space are checked, and a
file gets its name when it is complete and of its declared type. Nothing is replaced: a file of the same name with other
content gets a numbered name, and one with the same content is stored once."""

import asyncio
import contextlib
import errno
import hashlib
import itertools
import os
import re
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ..errors import LumigraphError
from ..files import explained, refuse_link, remove
from ..files.names import counted
from ..files.reading import reason_of

MAX_PIECE_BYTES = 16 << 20  # bytes of one request
MAX_FILE_BYTES = {"photograph": 1 << 30, "video": 32 << 30}
MAX_FILES = 5000  # of one project
MAX_NAME_BYTES, MAX_FOLDER_BYTES, MAX_FOLDERS = 180, 40, 4  # of a whole name; of a folder in a name that is too long
RESERVED_BYTES = 256 << 20  # of the disk, which stay free
HASH_BYTES, READ_BYTES = 16, 1 << 20  # of a hash; of a file that are read at a time
PART = re.compile(r"\..+\.part")  # name of a file that is not whole yet
PART_SECONDS = 7 * 86_400.0  # that part of an upload waits for the rest
RELIST_SECONDS = 5.0  # between listings of a full folder
DEVICE_NAME = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")  # of Windows, in any folder
FORBIDDEN = re.compile(r'[\\/:*?"<>|]')  # in a name on some system
NUMBERED = re.compile(r"(.+)-([1-9]\d{0,3})(\.[^./]+)")
# The first bytes of containers. FFmpeg would also open lists of other files (HLS, concat) by their content.
CONTAINERS = (
    (4, b"ftyp"), (4, b"moov"), (4, b"mdat"), (4, b"wide"), (4, b"free"), (4, b"skip"),  # MP4, MOV, 3GP
    (0, b"\x1aE\xdf\xa3"), (0, b"RIFF"), (0, b"\x00\x00\x01\xba"), (0, b"\x00\x00\x01\xb3"),  # MKV, AVI, MPEG
    (0, b"G"), (4, b"G"), (0, b"OggS"), (0, b"FLV"), (0, b"0&\xb2u\x8ef\xcf\x11"),  # TS, M2TS, OGG, FLV, WMV
)  # fmt: skip


class DiskFullError(LumigraphError):
    """The disk has no space for an upload."""


class MisplacedError(LumigraphError):
    """A chunk at the wrong offset. have: bytes received so far"""

    def __init__(self, have: int):
        super().__init__(f"The upload goes on from byte {have}")
        self.have = have


class Album:
    """Uploaded photographs of a project, listed once: their number and names. lock: held to add or move one"""

    def __init__(self, folder: Path):
        self.folder, self.lock = folder, threading.RLock()
        self.refresh()

    def refresh(self) -> None:
        """List the folder, and delete parts of abandoned uploads."""
        self._count, self._listed = 0, time.monotonic()
        self._unread: dict[tuple[str, int], list[str]] = defaultdict(list)  # names by wanted name and size
        self._known: dict[tuple[str, int], dict[str, str]] = defaultdict(dict)  # those that were read, by content
        self._numbers: dict[str, int] = {}  # the last number behind a name
        for path in self.folder.rglob("*"):
            with contextlib.suppress(OSError):
                about = path.stat()
                if PART.fullmatch(path.name) and time.time() - about.st_mtime > PART_SECONDS:
                    path.unlink()
        for name in listed(self.folder):
            with contextlib.suppress(OSError):
                self._note(name, (self.folder / name).stat().st_size)

    def _note(self, name: str, size: int) -> None:
        self._count += 1
        self._unread[name, size].append(name)
        if found := NUMBERED.fullmatch(name):
            wanted, number = found[1] + found[3], int(found[2])
            self._unread[wanted, size].append(name)
            self._numbers[wanted] = max(number, self._numbers.get(wanted, 1))

    def is_full(self) -> bool:
        if self._count >= MAX_FILES and time.monotonic() - self._listed > RELIST_SECONDS:
            self.refresh()  # some may have been deleted by hand
        return self._count >= MAX_FILES

    def find(self, name: str, size: int, content: str | Path) -> str | None:
        """Name of the file with this content among those of a requested name. content: hash, or a file of it"""
        key = name, size
        with self.lock:
            for one in self._unread.pop(key, ()):
                with contextlib.suppress(OSError):  # it has gone
                    self._known[key][hash_of(self.folder / one)] = one
            known = self._known.get(key, {})
        if not known and not is_of_size(self.folder / name, size):
            return None
        wanted = hash_of(content) if isinstance(content, Path) else content
        place = self.folder / (found := known.get(wanted, name))
        return found if is_of_size(place, size) and hash_of(place) == wanted else None

    def add(self, file: Path, name: str) -> str:
        """Move a complete file to a requested name, numbered if taken. Returns the name."""
        name = free_name(self.folder, name, self._numbers.get(name, 1) + 1)
        size = file.stat().st_size
        file.rename(self.folder / name)
        self._note(name, size)
        return name

    def leave_out(self, name: str, folder: Path) -> None:
        """Move a photograph into another folder, without replacing anything there."""
        with self.lock, explained(self.folder / name):
            target = folder / free_name(folder, name)
            refuse_links_above(target, folder)
            target.parent.mkdir(parents=True, exist_ok=True)
            (self.folder / name).rename(target)
            self._count -= 1


_albums: dict[tuple[Path, int], Album] = {}  # by folder and its number on the disk
_opening = threading.Lock()


def album(folder: Path) -> Album:
    """The album of a folder, which all requests share."""
    with _opening, explained(folder):
        folder.mkdir(exist_ok=True)
        key = folder, folder.stat().st_ino
        if key not in _albums:
            _albums[key] = Album(folder)
        return _albums[key]


@dataclass(frozen=True)
class Arrived:
    """State of an upload: received bytes, and when complete, the file's name."""

    have: int
    name: str
    done: bool = False


@dataclass(frozen=True)
class Upload:
    """An upload into an album.

    name: requested, with "/"; size: bytes of the whole file; content: its hash, to resume and to detect duplicates;
    empty if the sender has not computed it
    """

    album: Album
    name: str
    size: int
    content: str = ""

    @property
    def partial(self) -> Path:
        place = self.album.folder / self.name
        return place.with_name(f".{place.name}.{self.size}-{self.content}.part")

    def arrived(self) -> Arrived:
        """State of this upload. Raises LumigraphError if it is new and the project has the maximum number of files."""
        have = self.partial.stat().st_size if self.partial.is_file() else 0
        if 0 < have < self.size:
            return Arrived(have, self.name)
        if self.content and (name := self.album.find(self.name, self.size, self.content)):
            return Arrived(self.size, name, True)
        self.check_number()
        return Arrived(0, self.name)

    async def take(self, offset: int, pieces: AsyncIterator[bytes]) -> Arrived:
        """Add a chunk at an offset, completely or not at all.

        Raises MisplacedError, DiskFullError, or LumigraphError with one sentence for a refused file.
        """
        data = bytearray()
        async for piece in pieces:
            data += piece
            if len(data) > MAX_PIECE_BYTES or offset + len(data) > self.size:
                with self.album.lock:
                    remove(self.partial)
                raise LumigraphError(f"{self.name} is larger than announced; drop it again")
        return await asyncio.to_thread(self.add, offset, data)

    def add(self, offset: int, data: bytes | bytearray) -> Arrived:
        with self.album.lock:
            before = self.arrived()
            if before.done:
                return before
            if offset != before.have:
                raise MisplacedError(before.have)
            check_room(self.album.folder, self.size - offset)
            self._write(offset, data)
            if (have := offset + len(data)) < self.size:
                return Arrived(have, self.name)
            return Arrived(have, self._finish(), True)

    def _write(self, offset: int, data: bytes | bytearray) -> None:
        refuse_link(self.partial)
        refuse_links_above(self.album.folder / self.name, self.album.folder)
        try:
            self.partial.parent.mkdir(parents=True, exist_ok=True)
            with open(self.partial, "ab" if offset else "wb") as file:
                file.write(data)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise full(self.album.folder) from error
            raise LumigraphError(f"{self.name} could not be written ({error.strerror}); drop it again") from error

    def _finish(self) -> str:
        """Give a complete file its name. Raises LumigraphError, and deletes it, for content of another type."""
        try:
            if fault := fault_of(self.partial, self.name):
                raise LumigraphError(fault)
            if same := self.album.find(self.name, self.size, self.partial):
                return same
            self.check_number()
            with explained(self.album.folder / self.name):
                return self.album.add(self.partial, self.name)
        finally:
            remove(self.partial)

    def check_number(self) -> None:
        if self.album.is_full():
            raise LumigraphError(
                f"{counted(MAX_FILES, 'file')} are the most of one scene; make another one of the rest"
            )


def upload(folder: Path, name: str, size: int, content: str = "") -> Upload:
    """An upload into a project's photographs. Raises LumigraphError for refused names and sizes."""
    name = safe_name(name)
    kind = kind_of_file(name)
    if kind is None:
        raise LumigraphError(f"{name} is no photograph and no video; drop JPEG, PNG, HEIC, raw files or a video")
    if not 0 < size <= MAX_FILE_BYTES[kind]:
        much = f"{MAX_FILE_BYTES[kind] >> 30} GB are the most for a {kind}"
        raise LumigraphError(f"{name} {'is empty' if size < 1 else f'has {size:,} bytes, and {much}'}; leave it out")
    if content and not re.fullmatch(f"[0-9a-f]{{{2 * HASH_BYTES}}}", content):
        raise LumigraphError(f"{content[:20]!r} is no hash; load the page again")
    return Upload(album(folder), name, size, content)


def safe_name(name: str) -> str:
    """A portable file name below a folder of photographs: without invisible or special characters, and not too long.
    Raises LumigraphError for one that leads out of the folder."""
    if ".." in re.split(r"[\\/]", name) or name.startswith(("/", "\\")):
        raise LumigraphError(f"{visible(name)} leads out of the folder of photographs; rename it and drop it again")
    *above, last = PurePosixPath(name).parts or [""]
    folders = [safe_part(part) for one in above if (part := readable(one).strip(". "))]
    folders = [*folders[: MAX_FOLDERS - 2], *filter(None, ["-".join(folders[MAX_FOLDERS - 2 :])])]
    last = readable(last).rstrip(". ")
    if len("/".join([*folders, last]).encode()) > MAX_NAME_BYTES:
        folders = [shortened(part, MAX_FOLDER_BYTES) for part in folders]
    stem, dot, ending = last.rpartition(".")
    room = MAX_NAME_BYTES - len("/".join([*folders, dot + ending]).encode())
    stem = shortened(stem.strip(". "), room) or "photograph"
    return "/".join([*folders, safe_part(stem + dot + ending)])


def visible(text: str) -> str:
    """Text without control characters and other invisible ones."""
    spaced = "".join(" " if letter.isspace() else letter for letter in text)
    return "".join(filter(str.isprintable, spaced))


def readable(text: str) -> str:
    """Visible text, with "-" for characters that are special on some system."""
    return FORBIDDEN.sub("-", visible(text))


def shortened(text: str, size: int) -> str:
    """Text truncated to `size` bytes."""
    return text.encode()[: max(size, 0)].decode(errors="ignore").rstrip(". ")


def safe_part(part: str) -> str:
    return f"_{part}" if DEVICE_NAME.fullmatch(part) else part


def kind_of_file(name: str) -> str | None:
    """ "photograph" or "video" by a name's ending; None for any other file."""
    from ..readers.raw.library import RAW_SUFFIXES
    from ..sfm.photos.film import VIDEOS
    from ..sfm.photos.gather import PHOTOGRAPHS

    ending = PurePosixPath(name).suffix.lower()
    if ending in VIDEOS:
        return "video"
    return "photograph" if ending in PHOTOGRAPHS or ending in RAW_SUFFIXES else None


def free_name(folder: Path, name: str, number: int = 2) -> str:
    """The name itself; if it is taken, a numbered one. number: the first to try"""
    place = PurePosixPath(name)
    others = (place.with_stem(f"{place.stem}-{n}").as_posix() for n in itertools.count(number))
    return next(one for one in itertools.chain([name], others) if not os.path.lexists(folder / one))


def refuse_links_above(place: Path, folder: Path) -> None:
    """Raise LumigraphError for a symbolic link among the folders between a path and the folder that must contain it."""
    for above in place.relative_to(folder).parents:
        refuse_link(folder / above)


def listed(folder: Path) -> Iterator[str]:
    """Names of the whole files in a project's photographs, without hidden ones."""
    found = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return (path.as_posix() for path in found if not any(part.startswith(".") for part in path.parts))


def is_of_size(path: Path, size: int) -> bool:
    return path.is_file() and path.stat().st_size == size


def hash_of(path: Path) -> str:
    """Hash of a file's content, as the page computes it (page/hash.js)."""
    hasher = hashlib.blake2s(digest_size=HASH_BYTES)
    with open(path, "rb") as file:
        while piece := file.read(READ_BYTES):
            hasher.update(piece)
    return hasher.hexdigest()


def check_room(folder: Path, size: int) -> None:
    """Raise DiskFullError unless a file fits on the disk with a reserve."""
    if shutil.disk_usage(folder).free - size < RESERVED_BYTES:
        raise full(folder)


def full(folder: Path) -> DiskFullError:
    return DiskFullError(f"The disk of {folder} is full; free some space, and the upload goes on")


def fault_of(path: Path, name: str) -> str | None:
    """Sentence for a file whose content does not match its suffix; None for a valid one."""
    if kind_of_file(name) == "video":
        with open(path, "rb") as file:
            begin = file.read(16)
        known = any(begin[at : at + len(mark)] == mark for at, mark in CONTAINERS)
        return None if known else f"{name} is no video that can be read; export it as MP4 and drop it again"
    return fault_of_photograph(path, name)


def fault_of_photograph(path: Path, name: str) -> str | None:
    from PIL import Image

    from ..readers.pictures import reads_heic
    from ..readers.raw.library import RAW_SUFFIXES

    if PurePosixPath(name).suffix.lower() in RAW_SUFFIXES:
        return None  # opened by its own library, in the process of the capture
    reads_heic()
    try:
        with Image.open(path):  # refuses pictures of more pixels than memory holds, before anything is decoded
            return None
    except Exception as fault:  # image libraries raise anything for a damaged file
        return f"{name} is no photograph that can be read ({reason_of(fault)}); copy it again, or leave it out"
