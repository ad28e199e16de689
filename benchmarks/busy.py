"""How quick the package is alone, and beside programs that each keep a processor busy, by how threads wait.

    python benchmarks/busy.py [--quick] [--beside 2] [--before CHECKOUT] [--work steps train eval mesh demo]

Starts and ends the busy programs itself. Ways of waiting take turns, so that whatever else happens on the machine meets
all of them: ours; OpenMP's own, which looks for work for milliseconds; and sleeping at once. `--before` measures
another checkout of the package too. Training is steps a second at a fixed share of the budget, of clouds that do not
grow; commands are seconds from start to end, with Python's and PyTorch's own start; of the demo, those beside its
training. `steps` counts the steps of 20 seconds, once by `lumigraph train` and once by `fit` in a script.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

HERE = Path(__file__).resolve()
WAYS = {"ours": {}, "OpenMP's own": {"GOMP_SPINCOUNT": "300000"}, "asleep": {"OMP_WAIT_POLICY": "PASSIVE"}}
SPEAK = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
PROGRESS = 0.4  # share of the budget at which steps are timed
WARM_UP = {"instant-ngp": 100, "gaussian-splatting": 10}  # steps; the number of rays settles in them
DEMO = 10.0  # seconds of training
STEPS_SECONDS = 20.0  # of training whose steps are counted
SCRIPT = """
import sys
import torch
from lumigraph import fit, methods
from lumigraph.opening import open_scene
from lumigraph.run import build

