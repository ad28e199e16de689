"""`lumigraph bench`: speed of kernels and steps, quality of methods, PSNR against the number of photographs; shapes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from .. import methods
from ..budget import Budget
from ..errors import LumigraphError
from ..files import claim
from ..files.options import DeviceOption, Overwrite, ReaderOption, SeedOption, StepsOption, needed, option
from ..files.ranges import Count, Downscale, Scales, Seconds, Seed, Share, Steps
from ..training.options import DEFAULT_SECONDS
from .capture import posed
from .common import choose_device, preset_device, say, scene_name, show, show_table

FEW_VIEW_METHODS = "nerf", "mip-nerf", "instant-ngp", "gaussian-splatting", "regnerf", "pixelnerf"

if TYPE_CHECKING:
    from ..lab.benchmark.cell import Cell, CellSettings


@dataclass(frozen=True)
class BenchKernels:
    """Measure every kernel's throughput on every engine, and its ratio to the reference in the same run."""

    output: Annotated[Path | None, option("FILE.json", "print the table only")] = None
    """File for the figures, in addition to the table."""
    overwrite: Overwrite = False
    device: DeviceOption = "auto"

    def run(self) -> int:
        from ..kernels.bench import bench_kernels

        if self.output is not None:
            claim(self.output, "benchmark", self.overwrite)
        bench_kernels(device=choose_device(self.device), output=self.output)
        return 0


