"""Jobs: commands in processes of their own, each by a typed request. Scenes are made one after another, and files to
share beside them, also one after another.

A record is written before its process changes. After a kill of the app its child gets SIGTERM, saves and ends; the next
app finds the job as running and starts the same command again, which continues from its stages or checkpoints.
"""

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .. import methods
from ..errors import LumigraphError
from ..files import open_anew, refuse_links
from ..system.children import REQUESTED, Request
from ..viewer.address import HOST, Address, free_port, new_token
from . import pace
from .job_record import JobRecord, JobState, Making, ShareJob, change, change_making, change_share, read_job
from .pictures import input_of
from .projects import JOB_FILE, LOG_FILE, PHOTOS, RUNS, SCENE, SHARED, Item, is_plain_name, items
from .sharing import share_request

POLL_SECONDS = 0.2  # between looks at a child
IDLE_SECONDS = 2.0  # between looks for jobs that nobody announced
PATIENCE_SECONDS = 60.0  # for the child of an app that was killed to save
LOG_BYTES = 60_000  # of the end of a log that are read
MAKE, SHARE = "make", "share"  # lanes of jobs
SHARE_NICENESS = 4  # of a file's command: beside a training it gets a quarter of the processors


@dataclass
class QueuedJob:
    """A job of an item. share: its file's name; None for the making of a run"""

    item: Item
    share: str | None
    child: subprocess.Popen[Any] | None = None
    viewer: Address | None = None  # of a training

    @property
    def lane(self) -> str:
        return MAKE if self.share is None else SHARE

    @property
    def job(self) -> Making | ShareJob | None:
        record = read_job(self.item)
        if self.share is None:
            return record.make
        return next((share for share in record.shares if share.name == self.share), None)

    def set(self, **values: Any) -> None:
        if self.share is None:
            change_making(self.item, **values)
        else:
            change_share(self.item, self.share, **values)


