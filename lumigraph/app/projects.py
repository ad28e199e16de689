"""Projects and other items of a folder. All of their state is in files, so the app may end at any time.

    NAME/project.json   title, and the path of photographs that were not uploaded
    NAME/photos/        uploaded photographs, or one video
    NAME/scene/         results of `lumigraph capture`
    NAME/runs/          runs, and splat files saved from them
    NAME/shared/        pages, films and files to share
    NAME/job.json       job request and progress: see `jobs`
    NAME/app.log        messages of the last command
    .lumigraph-app/     lock of the app; trash/ with deleted items, which can be restored

Runs and scenes that the command line made, also in `runs/` and `scenes/`, are items too.
"""

import itertools
import os
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from ..errors import LumigraphError
from ..files import exists, explained, is_file, read_json, refuse_link, remove, write_json
from ..files.names import natural
from .folders import size_within

PROJECT_FILE, JOB_FILE, LOG_FILE = "project.json", "job.json", "app.log"
PHOTOS, SCENE, RUNS, SHARED = "photos", "scene", "runs", "shared"
APP_FOLDER, TRASH = ".lumigraph-app", "trash"
SHELVES = "", RUNS, "scenes"  # folders whose folders are items
SCENE_FILES = "transforms.json", "transforms_train.json", "sparse", "poses_bounds.npy"  # of photographs with poses
EXAMPLE = Path(__file__).parents[1] / "samples" / "still-life.sog"
MAX_TITLE_LENGTH = 120  # letters
WRITTEN = PHOTOS, "left-out", SCENE, RUNS, SHARED  # folders of an item that the app writes into
PLAIN = r"[^./\\:\x00-\x1f][^/\\:\x00-\x1f]*"  # name of one file or folder that is not hidden
SEPARATOR = ":"  # between the folders of a key, as "/" cannot be in one part of a URL

ItemKind = Literal["project", "run", "scene"]


@dataclass(frozen=True)
class ProjectRecord:
    """Contents of project.json. source: photographs on this machine, in place of uploads; place: the project's path
    when the paths inside it were written"""

    title: str
    made: float
    source: str = ""
    place: str = ""


@dataclass(frozen=True)
class TrashRecord:
    """Place of a deleted item, relative to the folder, and its title."""

    origin: str
    title: str
    deleted: float


@dataclass(frozen=True)
class Item:
    """A project, a run or a scene in the app's folder.

    root: that folder; path: the item's
    """

    root: Path
    path: Path

    @property
    def key(self) -> str:
        return SEPARATOR.join(self.path.relative_to(self.root).parts)

    @property
    def kind(self) -> ItemKind:
        if (self.path / PROJECT_FILE).is_file():
            return "project"
        return "run" if is_run(self.path) else "scene"

    @property
    def record(self) -> ProjectRecord:
        """Contents of project.json; of another item its name and date."""
        if self.kind == "project":
            record = read_json(self.path / PROJECT_FILE, ProjectRecord)
            return replace(record, title=readable_title(record.title) or self.path.name)
        return ProjectRecord(self.path.name, changed_at(self.path))

    def keep(self, record: ProjectRecord) -> None:
        write_json(self.path / PROJECT_FILE, asdict(record), ours=True)

    @property
    def photographs(self) -> Path:
        """Photographs, a video, or a scene with poses: the input of `capture` or `train`."""
        if self.kind == "scene":
            return self.path
        return Path(self.record.source) if self.record.source else self.path / PHOTOS

    @property
    def runs(self) -> list[Path]:
        """Runs and splat files, the latest last; of a run the run itself."""
        if self.kind != "project":
            return [self.path] if self.kind == "run" else []
        folder = self.path / RUNS
        paths = filter(lambda path: is_plain_name(path.name), folder.iterdir() if folder.is_dir() else ())
        found = [path for path in paths if is_run(path) or is_splats(path)]
        return sorted(found, key=lambda path: (changed_at(path), natural(path.name)))

    def run(self, name: str) -> Path:
        """One of its runs by name. Raises LumigraphError if there is none."""
        for path in self.runs:
            if path.name == name:
                return path
        raise LumigraphError(f"{self.record.title} has no run {name[:80]!r}; load the page again")


