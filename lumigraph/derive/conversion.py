"""Conversion: a student is initialised from a teacher, trained further, and compared with it.

The way of conversion follows from capabilities, so that a new method needs no entry here.
"""

import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from .. import files, methods
from ..budget import Budget
from ..camera import Camera
from ..camera.rays import Rendering
from ..datasets.dataset import check_kind
from ..datasets.images import ImageStore
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..evaluation.options import EvaluationOptions
from ..evaluation.views import evaluate, warm_up
from ..geometry import evenly, look_at
from ..method import Method
from ..method.capabilities import FromField, HasDensity, HasField, HasGaussians, HasLooks, RefinesPoses, can, needs
from ..metrics import psnr
from ..run import Opened, Run, State, build, check_new
from ..run.derived import ConversionStart, Converted, LearntFrom, MeasuredModel, whole_run
from ..system.progress import NumberedStages, clock, track
from ..system.signals import go_on_unless
from ..system.work import at_work
from ..training.loop import fit
from .compression.compress import bytes_of
from .options import ConvertOptions

INHERITED_PROGRESS = 0.5  # training progress at which schedules go on after a field was taken over
RENDERING_SHARE = 0.5  # of the training time that rendering of training views may take in addition
PHOTOGRAPHS: LearntFrom = "photographs"
RENDERINGS: LearntFrom = "renderings of the source"
INITIALISATION_SECONDS = 60.0  # seconds that initialisation and comparison rarely exceed, on two cores
Way = Literal["field", "gaussians", "depth", "pictures"]
SPATIAL_CAPABILITIES = FromField, HasField, HasDensity, HasLooks, HasGaussians  # one of them is needed

MAX_VIEWS, MIN_VIEWS = 80, 8  # pictures, and however short the time
MAX_SIDE = 400  # pixels of their longer side
NEIGHBOUR_SHARE = 1 / 3  # position of an additional camera, as a share of the way to the nearest neighbour


@at_work()
def convert(
    source: Opened,
    name: str,
    output: Path,
    aim: ConvertOptions = ConvertOptions(),
    device: torch.device | str = "cpu",
    show: bool = False,
    config: Any = None,
) -> Converted:
    """Write a run of the named method in a new folder, converted from an opened model. Returns its convert.json.

    output: a new or empty folder, or one with the same interrupted conversion, which continues
    show:   whether stages and training are shown
    config: the student's numbers; None for its defaults on the device
    Raises LumigraphError for what cannot be converted, and Stopped after Ctrl-C, with the state saved.
    """
    if (going_on := unfinished(source, name, output)) is None:
        check_new(output)
    kind, device = methods.find(name), torch.device(device)
    aim = aim.limited(kind.taught_steps)
    check(source, kind)
    scene = source.photographs(aim.scene, "It learns from renderings instead")
    cameras, teacher = source.cameras(), source.method(device)
    how = way(type(teacher), kind)
    assert how is not None  # for `check` has asked
    student = going_on[0].new_method(device) if going_on else new_student(kind, teacher, device, config, aim.seed)
    around = teacher.refined(source.survey(cameras["train"]))
    distil = scene is None or (going_on[1].learnt_from == RENDERINGS if going_on else aim.distil)
    stages = NumberedStages(stage_names(distil, going_on is not None), about_time(aim, distil), show)
    if distil:
        stages.begin()
        allowed = math.inf if aim.seconds is None else RENDERING_SHARE * aim.seconds
        learnt_from, data = RENDERINGS, rendered_scene(teacher, around, str(source.path), allowed)
    else:
        assert scene is not None
        learnt_from, data = PHOTOGRAPHS, scene
        if not can(student, RefinesPoses):  # which learns from the poses as its teacher refined them
            data = replace(scene, cameras=teacher.refined(scene.cameras).to("cpu"))
    if going_on is None:
        stages.begin()
        seconds = take_over(teacher, student, data, around, as_taken=learnt_from == PHOTOGRAPHS)
        begun = ConversionStart(str(source.path.resolve()), learnt_from, round(seconds, 3))
        budget = budget_of(student, data, aim)
        run = created(source, student, scene or data, output, budget, aim.seed, begun)
    else:
        run, begun = going_on
    budget = Budget.from_json(run.settings.budget)
    stages.begin()
    outcome = fit(student, data, run, budget=budget, seed=run.settings.seed, show=show)
    go_on_unless(outcome.signal)
    stages.begin()
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


