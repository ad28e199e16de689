"""Rows of the page: JSON about items, runs, jobs and the findings of a capture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..budget import QUALITIES
from ..errors import LumigraphError
from ..exchange import size_of
from . import pictures, progress
from .comparison import comparison, rendering
from .job_record import Making, ShareJob, read_job
from .jobs import log_lines
from .projects import SCENE, SHARED, Item

MIN_PLACED_SHARE = 0.9  # of the photographs, below which the other mapper is offered
MAX_MESSAGES = 30  # lines of a log on the page


def card(item: Item) -> dict[str, Any]:
    """Card of an item on the home page."""
    try:
        record = item.record
        runs = [path for path in item.runs if path.is_dir()]
        about = progress.card_of_run(runs[-1]) if runs else {"method": "", "psnr": None}
        job = read_job(item).make
        size = size_of(item.path)
    except LumigraphError as fault:
        return {"key": item.key, "kind": item.kind, "title": item.path.name, "fault": str(fault), "age": 0, "bytes": 0}
    picture = next((path for run in reversed(runs) if (path := progress.picture_of_run(run))), None)
    picture = picture or next(iter(pictures.photographs_of(item).values()), None)
    return {
        "key": item.key,
        "kind": item.kind,
        "title": record.title,
        "picture": pictures.version_of(picture) if picture else "",
        "age": progress.age(item.path),
        "bytes": size,
        "state": job.state if job else "",
        "share": progress.progress_of(item, job)["share"] if job and job.state == "running" else None,
        "fault": job.fault if job else "",
        "runs": len(runs),
        **about,
    }


def run_row(path: Path) -> dict[str, Any]:
    about = progress.card_of_run(path) if path.is_dir() else {"method": path.suffix, "psnr": None, "trained": True}
    picture = progress.picture_of_run(path)
    row = {"name": path.name, "bytes": size_of(path), "age": progress.age(path), **about}
    row["compared"] = comparison(path)
    return row | {"picture": pictures.version_of(picture) if picture else ""}


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
    place = item.path / SHARED / share.name
    there = place.stat().st_size if share.state == "done" and place.is_file() else None
    names = ("name", "kind", "run", "state", "fault")
    return {name: getattr(share, name) for name in names} | {"bytes": there}


def result_of(item: Item) -> dict[str, Any] | None:
    """Findings of the capture: photographs placed and left out, warnings, and what to do."""
    result = progress.capture_result(item)
    if result is None:
        return None
    names = ("given", "left_out", "blurred", "duplicates", "warnings", "error", "points", "angle", "findings")
    kept = {name: result.get(name) for name in names} | {"placed": len(result.get("registered", []))}
    mapper = result.get("options", {}).get("mapper", "incremental")
    folded = any("folded" in one or "far apart" in one or "leap" in one for one in result.get("warnings", []))
    few = len(result.get("registered", [])) < MIN_PLACED_SHARE * (result.get("used") or 0)
    other = "global" if mapper == "incremental" else "incremental"
    return kept | {"mapper": mapper, "try": other if folded or few else ""}


def picture(item: Item, name: str, run: str) -> Path:
    """File of a photograph by name, its rendering by a run, a run's preview, or the picture of a card.

    Raises LumigraphError without one.
    """
    found: Path | None = None
    if name and run:
        found = rendering(item.run(run), name)
    elif name:
        made = pictures.files_of(item.path / SCENE / "images")
        plain = name.removeprefix("images/")  # as a scene names it
        found = pictures.photographs_of(item).get(plain) or made.get(plain)
    elif run:
        found = progress.picture_of_run(item.run(run))
    else:
        found = next(filter(None, map(progress.picture_of_run, reversed(item.runs))), None)
        found = found or next(iter(pictures.photographs_of(item).values()), None)
    if found is None:
        raise LumigraphError("There is no such picture; load the page again")
    return found
