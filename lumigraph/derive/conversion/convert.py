"""convert(): a method begins as what another one holds, learns on, and is compared with it."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ... import files, methods
from ...budget import Budget, Quality
from ...camera import Camera
from ...datasets.scene import Scene
from ...errors import LumigraphError, LumigraphWarning
from ...method import Method
from ...method.capabilities import FromField, RefinesPoses, can, needs
from ...run import Opened, Run, State, build, check_new
from ...run.converted import ConversionStart, Converted, LearntFrom, MeasuredModel
from ...system.signals import go_on_unless
from ...training import fit
from .measure import likeness, shown
from .renderings import rendered_scene
from .ways import check, way

INHERITED_PROGRESS = 0.5  # training progress at which schedules go on after a field was taken over
RENDERING_SHARE = 0.5  # of the training time that rendering of training views may take in addition
PHOTOGRAPHS: LearntFrom = "photographs"
RENDERINGS: LearntFrom = "renderings of the source"
COMPARED_VIEWS = 8  # held-out views that are compared


@dataclass(frozen=True)
class ConversionTarget:
    """Target of a conversion and its limit; exactly one of steps, seconds and quality.

    config:  the student's numbers; None takes its defaults for the device
    steps, seconds: of learning on, once the teacher is taken over
    quality: that share of the steps a whole training takes which is left then
    distil:  learn from what the teacher renders, even where photographs are at hand
    source:  where the photographs are now, if they have moved
    views:   held-out views to compare at most
    """

    config: Any = None
    steps: int | None = None
    seconds: float | None = None
    quality: Quality | None = None
    distil: bool = False
    source: str | None = None
    views: int = COMPARED_VIEWS
    seed: int = 0


def convert(
    source: Opened,
    name: str,
    output: Path,
    aim: ConversionTarget,
    device: torch.device | str = "cpu",
    show: bool = False,
) -> Converted:
    """A run of the method of that name in a new folder, made of whatever was opened; gives what its convert.json says.

    output: a new or empty folder, or one in which the same conversion was interrupted, which goes on
    show:   whether training is shown
    Raises LumigraphError for what cannot be converted, and Stopped after Ctrl-C, with the state saved.
    """
    if (going_on := unfinished(source, name, output)) is None:
        check_new(output)
    kind, device = methods.find(name), torch.device(device)
    check(source, kind)
    scene, cameras, teacher = photographs(source, aim.source), source.cameras(), source.method(device)
    how = way(type(teacher), kind)
    assert how is not None  # for `check` has asked
    student = going_on[0].new_method(device) if going_on else new_student(kind, teacher, aim, device)
    around = teacher.refined(source.survey(cameras["train"]))
    distil = going_on[1].learnt_from == RENDERINGS if going_on else aim.distil
    if scene is None or distil:
        allowed = math.inf if aim.seconds is None else RENDERING_SHARE * aim.seconds
        learnt_from, data = RENDERINGS, rendered_scene(teacher, around, str(source.path), allowed)
    else:
        learnt_from, data = PHOTOGRAPHS, seen_as(teacher, student, scene)
    if going_on is None:
        seconds = take_over(teacher, student, data, around, as_taken=learnt_from == PHOTOGRAPHS)
        begun = ConversionStart(str(source.path.resolve()), learnt_from, round(seconds, 3))
        going_on = (
            created(source, student, scene or data, output, budget_of(student, data, aim), aim.seed, begun),
            begun,
        )
    run, begun = going_on
    budget = Budget.from_json(run.settings.budget)
    outcome = fit(student, data, run, budget=budget, seed=run.settings.seed, show=show)
    go_on_unless(outcome.signal)
    held_out = cameras["test"] if len(cameras.get("test", ())) else cameras["train"]
    seen = [shown(method, scene, held_out, aim.views) for method in (teacher, student)]
    made = Converted(
        source=begun.source,
        how=how,
        learnt_from=begun.learnt_from,
        teacher=MeasuredModel(methods.name_of(teacher), source.model_bytes, seen[0].seconds, seen[0].psnr),
        student=MeasuredModel(name, run.model_bytes, seen[1].seconds, seen[1].psnr),
        psnr=likeness(*seen),
        views=len(seen[0].views),
        taking_over=begun.taking_over,
        steps=outcome.state.step,
        seconds=outcome.state.seconds,
    )
    made.write(run.folder)
    return made


def new_student(kind: type[Method], teacher: Method, aim: ConversionTarget, device: torch.device) -> Method:
    """A method in the teacher's frame, before it has learnt anything."""
    config = kind.preset(device) if aim.config is None else aim.config
    return build(kind, teacher.frame, config, device, getattr(config, "seed", aim.seed), learning=True)


