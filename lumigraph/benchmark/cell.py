"""A cell of a benchmark: one training and its evaluation, as commands that anybody could type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from .. import files
from ..budget import Budget
from ..capture import requested
from ..errors import LumigraphError
from ..run import Run
from ..run.inferred import Inferred
from ..synthetic import is_category

SHEET = "views.png"
MEMBERS = "-members"  # behind a collection's name: its members, averaged


@dataclass(frozen=True)
class Settings:
    """Settings of all cells of a benchmark: the command line's options of the same names.

    eval_views: number of held-out views to compare; `None` for all
    lpips:      files with the weights of LPIPS; empty for none
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
    """A method, what it learns, and for how long: seconds or steps.

    scene:      its short name, the same for all cells of the scene
    source:     where it is
    views:      photographs to learn from; None for all
    collection: the name of the one whose member the scene is, with which it is averaged
    prior:      the run that makes the cell's out of so many photographs, which learns nothing; its budget is then that
                of the cells beside it
    """

    method: str
    scene: str
    source: str
    budget: Budget
    seed: int = 0
    views: int | None = None
    collection: str = ""
    prior: str | None = None

    @property
    def name(self) -> str:
        """The cell's name for folders, unique among cells that share their settings."""
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
        """The cell's name for people."""
        views = "" if self.views is None else f" from {self.views} views"
        if self.prior:
            return f"{self.method} on {self.scene}{views}, by {Path(self.prior).name}"
        return f"{self.method} on {self.scene}{views}, {duration(self.budget)}, seed {self.seed}"


def duration(budget: Budget) -> str:
    return f"{budget.seconds:g} s" if budget.seconds else f"{budget.steps} steps"


def training(cell: Cell, folder: Path, settings: Settings) -> list[str]:
    """Arguments of `lumigraph` that train or resume the cell; empty if it is trained."""
    if (folder / "config.json").exists():
        return [] if trained(folder) else ["resume", str(folder)]
    return [*train_command(cell, settings), "--output", str(folder)]


def train_command(cell: Cell, settings: Settings) -> list[str]:
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
    return ["train", cell.method, cell.source, *options(told)]


def reduced(source: str, downscale: int | None) -> int | None:
    """Downscale of a source; `None` for objects of a procedural category, whose size is in their name."""
    request = requested(source)
    return None if request is not None and is_category(request) else downscale


def evaluation(cell: Cell, folder: Path, settings: Settings) -> list[str]:
    """Arguments of `lumigraph` that evaluate the cell; empty if that is done."""
    if evaluated(folder, settings):
        return []
    weights = ["--lpips", *map(str, settings.lpips)] if settings.lpips else []
    told = {"--views": settings.eval_views, "--device": settings.device}
    return ["eval", str(folder), "--save-images", *options(told), *weights]


def options(told: dict[str, Any]) -> list[str]:
    """Options as words; those that stand as they would anyway are left out."""
    given = {name: f"{x:g}" if isinstance(x, float) else str(x) for name, x in told.items() if x not in (None, "auto")}
    return [word for option in given.items() for word in option]


def trained(folder: Path) -> bool:
    """True if a run has spent its budget, or was inferred by a prior."""
    run = Run(folder)
    if Inferred.of(run.settings, folder / "config.json"):
        return run.has_state
    return run.has_state and Budget.from_json(run.settings.budget).progress(run.state.step, run.state.seconds) >= 1


def evaluated(folder: Path, settings: Settings) -> bool:
    """True if a run's latest state was evaluated with these settings."""
    run = Run(folder)
    result = run.evaluation()
    if result is None or result["steps"] != run.state.step:
        return False
    protocol = result["protocol"]
    there = protocol.get("of", 0)
    wanted = min((settings.eval_views or there) * protocol.get("members", 1), there)  # of each member so many
    if "views" not in protocol:
        return protocol.get("shapes") == wanted
    kept = (folder / "eval").is_dir() and (result["lpips"] is not None or not settings.lpips)
    return kept and protocol["views"] == wanted


@dataclass(frozen=True)
class Claim:
    """Content of settings.json: the settings of all cells, and the source of each scene."""

    settings: dict[str, str | int | None]
    scenes: dict[str, str]


def claim(output: Path, cells: Sequence[Cell], settings: Settings) -> None:
    """Note in the output's folder what its cells share. Raises LumigraphError if they shared something else so far, or
    if somebody else's files lie where the results go."""
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