@dataclass(frozen=True)
class BenchStep:
    """Take one training step apart: each kernel, PyTorch operation and optimizer, in milliseconds and bytes.

    A fresh method is warmed up with the preset of the device; a run is continued in memory, and its folder stays as it
    is. Bytes are compared with the rate at which the main memory copies.
    """

    method: Annotated[Positional[str], needed("METHOD_OR_RUN")]
    """Method, for example gaussian-splatting; or the folder of a run, without SCENE."""
    scene: Annotated[Positional[str | None], option("SCENE", "the run's own")] = None
    """Scene to train on, as for `lumigraph train`."""
    output: Annotated[Path | None, option("FILE.json", "print the table only")] = None
    """File for the figures, in addition to the table."""
    flame: Annotated[Path | None, option("FILE.svg", "none")] = None
    """File for the flame graph: nested bars as wide as their share of the step."""
    overwrite: Overwrite = False
    warmup: Annotated[Count, option("N")] = 100
    """Training steps before the measurement; more let clouds and grids grow."""
    steps: Annotated[Count, option("N")] = 40
    """Steps that are measured; more average over more photographs."""
    progress: Annotated[Share, option("SHARE")] = 0.75
    """Share of the budget that schedules follow while measuring, such as picture size and bands of harmonics."""
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce photographs by this whole number."""
    reader: ReaderOption = None
    seed: SeedOption = 0
    device: DeviceOption = "auto"
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the method's options: the paper's, or those tuned for a CPU; auto decides by --device."""

    def run(self) -> int:
        os.environ.setdefault("CUDA_LAUNCH_BLOCKING", "1")  # a GPU's work then counts where it is launched
        from ..figures.charts import standalone
        from ..files import write_bytes, write_json
        from ..lab.benchmark.step import bench_step
        from ..opening import open_dataset
        from ..run import Run, build

        if self.output is not None:
            claim(self.output, "benchmark", self.overwrite)
        if self.flame is not None:
            claim(self.flame, "figure", self.overwrite)
        device = choose_device(self.device)
        if self.scene is None:
            run = Run(Path(self.method))
            data, method, name = run.dataset(), run.new_method(device), run.method_name
        else:
            run, name = None, methods.check(self.method)
            learner = methods.find(name)
            data = open_dataset(posed(self.scene), learner.learns_from, downscale=self.downscale, reader=self.reader)
            config = learner.preset(preset_device(self.device, self.preset))
            method = build(learner, data.frame, config, device, self.seed, learning=True)
        found = bench_step(method, data, run, self.warmup, self.steps, self.progress, self.seed)
        show_table(found.table(f"A step of {name} on {scene_name(data.source)}"))
        if self.output is not None:
            write_json(self.output, {"method": name, "scene": data.source, **found.to_json()}, "benchmark")
        if self.flame is not None:
            write_bytes(self.flame, standalone(found.graph()), "figure")
        return 0


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Options of benchmarks that train methods and compare them."""

    methods: Annotated[tuple[str, ...], needed("METHOD ...")]
    """Methods to train, for example instant-ngp gaussian-splatting."""
    scenes: Annotated[tuple[str, ...], needed("SCENE ...")]
    """Scenes to train on, as for `lumigraph train`."""
    output: Annotated[Path, needed("OUTPUT")]
    """Folder for runs, table and charts."""
    seeds: Annotated[tuple[Seed, ...], option("N")] = (0,)
    """Seeds of all random choices; several give means with deviations."""
    eval_views: Annotated[Count | None, option("N", "all")] = None
    """Compare only this number of held-out views, evenly spread."""
    lpips: Annotated[tuple[Path, ...], option("FILE", "those in LUMIGRAPH_LPIPS, if any")] = ()
    """Files with the weights of LPIPS, as for `lumigraph eval`."""
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce photographs by this whole number; a larger one trains faster and loses detail."""
    reader: ReaderOption = None
    scales: Annotated[Scales, option("N")] = 1
    """Number of resolutions of every photograph, each half of the one before; scores average over all."""
    device: DeviceOption = "auto"
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the methods' options: the papers', or those tuned for a CPU; auto decides by --device."""

    def checked(self) -> CellSettings:
        """Settings of all cells. Raises LumigraphError for impossible ones, before anything is opened or trained."""
        from ..lab.benchmark.cell import CellSettings
        from ..metrics.lpips import load_lpips, named_files

        for name in self.methods:
            methods.check(name)
        choose_device(self.device)
        weights = tuple(path.resolve() for path in named_files(self.lpips))
        if weights:
            load_lpips(weights)
        return CellSettings(
            self.downscale, self.reader, self.scales, self.preset, self.device, self.eval_views, weights
        )

    def conduct(self, cells: Sequence[Cell], settings: CellSettings) -> int:
        """Train and compare all cells."""
        from ..lab.benchmark.conduct import conduct

        code = conduct(cells, settings, self.output, say)
        if code:
            say("Stopped; what is done is kept, and the same command goes on")
            return code
        show({"table": str(self.output / "results.md"), "figures": str(self.output / "results.json")})
        return 0


def budgets(seconds: Sequence[float], steps: Sequence[int]) -> list[Budget]:
    """Budgets in seconds or steps, DEFAULT_SECONDS without either. Raises LumigraphError for both."""
    if seconds and steps:
        raise LumigraphError("--steps and --seconds are two ways to say how long; give one of them")
    return [Budget(n, None) for n in steps] or [Budget(None, s) for s in seconds or (DEFAULT_SECONDS,)]


def place_of(scene: str) -> str:
    """Source with poses of a named scene, independent of the current folder: paths become absolute."""
    source = posed(scene)
    path = Path(source).expanduser()
    return str(path.resolve()) if path.exists() else source


@dataclass(frozen=True, kw_only=True)
class BenchMethods(Cells):
    """Train methods on scenes, for several durations and from several seeds, and compare held-out views.

    Every cell is a separate run in OUTPUT/runs, trained by `lumigraph train` and compared by `lumigraph eval` in
    separate processes. OUTPUT/results.md has the table, results.json all figures; charts show PSNR over time. Ctrl-C
    stops; the same command continues.
    """

    seconds: Annotated[tuple[Seconds, ...], option("S", "60")] = ()
    """Training time in seconds; several give a chart."""
    steps: Annotated[tuple[Steps, ...], option("N", "as long as --seconds")] = ()
    """Train for these numbers of steps instead."""

    def run(self) -> int:
        from ..lab.benchmark.cell import Cell

        times, settings = budgets(self.seconds, self.steps), self.checked()
        cells = [
            Cell(methods.check(name), scene_name(place), place, budget, seed)
            for place in map(place_of, self.scenes)
            for budget in times
            for seed in self.seeds
            for name in self.methods
        ]
        return self.conduct(cells, settings)


@dataclass(frozen=True, kw_only=True)
class BenchViews(Cells):
    """Train methods on fewer and fewer photographs of a scene, and compare the same held-out views.

    The photographs are spread evenly over the cameras, and each subset contains the smaller ones. A table and a chart
    show PSNR over the number of photographs; the rest is as in `lumigraph bench methods`. For a collection, held-out
    members are scenes, and the mean is shown. Priors, such as pixelnerf, take the photographs as input. The prior is a
    run of --priors, or one that is trained first, on the first collection of --scenes.
    """

    methods: Annotated[
        tuple[str, ...], needed("METHOD ...", f"Methods to train (default: {' '.join(FEW_VIEW_METHODS)}).")
    ] = FEW_VIEW_METHODS
    views: Annotated[tuple[Count | Literal["all"], ...], option("N")] = (2, 3, 4, 6, 9, 15, 25, 50, "all")
    """Numbers of training photographs; those that a scene does not have are left out."""
    seconds: Annotated[Seconds | None, option("S", "60")] = None
    """Training time in seconds."""
    steps: StepsOption = None
    members: Annotated[Count, option("N")] = 4
    """Number of held-out members of a collection, evenly spread."""
    priors: Annotated[tuple[Path, ...], option("RUN ...", "trained first, on the first collection of --scenes")] = ()
    """Runs trained on a collection."""
    prior_seconds: Annotated[Seconds | None, option("S", "as long as the others")] = None
    """Training time of priors in seconds."""
    prior_steps: Annotated[Steps | None, option("N", "as long as --prior-seconds")] = None
    """Train priors for this number of steps instead."""

    def run(self) -> int:
        (budget,) = budgets(given(self.seconds), given(self.steps))
        longer = self.prior_seconds is not None or self.prior_steps is not None
        (of_priors,) = budgets(given(self.prior_seconds), given(self.prior_steps)) if longer else (budget,)
        settings = self.checked()
        sources = list(map(place_of, self.scenes))
        names = [methods.check(name) for name in self.methods]
        learnt, cells = self.by_priors(names, sources, of_priors)
        names = [name for name in names if name in learnt or not learns_across(name)]
        if not names:
            raise LumigraphError("There is no method left to compare; name a collection among --scenes, or --priors")
        for place in (place for source in sources for place in self.places(source)):
            cells += self.cells_of(place, names, budget, learnt)
        return self.conduct(cells, settings)

    def by_priors(
        self, names: Sequence[str], sources: Sequence[str], budget: Budget
    ) -> tuple[dict[str, dict[int, Path]], list[Cell]]:
        """The prior's run for each method that learns from collections and each seed, and cells that train missing
        ones."""
        from ..datasets.collection import Collection
        from ..lab.benchmark.cell import Cell
        from ..opening import kind_of
        from ..run import Run

        there = {Run(path).method_name: path.resolve() for path in self.priors}
        collection = next((source for source in sources if kind_of(source) is Collection), None)
        learnt: dict[str, dict[int, Path]] = {}
        cells = []
        for name in filter(learns_across, names):
            if self.scales > 1:
                raise LumigraphError(f"{name} takes photographs of one size, so --scales cannot be {self.scales}")
            if name in there:
                learnt[name] = dict.fromkeys(self.seeds, there[name])
            elif collection is None:
                say(f"{name} learns from a collection, and there is none among --scenes, nor --priors; leaving it out")
            else:
                trained = [Cell(name, scene_name(collection), collection, budget, seed) for seed in self.seeds]
                learnt[name] = {cell.seed: (self.output / "runs" / cell.name).resolve() for cell in trained}
                cells += trained
        return learnt, cells

    def places(self, source: str) -> Iterator[tuple[str, str, str]]:
        """Source, short name and collection of the source, or of held-out members of the collection that it is."""
        from ..datasets.collection import Collection
        from ..geometry import evenly
        from ..lab.benchmark.cell import MEMBERS
        from ..opening import kind_of, open_dataset, sources_of

        if kind_of(source) is not Collection:
            yield source, scene_name(source), ""
            return
        collection, of_member = open_dataset(source), sources_of(source)
        assert isinstance(collection, Collection)
        held_out = [collection.names[i] for i in collection.splits["test"].tolist()]
        for name in evenly(held_out, self.members):
            yield of_member[name], scene_name(name), scene_name(source) + MEMBERS

    def cells_of(
        self, place: tuple[str, str, str], names: Sequence[str], budget: Budget, learnt: dict[str, dict[int, Path]]
    ) -> Iterator[Cell]:
        """A place's cells: each number of photographs, each seed, each method."""
        from ..lab.benchmark.cell import Cell

        source, scene, collection = place
        there = self.there(source)
        for number in self.possible(source, there):
            for seed in self.seeds:
                for name in names:
                    cell = Cell(name, scene, source, budget, seed, number, collection)
                    if name in learnt:  # a prior gets all photographs as input
                        cell = replace(cell, views=number or there, prior=str(learnt[name][seed]))
                    yield cell

    def there(self, source: str) -> int:
        """Number of a scene's training photographs."""
        from ..lab.benchmark.cell import reduced
        from ..opening import open_scene

        downscale = reduced(source, self.downscale)
        return len(open_scene(source, downscale=downscale, reader=self.reader).splits["train"])

    def possible(self, source: str, there: int) -> list[int | None]:
        """Numbers of views up to a scene's number of photographs; `None` is all."""
        left_out = [views for views in self.views if views != "all" and views > there]
        if left_out:
            say(f"{source} has {there} photographs to learn from; leaving out {', '.join(map(str, left_out))}")
        return [None if views == "all" else views for views in self.views if views not in left_out]


