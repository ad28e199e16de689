"""What an input came to, by how the command ended and what it left behind."""

from __future__ import annotations

import re
import shutil
import signal
from dataclasses import dataclass
from pathlib import Path

from .folders import halfway, snapshot, touched
from .hostile import MARK
from .inputs import make
from .warm import run
from .watched import Ended, Limits, watch

FINE = ("fine", "sentence", "usage", "stopped")
BAD = (
    "no sentence",
    "traceback",
    "signal",
    "hang",
    "memory",
    "half-written",
    "foreign",
    "folder left",
    "child left",
    "code ran",
)
PATIENCE = 15.0  # seconds after which a command that was asked for much is told to end
TELLTALES = ("Traceback (most recent call last)", "Exception ignored in", "terminate called", "Fatal Python error")
FRAME = re.compile(r'File "[^"]*?(lumigraph/[^"]+)", line (\d+), in (\S+)')


@dataclass(frozen=True)
class Verdict:
    """What became of one input. outcome: one of FINE or BAD;  where: what tells it from others of its outcome"""

    kind: str
    number: int
    outcome: str
    where: str
    command: list[str]
    bent: str
    seconds: float
    memory: int

    @property
    def is_bad(self) -> bool:
        return self.outcome in BAD


def judged(kind: str, number: int, seed: int, templates: Path, work: Path, limits: Limits = Limits()) -> Verdict:
    """Make an input, run it, look at what it did. work: a folder that is emptied before."""
    shutil.rmtree(work, ignore_errors=True)
    home, notes = work / "home", work / "notes"
    for folder in (work, notes, work / "outside", work / "cache"):
        folder.mkdir(parents=True)
    (work / "outside" / "theirs.json").write_bytes(b'{"theirs": true}')
    given = make(kind, number, seed, templates, home)
    before = snapshot(work)

    def command() -> int:
        import os

        os.environ |= {"HOME": str(work / "cache"), "XDG_CACHE_HOME": str(work / "cache")}
        return run(given.command)

    seconds = min(limits.seconds, PATIENCE) if given.patient else limits.seconds
    ended = watch(command, home, notes, Limits(seconds, limits.memory, given.patient))
    after = {path: data for path, data in snapshot(work).items() if Path(path).parts[0] not in ("notes", "cache")}
    ours = [f"home/{pattern}" for pattern in given.ours]
    outcome, where = outcome_of(ended)
    if outcome in FINE:
        mine = {path: data for path, data in before.items() if Path(path).parts[0] not in ("notes", "cache")}
        if foreign := touched(mine, after, ours):
            outcome, where = "foreign", foreign[0]
        elif half := halfway(work, mine, after):
            outcome, where = "half-written", half[0]
        elif outcome == "sentence" and given.command[0] == "train" and (new := after.keys() - before.keys()):
            outcome, where = "folder left", min(new)
    if f"home/{MARK}" in after:
        outcome, where = "code ran", given.bent
    return Verdict(kind, number, outcome, where, given.command, given.bent, ended.seconds, ended.memory)


def outcome_of(ended: Ended) -> tuple[str, str]:
    """What a command came to, and what tells it from others that came to the same."""
    if ended.why:
        return ended.why, f"{ended.seconds:.0f} s, {ended.memory / 2**30:.1f} GB"
    if any(tale in ended.said for tale in TELLTALES):
        return "traceback", place_of(ended.said)
    if ended.code < 0:
        return "signal", signal.Signals(-ended.code).name
    if ended.left:
        return "child left", ""
    if ended.code == 0:
        return "fine", ""
    if ended.code in (130, 143):
        return "stopped", ""
    lines = [line for line in ended.said.splitlines() if line.startswith("lumigraph:")]
    if ended.code == 2 and len(lines) == 1:
        return "sentence", lines[0]
    if ended.code == 2 and not lines and "For full helptext" in ended.said:
        return "usage", ""
    return "no sentence", f"code {ended.code}, {len(lines)} sentences: {ended.said.strip()[-200:]}"


def place_of(said: str) -> str:
    """Where in our code a traceback ends, and with what."""
    frames = FRAME.findall(said)
    last = next(
        (line for line in reversed(said.splitlines()) if re.match(r"\w[\w.]*(Error|Exception|Warning)", line)), ""
    )
    where = "{0}:{2}".format(*frames[-1]) if frames else "?"
    return f"{where}: {last[:140]}"