def stage_names(distil: bool, going_on: bool) -> list[str]:
    """Stages of a conversion. distil: learns from renderings; going_on: was interrupted, so it is initialised"""
    return [*["render views to learn from"] * distil, *["initialise"] * (not going_on), "train", "compare"]


def about_time(aim: ConvertOptions, distil: bool) -> str:
    """Duration of a conversion as text; empty if steps limit it."""
    if aim.seconds is None:
        return ""
    least = aim.seconds * (1 + RENDERING_SHARE * distil)
    return f", {clock(least)} to {clock(least + INITIALISATION_SECONDS)} in all"


def new_student(kind: type[Method], teacher: Method, device: torch.device, config: Any = None, seed: int = 0) -> Method:
    """A method in the teacher's frame, before it has learnt anything."""
    config = kind.taught_preset(device) if config is None else config
    return build(kind, teacher.frame, config, device, getattr(config, "seed", seed), learning=True)


def take_over(teacher: Method, student: Method, data: Scene, cameras: Camera, as_taken: bool) -> float:
    """Initialise a student from its teacher, as far as possible, and with its poses if both optimise them. Returns the
    seconds it took.

    as_taken: whether the data's cameras are the given ones, rather than the teacher's refined ones
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


def budget_of(student: Method, data: Scene, aim: ConvertOptions) -> Budget:
    """Budget of further training. Schedules of a converted field begin at INHERITED_PROGRESS."""
    share, steps = INHERITED_PROGRESS if can(student, FromField) else 0.0, aim.steps
    if aim.quality is not None:
        steps = max(1, round((1 - share) * student.steps_for(aim.quality, data)))
    return Budget(steps, aim.seconds, aim.quality, (0.0, share) if share else None)


def created(
    source: Opened, student: Method, data: Scene, output: Path, budget: Budget, seed: int, begun: ConversionStart
) -> Run:
    """A run of the initialised student, with the teacher's cameras and photographs.

    data: the photographs, or renderings instead
    """
    options = None
    if isinstance(source, Run):
        told = source.settings.scene
        data, options = replace(data, source=told.source), told.options
    seed = getattr(student.config, "seed", seed)
    with whole_run(output) as folder:
        run = Run.create(folder, student, data, seed=seed, options=options, budget=budget.to_json())
        if isinstance(source, Run):
            files.write_bytes(folder / "cameras.json", (source.folder / "cameras.json").read_bytes(), ours=True)
            run.settings = replace(run.settings, splits=source.settings.splits)
        run.settings = begun.within(run.settings)
        run.settings.write(folder / "config.json")
        if can(student, FromField):  # so that it does not begin from the photographs
            run.save(State(), student, student.optimizers(), torch.Generator().manual_seed(seed))
    return Run(output)


def unfinished(source: Opened, name: str, output: Path) -> tuple[Run, ConversionStart] | None:
    """The run of the same conversion that was interrupted there; None if there is none."""
    if not files.is_file(output / "config.json"):
        return None
    run = Run(output)
    begun = ConversionStart.of(run.settings, output / "config.json")
    if begun is None or (begun.source, run.method_name) != (str(source.path.resolve()), name):
        return None
    return (run, begun) if Converted.read(output) is None else None


def way(teacher: type[Method], student: type[Method]) -> Way | None:
    """Conversion of a teacher to a student: by the teacher's field at points, by its Gaussians as they are, by the
    depth of what it renders, or by learning from its pictures alone; None if not at all."""
    shows = issubclass(Scene, teacher.learns_from) or Scene in teacher.accepts  # a prior's runs are of scenes too
    if not (shows and issubclass(Scene, student.learns_from)):
        return None
    if can(student, FromField):
        if can(teacher, HasGaussians) and can(student, HasGaussians):
            return "gaussians"
        return "field" if can(teacher, HasField) else "depth"
    return "pictures" if any(can(student, capability) for capability in SPATIAL_CAPABILITIES) else None


def ways() -> dict[str, dict[str, Way | None]]:
    """Way of conversion by the names of teacher and student, for all installed methods."""
    kinds = {name: methods.find(name) for name in methods.available()}
    return {name: {other: way(teacher, student) for other, student in kinds.items()} for name, teacher in kinds.items()}


OCTREE = "plenoctrees"


def becomes_octree(opened: Opened, method: Method) -> bool:
    """True if a method's field can be converted to an octree, which supports objects only."""
    try:
        check(opened, methods.find(OCTREE))
    except LumigraphError:
        return False
    return not opened.frame.is_open and way(type(method), methods.find(OCTREE)) == "field"


