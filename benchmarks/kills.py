"""Whether anything is lost when a command is killed while it works.

    python benchmarks/kills.py [--count 200] [--seed 0] [--output FILE.json]

train, resume, eval, render, exports and capture are begun in a copy of a small home folder, on top of what they made
there earlier, and killed: four of five by SIGKILL, the rest by SIGTERM; half at any moment, half right after something
in the folder has changed. Then, by checksums of the whole folder: nothing of others has changed; what was made earlier
is there, as it was or whole and new; no process is left. At last the same command, or `resume`, must go well. Exit code
1 if any of that fails.
"""

from __future__ import annotations

from fuzzing import alone, warm  # noqa: F401, ahead of PyTorch, isort: skip
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from fuzzing.folders import halfway, is_left_over, snapshot, touched
from fuzzing.inputs import allowed
from fuzzing.templates import SMALL, home, must
from fuzzing.verdict import TELLTALES
from fuzzing.watched import Ended, Limits, begun, still_there, watch

CLOUD, SCENE = "given/run", "given/scene"
TRAIN = ["train", "gaussian-splatting", SCENE, "--steps", "30", "--device", "cpu", *SMALL["gaussian-splatting"]]
EARLY = 0.9  # of the time that a command takes alone: kills come before
RECORD = "*.lumigraph"  # of what Lumigraph wrote in a folder


@dataclass(frozen=True)
class Work:
    """A command that is killed.

    words: it
    onward: what must go well afterwards; None for the same again
    results: patterns of what it makes, which may change
    """

    words: list[str]
    onward: list[str] | None = None
    results: tuple[str, ...] = ()


WORKS: dict[str, Work] = {
    "train": Work([*TRAIN, "--output", "out/new"], ["resume", "out/new"], ("out/new*",)),
    "resume": Work(["resume", CLOUD, "--steps", "60"]),
    "eval": Work(["eval", CLOUD, "--save-images"]),
    "render": Work(
        ["render", CLOUD, "--frames", "6", "--size", "24", "--output", "out/film.mp4"], None, ("out/film*",)
    ),
    "export splats": Work(["export", "splats", CLOUD, "out/cloud.ply"], None, ("out/cloud*",)),
    "export web": Work(["export", "web", CLOUD, "out/page.html"], None, ("out/page*",)),
    "export panorama": Work(["export", "panorama", CLOUD, "out/all.png", "--size", "128"], None, ("out/all*",)),
    "capture": Work(["capture", "given/photographs", "--output", "out/scene"], None, ("out/scene*",)),
}


@dataclass(frozen=True)
class Options:
    count: int = 200  # kills
    seed: int = 0
    only: tuple[str, ...] = ()  # commands; all of them if none is named
    processes: int = 2
    output: Path | None = None  # also write all that was found there, as JSON


@dataclass(frozen=True)
class Kill:
    """What one kill came to.

    moment:  seconds after the beginning;  ended: whether the command was done before
    partial: what is left of writing when all is over;  fault: what is wrong, if anything
    """

    work: str
    number: int
    signal: str
    moment: float
    ended: bool
    partial: int
    fault: str


def main(options: Options) -> int:
    if unknown := set(options.only) - WORKS.keys():
        sys.exit(f"There is no work called {unknown.pop()}; there are {', '.join(WORKS)}")
    warm.warm()
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="kills-") as folder:
        place = Path(folder)
        template = place / "home"
        prepared = watch(lambda: write(place), place, place, Limits(seconds=580))
        if prepared.code:
            sys.exit(f"the folder to begin with could not be made: {prepared.said[-3000:]}")
        names = list(options.only or WORKS)
        with multiprocessing.get_context("fork").Pool(options.processes) as pool:
            longest = dict(pool.imap_unordered(lasted, [(name, template, place) for name in names]))
            tasks = [
                (names[i % len(names)], i, options.seed, longest[names[i % len(names)]], template, place)
                for i in range(options.count)
            ]
            found = []
            for kill in pool.imap_unordered(one, tasks):
                found.append(kill)
                if kill.fault:
                    print(f"{kill.work} {kill.number}, {kill.signal} at {kill.moment:.2f} s: {kill.fault}", flush=True)
    show(found, longest, time.perf_counter() - begin)
    if options.output:
        options.output.write_text(json.dumps([asdict(kill) for kill in found], indent=1))
    return int(any(kill.fault for kill in found))


def write(place: Path) -> int:
    """The home folder: a scene, photographs, a run, what commands made of it earlier, and somebody's files."""
    import captures
    import views

    folder = home(place, "home")
    captures.write_blender(folder / SCENE, captures.Tiny(6))
    views.write_views(folder / "given/photographs")
    os.chdir(folder)
    must(*TRAIN, "--output", CLOUD)
    for name, work in WORKS.items():
        if name not in ("train", "resume", "capture"):
            must(*work.words)
    for beside in ("out", CLOUD, "given/photographs"):
        (folder / beside / "holiday.txt").write_text("a holiday")
    return 0


def lasted(task: tuple[str, Path, Path]) -> tuple[str, float]:
    """A command's name and the seconds that it takes when nobody kills it. It has to go well."""
    name, template, place = task
    folder, notes = fresh(template, place)
    ended = run(WORKS[name].words, folder, notes)
    if ended.code:
        raise RuntimeError(f"{name} does not even go well when nobody kills it: {ended.said[-2000:]}")
    return name, ended.seconds


def fresh(template: Path, place: Path) -> tuple[Path, Path]:
    """A copy of the home folder for this process, and a folder for notes."""
    folder = place / multiprocessing.current_process().name
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(template, folder / "home")
    (folder / "notes").mkdir()
    return folder / "home", folder / "notes"