class Runner:
    """Threads that run the jobs of a folder from `begin` until `end`, one for each lane.

    program: words of Python before a request
    running: the job at work in each lane
    """

    def __init__(self, root: Path, program: Sequence[str] = REQUESTED):
        self.root, self.program = root, list(program)
        self.running: dict[str, QueuedJob] = {}
        self._choosing, self._ended = threading.Lock(), False
        # A child ends with the thread that started it, so these live as long as the app.
        self._wake = {lane: threading.Event() for lane in (MAKE, SHARE)}
        self._threads = [threading.Thread(target=self._work, args=(lane,), daemon=True) for lane in self._wake]

    @property
    def making(self) -> QueuedJob | None:
        """The scene that is being made."""
        return self.running.get(MAKE)

    def works_in(self, item: Item) -> bool:
        return any(task.item == item for task in list(self.running.values()))

    def begin(self) -> None:
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        """End the running commands; their jobs continue when the app starts again."""
        self._ended = True
        self.wake()
        for task in list(self.running.values()):
            if task.child:
                task.child.send_signal(signal.SIGTERM)
        for thread in self._threads:
            if thread.is_alive():
                thread.join(PATIENCE_SECONDS)

    def wake(self) -> None:
        for event in self._wake.values():
            event.set()

    def queue(self) -> list[QueuedJob]:
        """Jobs that run or wait, in order."""
        tasks = []
        for item in items(self.root):
            if not (item.path / JOB_FILE).is_file():
                continue
            with contextlib.suppress(LumigraphError):  # a damaged record is shown on the page of its project
                record = read_job(item)
                jobs: list[tuple[str | None, Making | ShareJob]] = [(share.name, share) for share in record.shares]
                jobs += [(None, record.make)] if record.make else []
                for name, job in jobs:
                    if job.state in ("queued", "running"):
                        tasks.append((job.state != "running", job.asked, QueuedJob(item, name)))
        return [task for _, _, task in sorted(tasks, key=lambda one: one[:2])]

    def stop(self, task: QueuedJob, state: JobState) -> None:
        """Pause or stop a job; its command saves and ends. Returns immediately."""
        task.set(state=state)
        running = self.running.get(task.lane)
        if running and running.child and (running.item, running.share) == (task.item, task.share):
            running.child.send_signal(signal.SIGINT)

    def put_first(self, item: Item) -> None:
        """Let a waiting scene be made now. The one at work saves, and goes on afterwards."""
        change_making(item, asked=0.0)
        if self.making and self.making.item != item:
            self.stop(self.making, "queued")

    def extend(self, item: Item, **budget: Any) -> None:
        """Give a training another budget. Its command saves, ends, and is started again."""
        change_making(item, **{"quality": None, "seconds": None, "steps": None} | budget)
        self.stop(QueuedJob(item, None), "queued")

    def release(self, item: Item) -> None:
        """Stop the jobs of an item before its deletion, and wait until no command works in it."""
        for task in self.queue():
            if task.item == item:
                self.stop(task, "stopped")
        end = time.monotonic() + PATIENCE_SECONDS
        while self.works_in(item):
            if time.monotonic() > end:
                raise LumigraphError(f"A command still works in {item.path}; try again when it has ended")
            time.sleep(POLL_SECONDS)

    def _work(self, lane: str) -> None:
        self._await_orphans()
        while not self._ended:
            task = self._next(lane)
            if task is None:
                self._wake[lane].wait(IDLE_SECONDS)
                self._wake[lane].clear()
                continue
            try:
                self._run(task)
            except LumigraphError as fault:
                self._fail(task, str(fault))
            except Exception as fault:
                self._fail(task, f"The job ended by a fault of the app ({type(fault).__name__}: {fault}); try it again")
            finally:
                del self.running[lane]
                self.wake()

    def _next(self, lane: str) -> QueuedJob | None:
        """The next job of a lane, which is at work from now on: one command at a time works in an item."""
        with self._choosing:
            busy = [task.item for task in self.running.values()]
            for task in self.queue():
                if task.lane == lane and task.item not in busy:
                    self.running[lane] = task
                    return task
                busy.append(task.item)
        return None

    def _fail(self, task: QueuedJob, fault: str) -> None:
        try:
            task.set(state="failed", fault=fault, process=0)
        except (LumigraphError, OSError):
            time.sleep(IDLE_SECONDS)  # the disk is full, or the item has gone

    def _await_orphans(self) -> None:
        """Wait until commands of a killed app have saved and ended."""
        end = time.monotonic() + PATIENCE_SECONDS
        for task in self.queue():
            while (job := task.job) and job.process and is_alive(job.process) and time.monotonic() < end:
                if self._ended:
                    return
                time.sleep(POLL_SECONDS)

    def _run(self, task: QueuedJob) -> None:
        """The commands of a job, until it is done, was paused, or the app ends."""
        while not self._ended and (job := task.job) and job.state in ("queued", "running"):
            task.set(state="running", fault="")
            request, task.viewer = self._request(task)
            begun, is_new = time.monotonic(), not (task.item.path / SCENE / "work").exists()
            code = self._call(task, request)
            job = task.job
            if self._ended or job is None or job.state != "running":
                return
            if code:
                self._fail(task, sentence(task.item, code))
            elif isinstance(job, Making) and job.stage == "capture":
                if is_new:
                    pace.note_capture(task.item, time.monotonic() - begun)
                task.set(stage="train", process=0)
            else:
                if isinstance(job, Making):
                    pace.note_training(run_folder(task.item, job.run))
                task.set(state="done", process=0)

    def _request(self, task: QueuedJob) -> tuple[Request, Address | None]:
        """The next command, and the address of its viewer."""
        job = task.job
        if isinstance(job, ShareJob):
            return share_request(task.item, job), None
        assert job is not None
        if job.stage == "capture" and (request := capture_request(task.item, job)):
            return request, None
        if job.stage == "capture" or not job.run:
            task.set(stage="train", run=job.run or next_run(task.item, job.method))
            job = task.job
            assert isinstance(job, Making)
        viewer = child_address()
        return train_request(task.item, job, viewer), viewer

    def _call(self, task: QueuedJob, request: Request) -> int:
        """Run a command with its messages in the log. Returns its exit code."""
        refuse_links(task.item.path, () if task.item.kind == "run" else (PHOTOS,))
        with open_anew(task.item.path / LOG_FILE) as log:
            log.write(f"$ lumigraph {request.command}\n".encode())
            log.flush()
            task.child = request.start(self.program, stdout=log, stderr=subprocess.STDOUT)
        if task.lane == SHARE and self.making and hasattr(os, "setpriority"):
            with contextlib.suppress(ProcessLookupError):
                os.setpriority(os.PRIO_PROCESS, task.child.pid, SHARE_NICENESS)
        task.set(process=task.child.pid)
        job = task.job
        if self._ended or job is None or job.state != "running":  # paused while it was being started
            task.child.send_signal(signal.SIGINT)
        code = task.child.wait()
        task.child = task.viewer = None
        return code


def child_address() -> Address:
    """Address on this machine for a child's viewer, with a token that only the app knows."""
    return Address(HOST, free_port(HOST, 0) or 0, new_token())


