"""Every method on data unlike those that it was made with, beside a baseline that needs no method.

    python benchmarks/strangers.py OUTPUT                                  all methods, four settings or more each
    python benchmarks/strangers.py OUTPUT --methods nerf neus --resume     more cells of the same table
    python benchmarks/strangers.py OUTPUT --data FOLDER                    methods of photographs on these, too
    python benchmarks/strangers.py OUTPUT --budget 0.2                     a fifth of each method's steps
    python benchmarks/strangers.py OUTPUT --publish                        the figures for `tables.py`

A cell trains by `lumigraph train` or `track` and compares by `lumigraph eval`, in a process of its own and for a number
of steps, so that other programs change its time alone. Seconds are the processor's. OUTPUT/results.json has for
each cell:

    outcome     ok; refused, with the sentence; crash; too slow, where a limit of seconds ended it
    score       the first of its evaluation, and beside it the baseline: the better one of mean and nearest training
                photograph; the convex hull of a shape; a camera that stands still; an untrained method for words and
                worlds
    coverage    share of held-out pixels with a surface whose rendered depth is within 5 %; of frames with a pose
    steps       made and expected
    warnings    the sentences of the log

A cell fails if it crashes, is too slow, or has a score below its baseline and no sentence that says so.
OUTPUT/METHOD.png has a row for each cell, truth beside rendering.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shlex
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from PIL import Image

from lumigraph.commands.cli import main as command_line
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.run import evaluate_on
from lumigraph.evaluation.tracking import ERRORS_FILE, TRUTH_FILE
from lumigraph.figures import Row as Line
from lumigraph.figures import contact_sheet
from lumigraph.geometry import evenly
from lumigraph.lab.benchmark.gallery import CAPTION_NUMBERS
from lumigraph.metrics import scores_of
from lumigraph.readers.capture import Capture
from lumigraph.run import Run

RESULTS = Path(__file__).parent / "results" / "strangers-cpu.json"
CELL_SECONDS, WALL_SECONDS = 240, 1200  # of a cell at the most: of the processor, and by the clock
EVAL_VIEWS, COVERED, SIDE = 4, 0.05, 160  # compared views; relative error of depth; pixels of photographs in --data
SOLID, SHEET_SIDE = 0.5, 240  # opacity of a surface; pixels of pictures in the sheets
UNSAID = "its score is below the baseline, and no sentence says so"
V = "size=96,views=24"
ROOM = "procedural:room,depth,size=120,views="

# Settings of photographs: source, by name. {data} is OUTPUT/data.
SETTINGS = {
    "another object": f"procedural:still-life,{V},shape=3",
    "metres, far origin": "procedural:toys,member=5,size=96,views=24,scale=1000,offset=1000000,order",
    "tiny unit": f"procedural:still-life,{V},shape=5,scale=0.001,order",
    "open, clutter": f"procedural:still-life,{V},open=30,clutter=6",
    "far background": f"procedural:still-life,{V},shape=7,open=300",
    "other light": f"procedural:still-life,{V},shape=5,exposure=1,white_balance=15,blur=2",
    "five views": f"procedural:still-life,{V},shape=7,few=5",
    "poses off": f"procedural:courtyard,{V},poses=2",
    "turntable": f"procedural:still-life,{V},shape=3,turntable",
    "wrong labels": f"procedural:still-life,{V},labels=20",
    "labels, open": f"procedural:still-life,{V},open=3,labels=5",
    "one label": "procedural:chairs,member=3,size=96,views=24",
    "labels, metres": f"procedural:still-life,{V},scale=1000",
    "tourists, few": "procedural:tourists,size=96,views=40,few=12",
    "city, scale": "procedural:city,crossings=2,views=40,size=64,scale=1000",
    "night, few": "procedural:night,size=80,views=30,few=8",
    "night, poses off": "procedural:night,size=80,views=24,poses=1",
    "night, millimetres": "procedural:night,size=80,views=24,scale=1000",
    "head, few": "procedural:head,size=96,views=60,few=20",
    "head, other light": "procedural:head,size=96,views=60,exposure=0.7",
    "head, millimetres": "procedural:head,size=96,views=60,scale=1000",
    "depth in a grid": ROOM + "60,holes=grid",
    "columns, quantised": ROOM + "60,holes=columns,noise=quantised",
    "borders, returns": ROOM + "60,holes=borders,noise=returns",
    "large steps": ROOM + "300,step=6",
    "wrong scale": ROOM + "60,noise=scaled,holes=far",
    "jelly, other light": "procedural:jelly,size=80,views=40,exposure=0.7",
    "clockwork, poses off": "procedural:clockwork,size=80,views=40,poses=1",
    "jelly, open": "procedural:jelly,size=80,views=40,open=30",
    "swing, metres": "procedural:swing,size=80,views=40,scale=1000,offset=1000000",
    "street, few": "procedural:street,size=80,views=60,few=20",
    "rig, other light": "procedural:jelly,rig=8,size=64,views=80,exposure=0.5",
    "rig, clockwork": "procedural:clockwork,rig=8,size=64,views=80",
    "rig, open": "procedural:jelly,rig=8,size=64,views=80,open=30",
    "rig, metres": "procedural:jelly,rig=8,size=64,views=80,scale=1000,offset=1000000",
    "two bones": "procedural:tail,joints=2,size=80,views=40",
    "forty bones": "procedural:tail,joints=40,size=80,views=40,clips=1",
    "walker, open": "procedural:walker,size=80,views=40,open=30",
    "walker, few": "procedural:walker,size=80,views=60,few=12,exposure=0.7",
    "grasp, metres": "procedural:grasp,size=80,views=40,scale=1000,offset=1000000",
    "traffic, other light": "procedural:traffic,size=80,views=40,exposure=0.7",
    "traffic, few": "procedural:traffic,size=80,views=60,few=15",
    "traffic, metres": "procedural:traffic,size=80,views=40,scale=1000,offset=1000000",
    "traffic, poses off": "procedural:traffic,size=80,views=40,poses=1",
    "materials, few": "procedural:materials,size=64,views=30,few=8",
    "materials, other light": "procedural:materials,light=2,size=64,views=20,exposure=0.5",
    "materials, metres": "procedural:materials,size=64,views=20,scale=1000",
    "toys, other light": "procedural:toys,count=12,size=48,views=10,exposure=0.7",
    "chairs, turned": "procedural:chairs,count=12,size=48,views=10,turned=1",
    "cars, metres": "procedural:cars,count=12,size=48,views=10,scale=1000",
    "meshes": "procedural:{data}/meshes,size=48,views=10",
    "wide": "{data}/wide.png",
    "grey": "{data}/grey.png",
    "transparent": "{data}/transparent.png",
    "noise": "{data}/noise.jpg",
    "bowl": "{data}/bowl.obj",
    "thin bars": "{data}/bars.ply",
    "metres, far off": "{data}/rock.obj",
    "open surface": "{data}/cup.ply",
    "blocks": "procedural:blocks,size=64,views=30,width=32,land=7",
    "wide land": "procedural:blocks,size=64,views=20,width=96,land=3",
    "few blocks": "procedural:blocks,size=64,views=40,few=8,width=32,land=2",
    "narrow land": "procedural:blocks,size=64,views=30,width=16,land=5",
    "two things": "words:a green cone beside a yellow cube",
    "one thing": "words:a blue ball",
    "nothing known": "words:the smell of rain",
    "long": "words:a red cube and a green ball and a blue cone and a yellow cube on a white table in a dark room",
}
PLAIN = ("another object", "metres, far origin", "other light", "open, clutter")
OBJECT = ("another object", "tiny unit", "metres, far origin", "other light", "five views")
OPEN = (*PLAIN, "five views", "poses off", "turntable", "far background")
LIT = ("tourists, few", "city, scale", "other light", "poses off")
MOVING = ("jelly, other light", "clockwork, poses off", "jelly, open", "swing, metres", "street, few")
RIG = ("rig, other light", "rig, clockwork", "rig, open", "rig, metres")
BODIES = ("two bones", "forty bones", "walker, open", "walker, few", "grasp, metres")
DEPTH = ("depth in a grid", "columns, quantised", "borders, returns", "wrong scale")
MANY = ("toys, other light", "chairs, turned", "cars, metres", "meshes")
SHAPES = ("bowl", "thin bars", "metres, far off", "open surface")
WORDS = ("two things", "one thing", "nothing known", "long")
GUIDED = ("--guidance", "{data}/captions")


@dataclass(frozen=True)
class Entry:
    """A method's line of the table. steps: of half a minute or less on an idle core, 0 for all frames"""

    steps: int
    settings: tuple[str, ...]
    options: tuple[str, ...] = ()
    command: str = "train"


