"""Job records in job.json: requests and progress.

A record is authenticated with a key of this user. A job of another record, as in a folder that was received or moved,
does not start by itself: it waits until a user presses a button.
"""

import contextlib
import functools
import hashlib
import hmac
import json
import os
import secrets
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Literal

import msgspec

from ..budget import Quality
from ..files import read_json, write_json
from ..files.ranges import Count, Downscale, Pixels, Seconds, Steps, Tally
from ..system.cache import cache_folder
from .projects import JOB_FILE, PLAIN, Item

KEY_FILE, KEY_BYTES = "app.key", 32  # in the user's cache folder
NOT_SEALED = "This was not asked for by the app at this place; press the button to begin"
Sentence = Annotated[str, msgspec.Meta(max_length=10_000)]
PlainName = Annotated[str, msgspec.Meta(max_length=255, pattern=rf"\A{PLAIN}\Z")]
RunName = Annotated[str, msgspec.Meta(max_length=255, pattern=rf"\A({PLAIN})?\Z")]
ShareName = Literal["page", "film", "splats", "mesh", "points", "compare"]
JobState = Literal["queued", "running", "paused", "stopped", "failed", "done"]
Mapper = Literal["incremental", "global"]


@dataclass(frozen=True)
class Making:
    """Job from photographs to a run: request and progress.

    quality, seconds, steps: budget of the training, one of them
    stage:   the next or current command
    run:     name of the run in the project's runs; empty before training
    fault:   error sentence of the failed command
    process: number of the running child
    """

    state: JobState
    asked: float
    quality: Quality | None = None
    seconds: Seconds | None = None
    steps: Steps | None = None
    method: PlainName = "gaussian-splatting"
    mapper: Mapper = "incremental"
    frames: Count | None = None
    downscale: Downscale | None = None
    mask_object: bool = False
    stage: Literal["capture", "train"] = "capture"
    run: RunName = ""
    fault: Sentence = ""
    process: Tally = 0


@dataclass(frozen=True)
class ShareJob:
    """Job from a run to a file in the project's shared folder. size: longer side of a film in pixels"""

    name: PlainName
    kind: ShareName
    run: PlainName
    state: JobState
    asked: float
    size: Pixels | None = None
    fault: Sentence = ""
    process: Tally = 0


@dataclass(frozen=True)
class JobRecord:
    """Contents of job.json."""

    make: Making | None = None
    shares: list[ShareJob] = field(default_factory=list)
    seal: str = ""


_writing = threading.RLock()  # around reading, changing and writing a record


def read_job(item: Item) -> JobRecord:
    """Job record of an item. Jobs not requested by this user's app at this path wait."""
    path = item.path / JOB_FILE
    if not path.is_file():
        return JobRecord()
    record = read_json(path, JobRecord)
    return record if hmac.compare_digest(record.seal, seal_of(item, record)) else waiting(record)


def waiting(record: JobRecord) -> JobRecord:
    """A record whose jobs wait for a button, pages too: the app opens those that it made itself."""

    def held_up(job: Any, state: JobState) -> Any:
        waits = job.state in ("queued", "running") or (job.state == "done" and getattr(job, "kind", "") == "page")
        return replace(job, state=state, fault=NOT_SEALED, process=0) if waits else job

    return JobRecord(record.make and held_up(record.make, "paused"), [held_up(one, "failed") for one in record.shares])


def seal_of(item: Item, record: JobRecord) -> str:
    """Authentication code of a record at its path (HMAC-SHA256)."""
    text = json.dumps([str(item.path.resolve()), asdict(replace(record, seal=""))], sort_keys=True)
    return hmac.new(user_key(), text.encode(), hashlib.sha256).hexdigest()


@functools.cache
def user_key() -> bytes:
    """This user's key, made at first use; one of this process alone if it cannot be saved."""
    place, new = cache_folder() / KEY_FILE, secrets.token_bytes(KEY_BYTES)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError), open(place, "xb", opener=of_this_user) as file:
            file.write(new)
        kept = place.read_bytes()
    except OSError:
        return new
    return kept if len(kept) == KEY_BYTES else new


def of_this_user(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def change(item: Item, make: Callable[[JobRecord], JobRecord]) -> JobRecord:
    """Read, change and write a record under a lock."""
    with _writing:
        after = make(read_job(item))
        after = replace(after, seal=seal_of(item, after))
        write_json(item.path / JOB_FILE, asdict(after), ours=True)
        return after


def change_making(item: Item, **values: Any) -> JobRecord:
    return change(item, lambda job: replace(job, make=job.make and replace(job.make, **values)))


def change_share(item: Item, name: str, **values: Any) -> JobRecord:
    def one(share: ShareJob) -> ShareJob:
        return replace(share, **values) if share.name == name else share

    return change(item, lambda job: replace(job, shares=[one(share) for share in job.shares]))