def is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def capture_request(item: Item, job: Making) -> Request | None:
    """`lumigraph capture`; None for photographs whose poses are known."""
    from ..sfm.photos import is_bare

    place = input_of(item)
    if not is_bare(place):
        return None
    options = {"what": [str(place)], "output": str(item.path / SCENE), "mapper": job.mapper}
    frames = {"frames": job.frames} if place.is_file() else {}
    return Request("capture", options | frames | {"mask_object": job.mask_object})


def scene_of(item: Item) -> Path:
    """The scene to train on: what `capture` made, or photographs whose poses are known."""
    made = item.path / SCENE
    return made if (made / "transforms.json").is_file() else item.photographs


def run_folder(item: Item, name: str) -> Path:
    return item.path / RUNS / name if item.kind == "project" else item.path


def train_request(item: Item, job: Making, viewer: Address) -> Request:
    """`lumigraph train`, or `resume` for a run that was begun."""
    run = run_folder(item, job.run)
    options: dict[str, Any] = {"quality": job.quality, "seconds": job.seconds, "steps": job.steps}
    options |= {"view": True, "stay": False, "port": viewer.port, "token": viewer.token}
    if (run / "config.json").is_file():
        return Request("resume", {"run_folder": str(run)} | options)
    options |= {"method": methods.check(job.method), "scene": str(scene_of(item)), "output": str(run)}
    return Request("train", options | {"downscale": job.downscale})


def next_run(item: Item, method: str) -> str:
    """Name of a new run of a method."""
    folder, number = item.path / RUNS, 1
    while os.path.lexists(folder / f"{method}-{number}"):
        number += 1
    return f"{method}-{number}"


def log_lines(item: Item) -> list[str]:
    """Last lines of the messages of the last command."""
    path = item.path / LOG_FILE
    if path.is_symlink() or not path.is_file():
        return []
    with open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - LOG_BYTES))
        return file.read().decode("utf-8", "replace").splitlines()


def sentence(item: Item, code: int) -> str:
    """The sentence by which a command has failed."""
    said = [line for line in log_lines(item) if line.startswith("lumigraph: ")]
    if said:
        return said[-1].removeprefix("lumigraph: ")
    if code == -signal.SIGKILL:
        return "The system has ended the command, as it does where memory runs out; choose draft, or close programs"
    return f"The command ended without a sentence (exit code {code}); its messages are in {item.path / LOG_FILE}"


# What the page asks for


def make(item: Item, **options: Any) -> JobRecord:
    """Queue a job from photographs to cameras to a new run."""
    input_of(item)
    asked = Making("queued", time.time(), **options)

    def begin(job: JobRecord) -> JobRecord:
        if job.make and job.make.state == "running":
            raise LumigraphError("This scene is being made already; pause or stop it first")
        return replace(job, make=asked)

    return change(item, begin)


def go_on(item: Item, **options: Any) -> JobRecord:
    """Queue a paused, stopped or failed job again, or a finished one with a larger budget."""

    def again(job: JobRecord) -> JobRecord:
        if job.make is None:
            if item.kind != "run":
                raise LumigraphError("Nothing has been made here yet; choose draft, good or best")
            job = replace(job, make=Making("stopped", 0.0, stage="train", run=item.path.name))
        if job.make and job.make.state in ("queued", "running"):
            raise LumigraphError("This scene is being made already")
        assert job.make is not None
        budget = {"quality": None, "seconds": None, "steps": None} if options.keys() & BUDGETS else {}
        queued = replace(job.make, **{**budget, **options, "state": "queued", "asked": time.time()})
        return replace(job, make=replace(queued, fault=""))

    return change(item, again)


BUDGETS = {"quality", "seconds", "steps"}


def ask_to_share(item: Item, share: ShareJob) -> JobRecord:
    """Queue a file to share."""

    def add(job: JobRecord) -> JobRecord:
        kept = [one for one in job.shares if one.name != share.name]
        if len(kept) < len(job.shares) and any(
            one.name == share.name and one.state in ("queued", "running") for one in job.shares
        ):
            raise LumigraphError(f"{share.name} is being made already")
        return replace(job, shares=[*kept, share])

    return change(item, add)


def forget_share(item: Item, name: str) -> JobRecord:
    """Delete a shared file, and its record."""
    if not is_plain_name(name):
        raise LumigraphError(f"There is no file {name[:80]!r} here")
    (item.path / SHARED / name).unlink(missing_ok=True)
    return change(item, lambda job: replace(job, shares=[one for one in job.shares if one.name != name]))