METHODS = {
    "fourier-features": Entry(300, ("wide", "grey", "transparent", "noise")),
    "lumigraph": Entry(1, PLAIN),
    "view-interpolation": Entry(1, PLAIN),
    "deep-appearance": Entry(200, ("head, few", "head, other light", "head, millimetres", "another object")),
    "nerf": Entry(300, PLAIN),
    "mip-nerf": Entry(300, PLAIN),
    "nerf-w": Entry(300, LIT),
    "block-nerf": Entry(300, LIT),
    "rawnerf": Entry(300, ("night, few", "night, poses off", "night, millimetres", "another object")),
    "regnerf": Entry(150, ("five views", "open, clutter", "tiny unit", "other light")),
    "dvgo": Entry(200, OBJECT),
    "plenoxels": Entry(400, PLAIN),
    "plenoctrees": Entry(300, PLAIN),
    "snerg": Entry(200, PLAIN),
    "tensorf": Entry(300, PLAIN),
    "instant-ngp": Entry(400, OPEN),
    "gaussian-splatting": Entry(600, OPEN),
    "occupancy-network": Entry(500, SHAPES),
    "deepsdf": Entry(500, SHAPES),
    "nglod": Entry(500, SHAPES),
    "dvr": Entry(200, (*OBJECT, "open, clutter")),
    "mesh-fit": Entry(150, (*OBJECT, "open, clutter")),
    "voxel-fit": Entry(200, (*OBJECT, "open, clutter")),
    "neus": Entry(200, (*PLAIN, "tiny unit", "turntable")),
    "planar-splatting": Entry(400, PLAIN),
    "tsdf-fusion": Entry(0, (*DEPTH, "large steps")),
    "imap": Entry(0, (*DEPTH, "large steps"), command="track"),
    "splat-slam": Entry(0, (*DEPTH, "large steps"), command="track"),
    "nerfies": Entry(200, MOVING),
    "nsff": Entry(200, MOVING),
    "neural-volumes": Entry(150, RIG),
    "deformable-splatting": Entry(500, MOVING),
    "humannerf": Entry(150, BODIES),
    "articulated-splatting": Entry(400, BODIES),
    "neural-scene-graph": Entry(200, ("traffic, other light", "traffic, few", "traffic, metres", "traffic, poses off")),
    "object-nerf": Entry(200, ("wrong labels", "labels, open", "one label", "labels, metres")),
    "nerfactor": Entry(150, ("materials, few", "materials, other light", "materials, metres", "another object")),
    "pixelnerf": Entry(300, MANY),
    "srn": Entry(300, MANY),
    "hyp-nerf": Entry(200, MANY),
    "eg3d": Entry(100, MANY),
    "dream-fields": Entry(60, WORDS, GUIDED),
    "dream-splats": Entry(60, WORDS, GUIDED),
    "gancraft": Entry(60, ("blocks", "wide land", "few blocks", "narrow land")),
}


