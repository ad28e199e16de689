"""Cache files: location, names, and atomic creation."""

import hashlib
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np

from ...errors import LumigraphError
from ...files import is_file
from ...system.cache import cache_folder as cache_folder
from ...system.memory import threads_for

CACHE_FORMAT = 2  # version of the cache's files
MARK_FILE = "store.json"  # written last: a folder that holds it is complete

Found = TypeVar("Found")


def key(parts: Iterable[str | None]) -> str:
    """Name of a cache file by a hash of these parts; unique if one of them is None."""
    digest = hashlib.sha256(f"{CACHE_FORMAT} {sys.byteorder}".encode())
    for number, part in enumerate(parts):
        digest.update(f"\n{part or f'{os.getpid()} {time.time_ns()} {number}'}".encode())
    return digest.hexdigest()[:32]


@contextmanager
def filled(folder: Path, size: int) -> Iterator[Path]:
    """Block that fills a cache folder with `size` bytes and MARK_FILE; it appears complete or not at all."""
    part = folder.with_name(f"{folder.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        yield part
        if not (folder / MARK_FILE).exists():  # else another process was quicker
            os.replace(part, folder)
    except OSError as fault:
        raise LumigraphError(
            f"{part.parent}: cannot keep {size / 1e9:.1f} GB of decoded images here ({fault.strerror or fault}); "
            f"free some space, set LUMIGRAPH_CACHE to a folder on another disk, or use a larger --downscale"
        ) from fault
    finally:
        shutil.rmtree(part, ignore_errors=True)


def new_file(path: Path, dtype: np.dtype | type, shape: tuple[int, ...]) -> np.memmap:
    """A mapped file to write to."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    with open(path, "wb") as file:  # claim the disk now: writing to a mapped file on a full disk kills the process
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            block = bytes(1 << 20)
            for begin in range(0, size, len(block)):
                file.write(block[: size - begin])
    return np.memmap(path, dtype, "r+", shape=shape)


def check_size(path: Path, size: int) -> None:
    """Raise LumigraphError unless a file of the cache has so many bytes."""
    if not is_file(path) or path.stat().st_size != size:
        raise LumigraphError(f"{path} is damaged; delete the folder {path.parent}, which is made again when needed")


def free_space(folder: Path) -> int:
    """Free bytes on the disk of a folder, which need not exist yet; very many if unknown."""
    there = next((place for place in (folder, *folder.parents) if place.is_dir()), Path.cwd())
    try:
        return shutil.disk_usage(there).free
    except OSError:
        return 1 << 60


def in_parallel(
    read: Callable[[int], Found],
    numbers: Sequence[int],
    progress: Callable[[int], object] = lambda done: None,
    each: int = 1,
) -> list[Found]:
    """Results of `read` for each number, from several threads. progress: called with each finished number; each: bytes
    of one call, which limit the threads by free memory"""
    with ThreadPoolExecutor(threads_for(each)) as pool:
        tasks = [pool.submit(read, number) for number in numbers]
        found = []
        try:
            for task in tasks:
                found.append(task.result())
                progress(len(found))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return found
