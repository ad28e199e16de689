"""Files to share: kinds, the request to make each, and its estimated size."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import LumigraphError
from ..system.children import Request
from .comparison import COMPARE, eval_options
from .job_record import ShareJob, ShareName
from .projects import SHARED, Item, is_splats

# Sizes: bytes of a Gaussian or of a second of film. Page: 16 of a draft, 36 of a cloud of degree 3; .spz of the latter.
PAGE_BYTES, PAGE_BYTES_PER_GAUSSIAN = 200_000, 25
SPZ_BYTES_PER_GAUSSIAN = 18
FILE_MANAGERS = {"darwin": "open", "win32": "explorer"}  # by system; elsewhere xdg-open
VIEWS_PAGE_BYTES = 72 * 30_000
FILM_SECONDS, FILM_BYTES_PER_SECOND = 4, 700_000
MESH_BYTES, POINTS_BYTES = 6_000_000, 4_000_000


@dataclass(frozen=True)
class ShareKind:
    """One kind of file.

    about: for users; command: that makes it
    clouds_only: True for methods of Gaussians alone
    size: estimate in bytes, from the number of Gaussians; None for other methods
    """

    title: str
    about: str
    ending: str
    command: str
    size: Callable[[int | None], float]
    clouds_only: bool = False


KINDS: dict[ShareName, ShareKind] = {
    "page": ShareKind(
        "Web page",
        "One file that opens in any browser, on a phone too, without a server",
        ".html",
        "export web",
        lambda n: VIEWS_PAGE_BYTES if n is None else PAGE_BYTES + n * PAGE_BYTES_PER_GAUSSIAN,
    ),
    "film": ShareKind(
        "Film", "MP4, a flight around the scene", ".mp4", "render", lambda n: FILM_SECONDS * FILM_BYTES_PER_SECOND
    ),
    "splats": ShareKind(
        "Splats",
        "Gaussians for other programs, as .spz",
        ".spz",
        "export splats",
        lambda n: (n or 0) * SPZ_BYTES_PER_GAUSSIAN,
        True,
    ),
    "mesh": ShareKind("Mesh", "A surface with a texture, as .glb", ".glb", "export mesh", lambda n: MESH_BYTES),
    "points": ShareKind("Points", "Coloured points, as .ply", ".ply", "export points", lambda n: POINTS_BYTES),
}


def kinds_for(path: Path) -> list[dict[str, Any]]:
    """Kinds of files for a run or a splat file, each with its estimated size."""
    count = gaussians_of(path)
    return [
        {"kind": name, "title": kind.title, "about": kind.about, "bytes": kind.size(count)}
        for name, kind in KINDS.items()
        if count is not None or not kind.clouds_only
    ]


def gaussians_of(path: Path) -> int | None:
    """Number of Gaussians of a run or a splat file; None without Gaussians."""
    from ..large import open_run
    from ..run.records import read_rows

    if is_splats(path):
        return path.stat().st_size // SPZ_BYTES_PER_GAUSSIAN
    rows = read_rows(path / "metrics.jsonl")
    counts = [row["statistics"]["gaussians"] for row in rows[-20:] if "gaussians" in row["statistics"]]
    if counts:
        return int(counts[-1])
    weights = open_run(path).version
    return header_count(Path(weights)) if weights else None


def header_count(weights: Path) -> int | None:
    """Number of Gaussians in a file of weights, from its header alone."""
    from safetensors import safe_open

    if weights.suffix != ".safetensors" or not weights.is_file():
        return None
    with safe_open(weights, "pt") as file:
        names = [name for name in file.keys() if name.endswith("means")]
        return file.get_slice(names[0]).get_shape()[0] if names else None


def share_job(item: Item, kind: ShareName, run: Path, now: float, size: int | None = None) -> ShareJob:
    """The job of a file to share. size: longer side of a film in pixels"""
    if kind == COMPARE:
        return ShareJob(f"{COMPARE}-{run.name}", kind, run.name, "queued", now)
    if kind not in [one["kind"] for one in kinds_for(run)]:
        raise LumigraphError(f"{run.name} is no cloud of Gaussians, so there are no splats; choose another kind")
    stem = item.path.name if run == item.path else f"{item.path.name}-{run.name.partition('.')[0]}"
    return ShareJob(f"{stem}{KINDS[kind].ending}", kind, run.name, "queued", now, size)


def share_request(item: Item, job: ShareJob) -> Request:
    """Command that makes a file. It replaces our own file of an earlier version."""
    run, place = item.run(job.run), item.path / SHARED / job.name
    if job.kind == COMPARE:
        return Request("eval", {"run_folder": str(run)} | eval_options(run))
    place.parent.mkdir(exist_ok=True)
    options: dict[str, Any] = {"source": str(run), "output": str(place)}
    if job.kind == "film":
        options["size"] = job.size
    if job.kind == "page":
        options["title"] = item.record.title
    if job.kind in ("mesh", "points"):
        options["origin"] = False  # the place on Earth stays at home
    if job.kind == "mesh":
        options["texture"] = True
    return Request(KINDS[job.kind].command, options)


def reveal(folder: Path) -> None:
    """Open a folder in the system's file manager. Raises LumigraphError where there is none."""
    if not folder.is_dir():  # what is no folder would be opened by the program of its kind
        raise LumigraphError(f"{folder} does not exist yet; make a file first")
    program, pipe = FILE_MANAGERS.get(sys.platform, "xdg-open"), subprocess.DEVNULL
    try:
        subprocess.Popen([program, folder], stdin=pipe, stdout=pipe, stderr=pipe, start_new_session=True)
    except OSError as fault:
        raise LumigraphError(f"No file manager was found ({program}); the files are in {folder}") from fault
