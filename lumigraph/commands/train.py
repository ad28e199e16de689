"""`lumigraph train`: train a method on photographs or other data."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Fixed, OmitArgPrefixes, Positional, Suppress, arg

from .. import methods
from ..budget import Quality
from ..errors import LumigraphError
from ..files.names import counted
from ..files.options import ViewerOptions, needed, option
from ..training.options import BlockOptions, TrainOptions
from .capture import posed
from .common import (
    choose_device,
    default_config,
    exit_code,
    method_config,
    option_group,
    preset_device,
    quality_of,
    say,
    show,
    typed,
)
from .main_options import hidden_options, option_names
from .results import Output


def learn_in_blocks(train: Train, blocks: BlockOptions) -> tuple[Path, int] | None:
    """Train all blocks of a scene. Returns the run and the exit code; None for a scene that is learnt as a whole."""
    import torch

    from ..large.training import begin_blocks, places_in_blocks, update

    source = posed(train.scene)
    if blocks.into is not None:
        ended = update(blocks.into, source, train, blocks)
        if ended.done is None:
            say("Stopped and saved; the same command goes on")
            return blocks.into, exit_code(ended.signal)
        took = f"{ended.done.steps} steps in {ended.done.seconds:.1f} s, from {ended.done.photographs} photographs"
        show({"run": str(blocks.into), f"block {blocks.blocks}": took} | onward(blocks.into, source))
        return blocks.into, 0
    if (places := places_in_blocks(source, train, blocks)) is None:
        return None
    if train.log:
        raise LumigraphError(f"{train.scene} is learnt in blocks, each a run of its own; leave --log out")
    if blocks.address is None or train.device == "auto":
        device = choose_device(train.device)
    else:  # of the cluster's machines
        device = torch.device("cuda" if train.device == "gpu" else train.device)
    config = method_config(train, methods.check(blocks.field or train.method))
    run, plan, workers = begin_blocks(source, places, train.method, config, device, train, blocks, train.output)
    show_plan(run, plan, train.budget)
    return run, train_all(run, plan, workers)


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


@dataclass(frozen=True, kw_only=True)
class Train(ViewerOptions, TrainOptions, Output):
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

    def run(self) -> int:
        return self.learn()[1]

    def learn(self, watch: Any = None, loggers: Sequence[Any] = ()) -> tuple[Path, int]:
        """Train, and print the outcome. Returns the run and the exit code.

        watch: of `fit`, in place of the viewer of --view
        loggers: of `fit`, beside those of --log
        """
        from ..opening import open_dataset
        from ..run import check_new
        from ..training.beginning import begin_run, check_source
        from ..training.loop import fit
        from .outcome import show_outcome
        from .view import end_training, keep_showing, watching

        blocks: BlockOptions | None = getattr(self, "blocks", None)
        if blocks is not None and (made := learn_in_blocks(self, blocks)) is not None:
            return made
        device = choose_device(self.device)
        if self.output is not None:
            check_new(self.output)
        check_source(self.scene, self.method)
        data: Any = open_dataset(posed(self.scene), methods.find(self.method).learns_from, **self.of_dataset)
        name = self.chosen(data)
        run, method, budget = begin_run(name, data, method_config(self, name), device, self, self.output)
        with watching(self, method, data, run) as viewer:
            with run.kept_if_learnt():
                seed, looking = run.settings.seed, viewer or watch
                told: dict[str, Any] = {"pause_at": self.pause_at, "loggers": [*self.log, *loggers]}
                outcome = fit(method, data, run, budget=budget, seed=seed, watch=looking, **told)
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
    asked = option("draft|good|best", "as long as --seconds", quality_of(kind))
    extra: dict[str, tuple[Any, Any]] = {}
    if "quality" in {x.name for x in dataclasses.fields(command)}:
        extra["quality"] = Annotated[Quality | None, asked], None
    default = default_config(command, kind, preset_device(device, preset))
    if in_blocks:
        blocks = derived(BlockOptions, default, {})
        extra["blocks"] = Annotated[blocks, OmitArgPrefixes], blocks()
    about = (
        f"What people set. `--help-all` lists all {len(option_names(default))} options."
        if hidden_options(default)
        else None
    )
    extra[option_group(name)] = Annotated[kind.Config, OmitArgPrefixes, arg(help=about)], default
    return derived(command, default, extra)


def derived(base: type, config: Any, extra: dict[str, tuple[Any, Any]]) -> type[Any]:
    """A dataclass of options with further ones, annotation and default by name. Options that a method's Config has too
    are hidden in favour of the Config's."""
    names = option_names(config)
    hidden = {x.name: (Annotated[Any, Fixed, Suppress], x.default) for x in dataclasses.fields(base) if x.name in names}
    options = [(name, kind, dataclasses.field(default=default)) for name, (kind, default) in (hidden | extra).items()]
    made = dataclasses.make_dataclass(base.__name__, options, bases=(base,), frozen=True)
    made.__doc__ = base.__doc__
    return made
