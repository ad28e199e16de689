"""Stages of work in a folder, each identified by all of its inputs; finished stages are not repeated."""

import hashlib
import json
import signal
import subprocess
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import LumigraphError
from ..files import read_json, write_json
from ..files.ranges import Lasted
from ..system.children import start_python

WORKER = Path(__file__).with_name("worker.py")
DONE = "done\n"  # the worker's line at the end of a job


def key_of(*parts: Any) -> str:
    """Short hash of JSON values."""
    return hashlib.blake2b(json.dumps(parts, sort_keys=True).encode(), digest_size=12).hexdigest()


@dataclass(frozen=True)
class StageMark:
    """Record of a stage: its inputs, whether it is done, and its duration."""

    key: str
    done: bool
    seconds: Lasted


class Stages:
    """Marks in a folder's stages.json: stages begun and done, with hashes of their inputs and durations."""

    def __init__(self, folder: Path):
        self.path = folder / "stages.json"
        self.log = folder / "colmap.log"
        self.worker: subprocess.Popen[str] | None = None
        self.marks: dict[str, StageMark] = read_json(self.path, dict[str, StageMark]) if self.path.is_file() else {}

    def is_done(self, stage: str, key: str) -> bool:
        return self.was_begun(stage, key) and self.marks[stage].done

    def was_begun(self, stage: str, key: str) -> bool:
        """True if an unfinished stage may continue: it was begun with the same inputs."""
        return stage in self.marks and self.marks[stage].key == key

    def seconds(self) -> dict[str, float]:
        """Duration of each stage, without interruptions."""
        return {stage: mark.seconds for stage, mark in self.marks.items()}

    @contextmanager
    def working(self, stage: str, key: str) -> Iterator[None]:
        """Mark a stage as begun, and after the block without an exception as done."""
        spent = self.marks[stage].seconds if self.was_begun(stage, key) else 0.0
        self.mark(stage, key, False, spent)
        begun = time.perf_counter()
        try:
            yield
        except BaseException:
            self.mark(stage, key, False, spent + time.perf_counter() - begun)
            raise
        self.mark(stage, key, True, spent + time.perf_counter() - begun)

    def mark(self, stage: str, key: str, done: bool, seconds: float) -> None:
        self.marks[stage] = StageMark(key, done, round(seconds, 2))
        write_json(self.path, {name: asdict(mark) for name, mark in self.marks.items()}, ours=True)

    def colmap(self, total: int, **job: Any) -> Generator[int, None, None]:
        """Run a job of `worker.py`; yields the number of finished items out of `total`. Closing the generator early
        ends the work. Raises LumigraphError if COLMAP fails."""
        worker = self.worker = self.worker or start_worker(self.log)
        assert worker.stdin and worker.stdout
        told = 0
        try:
            worker.stdin.write(json.dumps(job) + "\n")
            worker.stdin.flush()
            for line in worker.stdout:
                if line == DONE:
                    break
                for told in range(told + 1, min(int(line), total) + 1):  # noqa: B020
                    yield told
            else:
                raise LumigraphError(
                    f"COLMAP gave up while {job['stage']} was under way ({last_words(self.log)}); {self.log} has all "
                    f"that it said"
                )
        except BaseException:
            self.close()
            raise
        yield from range(told + 1, total + 1)

    def close(self) -> None:
        """End the worker. Another job starts a new one."""
        if self.worker:
            self.worker.kill()
            self.worker.wait()
            for pipe in (self.worker.stdin, self.worker.stdout):
                assert pipe
                with suppress(BrokenPipeError):  # a job that it never read
                    pipe.close()
            self.worker = None


def start_worker(log: Path) -> subprocess.Popen[str]:
    with open(log, "ab") as messages:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": messages}
        return start_python([str(WORKER)], signal.SIGKILL, Path.cwd(), **pipes, start_new_session=True, text=True)


def last_words(log: Path) -> str:
    lines = log.read_text("utf-8", errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "without a word")
