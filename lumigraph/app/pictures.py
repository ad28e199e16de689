"""Photographs of a project as the page shows them: thumbnails, their state, and advice while they arrive."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from PIL import Image, ImageOps

from ..capture.masks import MASKS
from ..capture.motion.reconstruction import BLACK, MIN_VIEWS
from ..capture.photos.gather import PHOTOGRAPHS, walk
from ..capture.photos.judge import Judgement, blurred, duplicates, exposure_jumps, judge
from ..capture.photos.overlap import Descriptors, apart, details, shared
from ..capture.photos.video import VIDEOS
from ..capture.pictures import eight_bits, reads_heic
from ..errors import LumigraphError
from ..files.names import counted, natural
from .projects import Item

THUMBNAIL_SIDE = 320  # pixels
DARK = -6.5  # mean log2 of the luminance, below which noise of a photograph has its detail
USUAL_VIEWS = 20  # photographs of a scene that has no gaps
MAX_NAMED = 3  # photographs that a piece of advice names
MAX_KEPT = 4096  # thumbnails and judgements in memory
MAX_COMPARED = 100  # photographs; more of them leave no gaps, and take long to compare


@dataclass(frozen=True)
class Advice:
    """A sentence about photographs that have arrived, and the names of those it is about."""

    text: str
    names: list[str]


def files_of(folder: Path) -> dict[str, Path]:
    """Photographs and videos of a folder by name, in natural order; of a file the file itself."""
    if folder.is_file():
        return {folder.name: folder}
    if not folder.is_dir():
        return {}
    films = [path for path in folder.iterdir() if is_film(path)]
    found = {path.relative_to(folder).as_posix(): path for path in [*walk(folder), *films]}
    return {name: found[name] for name in sorted(found, key=natural)}


def photographs_of(item: Item) -> dict[str, Path]:
    """Photographs or the video of an item by name; of a scene those in its folder of images."""
    if item.kind == "run":
        return {}
    images = item.path / "images"
    return files_of(images if item.kind == "scene" and images.is_dir() else item.photographs)


def is_film(path: Path) -> bool:
    return path.suffix.lower() in VIDEOS and path.is_file() and not path.name.startswith(".")


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
    return _thumbnail(path, about.st_mtime_ns, about.st_size, side)


@lru_cache(MAX_KEPT)
def _thumbnail(path: Path, modified: int, size: int, side: int) -> bytes:
    reads_heic()
    try:
        image = first_frame(path) if is_film(path) else opened(path, side)
        image.thumbnail((side, side))
        out = io.BytesIO()
        image.save(out, "JPEG", quality=80, comment="")  # Pillow would keep the photograph's
    except LumigraphError:
        raise
    except Exception as fault:  # image libraries raise anything for a damaged file
        raise LumigraphError(f"{path.name} cannot be shown; copy it again, or leave it out") from fault
    return out.getvalue()


def opened(path: Path, side: int) -> Image.Image:
    if path.suffix.lower() not in PHOTOGRAPHS and path.suffix.lower() != ".png":
        raise LumigraphError(f"{path.name} is a raw file, which is developed when the scene is made")
    with Image.open(path) as image:
        image.draft("RGB", (2 * side, 2 * side))
        return ImageOps.exif_transpose(eight_bits(image).convert("RGB"))


def first_frame(path: Path) -> Image.Image:
    import av

    with av.open(str(path)) as film:
        return next(film.decode(video=0)).to_image()


def version_of(path: Path) -> str:
    """Short name of a file's present content, for addresses that browsers may keep."""
    about = path.stat()
    return hashlib.blake2b(f"{about.st_mtime_ns} {about.st_size}".encode(), digest_size=6).hexdigest()


@lru_cache(MAX_COMPARED)
def _details(path: Path, modified: int, size: int) -> Descriptors:
    with Image.open(path) as image:
        return details(image)


@lru_cache(MAX_COMPARED**2)
def _shared(one: tuple[Path, int, int], other: tuple[Path, int, int]) -> int:
    return shared(_details(*one), _details(*other))


def too_far(files: Mapping[str, Path]) -> list[str]:
    """Names of photographs that share too little with every other one; none of too many photographs to compare."""
    if not MIN_VIEWS <= len(files) <= MAX_COMPARED:
        return []
    about = {name: (path, path.stat().st_mtime_ns, path.stat().st_size) for name, path in files.items()}
    return apart(list(files), lambda a, b: _shared(*sorted((about[a], about[b]))))


@lru_cache(MAX_KEPT)
def _judged(path: Path, modified: int, size: int) -> tuple[Judgement, tuple[int, int]] | None:
    reads_heic()
    try:
        with Image.open(path) as image:
            full = image.size
            return judge(image), full
    except Exception:  # image libraries raise anything for a damaged file
        return None


def judged(path: Path) -> tuple[Judgement, tuple[int, int]] | None:
    """Judgement and size of a photograph; None for raw files, videos and damaged files."""
    if path.suffix.lower() not in PHOTOGRAPHS:
        return None
    about = path.stat()
    return _judged(path, about.st_mtime_ns, about.st_size)


def advice(files: Mapping[str, Path]) -> list[Advice]:
    """Advice about photographs before cameras are looked for: too few, blurred, too dark, other exposure, repeated, too
    far from every other."""
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
