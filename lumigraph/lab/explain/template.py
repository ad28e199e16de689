"""Conversion of a trained field into other structures with further training, compared with training from scratch."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ... import methods
from ...datasets.scene import Scene
from ...derive.conversion import check, convert, new_student, shown, take_over
from ...derive.options import ConvertOptions
from ...figures import Row, contact_sheet, save_picture
from ...figures.charts import Series, line_chart, standalone
from ...files import write_bytes, write_json
from ...method import Method
from ...run import Run, build
from ...system.signals import go_on_unless
from ...training.loop import fit

STAGES = "trained", "moved", "continued", "from nothing"


@dataclass(frozen=True)
class TemplateStage:
    """A method at one stage.

    stage:   one of STAGES
    seconds: of training since the field began, conversion included
    psnr:    mean over held-out views, dB
    view_seconds: rendering time of one of them
    picture: the first of them
    """

    method: str
    stage: str
    seconds: float
    psnr: float
    view_seconds: float
    picture: Float[Tensor, "height width 3"]

    def __str__(self) -> str:
        return f"{self.psnr:.1f} dB, {self.seconds:.0f} s"


def stages_of(
    run: Run, scene: Scene, into: Sequence[str], seconds: float, views: int, runs: Path, alone: bool
) -> list[TemplateStage]:
    """The run itself; and each method converted from it and trained for `seconds` more, and, with `alone`, trained from
    scratch for as long as both together. Raises LumigraphError for methods that the run cannot be converted to.

    scene: the run's photographs; views: largest number of held-out ones; runs: new folder of the runs
    """
    for name in into:
        check(run, methods.find(name))
    teacher = run.method()
    around = teacher.refined(run.cameras()["train"])
    first = scene.cameras[shown_photograph(scene)]
    aim = ConvertOptions(seconds, scene=scene.source, views=views, seed=run.settings.seed)

    def stage(method: Method, name: str, spent: float) -> TemplateStage:
        seen = shown(method.eval(), scene, first, views)
        assert seen.psnr is not None  # for there are photographs
        with torch.no_grad():
            picture = method.render(first.to(method.device)).rgb.clamp(0, 1).cpu()
        return TemplateStage(methods.name_of(method), name, spent, seen.psnr, seen.seconds, picture)

    trained = run.state.seconds
    found = [stage(teacher, "trained", trained)]
    for name in into:
        student = new_student(methods.find(name), teacher, teacher.device, seed=aim.seed)
        moved = trained + take_over(teacher, student, scene, around, as_taken=True)
        found.append(stage(student, "moved", moved))
        made = convert(run, name, runs / name, aim, teacher.device)
        whole = moved + made.seconds
        found.append(stage(Run(runs / name).method(), "continued", whole))
        if alone:
            found.append(stage(from_nothing(scene, name, whole, aim.seed, teacher.device), "from nothing", whole))
    return found


def shown_photograph(scene: Scene) -> int:
    """Index of the first held-out photograph, or of the first of all."""
    held_out = scene.splits.get("test")
    return int((scene.splits["train"] if held_out is None or not len(held_out) else held_out)[0])


def from_nothing(scene: Scene, name: str, seconds: float, seed: int, device: torch.device) -> Method:
    """A method trained on a scene for `seconds` seconds, with its preset."""
    kind = methods.find(name)
    method = build(kind, scene.frame, kind.preset(device), device, seed, learning=True)
    go_on_unless(fit(method, scene, seconds=seconds, seed=seed, show=False).signal)
    return method


def draw(folder: Path, title: str, truth: Float[Tensor, "height width 3"], found: Sequence[TemplateStage]) -> None:
    """Write template.png (a held-out view at each stage), template.svg (PSNR by seconds) and template.json."""
    first, rest = found[0], found[1:]
    rows = [Row("photograph", [truth])]
    series = [Series(f"{first.method}, trained", [first.seconds], [first.psnr])]
    for name in dict.fromkeys(x.method for x in rest):
        own = [x for x in rest if x.method == name]
        labels = [str(x) for x in (first, *own)]
        labels[:2] = [f"{x.method}, {x.psnr:.1f} dB" for x in (first, own[0])]
        rows.append(Row(labels, [x.picture for x in (first, *own)]))
        path = [first, *(x for x in own if x.stage != "from nothing")]
        series.append(Series(f"into {name}", [x.seconds for x in path], [x.psnr for x in path]))
        series += [Series(f"{name}, from nothing", [x.seconds], [x.psnr]) for x in own if x.stage == "from nothing"]
    columns = STAGES[: max(len(row.pictures) for row in rows)]
    save_picture(folder / "template.png", contact_sheet(title, columns, rows), "figure")
    chart = line_chart(series, "seconds of training", "PSNR (dB)", marks=True, smoothed=False)
    write_bytes(folder / "template.svg", standalone(chart), "figure")
    write_json(folder / "template.json", [figures(x) for x in found], "figure")


def figures(stage: TemplateStage) -> dict[str, Any]:
    """A stage without its picture."""
    return {name: x for name, x in asdict(stage).items() if name != "picture"}
