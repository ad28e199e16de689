"""Records of jobs in job.json: as they were asked for, and how far they are."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from ..budget import Quality
from ..files import read_json, write_json
from ..files.ranges import Count, Downscale, Seconds, Steps
from .projects import JOB_FILE, Item

JobState = Literal["queued", "running", "paused", "stopped", "failed", "done"]
Mapper = Literal["incremental", "global"]


@dataclass(frozen=True)
class Making:
    """Photographs to a run: as it was asked for, and how far it is.

    quality, seconds, steps: budget of the training, one of them
    stage:   the command that is next or under way
    run:     name of the run in the project's runs; empty before training
    fault:   sentence of the command that failed
    process: number of the running child
    """

    state: JobState
    asked: float
    quality: Quality | None = None
    seconds: Seconds | None = None
    steps: Steps | None = None
    method: str = "gaussian-splatting"
    mapper: Mapper = "incremental"
    frames: Count | None = None
    downscale: Downscale | None = None
    mask_object: bool = False
    stage: Literal["capture", "train"] = "capture"
    run: str = ""
    fault: str = ""
    process: int = 0


@dataclass(frozen=True)
class ShareJob:
    """A run to a file in the project's shared folder. command: words between the run and the file, see `sharing`"""

    name: str
    kind: str
    run: str
    options: list[str]
    state: JobState
    asked: float
    fault: str = ""
    process: int = 0


@dataclass(frozen=True)
class JobRecord:
    """Contents of job.json."""

    make: Making | None = None
    shares: list[ShareJob] = field(default_factory=list)


_writing = threading.RLock()  # around reading, changing and writing a record


def read_job(item: Item) -> JobRecord:
    path = item.path / JOB_FILE
    return read_json(path, JobRecord) if path.is_file() else JobRecord()


def change(item: Item, make: Callable[[JobRecord], JobRecord]) -> JobRecord:
    """Read, change and write a record; nobody else does meanwhile."""
    with _writing:
        after = make(read_job(item))
        write_json(item.path / JOB_FILE, asdict(after), ours=True)
        return after


def change_making(item: Item, **values: Any) -> JobRecord:
    return change(item, lambda job: replace(job, make=job.make and replace(job.make, **values)))


def change_share(item: Item, name: str, **values: Any) -> JobRecord:
    def one(share: ShareJob) -> ShareJob:
        return replace(share, **values) if share.name == name else share

    return change(item, lambda job: replace(job, shares=[one(share) for share in job.shares]))
