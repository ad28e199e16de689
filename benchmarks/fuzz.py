"""Whether any input ends a command otherwise than well or by one sentence.

    python benchmarks/fuzz.py [--count 5000] [--seed 0] [--keep FOLDER] [--output FILE.json]

Small valid files of everything that is opened are made wrong, and given to the command that opens them; options of all
commands are given values that nobody expects. Each command runs in a process of its own with limits of time and memory.
Counted as bad: a traceback, a signal, more time or memory than the limits, a fault that is not told in one sentence,
an output that is half written, a file touched that is not ours, a folder that a refused training leaves, a pickle that
ran, and a process left behind. Exit code 1 if there is any.

An input is its class, its number and the seed; `--only CLASS` tries one class, `--number N` one input of it.
"""

from __future__ import annotations

from fuzzing import alone, warm  # noqa: F401, ahead of PyTorch, isort: skip
import json
import multiprocessing
import shlex
import shutil
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from fuzzing.inputs import KINDS, controls, make, shares
from fuzzing.templates import prepared
from fuzzing.verdict import BAD, FINE, Verdict, judged
from fuzzing.watched import Limits

TOLD = 3  # of the worst of each class that are told of


@dataclass(frozen=True)
class Options:
    count: int = 5000  # inputs
    seed: int = 0
    only: tuple[str, ...] = ()  # classes; all of them if none is named
    number: int | None = None  # of the one input that is tried of each class
    control: bool = False  # try files as they should be, with every command, instead
    limit: float = 60.0  # seconds
    memory: float = 4.0  # GiB
    seconds: float = 1e9  # after which no further input begins
    processes: int = 2
    keep: Path | None = None  # folder for what was bad: a home folder and a command each
    output: Path | None = None  # also write all that was found there, as JSON


def main(options: Options) -> int:
    if unknown := set(options.only) - KINDS.keys():
        sys.exit(f"There is no class called {unknown.pop()}; there are {', '.join(KINDS)}")
    warm.warm()
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        work = Path(folder)
        (work / "templates").mkdir()
        prepared(work / "templates", work)
        found = list(verdicts(options, work))
        show(found, time.perf_counter() - begin)
        if options.keep:
            keep(found, options, work / "templates")
    if options.output:
        options.output.write_text(json.dumps([asdict(verdict) for verdict in found], indent=1))
    return int(any(verdict.is_bad for verdict in found))


def verdicts(options: Options, work: Path) -> Iterator[Verdict]:
    """What every input came to, as they end."""
    planned = shares(options.count, options.only)
    tasks = [(kind, n, options, work) for kind, count in planned.items() for n in numbers(kind, count, options)]
    tasks.sort(key=lambda task: task[1])
    if options.processes == 1:
        yield from map(one, tasks)
        return
    end = time.perf_counter() + options.seconds
    with ProcessPoolExecutor(options.processes, multiprocessing.get_context("fork")) as pool:
        for count, done in enumerate(as_completed([pool.submit(one, task) for task in tasks]), 1):
            verdict = done.result()
            if verdict.is_bad or count % 250 == 0:
                told = f"{verdict.kind} {verdict.number}: {verdict.outcome} {verdict.where}" if verdict.is_bad else ""
                print(f"{count} of {len(tasks)} {told}"[:200], file=sys.stderr, flush=True)
            yield verdict
            if time.perf_counter() > end:
                pool.shutdown(cancel_futures=True)
                return


def numbers(kind: str, count: int, options: Options) -> Iterable[int]:
    """Which inputs of a class are tried."""
    if options.control:
        return range(-len(controls(kind)), 0)
    return range(count) if options.number is None else [options.number]


def one(task: tuple[str, int, Options, Path]) -> Verdict:
    kind, number, options, work = task
    limits = Limits(options.limit, int(options.memory * 2**30))
    own = work / multiprocessing.current_process().name
    return judged(kind, number, options.seed, work / "templates", own, limits)


def show(found: list[Verdict], seconds: float) -> None:
    """A row for each class, a column for each outcome; then what was bad, the same faults together."""
    from rich.table import Table

    from lumigraph.system.console import console

    outcomes = [name for name in (*FINE, *BAD) if name in BAD or any(v.outcome == name for v in found)]
    table = Table("class", "inputs", *outcomes)
    for kind in [*dict.fromkeys(v.kind for v in found), None]:
        some = [v for v in found if kind in (None, v.kind)]
        counts = Counter(v.outcome for v in some)
        table.add_row(kind or "all", str(len(some)), *(str(counts[name] or "·") for name in outcomes))
    console(width=160).print(table)
    alike: dict[tuple[str, str], list[Verdict]] = defaultdict(list)
    for verdict in found:
        if verdict.is_bad:
            alike[verdict.outcome, "" if verdict.outcome in ("hang", "memory") else verdict.where].append(verdict)
    if any(v.number < 0 and v.outcome != "fine" for v in found):
        print("\nNot fine, with files as they should be:")
        for verdict in (v for v in found if v.number < 0 and v.outcome != "fine"):
            print(f"  {verdict.kind!r} {verdict.number}: {verdict.where} {line_of(verdict.command)}")
    for (outcome, where), some in sorted(alike.items(), key=lambda item: -len(item[1])):
        print(f"\n{len(some)} times {outcome}: {where}")
        for verdict in some[:TOLD]:
            print(f"  {verdict.kind!r} {verdict.number} ({verdict.bent}): {line_of(verdict.command)}")
    slowest, largest = max(found, key=lambda v: v.seconds), max(found, key=lambda v: v.memory)
    print(f"\n{len(found)} inputs in {seconds:.0f} s, {sum(v.is_bad for v in found)} of them bad")
    print(f"slowest {slowest.seconds:.1f} s ({slowest.kind} {slowest.number}), ", end="")
    print(f"largest {largest.memory / 2**30:.2f} GiB ({largest.kind} {largest.number})")


def keep(found: list[Verdict], options: Options, templates: Path) -> None:
    """Write what is needed to try again whatever was bad."""
    assert options.keep
    for verdict in found:
        if verdict.is_bad:
            folder = options.keep / f"{verdict.kind}-{verdict.number}".replace(" ", "-")
            shutil.rmtree(folder, ignore_errors=True)
            folder.parent.mkdir(parents=True, exist_ok=True)
            make(verdict.kind, verdict.number, options.seed, templates, folder)
            said = f"# {verdict.outcome}: {verdict.where}\n# {verdict.bent}\n{line_of(verdict.command, None)}\n"
            (folder / "command").write_text(said, "utf-8", errors="replace")


def line_of(words: list[str], longest: int | None = 300) -> str:
    """A command as a shell takes it, cut where it is told to people."""
    return f"lumigraph {shlex.join(words)}"[:longest].encode("utf-8", "replace").decode()


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
