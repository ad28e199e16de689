"""`lumigraph bench views`: PSNR against the number of training photographs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from ... import methods
from ...budget import Budget
from ...errors import LumigraphError
from ...files.ranges import Count, Seconds, Steps
from ..common import needed, option, say, scene_name
from .cells import Cells, budgets, place_of

if TYPE_CHECKING:
    from ...benchmark.cell import Cell


@dataclass(frozen=True)
class Place:
    """A scene: its source, its short name, and the name of its collection, if any."""

    source: str
    scene: str
    collection: str = ""


@dataclass(frozen=True, kw_only=True)
class BenchViews(Cells):
    """Train methods on fewer and fewer photographs of a scene, and compare the same held-out views.

    The photographs are spread evenly over the cameras, and each subset contains the smaller ones. A table and a chart
    show PSNR over the number of photographs; the rest is as in `lumigraph bench methods`. For a collection, held-out
    members are scenes, and the mean is shown. Priors, such as pixelnerf, take the photographs as input. The prior is a
    run of --priors, or one that is trained first, on the first collection of --scenes.
    """

    methods: Annotated[tuple[str, ...], needed("METHOD ...")] = (
        "nerf",
        "mip-nerf",
        "instant-ngp",
        "gaussian-splatting",
        "regnerf",
        "pixelnerf",
    )
    """Methods to train (default: nerf mip-nerf instant-ngp gaussian-splatting regnerf pixelnerf)."""
    views: Annotated[tuple[Count | Literal["all"], ...], option("N")] = (2, 3, 4, 6, 9, 15, 25, 50, "all")
    """Numbers of training photographs; those that a scene does not have are left out."""
    seconds: Annotated[Seconds | None, option("S", "60")] = None
    """Training time in seconds."""
    steps: Annotated[Steps | None, option("N", "as long as --seconds")] = None
    """Train for this number of steps instead."""
    members: Annotated[Count, option("N")] = 4
    """Number of held-out members of a collection, evenly spread."""
    priors: Annotated[tuple[Path, ...], option("RUN ...", "trained first, on the first collection of --scenes")] = ()
    """Runs trained on a collection."""
    prior_seconds: Annotated[Seconds | None, option("S", "as long as the others")] = None
    """Training time of priors in seconds."""
    prior_steps: Annotated[Steps | None, option("N", "as long as --prior-seconds")] = None
    """Train priors for this number of steps instead."""

    def run(self) -> int:
        (budget,) = budgets(said(self.seconds), said(self.steps))
        longer = self.prior_seconds is not None or self.prior_steps is not None
        (of_priors,) = budgets(said(self.prior_seconds), said(self.prior_steps)) if longer else (budget,)
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
        """The prior's run for each method that learns from collections and each seed, and cells that train those that
        are not there."""
        from ...benchmark.cell import Cell
        from ...capture import kind_of
        from ...datasets.collection import Collection
        from ...run import Run

        there = {Run(path).method_name: path.resolve() for path in self.priors}
        collection = next((source for source in sources if kind_of(source) is Collection), None)
        learnt: dict[str, dict[int, Path]] = {}
        cells = []
        for name in filter(learns_across, names):
            if self.scales > 1:
                raise LumigraphError(f"{name} is told photographs of one size, so --scales cannot be {self.scales}")
            if name in there:
                learnt[name] = dict.fromkeys(self.seeds, there[name])
            elif collection is None:
                say(f"{name} learns from a collection, and there is none among --scenes, nor --priors; leaving it out")
            else:
                trained = [Cell(name, scene_name(collection), collection, budget, seed) for seed in self.seeds]
                learnt[name] = {cell.seed: (self.output / "runs" / cell.name).resolve() for cell in trained}
                cells += trained
        return learnt, cells

    def places(self, source: str) -> Iterator[Place]:
        """The source itself, or held-out members of the collection that it is."""
        from ...benchmark.cell import MEMBERS
        from ...capture import kind_of, open_dataset, sources_of
        from ...datasets.collection import Collection
        from ...geometry import evenly

        if kind_of(source) is not Collection:
            yield Place(source, scene_name(source))
            return
        collection, of_member = open_dataset(source), sources_of(source)
        assert isinstance(collection, Collection)
        held_out = [collection.names[i] for i in collection.splits["test"].tolist()]
        for name in evenly(held_out, self.members):
            yield Place(of_member[name], scene_name(name), scene_name(source) + MEMBERS)

    def cells_of(
        self, place: Place, names: Sequence[str], budget: Budget, learnt: dict[str, dict[int, Path]]
    ) -> Iterator[Cell]:
        """A place's cells: each number of photographs, each seed, each method."""
        from ...benchmark.cell import Cell

        there = self.there(place.source)
        for number in self.possible(place.source, there):
            for seed in self.seeds:
                for name in names:
                    cell = Cell(name, place.scene, place.source, budget, seed, number, place.collection)
                    if name in learnt:  # a prior looks at as many as it is told, and is told all
                        cell = replace(cell, views=number or there, prior=str(learnt[name][seed]))
                    yield cell

    def there(self, source: str) -> int:
        """Number of a scene's training photographs."""
        from ...benchmark.cell import reduced
        from ...capture import open_scene

        downscale = reduced(source, self.downscale)
        return len(open_scene(source, downscale=downscale, reader=self.reader).splits["train"])

    def possible(self, source: str, there: int) -> list[int | None]:
        """The numbers of views that a scene has photographs for; `None` is all."""
        left_out = [views for views in self.views if views != "all" and views > there]
        if left_out:
            say(f"{source} has {there} photographs to learn from; leaving out {', '.join(map(str, left_out))}")
        return [None if views == "all" else views for views in self.views if views not in left_out]


def learns_across(name: str) -> bool:
    """True if a method learns from collections and takes a scene as input."""
    from ...datasets.collection import Collection

    return methods.find(name).learns_from is Collection


def said(value: float | int | None) -> tuple:
    return () if value is None else (value,)