def run(words: list[str], folder: Path, notes: Path) -> Ended:
    return watch(lambda: warm.run(words), folder, notes, Limits(seconds=240))


def one(task: tuple[str, int, int, float, Path, Path]) -> Kill:
    """Begin a command, kill it, look at what is there, go on."""
    name, number, seed, longest, template, place = task
    chance, work = random.Random(f"{seed} {name} {number}"), WORKS[name]
    folder, notes = fresh(template, place)
    before = snapshot(folder)
    which = signal.SIGKILL if chance.random() < 0.8 else signal.SIGTERM
    begin = time.perf_counter()
    child = begun(lambda: warm.run(work.words), folder, notes)
    if chance.random() < 0.5:
        wait(child, chance.random() * EARLY * longest)
    else:
        wait(child, chance.random() * EARLY * longest, folder)
        time.sleep(chance.random() * 0.03)
    ended = os.waitpid(child, os.WNOHANG)
    moment = time.perf_counter() - begin
    if not ended[0]:
        os.kill(child, which)
        ended = os.waitpid(child, 0)
    done = os.WIFEXITED(ended[1]) and os.WEXITSTATUS(ended[1]) == 0
    told = notes / "stderr"
    said = told.read_text("utf-8", errors="replace") if told.exists() else ""  # it may have ended before it could speak
    fault = after_a_kill(work, which, ended[1], said, still_there(child), folder, before)
    fault = fault or onward(work, done, folder, notes, before)
    partial = sum(is_left_over(path) for path in snapshot(folder))
    return Kill(name, number, which.name, moment, done, partial, fault)


def wait(child: int, seconds: float, folder: Path | None = None) -> None:
    """Wait until a command has run for so long or is done; with a folder, until something in it changes after that
    share of the way."""
    begin, last = time.perf_counter(), None
    while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        passed = time.perf_counter() - begin
        if passed > seconds:
            if folder is None or passed > 3 * seconds + 20:
                return
            now = looks_of(folder)
            if last is not None and now != last:
                return
            last = now
        time.sleep(0.001)


def looks_of(folder: Path) -> set[tuple[str, int, int]]:
    """Names, sizes and times of what is in a folder."""
    found = set()
    for place, _, files in os.walk(folder):
        for name in files:
            try:
                about = os.stat(os.path.join(place, name), follow_symlinks=False)
            except OSError:
                continue
            found.add((os.path.join(place, name), about.st_size, about.st_mtime_ns))
    return found


def after_a_kill(
    work: Work, which: int, status: int, said: str, left: bool, folder: Path, before: dict[str, bytes]
) -> str:
    """What is wrong right after a kill, nothing if all is well."""
    after = snapshot(folder)
    if left:
        return "a process is left"
    if any(tale in said for tale in TELLTALES) or "*** " in said:
        return f"it printed more than a sentence: {said[-300:]}"
    expected = (0, 143, -signal.SIGTERM)  # the last ahead of any handler
    if which == signal.SIGTERM and os.waitstatus_to_exitcode(status) not in expected:
        return f"SIGTERM ended it with {os.waitstatus_to_exitcode(status)}: {said[-200:]}"
    if foreign := touched(before, after, [*allowed(work.words), *work.results, RECORD]):
        return f"{foreign[0]} is not as it was"
    gone = [path for path in before if path not in after and "checkpoints" not in path and not is_left_over(path)]
    if gone:
        return f"{gone[0]} is gone"
    half = [path for path in halfway(folder, before, after) if not is_left_over(path) and not path.endswith(".jsonl")]
    half = [path for path in half if not path.startswith("out/scene/")]  # of a capture, which goes on by its stages
    return f"{half[0]} is half written" if half else ""


def onward(work: Work, done: bool, folder: Path, notes: Path, before: dict[str, bytes]) -> str:
    """What is wrong with going on after a kill, nothing if all is well."""
    words = work.words
    if work.onward and (folder / work.onward[1] / "config.json").exists():
        words = work.onward
    if done and words[0] in ("train", "resume"):
        return ""
    ended = run(words, folder, notes)
    if ended.code and "has spent its budget" not in ended.said:  # a signal that came when all was done
        return f"{' '.join(words[:2])} does not go on: {ended.said.strip()[-300:]}"
    after = snapshot(folder)
    if foreign := touched(before, after, [*allowed(words), *work.results, RECORD]):
        return f"{foreign[0]} is not as it was, once it has gone on"
    half = [path for path in halfway(folder, before, after) if not is_left_over(path)]
    return f"{half[0]} is half written, once it has gone on" if half else ""


def show(found: list[Kill], longest: dict[str, float], seconds: float) -> None:
    """A row for each command."""
    from rich.table import Table

    from lumigraph.system.console import console

    table = Table("command", "alone, s", "kills", "while it worked", "SIGKILL", "SIGTERM", "left partial", "faults")
    for name in [*longest, None]:
        some = [kill for kill in found if name in (None, kill.work)]
        signals = Counter(kill.signal for kill in some)
        numbers = (len(some), sum(not kill.ended for kill in some), signals["SIGKILL"], signals["SIGTERM"])
        partial, faults = sum(kill.partial > 0 for kill in some), sum(bool(kill.fault) for kill in some)
        by_itself = f"{longest[name]:.1f}" if name else ""
        table.add_row(name or "all", by_itself, *map(str, (*numbers, partial, faults)))
    console(width=140).print(table)
    print(f"{len(found)} kills in {seconds:.0f} s, {sum(bool(kill.fault) for kill in found)} of them lost something")


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
