"""What lies in a folder, byte for byte; what has changed since; and whether a file that was written is whole."""

from __future__ import annotations

import json
import os
import struct
import zipfile
import zlib
from collections.abc import Iterable
from fnmatch import fnmatch
from hashlib import blake2b
from pathlib import Path

from PIL import Image

PICTURES = (".png", ".jpg", ".jpeg", ".gif", ".webp")
FILMS = (".mp4",)
OF_LOCKS = "lock.json"  # says who works in a folder; nothing rests on what it holds


def snapshot(folder: Path) -> dict[str, bytes]:
    """A checksum of each file below a folder, by its path from there. Folders are named too; links are not followed."""
    found: dict[str, bytes] = {}
    for place, folders, files in os.walk(os.fsencode(folder)):
        inside = os.path.relpath(place, os.fsencode(folder))
        for name in folders:
            found[os.fsdecode(os.path.normpath(os.path.join(inside, name)))] = b"folder"
        for name in files:
            path = os.path.join(place, name)
            if os.path.islink(path):
                data = os.readlink(path)
            elif not os.path.isfile(path):
                data = b"special"
            else:
                with open(path, "rb") as file:
                    data = file.read()
            found[os.fsdecode(os.path.normpath(os.path.join(inside, name)))] = blake2b(data).digest()
    return found


def touched(before: dict[str, bytes], after: dict[str, bytes], ours: Iterable[str]) -> list[str]:
    """What was there and is not as it was, beside what a command may change.

    ours: patterns of paths, as fnmatch knows them
    """
    ours = list(ours)
    changed = [path for path, data in before.items() if after.get(path) != data]
    return sorted(path for path in changed if not any(fnmatch(path, pattern) for pattern in ours))


def halfway(folder: Path, before: dict[str, bytes], after: dict[str, bytes]) -> list[str]:
    """What is new or changed and is not whole: what is left of writing, and files that do not open."""
    new = [path for path, data in after.items() if before.get(path) != data and data != b"folder"]
    return sorted(path for path in new if is_left_over(path) or not is_whole(folder / path))


def is_left_over(path: str) -> bool:
    """Whether a path is a name under which something is written before it takes its place."""
    return any(".partial" in part or part.endswith((".tmp", "~")) for part in Path(path).parts)


def is_whole(path: Path) -> bool:
    """Whether a file is what its name says, to the end. Names that say nothing are believed."""
    suffix = path.suffix.lower()
    try:
        if path.name == OF_LOCKS:
            return True
        if suffix == ".json":
            json.loads(path.read_text("utf-8"))
        elif suffix == ".jsonl":
            return not (text := path.read_text("utf-8")) or text.endswith("\n")
        elif suffix == ".html":
            return path.read_text("utf-8").rstrip().endswith("</html>")
        elif suffix == ".svg":
            return path.read_text("utf-8").rstrip().endswith("</svg>")
        elif suffix == ".safetensors":
            return safetensors_are_whole(path.read_bytes())
        elif suffix in PICTURES:
            with Image.open(path) as image:
                for number in range(getattr(image, "n_frames", 1)):
                    image.seek(number)
                    image.load()
        elif suffix in FILMS:
            return film_is_whole(path)
        elif suffix == ".ply":
            return ply_is_whole(path)
        elif suffix == ".gz":
            return gzip_is_whole(path.read_bytes())
        elif suffix == ".spz":
            return spz_is_whole(path.read_bytes())
        elif suffix == ".glb":
            return struct.unpack_from("<4sII", path.read_bytes()) == (b"glTF", 2, path.stat().st_size)
        elif suffix == ".sog":
            with zipfile.ZipFile(path) as archive:
                return archive.testzip() is None
        elif suffix == ".splat":
            return path.stat().st_size % 32 == 0 and path.stat().st_size > 0
    except Exception:
        return False
    return True


def safetensors_are_whole(data: bytes) -> bool:
    (length,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + length])
    ends = [row["data_offsets"][1] for name, row in header.items() if name != "__metadata__"]
    return len(data) == 8 + length + max(ends, default=0)


def film_is_whole(path: Path) -> bool:
    import av

    with av.open(str(path)) as film:
        return sum(1 for _ in film.decode(video=0)) > 0


def ply_is_whole(path: Path) -> bool:
    from lumigraph.files import ply

    return len(ply.read_rows(path, ply.read_header(path).elements)) > 0


def spz_is_whole(data: bytes) -> bool:
    """Whether the streams of version 4, of which a table tells, fill the file."""
    count, table = struct.unpack_from("<BI", data, 15)
    streams = [struct.unpack_from("<QQ", data, table + 16 * i)[0] for i in range(count)]
    return table + 16 * count + sum(streams) == len(data)


def gzip_is_whole(data: bytes) -> bool:
    unpack = zlib.decompressobj(31)
    unpack.decompress(data)
    return unpack.eof
