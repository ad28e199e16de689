"""Held-out photographs of one scene beside what several runs make of them, as a small JPEG: the pictures of
docs/own-photographs.md and docs/few-views.md.

    python benchmarks/side_by_side.py plain=RUN nerf-w=RUN --views 2 --output pair.jpg

A method that holds a code for each photograph is told left halves, as in `lumigraph eval`.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tyro.conf import Positional

from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.halves import judged_by_halves, left_half
from lumigraph.evaluation.views import LIGHT_LAYER, in_light
from lumigraph.figures import Row, colour_depth, contact_sheet, depth_range
from lumigraph.geometry import evenly
from lumigraph.run import Run

MOST = 60_000  # bytes of a picture


@dataclasses.dataclass(frozen=True)
class Options:
    runs: Annotated[Positional[tuple[str, ...]], tyro.conf.arg(metavar="TITLE=RUN ...")]
    output: Path
    views: int = 2  # of the held-out ones, evenly spread
    only: tuple[int, ...] = ()  # or those with these numbers among the held-out ones
    scene: str | None = None  # where the photographs are now
    depth: bool = False  # how far away what they show is, below
    title: str = ""
    width: int = 900  # of the picture, at most


def main(options: Options) -> None:
    named = dict(text.split("=", 1) for text in options.runs)
    runs = {title: Run(Path(folder)) for title, folder in named.items()}
    scene = next(iter(runs.values())).dataset(options.scene)
    assert isinstance(scene, Scene)
    held_out = scene.splits["test"].tolist()
    chosen = [held_out[i] for i in options.only] or evenly(held_out, options.views)
    methods = {title: run.method(torch.device("cpu")).eval() for title, run in runs.items()}
    rows = []
    for index in chosen:
        shot = scene.photograph(index, [name for name in (LIGHT_LAYER,) if name in scene.layers])
        pictures, depths = [shot.before(scene.frame.background)], []
        for method in methods.values():
            told = method.given(left_half(shot)) if judged_by_halves(method) else method
            seen = told.render(method.refined(shot.camera))
            pictures.append(
                in_light(seen, shot.extra[LIGHT_LAYER])[0] if LIGHT_LAYER in shot.extra else seen.rgb.clamp(0, 1)
            )
            depths.append((seen.depth, seen.opacity))
        rows.append(Row(scene.names[index], pictures))
        if options.depth:
            coloured = (colour_depth(*seen, depth_range(*seen)) for seen in depths)
            rows.append(Row("depth, each by its own range", [torch.ones_like(shot.rgb), *coloured]))
    sheet = contact_sheet(options.title, ["photograph", *methods], rows).convert("RGB")
    sheet.thumbnail((options.width, 4 * options.width))
    for quality in range(85, 20, -5):
        sheet.save(options.output, quality=quality)
        if options.output.stat().st_size <= MOST:
            break


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
