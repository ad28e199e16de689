"""The lumigraph without a step of learning, beside methods that learn for a while, over numbers of photographs.

    python benchmarks/light_fields.py --scenes procedural:still-life,size=200 FERN CAN --views 8 16 32 64 --seconds 60

Held-out PSNR of each, processor seconds (of all threads) until it is ready, and of a frame of 400 x 400 pixels. Methods
that learn take as many steps as fit into --seconds of processor time, by the pace of PACE_STEPS steps. One scene is one
chart, NAME.svg, and a sheet of a held-out view, NAME.png.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lumigraph import methods
from lumigraph.datasets.scene import Scene
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.figures.charts import Series, line_chart, standalone
from lumigraph.files import scene_name, write_bytes, write_json
from lumigraph.geometry import evenly
from lumigraph.method import Method
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene
from lumigraph.readers.views import with_fewer_views
from lumigraph.run import build
from lumigraph.system.console import console
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

PACE_STEPS = 30  # steps whose pace says how many fit
FRAME_SIDE = 400  # pixels


@dataclasses.dataclass(frozen=True)
class Options:
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENE ...")]
    output: Path = Path("light-fields")
    views: tuple[int, ...] = (8, 16, 32, 64)  # photographs to learn from; those that a scene has not are left out
    seconds: float = 60.0  # of processor time, of methods that learn
    methods: tuple[str, ...] = ("lumigraph", "instant-ngp", "gaussian-splatting")
    downscale: int | None = None
    eval_views: int = 8  # held-out photographs, spread evenly
    plane: bool = False  # also the lumigraph over a plane


def main(options: Options) -> None:
    found = []
    for source in options.scenes:
        whole = open_scene(source, options.downscale)
        scenes = [with_fewer_views(whole, n) for n in options.views if n <= len(whole.splits["train"])]
        shown: dict[str, list[Any]] = {}
        for scene in scenes:
            for name in options.methods:
                row, pictures = measured(name, {}, scene, options)
                found.append(row)
                shown.setdefault(row["method"], pictures)
                console().print(row)
            if options.plane:
                row, pictures = measured("lumigraph", {"geometry": "plane"}, scene, options)
                found.append(row | {"method": "lumigraph, plane"})
                console().print(found[-1])
        draw(options.output, scene_name(source), [row for row in found if row["scene"] == source], shown)
        write_json(options.output / "light_fields.json", found, ours=True)


def measured(name: str, numbers: dict[str, Any], scene: Scene, options: Options) -> tuple[dict[str, Any], list[Any]]:
    """One method on one number of photographs: figures, and the first held-out view beside the truth."""
    kind, device = methods.find(name), torch.device("cpu")
    config = dataclasses.replace(kind.preset(device), **numbers)
    method = build(kind, scene.frame, config, device, 0)
    begin, steps = time.process_time(), 1
    if name in ("lumigraph", "view-interpolation"):
        go_on_unless(fit(method, scene, steps=1, show=False, rehearsal=False).signal)
    else:
        for count in (2, PACE_STEPS):  # the first ones compile
            begin = time.process_time()
            go_on_unless(
                fit(build(kind, scene.frame, config, device, 0), scene, steps=count, show=False, rehearsal=False).signal
            )
        each = (time.process_time() - begin) / PACE_STEPS
        steps, begin = max(PACE_STEPS, math.floor(options.seconds / each)), time.process_time()
        go_on_unless(fit(method, scene, steps=steps, show=False, rehearsal=False).signal)
    spent = time.process_time() - begin
    method.eval()
    scores, pictures = [], []
    for i in evenly(scene.splits["test"].tolist(), options.eval_views):
        photograph = scene.photograph(i)
        truth, seen = photograph.before(scene.frame.background), method.render(photograph.camera).rgb
        scores.append(float(psnr(seen, truth)))
        pictures = pictures or [truth, seen.clamp(0, 1)]
    row = {
        "scene": scene.source,
        "method": name,
        "views": len(scene.splits["train"]),
        "psnr": round(sum(scores) / len(scores), 2),
        "steps": steps,
        "processor_seconds": round(spent, 1),
        "frame_processor_seconds": round(frame_seconds(method, scene), 4),
    }
    return row, pictures


def frame_seconds(method: Method, scene: Scene) -> float:
    """Processor seconds of a picture of 400 x 400 pixels, or of as many; the least of three."""
    camera = scene.preview()
    camera = camera.resized(FRAME_SIDE / math.sqrt(float(camera.size[0].prod())))
    method.render(camera)
    took = []
    for _ in range(3):
        begin = time.process_time()
        method.render(camera)
        took.append(time.process_time() - begin)
    return min(took)


def draw(folder: Path, name: str, rows: list[dict[str, Any]], shown: dict[str, list[Any]]) -> None:
    """The chart of a scene, and its first held-out view by each method from the fewest photographs."""
    order = list(dict.fromkeys(row["method"] for row in rows))
    series = []
    for method in order:
        own = [row for row in rows if row["method"] == method]
        series.append(Series(method, [row["views"] for row in own], [row["psnr"] for row in own]))
    ticks = sorted({row["views"] for row in rows})
    chart = line_chart(series, "photographs", "PSNR of held-out views, dB", False, True, True, False, x_ticks=ticks)
    write_bytes(folder / f"{name}.svg", standalone(chart), ours=True)
    truth = next(iter(shown.values()))[0]
    sheet = contact_sheet(name, ["photograph", *shown], [Row("", [truth, *(x[1] for x in shown.values())])])
    save_picture(folder / f"{name}.png", sheet, ours=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
