"""Cell of a benchmark: one training and its evaluation, as commands that a user could type; its results as a row."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from ... import files, methods
from ...budget import Budget
from ...errors import LumigraphError
from ...files.ranges import Lasted, Tally, typed
from ...metrics import Score
from ...opening import requested
from ...run import Run
from ...run.derived import Inferred
from ...run.records import Protocol, ViewScores, compared_kind
from ...synthetic import is_category
from .published import of_scene

SHEET = "views.png"
MEMBERS = "-members"  # behind a collection's name: its members, averaged
Row = dict[str, Any]
MEASURED = (
    "scores",
    "psnr",
    "ssim",
    "lpips",
    "steps",
    "training_seconds",
    "compile_seconds",
    "peak_memory",
    "seconds_per_view",
    "cloud",
    "protocol",
    "trained_on",
    "evaluated_on",
    "versions",
)


@dataclass(frozen=True)
class CellSettings:
    """Settings of all cells of a benchmark: the command line's options of the same names.

    eval_views: number of held-out views to compare; `None` for all
    lpips:      weight files of LPIPS; empty for none
    """

    downscale: int | None = None
    reader: str | None = None
    scales: int = 1
    preset: str = "auto"
    device: str = "auto"
    eval_views: int | None = None
    lpips: tuple[Path, ...] = ()

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"lpips": [path.name for path in self.lpips]}


@dataclass(frozen=True)
class Cell:
    """A method, its data, and its budget: seconds or steps.

    scene:      its short name, the same for all cells of the scene
    views:      number of training photographs; None for all
    collection: name of the scene's collection, over which results are averaged
    prior:      the run that infers the cell's run from so many photographs without training; its budget is then that of
                the cells beside it
    further:    other options of `lumigraph train`
    """

    method: str
    scene: str
    source: str
    budget: Budget
    seed: int = 0
    views: int | None = None
    collection: str = ""
    prior: str | None = None
    further: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The cell's folder name, unique among cells with common settings."""
        views = "" if self.views is None else f"-{self.views}views"
        if self.prior:
            return f"{self.scene}-{self.method}{views}-by-{Path(self.prior).name}"
        return f"{self.scene}-{self.method}{views}-{duration(self.budget).replace(' ', '')}-seed{self.seed}"

    @property
    def seconds(self) -> float:
        """Expected training seconds; 0 if unknown."""
        return 0.0 if self.prior else self.budget.seconds or 0.0

    @property
    def title(self) -> str:
        """The cell's display name."""
        views = "" if self.views is None else f" from {self.views} views"
        if self.prior:
            return f"{self.method} on {self.scene}{views}, by {Path(self.prior).name}"
        return f"{self.method} on {self.scene}{views}, {duration(self.budget)}, seed {self.seed}"


def duration(budget: Budget) -> str:
    return f"{budget.seconds:g} s" if budget.seconds else f"{budget.steps} steps"


def training(cell: Cell, folder: Path, settings: CellSettings) -> list[str]:
    """Arguments of `lumigraph` that train or resume the cell; empty if it is trained."""
    if (folder / "config.json").exists():
        return [] if trained(folder) else ["resume", str(folder)]
    return [*train_command(cell, settings), "--output", str(folder)]


def train_command(cell: Cell, settings: CellSettings) -> list[str]:
    downscale = reduced(cell.source, settings.downscale)
    opened = {"--views": cell.views, "--downscale": downscale, "--reader": settings.reader}
    if cell.prior:
        return ["infer", cell.prior, cell.source, *options(opened | {"--device": settings.device})]
    told = {
        "--seconds": cell.budget.seconds,
        "--steps": cell.budget.steps,
        "--seed": cell.seed,
        **opened,
        "--scales": settings.scales if settings.scales > 1 else None,
        "--preset": settings.preset,
        "--device": settings.device,
    }
    return ["train", cell.method, cell.source, *options(told), *cell.further]


def reduced(source: str, downscale: int | None) -> int | None:
    """Downscale of a source; `None` for objects of a procedural category, whose size is in their name."""
    request = requested(source)
    return None if request is not None and is_category(request) else downscale


def evaluation(folder: Path, settings: CellSettings, halves: bool = False) -> list[str]:
    """Arguments of `lumigraph` that evaluate a cell; empty if it is evaluated.

    halves: compare only right halves, because another method of the scene is evaluated on them
    """
    if evaluated(folder, settings, halves):
        return []
    weights = ["--lpips", *map(str, settings.lpips)] if settings.lpips else []
    told = {"--views": settings.eval_views, "--device": settings.device}
    return ["eval", str(folder), "--save-images", *(["--right-halves"] if halves else []), *options(told), *weights]


def options(told: dict[str, Any]) -> list[str]:
    """Command line words of options, without defaults."""
    given = {name: f"{x:g}" if isinstance(x, float) else str(x) for name, x in told.items() if x not in (None, "auto")}
    return [word for option in given.items() for word in option]


def trained(folder: Path) -> bool:
    """True if a run has spent its budget, or was inferred by a prior."""
    run = Run(folder)
    if Inferred.of(run.settings, folder / "config.json"):
        return run.has_state
    return run.has_state and Budget.from_json(run.settings.budget).progress(run.state.step, run.state.seconds) >= 1


