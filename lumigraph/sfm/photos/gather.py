"""Pictures of a folder, of a list of files or of a video, with quality checks before reconstruction."""

from __future__ import annotations

import math
import os
import re
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from ...errors import LumigraphError
from ...files import exists, explained
from ...files.foreign import about_file
from ...files.names import counted, natural
from ...files.reading import reason_of
from ...readers.exif import read_facts
from ...readers.masks import LABELS, MASKS, OBJECT_MASKS, OTHER_MASKS, PLANES, find_mask, names_beside
from ...readers.pictures import HEIC_SUFFIXES, NO_HEIC, UNSEEN, reads_heic
from ...readers.raw import Developed, is_raw
from ...system.memory import threads_for
from .copies import copy_upright, develop, is_current, is_plain, name_of_copy
from .film import is_video, tags_of
from .judge import blurred, duplicates, judge
from .photo import Intake, Photo, Track, untracked
from .video import extract

PHOTOGRAPHS = {".jpg", ".jpeg", ".jfif", ".png", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".jp2", *HEIC_SUFFIXES}
MASK_LEVELS = 3  # folders above a photograph that are searched for a folder of masks
LOOKING_BYTES = 400_000_000  # of a photograph of 24 megapixels, decoded and turned
REDUCED_FOLDER = re.compile(r"(.+)_(?!0*1?$)[0-9]+")  # images_4 beside images: the same photographs, reduced
NO_PHOTOGRAPHS = {MASKS, OBJECT_MASKS, LABELS, *OTHER_MASKS, *PLANES}  # folders beside photographs
PROGRAM_FILES = ("transforms.json", "transforms_train.json", "sparse", "checkpoints")  # in folders of programs


def gather(sources: Sequence[Path], work: Path, frames: int | None = None, track: Track = untracked) -> Intake:
    """All pictures of a folder, a list of files, or a video.

    sources: one folder, one video, or image files
    work:    a folder for upright copies and a video's frames; existing ones are reused if current
    frames:  number of frames of a video; None: by its length
    track:   progress display, as display.track
    Raises LumigraphError without any picture.
    """
    films = [source for source in sources if is_video(source)] or lone_film(sources)
    if films and len(sources) > 1:
        raise LumigraphError(f"{films[0]} is a video among other things; name it alone, or photographs without it")
    source = ", ".join(map(str, sources)) if len(sources) < 4 else f"{sources[0]} and {len(sources) - 1} more"
    if films:
        return of_video(films[0], source, work, frames, track)
    files, pairs = without_raw_twins(named_files(list_photographs(sources, work)))
    raw: dict[str, Developed] = {}
    unreadable: dict[str, str] = {}
    if all_raw(files, source):
        pictures = work / "developed"
        made = develop(files, pictures, track)
        unreadable = {name: why for name, why in made.items() if isinstance(why, str)}
        raw = {f"{name}.jpg": one for name, one in made.items() if isinstance(one, Developed)}
        files = {name: pictures / name for name in raw}
    taken = examine(files, work / "upright", track)
    unreadable |= {name: why for name, why in taken.items() if isinstance(why, str)}
    readable = {name: one for name, one in taken.items() if isinstance(one, Candidate)}
    seen = [readable[name] for name in sorted(readable, key=natural)]
    if not seen:
        raise LumigraphError(nothing(source, unreadable))
    photos = with_altitudes([one.photo for one in seen])
    remarks = pairs + left_out_films(sources)
    return assess(Intake(source, photos, unreadable=unreadable, raw=raw, remarks=remarks), seen)


def left_out_films(sources: Sequence[Path]) -> tuple[str, ...]:
    """A sentence on the films beside photographs."""
    films = films_in(sources)
    names = f"{counted(len(films), 'film')} beside the photographs, such as {films[0].name}," if films else ""
    return (f"{names} are left out; name a film alone to use it",) if films else ()


def without_raw_twins(files: Mapping[str, Path]) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Files without raw ones beside which the camera's own picture of the same name lies, and a sentence on these."""
    pictures = {Path(name).with_suffix("") for name, path in files.items() if not is_raw(path)}
    twins = [name for name, path in files.items() if is_raw(path) and Path(name).with_suffix("") in pictures]
    if not twins:
        return dict(files), ()
    count = counted(len(twins), "photograph")
    told = f"{count} are raw files with pictures beside them, such as {twins[0]}; the pictures are taken"
    return {name: path for name, path in files.items() if name not in twins}, (told,)


