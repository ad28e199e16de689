"""`lumigraph train`: train a method on photographs or other data."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Fixed, OmitArgPrefixes, Positional, Suppress, arg

from .. import methods
from ..budget import Budget, Quality
from ..errors import LumigraphError
from ..files.names import counted
from ..files.ranges import Count, Downscale, Port, Scales, Seconds, Steps
from .capture import posed
from .common import (
    about_quality,
    choose_device,
    default_config,
    exit_code,
    given_budget,
    method_config,
    next_free,
    option_group,
    preset_device,
    quality_budget,
    say,
    scene_name,
    show,
    typed,
)
from .main_options import hidden_options, option_names
from .options import DeviceOption, ReaderOption, SeedOption, StepsOption, ViewerToken, needed, option

MEMORY_BYTES = 2 << 30  # bytes reserved for a block
OPTIONS = "downscale", "reader", "scales"  # of `open_dataset`, for the whole scene


@dataclass(frozen=True)
class BlockOptions:
    """A large scene is trained in blocks, each a run of its own; from few photographs one block, an ordinary run.

    --steps and --seconds are for all blocks together and divided evenly; the default is a minute for each block. After
    Ctrl-C, a crash or a lost machine the same command continues; finished blocks are kept. RUN/blocks.png shows the
    plan. `eval`, `render`, `view` and `export` open the run as one scene. --field METHOD, such as gaussian-splatting,
    trains each block with another method; for clouds, RUN/cloud.ply joins each block's own cell.
    """

    blocks: Annotated[str | None, option("auto|N|FILE", "auto from 200 photographs on, else one block")] = None
    """Positions of blocks: auto (street crossings, or evenly spread), a number of evenly spread ones, or a JSON file in
    the frame of the photographs: {"blocks": [{"centre": [x, y, z], "radius": r}, ...]}. With --into, a block's name."""
    workers: Annotated[Count | None, option("N", "1, in this process")] = None
    """Number of blocks to train at a time on this machine, with Ray."""
    address: Annotated[str | None, option("HOST:PORT", "this machine")] = None
    """Train blocks on an existing Ray cluster; --output must be on storage that all its machines share."""
    into: Annotated[Path | None, option("RUN", "a new run")] = None
    """Learn one block of this run again, from other photographs, as the run's own were learnt; the rest stays."""
    field: Annotated[str, arg(metavar="METHOD", help="The method that learns each block.")] = ""

    def learn(self, train: Any) -> tuple[Path, int] | None:
        """Train all blocks of a scene. Returns the run and the exit code; None for a scene that `train` learns whole.

        train: the command's other options, a `Train`
        """
        from ..datasets.scene import Scene
        from ..large.layout import MIN_LARGE_VIEWS
        from ..large.planning import survey
        from ..opening import kind_of

        if self.into is not None:
            return self._again(train, self.into)
        source, other = posed(train.scene), bool(self.field)
        if kind_of(source, Scene) is not Scene or Path(source).is_file() or (self.blocks == "1" and not other):
            return None  # a file is a single picture
        places = survey(source, train.reader)
        few = places.splits.count("train") < MIN_LARGE_VIEWS
        if few and not other and (self.blocks, self.workers, self.address) == (None, None, None):
            return None
        for name in ("view", "pause_at", "views", "depth_from"):
            if getattr(train, name):
                raise LumigraphError(f"--{name.replace('_', '-')} is for one block; leave it out, or give --blocks 1")
        return self._all(train, source, places)

    def _all(self, train: Any, source: str, places: Any) -> tuple[Path, int]:
        import torch

        from ..large.planning import BlockRecipe, begin, make_plan
        from ..large.training import Workers
        from ..system.memory import free_memory

        here = self.address is None
        budget = given_budget(train.steps, train.seconds, train.quality)
        if here or train.device == "auto":
            device = choose_device(train.device)
        else:  # of the cluster's machines
            device = torch.device("cuda" if train.device == "gpu" else train.device)
        method = methods.check(self.field or train.method)
        config = method_config(train, method)
        seed = getattr(config, "seed", train.seed)
        options = {name: getattr(train, name) for name in OPTIONS}
        recipe = BlockRecipe(method, config, options, budget, train.quality, seed, str(device), here)
        plan = make_plan(source, places, self.blocks or "auto", recipe)
        output = train.output or unfinished(f"runs/{scene_name(source)}-{methods.check(train.method)}", plan)
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        cpus = max(1, cores // self.workers) if self.workers else 1
        plan = begin(output, plan, places, None if here and self.workers is None else cpus)
        show_plan(output, plan, budget)
        gpus = 1.0 if device.type == "cuda" else 0.0
        memory = min(MEMORY_BYTES, free_memory() // (2 * self.workers)) if here and self.workers else MEMORY_BYTES
        return output, train_all(output, plan, Workers(self.workers, self.address, cpus, gpus, memory))

    def _again(self, train: Any, run: Path) -> tuple[Path, int]:
        from ..large.planning import survey
        from ..large.training import update

        if self.blocks is None or not self.blocks.isdigit():
            raise LumigraphError("--into needs the name of the block to learn again; give it as --blocks 3")
        source, budget = posed(train.scene), given_budget(train.steps, train.seconds, train.quality)
        options = {name: getattr(train, name) for name in OPTIONS}
        ended = update(run, self.blocks, source, survey(source, train.reader), options, budget)
        if ended.done is None:
            say("Stopped and saved; the same command goes on")
            return run, exit_code(ended.signal)
        took = f"{ended.done.steps} steps in {ended.done.seconds:.1f} s, from {ended.done.photographs} photographs"
        show({"run": str(run), f"block {self.blocks}": took} | onward(run, source))
        return run, 0


def train_all(output: Path, plan: Any, workers: Any) -> int:
    """Train the blocks of a plan that are not done, and print what they took. Returns the exit code."""
    from ..large.training import conduct, finish

    found = conduct(output, plan, workers)
    if found.signal is not None:
        done = f"{len(found.done)} of {len(plan.blocks)} blocks done"
        say(f"Stopped and saved, {done}; the same command goes on, and so does {typed('resume', output)}")
        return exit_code(found.signal)
    if found.failed:
        first, why = next(iter(found.failed.items()))
        raise LumigraphError(
            f"{len(found.failed)} of {len(plan.blocks)} blocks of {output} could not be learnt; block {first}: "
            f"{why}; the others are kept, and {typed('resume', output)} tries again"
        )
    finish(output)
    show_done(output, found)
    return 0


def unfinished(prefix: str, plan: Any) -> Path:
    """The latest run of this name, if it is the same and not done; else the next name that is free."""
    from ..large.plan import DONE_FILE, PLAN_FILE, Plan
    from ..large.planning import difference, place_of

    free = next_free(prefix)
    number = int(free.name.rpartition("-")[2])
    latest = free.with_name(f"{free.name.rpartition('-')[0]}-{number - 1}")
    if (latest / PLAN_FILE).is_file() and difference(known := Plan.read(latest / PLAN_FILE), plan) is None:
        if not all((place_of(latest, block) / DONE_FILE).exists() for block in known.blocks):
            return latest
    return free


def show_plan(output: Path, plan: Any, budget: Any) -> None:
    """Print the plan before training."""
    counts = [len(block.photographs) for block in plan.blocks]
    each = " ".join(
        f"{value:g} {name}" if name != "quality" else f"as {value} asks" for name, value in plan.budget.items()
    )
    least, most = min(counts), counted(max(counts), "photograph")
    many = most if least == max(counts) else f"{least} to {most}"
    total = f" of {budget}" if budget is not None else ""
    say(f"{counted(len(counts), 'block')} of {many}, each learnt for {each}{total}; {output / 'blocks.png'} shows them")


def show_done(output: Path, found: Any) -> None:
    """Print the cost of all blocks."""
    done = list(found.done.values())
    rows = {"run": str(output), "blocks": f"{len(done)}, {sum(x.bytes for x in done) / 1e6:.1f} MB of weights"}
    steps, seconds = sum(x.steps for x in done), sum(x.seconds for x in done)
    rows["training"] = f"{steps:,} steps in {seconds:.1f} s, all blocks together"
    if memory := max(x.peak_memory for x in done):
        rows["memory"] = f"{memory / 1e9:.2f} GB at most in one process"
    show(rows | onward(output))


def onward(run: Path, source: str | None = None) -> dict[str, str]:
    """Command to type next."""
    from .outcome import NEXT

    again = ["--scene", source] if source else []
    return {NEXT["eval"]: typed("eval", run, *again), NEXT["view"]: typed("view", run)}


DEFAULT_SECONDS = 60.0


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a method on the photographs of a scene.

    The scene is a folder of photographs, a video, a single picture, or procedural:NAME. Methods that learn from shapes
    take a mesh or a folder of meshes, those that learn from a collection a folder of scenes, or procedural:toys. Those
    that learn from words take words:PROMPT and --guidance. If photographs have no poses, `lumigraph capture` finds them
    first. `lumigraph train METHOD --help` adds the method's options that people set, `--help-all` all of them;
    `lumigraph methods` lists the methods. Ctrl-C saves; `lumigraph resume` continues.
    """

    method: Annotated[Positional[str], needed("METHOD")]
    """Method to train, for example instant-ngp, or `surface` for the default method for meshes: neus for objects and
    bounded scenes, planar-splatting in the open."""
    scene: Annotated[Positional[str], needed("SCENE")]
    """Photographs, a video, or other data to train on."""
    output: Annotated[Path | None, option("RUN", "runs/SCENE-METHOD-N")] = None
    """New folder for the run."""
    seconds: Annotated[Seconds | None, option("S", f"{DEFAULT_SECONDS:.0f}")] = None
    """Training time in seconds; longer gives a higher PSNR. Compiling kernels on first use is not counted."""
    steps: StepsOption = None
    quality: Annotated[Quality | None, option("draft|good|best", "as long as --seconds", about_quality())] = None
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce photographs by this whole number; a larger one trains faster and loses detail."""
    reader: ReaderOption = None
    views: Annotated[Count | None, option("N", "all")] = None
    """Train on only this number of photographs, spread evenly over the cameras."""
    depth_from: Annotated[str | None, option("FILE", "depth beside the photographs")] = None
    """Cloud (.las, .laz, .e57, .ply) or mesh that gives the photographs their depth, in the frame of their poses."""
    guidance: Annotated[str | None, option("FILE", "")] = None
    """Model that judges pictures by words:PROMPT: CLIP or a diffusion model, in a folder or file of yours."""
    scales: Annotated[Scales, option("N")] = 1
    """Number of resolutions of every photograph, each half of the one before; evaluation averages over all."""
    seed: SeedOption = 0
    device: DeviceOption = "auto"
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the method's options: the paper's, or those tuned for a CPU; auto decides by --device."""
    pause_at: Annotated[Steps | None, option("STEP", "never")] = None
    """Stop at this step as if interrupted. The schedule still follows the whole budget."""
    view: bool = False
    """Show the scene in the browser during training, and afterwards until Ctrl-C."""
    stay: bool = True
    """With --view, show the scene after training too, until Ctrl-C."""
    host: Annotated[str, option("ADDRESS", "127.0.0.1, this machine only")] = "127.0.0.1"
    """Address that --view listens at; 0.0.0.0 gives access to other machines."""
    port: Annotated[Port | None, option("N", "8080, or the next free port")] = None
    """Port that --view listens at."""
    token: ViewerToken = ""

    def run(self) -> int:
        return self.learn()[1]

    def learn(self, watch: Any = None) -> tuple[Path, int]:
        """Train, and print the outcome. Returns the run and the exit code.

        watch: of `fit`, in place of the viewer of --view
        """
        from ..datasets.dataset import check_kind
        from ..opening import confirm, kind_of, open_dataset
        from ..run import Run, build, check_new
        from ..training import fit
        from .outcome import show_outcome
        from .view import end_training, keep_showing, watching

        blocks: BlockOptions | None = getattr(self, "blocks", None)
        if blocks is not None and (made := blocks.learn(self)) is not None:
            return made
        budget = given_budget(self.steps, self.seconds, self.quality)
        kind, device = methods.find(self.method), choose_device(self.device)
        if self.output is not None:
            check_new(self.output)
        found = kind_of(self.scene, kind.learns_from)
        if found is not kind.learns_from:
            confirm(self.scene)  # a missing path has no kind
        check_kind(methods.check(self.method), kind.learns_from, found, self.scene, methods.learning_from)
        source = posed(self.scene)
        options: dict[str, Any] = {name: getattr(self, name) for name in ("downscale", "reader", "views", "scales")}
        if self.depth_from is not None:
            options["depth_from"] = str(Path(self.depth_from).resolve())
        if self.guidance is not None:
            options["guidance"] = str(Path(self.guidance).expanduser().resolve())
        data = open_dataset(source, kind.learns_from, **options)
        name = self.chosen(data)
        kind = methods.find(name)
        output = self.output or next_free(f"runs/{scene_name(source)}-{name}")
        check_new(output)
        config = method_config(self, name)
        seed = getattr(config, "seed", self.seed)
        method = build(kind, data.frame, config, device, seed, learning=True)
        if budget is None:
            asked = self.quality or method.default_quality
            budget = quality_budget(asked, method, data) if asked else Budget(seconds=DEFAULT_SECONDS)
        run = Run.create(output, method, data, seed=seed, options=options, budget=budget.to_json())
        with watching(self, method, data, run) as viewer:
            with run.kept_if_learnt():
                looking = viewer or watch
                outcome = fit(method, data, run, budget=budget, seed=seed, pause_at=self.pause_at, watch=looking)
            show_outcome(run, outcome, method, data, end_training(viewer, method))
            keep_showing(viewer if self.stay else None, outcome.signal)
        return run.folder, exit_code(outcome.signal)

    def chosen(self, data: Any) -> str:
        """Name of the method. The word `surface`, without options of the method, depends on the scene."""
        name = methods.check(self.method)
        if self.method not in methods.BOUNDED or data.frame.is_open:
            return name
        asked, device = getattr(self, option_group(name), None), preset_device(self.device, self.preset)
        if asked not in (None, default_config(type(self), methods.find(name), device)):
            return name
        say(f"{self.method}: {methods.BOUNDED[self.method]}, for the scene is bounded; {name} is for open ones")
        return methods.BOUNDED[self.method]


def with_options_of(
    name: str, command: type = Train, device: str = "auto", preset: str = "auto", field: str = ""
) -> type[Any]:
    """A command, `train` or one like it, with a method's own numbers among its options. Where the method is trained in
    blocks, `train` also has `BlockOptions`, and the numbers of the method that --field names for each block.

    device, preset, field: values of these options, on which the defaults depend
    """
    in_blocks = command is Train and methods.find(name).in_blocks
    if in_blocks and (learner := field.replace("_", "-")) in methods.available():
        name = learner
    kind = methods.find(name)
    asked = option("draft|good|best", "as long as --seconds", about_quality(kind))
    extra: dict[str, tuple[Any, Any]] = {}
    if "quality" in {x.name for x in dataclasses.fields(command)}:
        extra["quality"] = Annotated[Quality | None, asked], None
    if in_blocks:
        blocks = derived(BlockOptions, kind.Config, {})
        extra["blocks"] = Annotated[blocks, OmitArgPrefixes], blocks()
    default = default_config(command, kind, preset_device(device, preset))
    about = (
        f"What people set. `--help-all` lists all {len(option_names(default))} options."
        if hidden_options(default)
        else None
    )
    extra[option_group(name)] = Annotated[kind.Config, OmitArgPrefixes, arg(help=about)], default
    return derived(command, kind.Config, extra)


def derived(base: type, config: type, extra: dict[str, tuple[Any, Any]]) -> type[Any]:
    """A dataclass of options with further ones, annotation and default by name. Options that a method's Config has too
    are hidden in favour of the Config's."""
    names = {x.name for x in dataclasses.fields(config) if not dataclasses.is_dataclass(x.default)}  # --steps stays
    hidden = {x.name: (Annotated[Any, Fixed, Suppress], x.default) for x in dataclasses.fields(base) if x.name in names}
    options = [(name, kind, dataclasses.field(default=default)) for name, (kind, default) in (hidden | extra).items()]
    made = dataclasses.make_dataclass(base.__name__, options, bases=(base,), frozen=True)
    made.__doc__ = base.__doc__
    return made
