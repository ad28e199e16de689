"""Evaluate a run or a collection under the protocol for its kind of dataset, and write the results."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from PIL import Image

from ..camera.rays import Rendering
from ..datasets.collection import Collection
from ..datasets.dataset import Dataset
from ..datasets.scene import Scene
from ..datasets.shapes import Shapes
from ..datasets.words import Words
from ..datasets.world import BlockWorld
from ..errors import LumigraphError, LumigraphWarning
from ..figures import save_picture
from ..files import claim, refuse_link, scene_name, write_json
from ..gaussians.cloud import needle_share
from ..method import Method
from ..method.capabilities import HasGaussians, can, needs
from ..metrics import Score
from ..metrics.lpips import Lpips, load_lpips, named_files
from ..run import Trained
from ..system.progress import counting
from .baseline import below
from .options import EvaluationOptions
from .shapes import ShapesEvaluation, evaluate_shapes
from .tracking import Followed, tracks
from .views import ViewsEvaluation, evaluate, file_name, reveal
from .walks import evaluate_walk
from .words import evaluate_words

Keep = Callable[[str, Rendering], object]


@runtime_checkable
class Evaluated(Protocol):
    """Result of every protocol.

    scores:   means over all compared items, the headline first
    compared: description of these items
    """

    @property
    def scores(self) -> list[Score]: ...

    @property
    def compared(self) -> str: ...

    def to_json(self) -> dict[str, Any]: ...

    def contact_sheet(self, title: str) -> Image.Image: ...


def evaluate_on(
    method: Method,
    data: Dataset,
    options: EvaluationOptions = EvaluationOptions(),
    keep: Keep = lambda name, rendering: None,
    lpips: Lpips | None = None,
) -> Evaluated:
    """Evaluate a method on a dataset, under the protocol for its kind.

    keep: receives each view's name and rendering, where views are compared
    lpips: the network of the options' files
    """
    if isinstance(data, Shapes):
        return evaluate_shapes(method, data, options)
    if isinstance(data, Words):
        return evaluate_words(method, data, options.views)
    if isinstance(data, Collection):
        return evaluate_collection(method, data, options, keep, lpips)
    if isinstance(data, BlockWorld) and issubclass(method.learns_from, BlockWorld):
        return evaluate_walk(method, data, options, keep)
    assert isinstance(data, Scene)
    return evaluate(method, data, options, keep, lpips)


def evaluate_run(
    run: Trained, method: Method, data: Dataset, options: EvaluationOptions = EvaluationOptions()
) -> dict[str, Any]:
    """Evaluate a Run's Method on its dataset and write the files. Returns what eval.json says."""
    claim_evaluation(run, options)
    split, weights = options.split, named_files(options.lpips)

    def keep(name: str, rendering: Rendering) -> None:
        if options.save_images:
            save_picture(image_of(run, name), rendering.rgb, "rendering")

    found, state = evaluate_on(method, data, options, keep, load_lpips(weights) if weights else None), run.state
    result = found.to_json() | {
        "training_seconds": state.seconds,
        "compile_seconds": state.compile_seconds,
        "peak_memory": state.peak_memory,
        "steps": state.step,
        "method": run.method_name,
        "scene": run.settings.scene.to_json(),
        "trained_on": f"{run.settings.device}, {run.settings.processor}",
        "evaluated_on": str(method.device),
        "versions": run.settings.versions,
    }
    if can(method, HasGaussians):
        cloud = needs(method, HasGaussians).gaussians()
        result["cloud"] = {"gaussians": len(cloud), "needles": needle_share(cloud)}
    if tracks(method):
        assert isinstance(data, Scene)
        followed = Followed.of(method, data)
        result["tracking"] = {"frames": followed.frames, "known": followed.known, "share": str(followed)}
        if followed.sentence:
            warnings.warn(followed.sentence, LumigraphWarning, stacklevel=2)
    figures = [f"{score.name} {score}" for score in found.scores]
    title = " · ".join([run.method_name, scene_name(run.settings.scene.source), found.compared, *figures])
    with counting("Drawing the contact sheet"):
        save_picture(run.folder / f"{stem(split)}.png", found.contact_sheet(title), "evaluation")
    write_json(run.folder / f"{stem(split)}.json", result, "evaluation")
    for score in found.scores[:1]:
        unit, baselines = score.unit or score.name, result.get("baselines", {})
        if sentence := below(run.folder, unit, score.value, baselines, method.complete):
            warnings.warn(sentence, LumigraphWarning, stacklevel=2)
    return result