@dataclass(frozen=True)
class Options:
    output: tyro.conf.Positional[Path]
    methods: tuple[str, ...] = ()  # all without
    data: tuple[Path, ...] = ()  # folders of photographs, as further settings of methods of photographs
    settings: tuple[str, ...] = ()  # names of settings to run; all without
    budget: float = 1.0  # factor on each method's steps
    resume: bool = False  # keep finished cells of an earlier call
    publish: bool = False  # write the figures of an earlier call to benchmarks/results instead


@dataclass(frozen=True)
class Cell:
    method: str
    setting: str
    source: str
    steps: int
    options: tuple[str, ...] = ()
    command: str = "train"

    @property
    def name(self) -> str:
        return f"{self.method}-{re.sub('[^a-z0-9]+', '-', self.setting.lower())}"

    def words(self, run: Path) -> list[str]:
        """Arguments of `lumigraph` that train or track it."""
        steps = ["--steps", str(self.steps)] if self.steps else []  # all frames of those that see each once
        return [self.command, self.method, self.source, *steps, *self.options, "--output", str(run)]


@dataclass
class Result:
    """Outcome of a cell; see the page's head."""

    method: str
    setting: str
    command: str
    outcome: str = "too slow"
    sentence: str = ""
    score: dict[str, Any] | None = None
    baseline: float | None = None
    coverage: float | None = None
    steps: int = 0
    expected: int = 0
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def below(self) -> bool:
        """True if the score is worse than the baseline."""
        if self.score is None or self.baseline is None:
            return False
        sign = 1 if self.score["better"] == "higher" else -1
        return sign * self.score["value"] < sign * self.baseline

    @property
    def fault(self) -> str:
        if self.outcome in ("crash", "too slow"):
            return self.outcome
        return UNSAID if self.below and not self.warnings else ""