def octree_of(opened: Opened, seconds: float, device: torch.device | str) -> tuple[Method, str]:
    """The opened method converted to an octree, and the cost as text. seconds: training time after initialisation"""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="lumigraph-") as folder:
        made = convert(opened, OCTREE, Path(folder) / OCTREE, ConvertOptions(seconds=seconds), device, show=True)
        method = Run(Path(folder) / OCTREE).method(device)
    return method, f"{time.monotonic() - begin:.0f} s, {made.psnr:.1f} dB to {made.teacher.method}"


def check(source: Opened, student: type[Method]) -> None:
    """Raise LumigraphError, in one sentence, unless an opened model can be converted to a student."""
    name = methods.name_of(student)
    if (reason := source.conversion_fault) is not None:
        raise LumigraphError(f"{source.path} {reason}")
    if source.frame.times is not None:
        raise LumigraphError(f"{source.path} is of a scene that moves, and what is converted stands still")
    check_kind(name, student.learns_from, Scene, str(source.path), methods.learning_from)
    if not any(can(student, capability) for capability in SPATIAL_CAPABILITIES):
        raise LumigraphError(
            f"{name} holds pictures, and no scene in space; `lumigraph convert --list` says what goes into what"
        )


@dataclass(frozen=True)
class Shown:
    """A method's views by name, seconds for each, and their PSNR in dB where there are photographs."""

    views: dict[str, Tensor]
    seconds: float
    psnr: float | None


def shown(method: Method, scene: Scene | None, held_out: Camera, most: int) -> Shown:
    """At most `most` held-out views of a method: of a scene's photographs or, without one, of cameras."""
    views: dict[str, Tensor] = {}

    def keep(name: str, seen: Rendering) -> None:
        views[name] = seen.rgb.clamp(0, 1).cpu()

    if scene is not None:
        split: Literal["test", "train"] = "test" if len(scene.splits.get("test", ())) else "train"
        found = evaluate(method, scene, EvaluationOptions(split, min(most, len(scene.splits[split]))), keep)
        return Shown(views, found.seconds_per_view, found.psnr)
    chosen = evenly(range(len(held_out)), most)
    warm_up(method, held_out[chosen[0]])
    begin = time.perf_counter()
    for i in track(chosen, "Rendering held-out views", len(chosen)):
        keep(str(i), method.render(method.refined(held_out[i])))
    return Shown(views, (time.perf_counter() - begin) / len(chosen), None)


def likeness(one: Shown, other: Shown) -> float:
    """Mean PSNR in dB between the views of two methods."""
    found = [psnr(one.views[name], other.views[name]) for name in one.views]
    return float(torch.tensor(found).mean())


@torch.no_grad()
def rendered_scene(teacher: Method, cameras: Camera, source: str, seconds: float) -> Scene:
    """A Scene of a teacher's renderings at its cameras, and at others between them.

    seconds: time for rendering, about
    """
    some = evenly(range(len(cameras)), MAX_VIEWS // 2)
    own = Camera.cat([cameras[i] for i in some])
    both = own if len(own) < 2 else Camera.cat([own, between(own)])
    both = both.resized(min(1.0, MAX_SIDE / int(both.size.max())))
    affordable = MAX_VIEWS
    if seconds < math.inf:
        warm_up(teacher, both[0])
        begin = time.perf_counter()
        teacher.render(both[0])
        affordable = int(seconds / max(time.perf_counter() - begin, 1e-6))
    chosen = evenly(range(len(both)), max(affordable, MIN_VIEWS))
    frame, pictures = teacher.frame, []
    for i in track(chosen, "Rendering what to learn from", len(chosen)):
        pictures.append(bytes_of(teacher.render(both[i]).cpu(), frame.background if frame.has_alpha else None))
    index = torch.arange(len(chosen))
    names = [f"{i:03d}" for i in chosen]
    return Scene(both[torch.tensor(chosen)], ImageStore.from_arrays(pictures), frame, {"train": index}, names, source)


def between(cameras: Camera) -> Camera:
    """For each camera an interpolated one towards its nearest neighbour, with an intermediate direction."""
    apart = torch.cdist(cameras.position, cameras.position).fill_diagonal_(torch.inf)
    other = apart.argmin(-1)

    def mixed(values: torch.Tensor) -> torch.Tensor:
        return torch.lerp(values, values[other], NEIGHBOUR_SHARE)

    pose = look_at(mixed(cameras.position), mixed(cameras.forward), -mixed(cameras.pose[:, :, 1]))
    return replace(cameras, pose=pose)
