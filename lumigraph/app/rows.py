"""Rows of the page: JSON about items, runs, jobs and the findings of a capture."""

from pathlib import Path
from typing import Any

from ..budget import QUALITIES
from ..errors import LumigraphError
from . import pictures, progress
from .comparison import comparison, rendering
from .folders import size_within
from .job_record import Making, ShareJob, read_job
from .jobs import log_lines, run_folder
from .projects import SCENE, SHARED, Item, changed_at

MIN_PLACED_SHARE = 0.9  # of the photographs, below which the other mapper is offered
MAX_MESSAGES = 30  # lines of a log on the page


def card(item: Item, until: float) -> dict[str, Any]:
    """Card of an item on the home page. until: moment (time.monotonic) after which no folder is looked through"""
    row = {"key": item.key, "kind": item.kind, "title": item.path.name, "age": progress.age(item.path), "bytes": None}
    try:
        record = item.record
        runs = [path for path in item.runs if path.is_dir()]
        about = progress.card_of_run(runs[-1]) if runs else {"method": "", "psnr": None}
        job = read_job(item).make
        share = progress.progress_of(item, job)["share"] if job and job.state == "running" else None
    except Exception as fault:  # a received folder may hold anything
        return row | {"fault": progress.sentence_of(item.path, fault)}
    picture = next((path for run in reversed(runs) if (path := progress.picture_of_run(run))), None)
    found, missing = (picture, "") if picture or item.kind == "run" else first_photograph(item, until)
    return row | {
        "title": record.title,
        "picture": pictures.version_of(found) if found else "",
        "bytes": size_within(item.path, until),
        "state": job.state if job else "",
        "share": share,
        "fault": job.fault if job and job.fault else missing,
        "runs": len(runs),
        **about,
    }


def first_photograph(item: Item, until: float) -> tuple[Path | None, str]:
    return pictures.first_of(pictures.folder_of(item), until)


def run_row(path: Path) -> dict[str, Any]:
    row = {"name": path.name, "bytes": size_within(path), "age": progress.age(path), "compared": None, "picture": ""}
    if not path.is_dir():
        return row | {"method": path.suffix, "psnr": None, "trained": True, "splats": True}
    picture = progress.picture_of_run(path)
    row |= progress.card_of_run(path) | {"picture": pictures.version_of(picture) if picture else ""}
    try:
        return row | {"compared": comparison(path)}
    except Exception as fault:  # a received run may hold anything
        return row | {"fault": progress.sentence_of(path, fault)}


def making_row(item: Item, job: Making) -> dict[str, Any]:
    row: dict[str, Any] = {
        name: getattr(job, name)
        for name in ("state", "stage", "quality", "seconds", "method", "mapper", "run", "fault")
    }
    if job.state == "queued":
        return row
    row["progress"] = progress.progress_of(item, job)
    if job.quality in QUALITIES[:-1]:
        row["next"] = QUALITIES[QUALITIES.index(job.quality) + 1]
    row["messages"] = log_lines(item)[-MAX_MESSAGES:]
    return row


def share_row(item: Item, share: ShareJob) -> dict[str, Any]:
    """State of a file to share. bytes: None before it is made, and where its run was trained further since"""
    place, run = item.path / SHARED / share.name, run_folder(item, share.run)
    fresh = share.state == "done" and place.is_file() and changed_at(place) >= changed_at(run / "checkpoints")
    there = place.stat().st_size if fresh else None
    names = ("name", "kind", "run", "state", "fault")
    return {name: getattr(share, name) for name in names} | {"bytes": there}


def result_of(item: Item) -> dict[str, Any] | None:
    """Findings of the capture, with advice. Raises LumigraphError for a damaged capture.json."""
    result = progress.capture_result(item)
    if result is None:
        return None
    names = ("given", "left_out", "blurred", "duplicates", "warnings", "error", "points", "angle", "findings")
    placed, mapper = len(result.registered), result.options.get("mapper", "incremental")
    folded = any("folded" in one or "far apart" in one or "leap" in one for one in result.warnings)
    other = "global" if mapper == "incremental" else "incremental"
    tried = other if folded or placed < MIN_PLACED_SHARE * result.used else ""
    return {name: getattr(result, name) for name in names} | {"placed": placed, "mapper": mapper, "try": tried}


def picture(item: Item, name: str, run: str) -> Path:
    """File of a photograph by name, its rendering by a run, a run's preview, or the picture of a card.

    Raises LumigraphError without one.
    """
    found: Path | None = None
    if name and run:
        found = rendering(item.run(run), name)
    elif name and item.kind != "run":
        found = pictures.named_file(pictures.folder_of(item), name)
        made = item.path / SCENE / "images"
        found = found or pictures.named_file(made, name.removeprefix("images/"))  # as a scene names it
    elif run:
        found = progress.picture_of_run(item.run(run))
    else:
        found = next(filter(None, map(progress.picture_of_run, reversed(item.runs))), None)
        found = found or (None if item.kind == "run" else first_photograph(item, float("inf"))[0])
    if found is None:
        raise LumigraphError("There is no such picture; load the page again")
    return found