def main(options: Options) -> None:
    output = options.output.resolve()
    path = output / "results.json"
    if options.publish:
        return publish(json.loads(path.read_text("utf-8")))
    if path.exists() and not options.resume:
        raise SystemExit(f"{path} exists; go on with --resume, or name another folder")
    output.mkdir(parents=True, exist_ok=True)
    results = (
        {name: Result(**row) for name, row in json.loads(path.read_text())["cells"].items()} if path.exists() else {}
    )
    cells = [cell for cell in chosen(options, output) if cell.name not in results]
    if apart(partial(make_data, output / "data", cells), output / "data.log")[0]:
        raise SystemExit(f"The data could not be made; {output / 'data.log'} has the reason")
    for number, cell in enumerate(cells, 1):
        results[cell.name] = result = carry_out(cell, output)
        print(f"{number} of {len(cells)}: {cell.method}, {cell.setting}: {described(result)}", flush=True)
        about = {"machine": f"{os.cpu_count()} threads", "commit": commit(), "budget": options.budget}
        kept = {name: asdict(one) for name, one in results.items()}
        path.write_text(json.dumps(about | {"cells": kept}, indent=1) + "\n", "utf-8")
        alike = [one for one in chosen(options, output) if one.method == cell.method]
        apart(partial(draw, cell.method, alike, output, results), output / "draw.log")
    failed = {name: one.fault for name, one in results.items() if one.fault}
    print(
        f"{len(results)} cells, {len(failed)} of them failed",
        *(f"  {name}: {why}" for name, why in failed.items()),
        sep="\n",
    )


def commit() -> str:
    words = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parent).stdout.strip()


def chosen(options: Options, output: Path) -> Iterator[Cell]:
    """Cells of the table, a setting of each method in turn, so that an interrupted table has some of all."""
    if unknown := {*options.methods} - {*METHODS}:
        raise SystemExit(f"{', '.join(sorted(unknown))}: no such method in the table")
    data = str(output / "data")
    entries = {name: entry for name, entry in METHODS.items() if name in (options.methods or METHODS)}
    settings = {
        name: [(setting, SETTINGS[setting].format(data=data), ()) for setting in entry.settings]
        + [(folder.name, str(folder.resolve()), reduced(folder)) for folder in options.data if of_photographs(name)]
        for name, entry in entries.items()
    }
    for turn in range(max(map(len, settings.values()))):
        for name, entry in entries.items():
            for setting, source, further in settings[name][turn : turn + 1]:
                if not options.settings or setting in options.settings:
                    steps = entry.steps and max(1, round(options.budget * entry.steps))
                    told = (*(word.format(data=data) for word in entry.options), *further)
                    yield Cell(name, setting, source, steps, told, entry.command)


