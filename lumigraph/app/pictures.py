"""Photographs of a project for the page: thumbnails, their state, and advice during upload."""

import contextlib
import hashlib
import io
import itertools
import math
import os
import signal
import subprocess
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

from PIL import Image, ImageOps

from ..errors import LumigraphError
from ..files import is_file
from ..files.names import counted, natural
from ..readers.masks import MASKS
from ..readers.numbers import check_pixels
from ..readers.pictures import reads_heic
from ..readers.profiles import colours_of
from ..readers.raw import is_raw
from ..sfm.photos.film import VIDEOS
from ..sfm.photos.gather import PHOTOGRAPHS, walk
from ..sfm.photos.judge import Judgement, blurred, duplicates, exposure_jumps, judge
from ..sfm.photos.overlap import Descriptors, apart, details, shared
from ..sfm.reconstruction import BLACK, MIN_VIEWS
from ..system.children import start_python
from . import reduce
from .folders import PAGE_SECONDS, Finder, Search
from .projects import Item
from .reduce import reduced
from .uploads import MAX_FILES

THUMBNAIL_SIDE, KEPT_SIDE = 320, 512  # pixels of a thumbnail; of those that are kept in memory, at most
DARK = -6.5  # mean log2 of the luminance, below which noise of a photograph has its detail
USUAL_VIEWS = 20  # photographs of a scene that has no gaps
MAX_NAMED = 3  # photographs that a piece of advice names
MAX_KEPT = 4096  # thumbnails and judgements in memory
LARGE_PIXELS = 24_000_000  # of a photograph, above which it is decoded in a process of its own
REDUCED_SIDE, MAX_LARGE_KEPT = 1600, 64  # pixels of the copy of a large photograph, up to twice that; copies in memory
BYTES_PER_PIXEL, REDUCE_SECONDS = 2, 120.0  # times DECODING_COPIES: memory of that process; its longest time

_reducing = threading.Lock()  # one large photograph at a time
MAX_COMPARED = 100  # photographs; more of them leave no gaps, and take long to compare


@dataclass(frozen=True)
class Advice:
    """A sentence of advice on uploaded photographs, and their names."""

    text: str
    names: list[str]


def _listing(search: Search) -> dict[str, Path]:
    films = (path for path in search.entries(search.folder) if is_film(path))
    found = itertools.islice(itertools.chain(walk(search.folder, list_entries=search.entries), films), MAX_FILES + 1)
    names = {path.relative_to(search.folder).as_posix(): path for path in found}
    search.is_cut |= len(names) > MAX_FILES
    return {name: names[name] for name in sorted(names, key=natural)[:MAX_FILES]}


def _first(search: Search) -> Path | None:
    films = (path for path in search.entries(search.folder) if is_film(path))
    return next(itertools.chain(walk(search.folder, list_entries=search.entries), films), None)


_listings, _firsts = Finder(_listing, PAGE_SECONDS), Finder(_first)


def files_of(folder: Path) -> dict[str, Path]:
    """Photographs and videos of a folder by name, in natural order, within a `Search`'s limits; a file itself."""
    if is_file(folder):
        return {folder.name: folder}
    found = _listings(folder)
    return dict(found[1]) if found else {}


def first_of(folder: Path, until: float) -> tuple[Path | None, str]:
    """A photograph or video of a folder for its card, and a sentence where none is found.

    until: time (time.monotonic) after which no folder is searched
    """
    if is_file(folder):
        return folder, ""
    found = _firsts(folder, until)
    return (None, "") if found is None else (found[1], "" if found[1] else found[0].sentence)


def listing_fault(item: Item) -> str:
    """Sentence for an incomplete list of an item's photographs; empty for a complete one."""
    folder = folder_of(item)
    found = None if item.kind == "run" or is_file(folder) else _listings(folder)
    return found[0].sentence if found else ""


def named_file(folder: Path, name: str) -> Path | None:
    """Photograph or video below a folder by its name; None for any other name. Of a file the file itself."""
    if is_file(folder):
        return folder if name == folder.name else None
    parts = PurePosixPath(name).parts
    path = folder.joinpath(*parts)
    if any(part.startswith(("/", ".")) for part in parts) or not is_file(path):
        return None
    is_inside = path.parent.resolve() == folder.resolve().joinpath(*parts[:-1])  # no link leads to its folder
    return path if is_inside and (path.suffix.lower() in PHOTOGRAPHS or is_raw(path) or is_film(path)) else None


