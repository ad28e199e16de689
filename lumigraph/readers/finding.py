"""Files as other programs name them: with backslashes, with the folders of another machine, in other letters."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from ..files import is_file
from .pictures import find_file

MAX_LINK_BYTES = 255  # of the text of a link
NO_LETTERS = re.compile(r"[\W_]+")
PHOTOGRAPH_FOLDERS = ("images", "input", "image", "rgb", "photos", "../images", "../resized_images")  # from a scene on
LOST = re.compile("\ufffd+")  # letters of another encoding than UTF-8


def find_named(folder: Path, name: str) -> Path:
    """The file that a name means, from a folder on; `folder / name` if there is none.

    Looked for in turn: the name as it is; its end, from the longest on, below the folder and its folders of
    photographs; the same in other letters (upper and lower case, composed and decomposed accents), and with other signs
    between letters and digits, as programs replace spaces and brackets; the only one that differs in letters which are
    no UTF-8. Signs of a link (%20) are undone.
    """
    exact = find_file(folder / name)
    if is_file(exact):
        return exact
    name = unquote(name)
    parts = PurePosixPath(name.replace("\\", "/")).parts
    parts = tuple(part for part in parts if part not in ("/", ".", "..") and not part.endswith(":"))
    ends = [parts[i:] for i in range(len(parts))]
    inner = (as_folder(folder / one) for one in PHOTOGRAPH_FOLDERS)
    places = [folder, *(one for one in inner if one.is_dir())]
    for end in ends:
        for place in places:
            if is_file(found := find_file(place.joinpath(*end))):
                return found
    for form in (folded, letters):
        for end in ends:
            for place in places:
                if (other := in_other_form(place, end, form)) is not None:
                    return other
    if "\ufffd" in name:
        alike = re.compile(LOST.sub(".+", re.escape(parts[-1])))
        files = {x.resolve() for place in places for x in place.iterdir() if alike.fullmatch(x.name) and is_file(x)}
        return files.pop() if len(files) == 1 else exact
    return exact


def as_folder(path: Path) -> Path:
    """The folder to which a link leads that was copied as text, as git and archives do on Windows; else the path."""
    if path.is_file() and path.stat().st_size <= MAX_LINK_BYTES:
        target = path.parent / path.read_text("utf-8", "replace").strip()
        return target if target.is_dir() else path
    return path


def in_other_form(folder: Path, parts: tuple[str, ...], form: Callable[[str], str]) -> Path | None:
    """The file below a folder whose path has the same form."""
    for part in parts:
        entry = entries(folder, stamp(folder), form).get(form(part))
        if entry is None:
            return None
        folder = folder / entry
    return folder if is_file(folder) else None


def folded(name: str) -> str:
    """A name in lower case and composed letters."""
    return unicodedata.normalize("NFC", name).casefold()


def letters(name: str) -> str:
    """Letters and digits of a name, and its suffix."""
    stem, _, suffix = folded(name).rpartition(".")
    return NO_LETTERS.sub("", stem) + "." + suffix


def stamp(folder: Path) -> int:
    return folder.stat().st_mtime_ns if folder.is_dir() else 0


@lru_cache(256)
def entries(folder: Path, modified: int, form: Callable[[str], str]) -> dict[str, str]:
    """Names in a folder by their forms; none where two names have one form."""
    names = sorted(os.listdir(folder)) if folder.is_dir() else []
    found = {form(name): name for name in names}
    return found if len(found) == len(names) else {}


def paired(names: Iterable[str], others: Iterable[str]) -> dict[str, str]:
    """Names of one list to those of another that mean the same photograph: by their paths below the folder that all of
    a list are in, without suffixes. What is ambiguous has no pair."""
    by_end: dict[str, str | None] = {}
    for other, ends in ends_of(others).items():
        for end in ends:
            by_end[end] = other if end not in by_end else None
    found = {
        name: next((by_end[end] for end in ends if by_end.get(end)), None) for name, ends in ends_of(names).items()
    }
    return {name: other for name, other in found.items() if other is not None}


def ends_of(names: Iterable[str]) -> dict[str, list[str]]:
    """Ends of each path, from the whole one to that below the folder that all are in, by name."""
    paths = {name: PurePosixPath(name.replace("\\", "/")).with_suffix("").parts for name in names}
    if not paths:
        return {}
    common = len(os.path.commonprefix([parts[:-1] for parts in paths.values()]))
    return {name: ["/".join(parts[i:]) for i in range(common + 1)] for name, parts in paths.items()}