def is_run(path: Path) -> bool:
    return is_file(path / "config.json") or is_file(path / "blocks.json")


def is_splats(path: Path) -> bool:
    return path.suffix.lower() in (".ply", ".spz", ".sog", ".splat") and path.is_file()


def newest(folder: Path) -> tuple[int, ...]:
    """Cache key of a run's card."""
    names = "metrics.jsonl", "eval.json", "eval-train.json", "config.json", "checkpoints", "blocks.json"
    places = (folder / name for name in names)
    return tuple(place.stat().st_mtime_ns for place in places if place.exists())


def items(root: Path) -> list[Item]:
    """Projects, runs and scenes of a folder, the latest first."""
    found = [Item(root, path) for shelf in SHELVES for path in candidates(root / shelf)]
    return sorted(found, key=lambda item: changed_at(item.path), reverse=True)


def changed_at(path: Path) -> float:
    """Time of change in seconds; 0 for a file or folder that is gone or cannot be read."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def candidates(folder: Path) -> Iterator[Path]:
    if not folder.is_dir():
        return
    with explained(folder):
        paths = list(folder.iterdir())
    yield from filter(is_item, paths)


def is_item(path: Path) -> bool:
    """True for the folder of a project, run or scene."""
    if path.name.startswith(".") or SEPARATOR in path.name or not os.path.isdir(path):
        return False
    return any(exists(path / name) for name in (PROJECT_FILE, *SCENE_FILES)) or is_run(path)


def find_item(root: Path, key: str) -> Item:
    """Item by key. Raises LumigraphError for an unknown one, and for keys that lead out of the folder."""
    parts = key.split(SEPARATOR)
    path = root.joinpath(*parts) if all(map(is_plain_name, parts)) else None
    shelves = {root / shelf for shelf in SHELVES}
    if path is None or path.parent not in shelves or not is_item(path):
        raise LumigraphError(f"There is no scene {key[:80]!r} here; load the page again")
    for place in (path.parent, path, *(path / name for name in WRITTEN)):
        refuse_link(place)
    return Item(root, path)


def is_plain_name(name: str) -> bool:
    """True for the name of one file or folder that is not hidden."""
    return bool(re.fullmatch(PLAIN, name))


def check_title(title: str) -> str:
    title = " ".join(title.split())
    if not title or title != readable_title(title):
        raise LumigraphError(f"A name has 1 to {MAX_TITLE_LENGTH} letters; choose another one")
    return title


def readable_title(title: str) -> str:
    """A title on one line, without invisible characters, truncated to the limit."""
    return "".join(x for x in " ".join(title.split()) if x.isprintable())[:MAX_TITLE_LENGTH]


def free_place(root: Path, title: str) -> Path:
    """A new folder name from a title."""
    stem = re.sub(r"[^\w.-]+", "-", title).strip(".-_")[:60] or "scene"
    names = itertools.chain([stem], (f"{stem}-{n}" for n in itertools.count(2)))
    return next(root / name for name in names if not os.path.lexists(root / name))


def new_project(root: Path, title: str, source: Path | None = None) -> Item:
    """Make an empty project. source: photographs, a video or a scene on this machine"""
    title = check_title(title)
    if source is not None and not source.exists():
        raise LumigraphError(f"{source} does not exist; check the path")
    item = Item(root, free_place(root, title))
    with explained(item.path):
        (item.path / PHOTOS).mkdir(parents=True)
    item.keep(ProjectRecord(title, time.time(), str(source.resolve()) if source else "", str(item.path.resolve())))
    return item


def new_example(root: Path) -> Item:
    """Make a project with a finished scene, which the package holds."""
    item = new_project(root, "Example, a still life")
    (item.path / RUNS).mkdir()
    shutil.copyfile(EXAMPLE, item.path / RUNS / EXAMPLE.name)
    return item


def rename(item: Item, title: str) -> Item:
    """Give an item another title. A project keeps its folder, whose path is stored in its runs; others are renamed."""
    title = check_title(title)
    if item.kind == "project":
        record = item.record
        item.keep(ProjectRecord(title, record.made, record.source, record.place))
        return item
    if item.kind == "scene":
        raise LumigraphError(f"{item.path} keeps its name, by which runs find their photographs")
    target = free_place(item.path.parent, title)
    with explained(target):
        item.path.rename(target)
    return Item(item.root, target)


def duplicate(item: Item) -> Item:
    """A copy of an item, without shared files and jobs."""
    record = item.record
    copy = Item(item.root, free_place(item.path.parent, f"{record.title} copy"))
    leave = shutil.ignore_patterns(SHARED, JOB_FILE, LOG_FILE, "lock.json", ".lumigraph-*.partial")
    try:
        with explained(copy.path):
            shutil.copytree(item.path, copy.path, symlinks=True, ignore=leave)
    except BaseException:
        remove(copy.path)
        raise
    if item.kind == "project":
        copy.keep(ProjectRecord(check_title(f"{record.title} copy"[:MAX_TITLE_LENGTH]), time.time(), record.source))
        relocate(copy, record.place or str(item.path.resolve()))
    return copy


def relocate(item: Item, before: str | None = None) -> None:
    """Correct the paths inside a project that was moved or copied. before: its path when they were written"""
    if item.kind != "project":
        return
    record, now = item.record, str(item.path.resolve())
    before = record.place if before is None else before
    if before == now or not before:
        return
    scene = item.path / SCENE
    places = [scene / "work" / "sources.json", scene / "capture.json", *(run / "config.json" for run in item.runs)]
    for path in filter(Path.is_file, places):
        write_json(path, replace_folder(read_json(path), before, now), ours=True)
    item.keep(ProjectRecord(record.title, record.made, record.source, now))


def replace_folder(value: object, before: str, now: str) -> object:
    """JSON with paths below one folder moved to another."""
    match value:
        case dict():
            return {key: replace_folder(one, before, now) for key, one in value.items()}
        case list():
            return [replace_folder(one, before, now) for one in value]
        case str() if value == before or value.startswith(before + os.sep):
            return now + value[len(before) :]
    return value


# Trash


def trash_folder(root: Path) -> Path:
    return root / APP_FOLDER / TRASH


def delete(item: Item) -> str:
    """Move an item to the trash. Returns its name for `restore`."""
    record = TrashRecord(item.path.relative_to(item.root).as_posix(), item.record.title, time.time())
    place = free_place(trash_folder(item.root), item.path.name)
    write_json(place.with_name(f"{place.name}.json"), asdict(record), ours=True)
    with explained(place):
        item.path.rename(place)
    return place.name


def restore(root: Path, name: str) -> Item:
    """Restore an item from the trash, to its original path or beside it."""
    place = trash_folder(root) / name
    about = place.with_name(f"{name}.json")
    if not is_plain_name(name) or not about.is_file() or not place.is_dir():
        raise LumigraphError(f"{name[:80]!r} is not in the trash any more; load the page again")
    origin = read_json(about, TrashRecord).origin
    target = root / origin
    if ".." in Path(origin).parts or Path(origin).is_absolute():
        raise LumigraphError(f"{about} names a place outside the folder; move {place} to its place by hand")
    target = free_place(target.parent, target.name) if os.path.lexists(target) else target
    with explained(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        place.rename(target)
    remove(about)
    relocate(item := Item(root, target))
    return item


def trash(root: Path, until: float) -> list[dict[str, Any]]:
    """Deleted items, the latest first. until: moment (time.monotonic) after which no sizes are counted"""
    folder = trash_folder(root)
    found: list[dict[str, Any]] = []
    for about in folder.glob("*.json") if folder.is_dir() else ():
        place = about.with_suffix("")
        if not place.is_dir():
            continue
        try:
            record = read_json(about, TrashRecord)
        except LumigraphError:  # such an item can still be moved back by hand, or deleted with the others
            record = TrashRecord(place.name, place.name, 0.0)
        found.append({"name": place.name, "bytes": size_within(place, until)} | asdict(record))
    return sorted(found, key=lambda one: one["deleted"], reverse=True)


def empty_trash(root: Path) -> None:
    folder = trash_folder(root)
    for path in list(folder.iterdir()) if folder.is_dir() else ():
        remove(path)