data, kind, device = open_scene(sys.argv[1]), methods.find("instant-ngp"), torch.device("cpu")
method = build(kind, data.frame, kind.preset(device), device, 0, learning=True)
print(fit(method, data, seconds=float(sys.argv[2]), show=False).state.step)
"""
Work = Literal["steps", "train", "eval", "mesh", "demo"]


@dataclasses.dataclass(frozen=True)
class Options:
    scene: str = "procedural:still-life"
    beside: int = 2  # busy programs
    seconds: float = 5.0  # of training each time
    rounds: int = 3
    quick: bool = False  # one round of our way and OpenMP's own, without the demo
    before: Path | None = None  # another checkout
    work: tuple[Work, ...] = ("steps", "train", "eval", "mesh", "demo")
    output: Path | None = None  # also write the figures there, as JSON


@dataclasses.dataclass
class Figures:
    """What was measured of one work in one way: alone, and beside busy programs."""

    alone: list[float] = dataclasses.field(default_factory=list)
    beside: list[float] = dataclasses.field(default_factory=list)


Measure = Callable[[str], float]


def main(options: Options) -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ends what was started
    if options.quick:
        options = dataclasses.replace(options, rounds=1, work=tuple(w for w in options.work if w != "demo"))
    ways = environments(options)
    result: dict[str, dict[str, Figures]] = {}
    with tempfile.TemporaryDirectory() as folder:
        if "steps" in options.work:
            both = {"lumigraph train": ways["ours"], "fit in a script": ways["ours"]}
            result["instant-ngp, steps in 20 s"] = in_turn(
                options, both, lambda way: steps_of(way, options.scene, Path(folder), both[way])
            )
        if "train" in options.work:
            for method in WARM_UP:
                with learners(method, options.scene, ways) as learn:
                    result[f"{method}, steps/s"] = in_turn(
                        options, ways, lambda way, learn=learn: learn(way, options.seconds)
                    )
        runs = {m: trained(m, options.scene, Path(folder)) for m in WARM_UP if {"eval", "mesh"} & {*options.work}}
        commands = {
            "eval": lambda: ["eval", runs["instant-ngp"], "--views", "4"],
            "mesh": lambda: ["export", "mesh", runs["gaussian-splatting"], f"{folder}/{time.time_ns()}.ply"],
            "demo": lambda: [
                "demo",
                "--seconds",
                f"{DEMO}",
                "--frames",
                "20",
                "--output",
                f"{folder}/{time.time_ns()}",
            ],
        }
        for name, command in commands.items():
            if name in options.work:
                less = DEMO if name == "demo" else 0.0
                result[f"{name}, s"] = in_turn(
                    options, ways, lambda way, command=command, less=less: lasted(command(), ways[way]) - less
                )
    show(result, options.beside)
    if options.output:
        plain = {work: {way: dataclasses.asdict(x) for way, x in rows.items()} for work, rows in result.items()}
        options.output.write_text(json.dumps(plain, indent=2))


def environments(options: Options) -> dict[str, dict[str, str]]:
    """The ways of waiting, as the environments that bring them about."""
    common = {name: value for name, value in os.environ.items() if name not in SPEAK}
    common["PYTHONPATH"] = str(HERE.parent.parent)
    ways = {way: common | own for way, own in WAYS.items() if not (options.quick and way == "asleep")}
    return ways | ({"before": common | {"PYTHONPATH": str(options.before.resolve())}} if options.before else {})


def in_turn(options: Options, ways: dict[str, dict[str, str]], measure: Measure) -> dict[str, Figures]:
    """Every way alone and beside busy programs, several times, each round in the other order."""
    found = {way: Figures() for way in ways}
    for turn in range(options.rounds):
        for busy in (0, options.beside):
            with busy_programs(busy):
                for way in list(ways)[:: 1 if turn % 2 == 0 else -1]:
                    (found[way].beside if busy else found[way].alone).append(figure := measure(way))
                    print(f"round {turn + 1}, beside {busy}, {way}: {figure:.1f}", file=sys.stderr, flush=True)
    return found


@contextlib.contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """So many processes that keep a processor busy for as long as this one lives, with the same priority."""
    program = f"import os\nwhile os.getppid() == {os.getpid()}: pass"
    programs = [subprocess.Popen([sys.executable, "-S", "-c", program]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def steps_of(way: str, scene: str, folder: Path, environment: dict[str, str]) -> float:
    """Steps of instant-ngp in STEPS_SECONDS of training, by the command or by a script."""
    if way == "fit in a script":
        command = [sys.executable, "-c", SCRIPT, scene, str(STEPS_SECONDS)]
        return float(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)
    run = folder / f"steps-{time.time_ns()}"
    told = ["--seconds", f"{STEPS_SECONDS:g}", "--device", "cpu", "--output", str(run)]
    lasted(["train", "instant-ngp", scene, *told], environment)
    from lumigraph.run import Run

    return float(Run(run).state.step)


@contextlib.contextmanager
def learners(method: str, scene: str, ways: dict[str, dict[str, str]]) -> Iterator[Callable[[str, float], float]]:
    """A process for each way, which trains when asked. Gives a function: steps a second, of so many seconds."""
    command = [sys.executable, str(HERE), "--learn", method, scene]
    open_pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    there = {way: subprocess.Popen(command, env=environment, **open_pipes) for way, environment in ways.items()}

    def learn(way: str, seconds: float) -> float:
        print(seconds, file=there[way].stdin, flush=True)
        return float(there[way].stdout.readline())

    try:
        for way in there:
            learn(way, 0.0)  # ready
        yield learn
    finally:
        for process in there.values():
            process.kill()
            process.wait()


def learner(method: str, scene: str) -> None:
    """Train for as many seconds as each line of stdin says, and print steps a second."""
    from lumigraph import methods  # ahead of PyTorch, as the command line does; isort: skip
    import torch

    from lumigraph.files.ranges import changed
    from lumigraph.opening import open_scene
    from lumigraph.run import build
    from lumigraph.training import Descent, set_learning_rate

    data, kind, device = open_scene(scene), methods.find(method), torch.device("cpu")
    config = kind.preset(device)
    if method == "gaussian-splatting":
        config = changed(config, refine_until=0.0)
    model = build(kind, data.frame, config, device, 0).train()
    optimizers, generator, step = model.optimizers(), torch.Generator().manual_seed(0), 0
    model.begin(data)

    def one() -> None:
        nonlocal step
        set_learning_rate(optimizers, model.learning_rate(step, PROGRESS))
        model.progress = PROGRESS
        model.before_step(step, PROGRESS)
        batch = model.batch(data, generator)
        model.step(batch, step, Descent(model, optimizers, batch, step, step % 10 == 0, sys.exit))
        model.after_step(step)
        step += 1

    for _ in range(WARM_UP[method]):
        one()
    with courtesy():
        for line in sys.stdin:
            begin, before = time.perf_counter(), step
            while (passed := time.perf_counter() - begin) < float(line):
                one()
            print((step - before) / passed, flush=True)


def courtesy() -> contextlib.AbstractContextManager[None]:
    """What the command line runs every command in; nothing in a checkout that has none."""
    try:
        from lumigraph.system.threads import considerate
    except ImportError:
        return contextlib.nullcontext()
    return considerate()


def trained(method: str, scene: str, folder: Path) -> str:
    """A run to measure commands with."""
    run = str(folder / method)
    lasted(["train", method, scene, "--steps", "300", "--device", "cpu", "--output", run], dict(os.environ))
    return run


def lasted(arguments: list[str], environment: dict[str, str]) -> float:
    """Seconds that a command took. What it says is shown only if it fails."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "lumigraph", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    return time.perf_counter() - begin


def show(result: dict[str, dict[str, Figures]], busy: int) -> None:
    """Medians; and speed beside the busy programs as a share of that alone when threads wait as OpenMP has it."""
    from rich.table import Table

    from lumigraph.system.console import console

    table = Table("work", "way", "alone", f"beside {busy}", "share of OpenMP's own, alone", f"beside {busy}")
    for work, rows in result.items():
        yardstick = statistics.median(rows.get("OpenMP's own", next(iter(rows.values()))).alone)
        for way, figures in rows.items():
            alone, beside = statistics.median(figures.alone), statistics.median(figures.beside)
            shares = [x / yardstick if "steps" in work else yardstick / x for x in (alone, beside)]
            table.add_row(work, way, f"{alone:.1f}", f"{beside:.1f}", *(f"{share:.0%}" for share in shares))
    console().print(table)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--learn"]:
        learner(*sys.argv[2:])
    else:
        import tyro

        main(tyro.cli(Options, description=__doc__))