def all_raw(files: Mapping[str, Path], source: str) -> bool:
    """True if photographs are raw files. Raises LumigraphError for a mixture."""
    raw = [name for name, path in files.items() if is_raw(path)]
    if raw and len(raw) < len(files):
        other = next(name for name in files if name not in raw)
        others = counted(len(files) - len(raw), "other photograph")
        raise LumigraphError(
            f"{source} has {counted(len(raw), 'raw file')} and {others}, such as {raw[0]} and {other}, whose light is "
            f"not comparable; name the files of one kind alone"
        )
    return bool(raw)


def of_video(path: Path, source: str, work: Path, frames: int | None, track: Track) -> Intake:
    found = extract(path, work / "frames", frames, track)
    taken = examine({file.name: file for file, _ in found}, work / "upright", track)
    seen = []
    for file, seconds in found:
        one = taken[file.name]
        if isinstance(one, str):
            raise LumigraphError(f"{file} is damaged ({one}); delete {file.parent}, and frames will be taken anew")
        seen.append(replace(one, photo=replace(one.photo, device=path.name, time=seconds)))
    photos, tags = [one.photo for one in seen], tags_of(path)
    remarks = (tags.fault,) if tags.fault else ()
    return assess(Intake(source, photos, in_order=True, film=tags, remarks=remarks), seen)


def examine(files: Mapping[str, Path], copies: Path, track: Track) -> dict[str, Candidate | str]:
    """Each file as a candidate, or the reason for none; several are read in parallel."""
    with ThreadPoolExecutor(threads_for(LOOKING_BYTES)) as pool:
        found = pool.map(lambda name: take(name, files[name], copies), files)
        try:
            return dict(zip(files, track(found, "Looking at photographs", len(files)), strict=True))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def assess(intake: Intake, seen: Sequence[Candidate]) -> Intake:
    """An intake with the blurred and the duplicates named: of two equal ones the sharper, larger one is kept."""
    bad = blurred({one.photo.name: one.photo.sharpness for one in seen})
    sizes = {one.photo.name: one.photo.size for one in seen}

    def worth(one: Candidate) -> tuple[bool, int, int, str]:
        return one.photo.name in bad, -math.prod(one.photo.size), -one.bytes, one.photo.name

    signatures = {one.photo.name: one.signature for one in sorted(seen, key=worth)}
    same = duplicates(signatures, sizes)
    return replace(intake, blurred=bad, duplicates={name: same[name] for name in sorted(same, key=natural)})


def nothing(source: str, unreadable: Mapping[str, str]) -> str:
    if not unreadable:
        return f"{source} holds no photographs ({', '.join(sorted(PHOTOGRAPHS))}); name the folder or the video to use"
    name, why = next(iter(unreadable.items()))
    if len(unreadable) == 1 and (foreign := about_file(Path(name))) is not None:
        return foreign
    return f"{source} holds no photograph that can be read ({name}: {why}); copy them again, or convert them to JPEG"


def is_bare(path: Path) -> bool:
    """True for a video, or a folder of photographs that no reader of poses recognises."""
    from ...readers import READERS  # that package may import this one

    if not path.is_dir():
        return is_video(path)
    if len(films_in([path])) == 1 and next(walk(path), None) is None:
        return True
    if any((path / name).exists() for name in PROGRAM_FILES) or any(r.recognises(path) for r in READERS.values()):
        return False
    return next(walk(path), None) is not None


def list_photographs(sources: Sequence[Path], work: Path) -> list[Path]:
    files: dict[Path, Path] = {}
    for source in sources:
        if not source.exists():
            raise LumigraphError(f"{source} does not exist; check the path")
        for file in [source] if source.is_file() else walk(source, work.resolve()):
            files.setdefault(file.resolve(), file)
    return list(files.values())