def folder_of(item: Item) -> Path:
    """Folder of an item's photographs, or its video; of a scene its folder of images."""
    images = item.path / "images"
    return images if item.kind == "scene" and os.path.isdir(images) else item.photographs


def photographs_of(item: Item) -> dict[str, Path]:
    """Photographs or the video of an item by name."""
    return {} if item.kind == "run" else files_of(folder_of(item))


def is_film(path: Path) -> bool:
    return path.suffix.lower() in VIDEOS and is_file(path) and not path.name.startswith(".")


def input_of(item: Item) -> Path:
    """Input of `capture`: the folder of photographs, or the only video in it.

    Raises LumigraphError if there is nothing, or a video among other things.
    """
    place = item.photographs
    films = [path for path in files_of(place).values() if is_film(path)]
    if not films:
        if not files_of(place) and item.kind == "project" and not item.record.source:
            raise LumigraphError("There are no photographs yet; drop some, or a video")
        return place
    if len(films) > 1 or len(files_of(place)) > 1:
        raise LumigraphError(f"{films[0].name} is a video among other files; make a scene of each")
    return films[0]


def thumbnail(path: Path, side: int = THUMBNAIL_SIDE) -> bytes:
    """JPEG of a photograph, or of the first frame of a video, upright."""
    about = path.stat()
    make = _thumbnail if side <= KEPT_SIDE else _thumbnail.__wrapped__
    return make(path, about.st_mtime_ns, about.st_size, side)


@lru_cache(MAX_KEPT)
def _thumbnail(path: Path, modified: int, size: int, side: int) -> bytes:
    try:
        if is_film(path):
            image = first_frame(path)
        else:
            with opened(path) as whole:
                image = ImageOps.exif_transpose(colours_of(whole).to_srgb(reduced(whole, side)))
        image.thumbnail((side, side))
        out = io.BytesIO()
        image.save(out, "JPEG", quality=80, comment="")  # Pillow would keep the photograph's
    except LumigraphError:
        raise
    except Exception as fault:  # image libraries raise anything for a damaged file
        raise LumigraphError(f"{path.name} cannot be shown; copy it again, or leave it out") from fault
    return out.getvalue()


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """A photograph at small size; for a large one a copy of about REDUCED_SIDE pixels, as stored."""
    if path.suffix.lower() not in PHOTOGRAPHS:
        raise LumigraphError(f"{path.name} is a raw file, which is developed when the scene is made")
    reads_heic()
    with Image.open(path) as image:
        if not is_large(image):
            yield image
            return
        size = image.size
    about = path.stat()
    with _reducing:
        data = _reduced(path, about.st_mtime_ns, about.st_size, size)
    with Image.open(io.BytesIO(data)) as image:
        yield image


def is_large(image: Image.Image) -> bool:
    """True if decoding takes much memory. JPEG is reduced during decoding, except for progressive files."""
    is_baseline = image.format in ("JPEG", "MPO") and not image.info.get("progressive")
    return not is_baseline and math.prod(image.size) > LARGE_PIXELS


def is_large_file(path: Path) -> bool:
    """True if the thumbnail of a photograph takes much memory, by its header."""
    with contextlib.suppress(Exception):  # image libraries raise anything for a damaged file
        reads_heic()
        with Image.open(path) as image:
            return is_large(image)
    return False


@lru_cache(MAX_LARGE_KEPT)
def _reduced(path: Path, modified: int, size: int, pixels: tuple[int, int]) -> bytes:
    """JPEG of a large photograph, made in a separate process; the caller holds the lock `_reducing`."""
    try:
        check_pixels(pixels, BYTES_PER_PIXEL)
    except ValueError as fault:
        raise LumigraphError(f"{path.name} cannot be shown: {fault}; close programs, or leave it out") from fault
    words = [reduce.__file__, str(path.absolute()), str(REDUCED_SIDE)]
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with start_python(words, signal.SIGKILL, **pipes) as child:
        try:
            made = child.communicate(timeout=REDUCE_SECONDS)[0]
        finally:
            child.kill()
    if child.returncode:
        raise LumigraphError(f"{path.name} cannot be shown; copy it again, or leave it out")
    return bytes(made)


def first_frame(path: Path) -> Image.Image:
    import av

    with av.open(str(path)) as film:
        return next(film.decode(video=0)).to_image()