def take_over(teacher: Method, student: Method, data: Scene, cameras: Camera, as_taken: bool) -> float:
    """Let a student begin as its teacher, as far as it can: with what the teacher holds, and with its poses where both
    learn them. Returns the seconds it took.

    as_taken: whether the data's cameras are as they were given, rather than as the teacher has refined them
    """
    begin = time.perf_counter()
    if can(student, RefinesPoses):
        own = needs(student, RefinesPoses).poses
        own.choose_axes(data.cameras, data.frame)
        if can(teacher, RefinesPoses) and as_taken:
            own.load_state_dict(needs(teacher, RefinesPoses).poses.state_dict())
    if can(student, FromField):
        needs(student, FromField).from_field(teacher, cameras)
    return time.perf_counter() - begin


def budget_of(student: Method, data: Scene, aim: ConversionTarget) -> Budget:
    """Budget of further training. Schedules of a converted field begin at INHERITED_PROGRESS."""
    share, steps = INHERITED_PROGRESS if can(student, FromField) else 0.0, aim.steps
    if aim.quality is not None:
        steps = max(1, round((1 - share) * student.steps_for(aim.quality, data)))
    return Budget(steps, aim.seconds, aim.quality, (0.0, share) if share else None)


def created(
    source: Opened, student: Method, data: Scene, output: Path, budget: Budget, seed: int, begun: ConversionStart
) -> Run:
    """A run of the student as it begins, with the cameras and photographs of what it is made of.

    data: the photographs, or what stands in for them
    """
    options = None
    if isinstance(source, Run):
        told = source.settings.scene
        data, options = replace(data, source=told.source), told.options
    seed = getattr(student.config, "seed", seed)
    run = Run.create(output, student, data, seed=seed, options=options, budget=budget.to_json())
    if isinstance(source, Run):
        files.write_bytes(output / "cameras.json", (source.folder / "cameras.json").read_bytes(), ours=True)
        run.settings = replace(run.settings, splits=source.settings.splits)
    run.settings = begun.within(run.settings)
    run.settings.write(output / "config.json")
    if can(student, FromField):  # so that it does not begin from the photographs
        run.save(State(), student, student.optimizers(), torch.Generator().manual_seed(seed))
    return run


def unfinished(source: Opened, name: str, output: Path) -> tuple[Run, ConversionStart] | None:
    """The run of the same conversion that was interrupted there; None if there is none."""
    if not files.is_file(output / "config.json"):
        return None
    run = Run(output)
    begun = ConversionStart.of(run.settings, output / "config.json")
    if begun is None or (begun.source, run.method_name) != (str(source.path.resolve()), name):
        return None
    return (run, begun) if Converted.read(output) is None else None


def photographs(source: Opened, where: str | None) -> Scene | None:
    """The photographs again; None where they are not at hand, and no other place is named."""
    if source.open_scene is None:
        return None
    try:
        return source.open_scene(where)
    except LumigraphError as error:
        if where is not None:
            raise
        warnings.warn(f"It learns from renderings instead, for {error}", LumigraphWarning, stacklevel=2)
        return None


def seen_as(teacher: Method, student: Method, scene: Scene) -> Scene:
    """Photographs, from where the teacher has come to see them, unless the student learns that too."""
    return scene if can(student, RefinesPoses) else replace(scene, cameras=teacher.refined(scene.cameras).to("cpu"))