def of_photographs(name: str) -> bool:
    """True for methods that learn from still photographs of any kind."""
    return bool({"another object", "five views"} & {*METHODS[name].settings})


def reduced(folder: Path) -> tuple[str, ...]:
    """Options that reduce the photographs of a folder to about SIDE pixels."""
    from lumigraph.opening import read_capture

    found: Capture = read_capture(str(folder))
    size = next((shot.size for shot in found.shots if shot.size), (SIDE, SIDE))
    return ("--downscale", str(max(1, round(max(size) / SIDE))))


def carry_out(cell: Cell, output: Path) -> Result:
    """Train and evaluate a cell in a process of its own."""
    folder = output / "runs" / cell.name
    log, command = folder.with_suffix(".log"), shlex.join(["lumigraph", *cell.words(folder)[:-2]])
    log.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(["rm", "-rf", str(folder)], check=True)
    found = Result(cell.method, cell.setting, command.replace(str(output), "OUTPUT"), expected=cell.steps)
    code, found.seconds = apart(partial(inside, cell, folder), log)
    text = log.read_text("utf-8", errors="replace")
    lines = [line for line in re.split(r"[\r\n]+", text) if line.strip()]
    found.warnings = sorted({line.removeprefix("warning: ") for line in lines if line.startswith("warning: ")})
    if (measured := folder / "cell.json").exists():
        vars(found).update(json.loads(measured.read_text()))
        found.outcome = "ok"
    elif "Traceback (most recent call last)" in text:
        found.outcome, found.sentence = "crash", lines[-1]
    elif code == 2:
        found.outcome, found.sentence = "refused", lines[-1].removeprefix("lumigraph: ")
    elif code not in (-signal.SIGKILL, -signal.SIGXCPU):
        found.outcome, found.sentence = "crash", f"exit code {code}"
    return found


