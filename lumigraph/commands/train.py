"""`lumigraph train`: train a method on photographs or other data."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Fixed, OmitArgPrefixes, Positional, Suppress

from .. import methods
from ..budget import Budget, Quality
from ..files.ranges import Count, Downscale, Port, Scales, Seconds, Steps
from .capture import posed
from .common import (
    about_quality,
    choose_device,
    exit_code,
    given_budget,
    method_config,
    next_free,
    option_group,
    preset_device,
    quality_budget,
    scene_name,
    value_of,
)
from .options import DeviceOption, ReaderOption, SeedOption, StepsOption, needed, option
from .train_blocks import BlockOptions

DEFAULT_SECONDS = 60.0


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a method on the photographs of a scene.

    The scene is a folder of photographs, a video, a single picture, or procedural:NAME. Methods that learn from shapes
    take a mesh or a folder of meshes, those that learn from a collection a folder of scenes, or procedural:toys. If
    photographs have no poses, `lumigraph capture` finds them first. `lumigraph train METHOD --help` adds the method's
    own options, `lumigraph methods` lists the methods. Ctrl-C saves; `lumigraph resume` continues.
    """

    method: Annotated[Positional[str], needed("METHOD")]
    """Method to train, for example instant-ngp."""
    scene: Annotated[Positional[str], needed("SCENE")]
    """Photographs, a video, or other data to train on."""
    output: Annotated[Path | None, option("RUN", "runs/SCENE-METHOD-N")] = None
    """New folder for the run."""
    seconds: Annotated[Seconds | None, option("S", f"{DEFAULT_SECONDS:.0f}")] = None
    """Training time in seconds; longer gives a higher PSNR. Compiling kernels on first use is not counted."""
    steps: StepsOption = None
    quality: Annotated[Quality | None, option("draft|good|best", "as long as --seconds", about_quality())] = None
    downscale: Annotated[Downscale | None, option("N", "to at most about 1000 pixels")] = None
    """Reduce photographs by this whole number; a larger one trains faster and loses detail."""
    reader: ReaderOption = None
    views: Annotated[Count | None, option("N", "all")] = None
    """Train on only this number of photographs, spread evenly over the cameras."""
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
    host: Annotated[str, option("ADDRESS", "127.0.0.1, this machine only")] = "127.0.0.1"
    """Address that --view listens at; 0.0.0.0 gives access to other machines."""
    port: Annotated[Port | None, option("N", "8080, or the next free port")] = None
    """Port that --view listens at."""

    def run(self) -> int:
        from ..capture import confirm, kind_of, open_dataset
        from ..datasets.dataset import check_kind
        from ..run import Run, build, check_new
        from ..training import fit
        from .outcome import show_outcome
        from .view import keep_showing, watching

        blocks: BlockOptions | None = getattr(self, "blocks", None)
        if blocks is not None and (code := blocks.run(self)) is not None:
            return code
        budget = given_budget(self.steps, self.seconds, self.quality)
        kind, device = methods.find(self.method), choose_device(self.device)
        if self.output is not None:
            check_new(self.output)
        found = kind_of(self.scene, kind.learns_from)
        if found is not kind.learns_from:
            confirm(self.scene)  # a missing path has no kind
        check_kind(methods.check(self.method), kind.learns_from, found, self.scene, methods.learning_from(found))
        source = posed(self.scene)
        output = self.output or next_free(f"runs/{scene_name(source)}-{methods.check(self.method)}")
        check_new(output)
        options: dict[str, Any] = {name: getattr(self, name) for name in ("downscale", "reader", "views", "scales")}
        data = open_dataset(source, kind.learns_from, **options)
        config = method_config(self, self.method)
        seed = getattr(config, "seed", self.seed)
        method = build(kind, data.frame, config, device, seed, learning=True)
        if budget is None:
            asked = self.quality
            budget = quality_budget(asked, method, data) if asked else Budget(seconds=DEFAULT_SECONDS)
        run = Run.create(output, method, data, seed=seed, options=options, budget=budget.to_json())
        with watching(self.view, method, data, run, self.host, self.port) as watch:
            with run.kept_if_learnt():
                outcome = fit(method, data, run, budget=budget, seed=seed, pause_at=self.pause_at, watch=watch)
            show_outcome(run, outcome, method, data)
            keep_showing(watch, outcome.signal)
        return exit_code(outcome.signal)


def with_options_of(name: str, arguments: Sequence[str], command: type = Train) -> type[Any]:
    """A command, `train` or one like it, with a method's own numbers among its options. Where the method is trained in
    blocks, `train` also has `BlockOptions`, and the numbers of the method that --field names for each block."""
    in_blocks = command is Train and methods.find(name).in_blocks
    if in_blocks and (field := value_of("--field", arguments, "").replace("_", "-")) in methods.available():
        name = field
    kind = methods.find(name)
    device, preset = value_of("--device", arguments, "auto"), value_of("--preset", arguments, "auto")
    asked = option("draft|good|best", "as long as --seconds", about_quality(kind))
    extra: dict[str, tuple[Any, Any]] = {"quality": (Annotated[Quality | None, asked], None)}
    if in_blocks:
        blocks = derived(BlockOptions, kind.Config, {})
        extra["blocks"] = Annotated[blocks, OmitArgPrefixes], blocks()
    extra[option_group(name)] = Annotated[kind.Config, OmitArgPrefixes], kind.preset(preset_device(device, preset))
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
