"""Reading of LiDAR points in a separate process: on damaged files, libraries of such formats crash or exhaust memory.

Run as a script: cloud_worker.py FILE RESULT.npy BYTES SECONDS. It imports nothing of the package. The exit code is 0
if the result is complete; otherwise the last line of standard error has the reason.
"""

from __future__ import annotations

import contextlib
import signal
import struct
import sys
from pathlib import Path

import numpy as np

PIECE = 1_000_000  # points that are unpacked together
WALL_FACTOR = 4  # of the seconds of the processor, for machines that are busy
LAS_HEADER_BYTES, RECORD_BYTES = 375, 54  # of version 1.4; of a record's own header
POINT_BYTES = 3 * 24  # of memory for each point: its coordinates, and copies of them


def main(path: Path, result: Path, memory: int, seconds: int) -> None:
    """Read a file and write an array of points. memory: bytes beyond those in use; seconds: of processor time"""
    limit(memory, seconds)
    points = read_e57(path) if path.suffix.lower() == ".e57" else read_las(path, memory)
    np.save(result, points)


def limit(memory: int, seconds: int) -> None:
    """Limit this process; no effect on systems without such limits."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limits = {resource.RLIMIT_AS: pages * resource.getpagesize() + memory, resource.RLIMIT_CPU: seconds}
        for kind, wanted in (*limits.items(), (resource.RLIMIT_CORE, 0)):
            hard = resource.getrlimit(kind)[1]
            resource.setrlimit(kind, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))
        signal.alarm(WALL_FACTOR * seconds)  # a library that runs out of memory may wait for itself


def read_las(path: Path, memory: int) -> np.ndarray:
    import laspy

    check_records(path)
    with laspy.open(path) as file:
        if file.header.point_count * POINT_BYTES > memory:
            raise ValueError(f"it declares {file.header.point_count:,} points, more than its size can hold")
        pieces = [np.stack([piece.x, piece.y, piece.z], -1) for piece in file.chunk_iterator(PIECE)]
    return np.concatenate([np.zeros((0, 3)), *pieces])


def check_records(path: Path) -> None:
    """Raise ValueError for more records of variable length than fit into the file: the library would loop."""
    with open(path, "rb") as file:
        head = file.read(LAS_HEADER_BYTES).ljust(LAS_HEADER_BYTES, b"\0")
        size = file.seek(0, 2)
    (records,), version = struct.unpack_from("<I", head, 100), head[25]
    further = struct.unpack_from("<I", head, 243)[0] if version >= 4 else 0
    if RECORD_BYTES * (records + further) > size:
        raise ValueError(f"it declares {records + further:,} records, more than its size can hold")


def read_e57(path: Path) -> np.ndarray:
    """Points of all scans in a file, at their poses."""
    import pye57

    with pye57.E57(str(path)) as file:
        scans = [file.read_scan(i, ignore_missing_fields=True) for i in range(file.scan_count)]
    return np.concatenate([np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], -1) for scan in scans])


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
    except BaseException as fault:  # a panic of a library in Rust is no Exception
        sys.exit(f"{' '.join(str(fault).split()) or type(fault).__name__}")