def evaluated(folder: Path, settings: CellSettings, halves: bool = False) -> bool:
    """True if a run's latest state was evaluated with these settings, with `halves` on right halves of photographs."""
    run = Run(folder)
    result = run.evaluation()
    if result is None or result["steps"] != run.state.step:
        return False
    protocol = result["protocol"]
    there = protocol.get("of", 0)
    wanted = min((settings.eval_views or there) * protocol.get("members", 1), there)  # of each member so many
    if "views" not in protocol:
        return protocol[compared_kind(protocol)] == wanted
    kept = (folder / "eval").is_dir() and (result["lpips"] is not None or not settings.lpips)
    return kept and protocol["views"] == wanted and (bool(protocol.get("halves")) or not halves)


@dataclass(frozen=True)
class Claim:
    """Content of settings.json: the settings of all cells, and the source of each scene."""

    settings: dict[str, str | int | None]
    scenes: dict[str, str]


def claim(output: Path, cells: Sequence[Cell], settings: CellSettings) -> None:
    """Write the common settings to the output's folder. Raises LumigraphError if earlier ones differ, or for foreign
    files at the paths of results."""
    path = output / "settings.json"
    shared = {name: getattr(settings, name) for name in ("downscale", "reader", "scales", "preset", "device")}
    known = asdict(files.read_json(path, Claim) if path.exists() else Claim(shared, {}))
    for name, value in shared.items():
        begun = known["settings"].get(name)
        if begun != value:
            raise LumigraphError(
                f"{output} was begun with --{name} {begun}, which is now {value}; choose another --output"
            )
    for cell in cells:
        if known["scenes"].setdefault(cell.scene, cell.source) != cell.source:
            raise LumigraphError(
                f"Two scenes are called {cell.scene}: {known['scenes'][cell.scene]} and {cell.source}; "
                "rename a folder, or choose another --output"
            )
    for name in ("results.json", "results.md", SHEET, *(chart.name for chart in output.glob("*-over-*.svg"))):
        files.claim(output / name, "benchmark")
    files.write_json(path, known, ours=True)


@dataclass(frozen=True)
class Begun:
    """Validated fields of every cell in results.json. run: its folder, within the output's"""

    method: str
    scene: str
    budget: dict[str, Any]
    seed: int
    run: Annotated[str, msgspec.Meta(pattern=r"\Aruns/[^/\\\x00]+\Z")]
    views: Tally | None = None
    failed: str | None = None
    collection: str = ""
    prior: str | None = None


@dataclass(frozen=True)
class ScenePSNR:
    """Published held-out PSNR in dB of one scene, as results.json holds it."""

    psnr: float
    resolution: str
    source: str


@dataclass(frozen=True)
class Measured:
    """Validated fields of cells that did not fail."""

    protocol: Protocol
    train_views: Tally
    model_bytes: Tally
    peak_memory: Tally
    steps: Tally
    training_seconds: Lasted
    compile_seconds: Lasted
    trained_on: str
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    scores: list[Score] = field(default_factory=list)
    seconds_per_view: Lasted | None = None
    shown: ViewScores | None = None
    published: ScenePSNR | None = None


@dataclass(frozen=True)
class Results:
    """Contents of results.json."""

    cells: list[Row] = field(default_factory=list)


def row_of(cell: Cell, output: Path, settings: CellSettings, failure: str | None) -> Row:
    """A cell's figures from its run's folder, under their names in eval.json; or the reason for none."""
    folder, file = output / "runs" / cell.name, methods.file_of(methods.find(cell.method))
    own = [methods.METHOD_FILE, Path(file).name] if file else []
    row: Row = {
        "method": cell.method,
        "scene": cell.scene,
        "views": cell.views,
        "budget": {name: value for name, value in asdict(cell.budget).items() if value is not None},
        "seed": cell.seed,
        "command": shlex.join(["lumigraph", *train_command(public(cell), settings), *own]),
        "run": f"runs/{cell.name}",
        "failed": failure,
        "collection": cell.collection,
        "prior": cell.prior and Path(cell.prior).name,
    }
    if failure:
        return row
    run = Run(folder)
    figure = published(cell.method, cell.scene) if cell.views is None and settings.scales == 1 else None
    return row | {
        "train_views": run.settings.splits.get("train", 0) // settings.scales,
        "model_bytes": run.model_bytes,
        "published": figure and asdict(figure),
        **scored(run, settings),
    }


def scored(run: Run, settings: CellSettings) -> Row:
    """Columns of a row from its evaluation."""
    result = run.evaluation() or {}
    row = {name: result[name] for name in (*MEASURED, "by_resolution", "by_held_out") if name in result}
    if (views := result.get("views")) and "members" not in result["protocol"]:
        row["shown"] = views[len(views) // 2 // settings.scales]  # at full size
    return row


def public(cell: Cell) -> Cell:
    """The cell without local paths of its scene and its prior."""
    source = cell.scene if Path(cell.source).exists() else cell.source
    return replace(cell, source=source, prior=cell.prior and Path(cell.prior).name)


def read_rows(output: Path) -> dict[str, Row]:
    """Rows so far by run, those of earlier commands included."""
    path = output / "results.json"
    if not path.exists():
        return {}
    rows = files.read_json(path, Results).cells
    for row in typed(list[Begun], rows, path):
        Budget.from_json(row.budget, f"{path}: {row.run}")
    typed(list[Measured], [row for row in rows if not row.get("failed")], path)
    return {row["run"]: row for row in rows}


def published(method: str, scene: str) -> ScenePSNR | None:
    """Published figure of a method for a scene of this name; `None` if unknown."""
    found = of_scene(method, scene)
    if not found:
        return None
    resolution, _, rest = found.protocol.partition(", ")
    return ScenePSNR(float(found.value), resolution, ", ".join(filter(None, (found.measured_by, rest))))