def apart(work: Callable[[], object], log: Path) -> tuple[int, float]:
    """Exit code and processor seconds of work in a process of its own, a copy of this one, which has imported
    everything and computed nothing. It is killed after CELL_SECONDS of the processor, or WALL_SECONDS."""
    if (child := os.fork()) == 0:
        code = 1
        try:
            os.setsid()
            resource.setrlimit(resource.RLIMIT_CPU, (CELL_SECONDS, CELL_SECONDS + 5))
            out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for stream in (1, 2):
                os.dup2(out, stream)
            work()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    until = time.monotonic() + WALL_SECONDS
    while (ended := os.wait4(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > until:
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.2)
    return os.waitstatus_to_exitcode(ended[1]), ended[2].ru_utime + ended[2].ru_stime


def inside(cell: Cell, folder: Path) -> None:
    """The process of a cell: train, compare, measure."""
    if code := command_line(cell.words(folder)):
        sys.exit(code)
    run = Run(folder)
    steps = {"steps": run.state.step}
    if cell.command == "track":
        about = json.loads((folder / ERRORS_FILE).read_text())
        truth = np.loadtxt(folder / TRUTH_FILE)[:, 1:4] if (folder / TRUTH_FILE).exists() else np.zeros((0, 3))
        still = 100 * float(np.sqrt(np.square(truth - truth.mean(0)).sum(1).mean())) if len(truth) else None
        found = {
            "score": first_score(about),
            "baseline": still,
            "coverage": about["known"] / about["frames"],
            "expected": about["frames"],
        }
        (folder / "cell.json").write_text(json.dumps(found | steps))
        return
    if code := command_line(["eval", str(folder), "--views", str(EVAL_VIEWS), "--save-images"]):
        sys.exit(code)
    result = json.loads((folder / "eval.json").read_text())
    method, data = run.method_and_data(torch.device("cpu"))
    measured = {
        "score": first_score(result),
        "baseline": max(result.get("baselines", {}).values(), default=None),
    } | steps
    if method.complete:
        measured["expected"] = run.state.step
    if isinstance(data, Scene) and "psnr" in result:
        measured["coverage"] = coverage(method, data)
        show(folder, data, result)
    elif "baselines" not in result:
        fresh = evaluate_on(run.new_method("cpu").eval(), data, EvaluationOptions(views=EVAL_VIEWS))
        measured["baseline"] = first_score(fresh.to_json())["value"]
    (folder / "cell.json").write_text(json.dumps(measured))


def first_score(result: dict[str, Any]) -> dict[str, Any]:
    """First score that says how well the data are shown. That of a walk is its colours by label."""
    scores = scores_of(result)
    one = next((score for score in scores if score.name == "colours by label"), scores[0] if scores else None)
    return one.to_json() if one else None  # type: ignore[return-value]


@torch.no_grad()
def coverage(method: Any, scene: Scene) -> float | None:
    """Share of held-out pixels with a surface whose rendered depth is within COVERED of it; None without depth."""
    layer = next((name for name in ("exact_depth", "depth") if name in scene.layers), None)
    if layer is None or "test" not in scene.splits:
        return None
    there = right = 0
    for index in evenly(scene.splits["test"].tolist(), EVAL_VIEWS):
        shot = scene.photograph(index, [layer])
        truth, seen = shot.extra[layer], method.render(method.refined(shot.camera)).cpu()
        known = truth.isfinite() & (truth > 0)
        close = ((seen.depth - truth).abs() < COVERED * truth) & (seen.opacity > SOLID)
        there, right = there + int(known.sum()), right + int((known & close).sum())
    return right / there if there else None


def show(folder: Path, scene: Scene, result: dict[str, Any]) -> None:
    """Save the photograph of the first compared view as truth.png, and its rendering as seen.png."""
    name = result["views"][0]["name"]
    shot = scene.photograph(scene.names.index(name)).before(scene.frame.background)
    Image.fromarray((255 * shot.clamp(0, 1)).round().byte().numpy()).save(folder / "truth.png")
    stored = next((folder / "eval").glob("*.png"))
    Image.open(stored).convert("RGB").save(folder / "seen.png")


def draw(method: str, cells: list[Cell], output: Path, results: dict[str, Result]) -> None:
    """The contact sheet of a method."""
    lines = []
    for cell in cells:
        folder = output / "runs" / cell.name
        pictures = [folder / "truth.png", folder / "seen.png"]
        if not pictures[0].exists():
            pictures = [folder / "eval.png"] if (folder / "eval.png").exists() else []
        if pictures and cell.name in results:
            shown = [enlarged(Image.open(path).convert("RGB")) for path in pictures]
            lines.append(Line(f"{cell.setting}: {said(results[cell.name])}", shown))
    if lines:
        contact_sheet(method, ["photograph", "rendering"], lines).save(output / f"{method}.png")


def enlarged(picture: Image.Image) -> torch.Tensor:
    """Pixels of a small picture repeated, so that its label fits beside it."""
    pixels = torch.from_numpy(np.array(picture)).float() / 255
    times = max(1, SHEET_SIDE // max(pixels.shape[:2]))
    return pixels.repeat_interleave(times, 0).repeat_interleave(times, 1)


def publish(results: dict[str, Any]) -> None:
    """Write the cells in the table's order to benchmarks/results, for `tables.py`."""
    found = [Result(**row) for row in results["cells"].values()]
    found.sort(key=lambda one: [*METHODS].index(one.method))
    cells = [
        {"method": one.method, "setting": one.setting, "verdict": verdict(one), "score": said(one)} for one in found
    ]
    words = "" if results["budget"] == 1 else f" --budget {results['budget']:g}"
    about = results | {"cells": cells, "commands": [f"python benchmarks/strangers.py OUTPUT{words}"]}
    RESULTS.write_text(json.dumps(about, indent=1) + "\n", "utf-8")


def verdict(result: Result) -> str:
    """Column of a cell in the table."""
    if result.outcome == "ok":
        return "below" if result.below else "above"
    return result.outcome


def described(result: Result) -> str:
    """A cell in a line."""
    if result.outcome != "ok":
        return f"{result.outcome} {result.sentence}"
    parts = [said(result)]
    parts += [f"{100 * result.coverage:.0f} % covered"] if result.coverage is not None else []
    parts += [f"{result.steps} of {result.expected} steps"] if result.steps != result.expected else []
    parts += [f"{len(result.warnings)} warnings"] if result.warnings else []
    parts += [result.fault] if result.fault else []
    return ", ".join(parts) + f" ({result.seconds:.0f} s)"


def said(result: Result) -> str:
    """Score beside baseline."""
    if result.score is None:
        return ""
    value, unit = result.score["value"], result.score.get("unit", "")
    beside = "" if result.baseline is None else f" ({result.baseline:.3g})"
    return f"{result.score['name']} {value:.3g}{' ' if unit else ''}{unit}{beside}"


def make_data(folder: Path, cells: list[Cell]) -> None:
    """Make the files that cells name in `folder`, unless they exist."""
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(0)
    wanted = " ".join(word for cell in cells for word in (cell.source, *cell.options))

    def missing(name: str) -> bool:
        return f"{folder}/{name}" in wanted and not (folder / name).exists()

    pictures = {
        "wide.png": np.uint8(255 * np.indices((24, 400)).sum(0) / 424)[..., None].repeat(3, 2),
        "grey.png": np.uint8(127 + 120 * np.sin(np.indices((64, 64)).prod(0) / 90)),
        "transparent.png": np.uint8(
            np.dstack([*np.indices((80, 60)) * 3, np.full((80, 60), 40), 255 * (np.indices((80, 60)).sum(0) % 40 > 12)])
        ),
        "noise.jpg": random.integers(0, 256, (64, 64, 3)).astype(np.uint8),
    }  # fmt: skip
    for name, pixels in pictures.items():
        if missing(name):
            Image.fromarray(pixels).save(folder / name)
    profile = np.array([[0, 0], [0.8, 0], [1, 0.6], [0.92, 0.62], [0.7, 0.08], [0, 0.08]])
    rock = trimesh.creation.icosphere(4)
    bumps = 1 + 0.15 * np.sin(5 * rock.vertices[:, :1]) * np.cos(4 * rock.vertices[:, 1:2])
    cup = trimesh.creation.icosphere(4)
    cup.update_faces(cup.triangles_center[:, 2] < 0.4)
    ends = [np.array([[-1.0, a, b], [1.0, a, b]]) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    bars = [trimesh.creation.cylinder(0.03, segment=np.roll(pair, turn, 1)) for pair in ends for turn in range(3)]
    shapes = {
        "bowl.obj": trimesh.creation.revolve(profile, sections=48),
        "bars.ply": trimesh.util.concatenate(bars),
        "rock.obj": trimesh.Trimesh(1000 * rock.vertices * bumps + 1e5, rock.faces),
        "cup.ply": cup,
    }
    for name, mesh in shapes.items():
        if missing(name):
            mesh.export(folder / name)
    if missing("meshes"):
        (folder / "meshes").mkdir()
        for number in range(10):
            parts = [
                trimesh.creation.box(random.uniform(0.2, 1, 3)),
                trimesh.creation.icosphere(2, random.uniform(0.2, 0.6)),
            ]
            for part in parts:
                part.apply_translation(random.uniform(-0.4, 0.4, 3))
                part.visual.vertex_colors = np.append(random.integers(40, 255, 3), 255)
            trimesh.util.concatenate(parts).export(folder / "meshes" / f"thing{number}.ply")
    if missing("captions"):
        words = ["-m", "lumigraph", "train", "captions", *CAPTION_NUMBERS, "--output", str(folder / "captions")]
        subprocess.run([sys.executable, *words], check=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