@dataclass(frozen=True, kw_only=True)
class BenchShapes:
    """Train methods on shapes, and measure levels of detail and completions of held-out shapes.

    A mesh is learnt by itself: OUTPUT/shapes.md has IoU, chamfer distance, normal consistency, bytes and the time of a
    picture, at each level of detail. A folder of meshes is a collection: each method completes its held-out members
    from the evidence that it takes (the whole mesh, one side's scan, 300 points, one picture), beside retrieval of the
    training member that fits best. Ctrl-C stops; the same command continues.
    """

    methods: Annotated[
        tuple[str, ...], needed("METHOD ...", "Methods to train (default: those that learn shapes).")
    ] = ()
    shapes: Annotated[tuple[str, ...], needed("MESH ...")]
    """Meshes, and folders of meshes, as for `lumigraph train`."""
    output: Annotated[Path, needed("OUTPUT")]
    """Folder for runs and tables."""
    runs: Annotated[tuple[Path, ...], option("RUN ...", "none")] = ()
    """Further trained runs of the same shapes to measure, for example of --input picture."""
    seconds: Annotated[Seconds | None, option("S", "60")] = None
    """Training time in seconds."""
    steps: StepsOption = None
    seed: Annotated[Seed, option("N")] = 0
    """Seed of all random choices."""
    members: Annotated[Count, option("N")] = 8
    """Number of held-out members of a collection, evenly spread."""
    points: Annotated[Count, option("N")] = 100_000
    """Points that are compared in the volume and on each surface; fewer are faster, and noisier."""
    cells: Annotated[Count, option("N")] = 128
    """Cells along the longest side of the grid that surfaces are found with; more are finer, and slower."""
    device: DeviceOption = "auto"
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the methods' options: the papers', or those tuned for a CPU; auto decides by --device."""

    def run(self) -> int:
        from ..datasets.shapes import Shapes
        from ..lab.benchmark.cell import Cell, CellSettings
        from ..lab.benchmark.conduct import conduct
        from ..lab.benchmark.shapes import measure

        (budget,) = budgets(given(self.seconds), given(self.steps))
        choose_device(self.device)
        names = [methods.check(name) for name in self.methods] or methods.learning_from(Shapes)
        for name in ("shapes.json", "shapes.md"):
            claim(self.output / name, "benchmark")
        settings = CellSettings(preset=self.preset, device=self.device, eval_views=self.members)
        cells = [
            Cell(name, scene_name(place), place, budget, self.seed)
            for place in map(place_of, self.shapes)
            for name in names
            if not (Path(place).is_dir() and learns_one(name))
        ]
        if code := conduct(cells, settings, self.output, say):
            return code
        there = [self.output / "runs" / cell.name for cell in cells]
        measured = [*filter(lambda folder: (folder / "config.json").exists(), there), *self.runs]
        measure(measured, self.members, self.points, self.cells, self.output, say)
        show({"table": str(self.output / "shapes.md"), "figures": str(self.output / "shapes.json")})
        return 0


def learns_one(name: str) -> bool:
    """True if a method of shapes trains on a single one."""
    from ..components.sampling.coded_surface import CodedSurface

    return not issubclass(methods.find(name), CodedSurface)


def learns_across(name: str) -> bool:
    """True if a method learns from collections and takes a scene as input."""
    from ..datasets.collection import Collection

    return methods.find(name).learns_from is Collection


def given(value: float | int | None) -> tuple:
    return () if value is None else (value,)


What = (
    Annotated[BenchKernels, subcommand("kernels")]
    | Annotated[BenchStep, subcommand("step")]
    | Annotated[BenchMethods, subcommand("methods")]
    | Annotated[BenchViews, subcommand("views")]
    | Annotated[BenchShapes, subcommand("shapes")]
)


@dataclass(frozen=True)
class Bench:
    """Benchmark kernels and training steps on this machine, methods on scenes, or methods on shapes."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