def version_of(path: Path) -> str:
    """Short version name of a file's content, for cacheable URLs; empty if the file is gone."""
    try:
        about = path.stat()
    except OSError:
        return ""
    return hashlib.blake2b(f"{about.st_mtime_ns} {about.st_size}".encode(), digest_size=6).hexdigest()


@lru_cache(MAX_COMPARED)
def _details(path: Path, modified: int, size: int) -> Descriptors:
    with opened(path) as image:
        return details(image)


@lru_cache(MAX_COMPARED**2)
def _shared(one: tuple[Path, int, int], other: tuple[Path, int, int]) -> int:
    return shared(_details(*one), _details(*other))


def too_far(files: Mapping[str, Path]) -> list[str]:
    """Names of photographs with too little overlap with every other one; none for too many photographs to compare."""
    if not MIN_VIEWS <= len(files) <= MAX_COMPARED:
        return []
    about = {name: (path, path.stat().st_mtime_ns, path.stat().st_size) for name, path in files.items()}
    return apart(list(files), lambda a, b: _shared(*sorted((about[a], about[b]))))


@lru_cache(MAX_KEPT)
def _judged(path: Path, modified: int, size: int) -> tuple[Judgement, tuple[int, int]] | None:
    try:
        with opened(path) as image:
            return judge(image), image.size
    except Exception:  # image libraries raise anything for a damaged file
        return None


def judged(path: Path) -> tuple[Judgement, tuple[int, int]] | None:
    """Judgement and size of a photograph; None for raw files, videos and damaged files."""
    if path.suffix.lower() not in PHOTOGRAPHS:
        return None
    about = path.stat()
    return _judged(path, about.st_mtime_ns, about.st_size)


def advice(files: Mapping[str, Path]) -> list[Advice]:
    """Advice on photographs before reconstruction: too few, blurred, dark, of other exposure, repeated, without
    overlap."""
    photographs = {name: path for name, path in files.items() if not is_film(path) and MASKS not in Path(name).parts}
    known = {name: found for name, path in photographs.items() if (found := judged(path)) is not None}
    said = [*about_number(len(photographs), len(files) - len(photographs))]
    soft = blurred({name: found.sharpness for name, (found, _) in known.items()})
    if soft:
        said.append(
            Advice(f"Blurred: {named(list(soft))}. Take them again if nothing else shows the same.", list(soft))
        )
    dark = [name for name, (found, _) in known.items() if found.brightness < DARK]
    if dark:
        black = all(known[name][0].brightness < BLACK for name in dark)
        said.append(
            Advice(f"{'Black' if black else 'Very dark'}: {named(dark)}. Take them again with more light.", dark)
        )
    jumps = exposure_jumps([found.brightness for found, _ in known.values()], False) if len(known) > 3 else {}
    other = [name for i, name in enumerate(known) if i in jumps and name not in dark]
    if other:
        said.append(Advice(f"Another exposure: {named(other)}. Lock the exposure of the camera.", other))
    signatures = {name: found.signature for name, (found, _) in known.items()}
    same = duplicates(signatures, {name: size for name, (_, size) in known.items()}) if known else {}
    if same:
        said.append(Advice(f"Shown twice: {named(list(same))}. Repeats are passed over.", list(same)))
    others = {name: path for name, path in photographs.items() if name in known and name not in same}
    alone = too_far(others)
    if alone and len(alone) == len(others):
        said.append(Advice("No two show enough of the same. Take them a step apart, around one thing.", []))
    elif alone:
        text = "Take more from places between them and their neighbours, a step apart."
        said.append(Advice(f"Too far from every other: {named(alone)}. {text}", alone))
    return said


def about_number(photographs: int, films: int) -> list[Advice]:
    if films and photographs:
        return [Advice("A video and photographs cannot be one scene; make a scene of each.", [])]
    if films > 1:
        return [Advice("Several videos cannot be one scene; make a scene of each.", [])]
    if not photographs or films:
        return []
    if photographs < MIN_VIEWS:
        return [Advice(f"{counted(photographs, 'photograph')}: {MIN_VIEWS} are the least, 20 to 60 are usual.", [])]
    if photographs < USUAL_VIEWS:
        text = "More from places between them make a better scene: 20 to 60 are usual."
        return [Advice(f"{counted(photographs, 'photograph')}. {text}", [])]
    return []


def named(names: Sequence[str]) -> str:
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return ", ".join(names[:MAX_NAMED]) + more