def claim_evaluation(run: Trained, options: EvaluationOptions, overwrite: bool | None = None) -> None:
    """Raise LumigraphError unless what an evaluation writes may be written into its run; see `files.claim`."""
    refuse_link(run.folder / "eval")
    for ending in (".json", ".png"):
        claim(run.folder / f"{stem(options.split)}{ending}", "evaluation", overwrite)
    for name in run.view_names().get(options.split, []) if options.save_images else []:
        claim(image_of(run, name), "rendering", overwrite)


def image_of(run: Trained, name: str) -> Path:
    """Path of the rendering of a view."""
    return run.folder / "eval" / f"{file_name(name)}.png"


def stem(split: str) -> str:
    """Stem of the file names of a split."""
    return "eval" if split == "test" else f"eval-{split}"


def evaluate_collection(
    method: Method,
    data: Collection,
    options: EvaluationOptions = EvaluationOptions(),
    keep: Keep = lambda name, rendering: None,
    lpips: Lpips | None = None,
) -> ViewsEvaluation | ShapesEvaluation:
    """Evaluate each member of a split on its own held-out views or as a shape, and combine the results.

    keep:  receives each view's name and rendering; names begin with the member's
    options: of which the views are those of each member
    """
    split, own = options.split, replace(options, split="test")
    scenes: dict[str, ViewsEvaluation] = {}
    shapes: dict[str, ShapesEvaluation] = {}
    for name, member in data.members(split):
        told = reveal(method, member)
        if isinstance(member, Scene):

            def keep_of(view: str, seen: Rendering, name: str = name) -> object:
                return keep(f"{name}/{view}", seen)

            scenes[name] = evaluate(told, member, own, keep_of, lpips)
        elif isinstance(member, Shapes):
            shapes[name] = evaluate_shapes(told, member, own)
    if scenes and shapes:
        raise LumigraphError(f"{data.source} holds scenes and shapes, whose scores have no mean; name one kind")
    members = {"split": split, "members": len(scenes or shapes)}
    return joined_views(scenes, members) if scenes else joined_shapes(shapes, members)


def joined_views(parts: dict[str, ViewsEvaluation], about_members: dict[str, Any]) -> ViewsEvaluation:
    views = [replace(view, name=f"{name}/{view.name}") for name, part in parts.items() for view in part.views]
    shown = {f"{name}/{view}": seen for name, part in parts.items() for view, seen in list(part.shown.items())[:2]}
    sizes = list(dict.fromkeys(view.resolution for view in views))
    counts = {key: sum(part.protocol[key] for part in parts.values()) for key in ("views", "of")}
    about = next(iter(parts.values())).protocol | about_members | counts
    about |= {
        "resolution": sizes[0] if len(sizes) == 1 else sizes,
        "psnr": "per view, averaged by member, then over all",
    }
    seconds = sum(part.compile_seconds for part in parts.values())
    return ViewsEvaluation(views, about, seconds, shown, members=tuple(parts.values()))


def joined_shapes(parts: dict[str, ShapesEvaluation], members: dict[str, Any]) -> ShapesEvaluation:
    shapes = [replace(shape, name=f"{name}/{shape.name}") for name, part in parts.items() for shape in part.shapes]
    shown = {f"{name}/{shape}": seen for name, part in parts.items() for shape, seen in list(part.shown.items())[:2]}
    counts = {key: sum(part.protocol[key] for part in parts.values()) for key in ("shapes", "of")}
    about = next(iter(parts.values())).protocol | members | counts
    return ShapesEvaluation(shapes, about, shown, tuple(parts.values()))