def walk(
    folder: Path,
    work: Path | None = None,
    list_entries: Callable[[Path], Iterable[Path]] = Path.iterdir,
    seen: set[Path] | None = None,
) -> Iterator[Path]:
    """Photographs below a folder, sorted, without hidden ones, masks, and programs' reduced or rendered copies. Links
    to folders are followed, and no folder is entered twice.

    work: a folder to leave out; list_entries: lists the entries of a folder; seen: folders entered so far
    """
    with explained(folder):
        entries = sorted(list_entries(folder), key=lambda path: natural(path.name))
    if not entries:
        return
    seen = {folder.resolve()} if seen is None else seen
    folders = {entry.name for entry in entries if os.path.isdir(entry)}
    masks = {name for entry in entries for name in names_beside(entry.stem)}
    for entry in entries:
        if entry.name.lower().startswith(UNSEEN) or (work is not None and entry.resolve() == work):
            continue
        if entry.name in folders:
            reduced = REDUCED_FOLDER.fullmatch(entry.name)
            if entry.name.lower() in NO_PHOTOGRAPHS or (reduced and reduced[1] in folders):
                continue
            if (place := entry.resolve()) not in seen and not any(exists(entry / name) for name in PROGRAM_FILES):
                seen.add(place)
                yield from walk(entry, work, list_entries, seen)
        elif (entry.suffix.lower() in PHOTOGRAPHS or is_raw(entry)) and entry.stem not in masks:
            yield entry


def films_in(sources: Sequence[Path]) -> list[Path]:
    """Films at the top of a folder that is the only source."""
    only = sources[0] if len(sources) == 1 and sources[0].is_dir() else None
    return [] if only is None else sorted(path for path in only.iterdir() if is_video(path))


def lone_film(sources: Sequence[Path]) -> list[Path]:
    """The one film of a folder without photographs. Raises LumigraphError for several."""
    films = films_in(sources)
    if not films or next(walk(sources[0]), None) is not None:
        return []
    if len(films) > 1:
        raise LumigraphError(
            f"{sources[0]} holds {len(films)} films and no photographs; name one of them, such as {films[0]}, or, if "
            f"cameras filmed at once, add --moving"
        )
    return films


def named_files(files: list[Path]) -> dict[str, Path]:
    """Files by path relative to their common folder."""
    if not files:
        return {}
    common = Path(os.path.commonpath([file.absolute().parent for file in files]))
    return {file.absolute().relative_to(common).as_posix(): file for file in files}


@dataclass(frozen=True)
class Candidate:
    """A photo, the signature of its pixels, and how many bytes its source has."""

    photo: Photo
    signature: np.ndarray
    bytes: int


def take(name: str, path: Path, copies: Path) -> Candidate | str:
    """One photograph, copied if necessary, and judged; or the reason for none. Raises LumigraphError if unwritable."""
    if path.suffix.lower() not in PHOTOGRAPHS:
        return "its format is not read here; convert it to JPEG"
    heic = path.suffix.lower() in HEIC_SUFFIXES
    if not reads_heic() and heic:  # a file of another name may be HEIC too
        return f"it {NO_HEIC}"
    try:
        with Image.open(path) as image:
            facts = read_facts(image.getexif(), image.size)
            upright_file = path
            if not is_plain(image, path):
                name = name_of_copy(name, image)
                upright_file = copies / name
                if not is_current(upright_file, path):
                    copy_upright(image, path, upright_file)
        with Image.open(upright_file) as image:
            size, found = image.size, judge(image)
    except LumigraphError:
        raise
    except Exception as fault:  # image libraries raise anything for a damaged file
        return "it is cut short or damaged" if heic and not getattr(fault, "strerror", None) else reason_of(fault)
    known = facts.device, facts.focal, facts.gps, facts.time
    photo = Photo(name, upright_file, size, *known, found.sharpness, found.brightness, mask_beside(path))
    return Candidate(photo, found.signature, path.stat().st_size)


def mask_beside(path: Path) -> Path | None:
    """Mask of a photograph, in a folder of masks beside it or beside one of its three parent folders."""
    above = path.absolute().parents[:MASK_LEVELS]
    found = (find_mask(folder / MASKS, path.absolute().relative_to(folder).as_posix()) for folder in above)
    return next((mask for mask in found if mask is not None), None)


def with_altitudes(photos: list[Photo]) -> list[Photo]:
    """Replace missing altitudes by the median of the others."""
    known = [p.gps[2] for p in photos if p.gps and not math.isnan(p.gps[2])]
    usual = statistics.median(known) if known else 0.0
    return [replace(p, gps=(p.gps[0], p.gps[1], usual)) if p.gps and math.isnan(p.gps[2]) else p for p in photos]
