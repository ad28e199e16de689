"""A run is evaluated: the protocol that suits what it learnt from, and the files that say what came of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from PIL import Image

from ..camera.rays import Rendering
from ..datasets.collection import Collection
from ..datasets.dataset import Dataset
from ..datasets.scene import Scene
from ..datasets.shapes import Shapes
from ..figures import save_picture
from ..files import claim, scene_name, write_json
from ..method import Method
from ..metrics import Score
from ..metrics.lpips import Lpips
from ..run import Trained
from ..system.progress import counting
from .collection import evaluate_collection
from .shapes import evaluate_shapes
from .views import evaluate, file_name


@runtime_checkable
class Evaluated(Protocol):
    """Result of every protocol.

    scores:   means over all that was compared, the headline first
    compared: what that was, in a few words
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
    split: str = "test",
    keep: Callable[[str, Rendering], object] = lambda name, rendering: None,
    most: int | None = None,
    lpips: Lpips | None = None,
    right_halves: bool = False,
) -> Evaluated:
    """A method on a dataset, under the protocol for its kind.

    keep: told each view's name and rendering, where views are compared
    most: so many views or shapes at most, evenly spread; None means all
    right_halves: of a Scene, compare those alone, whatever the method
    """
    if isinstance(data, Shapes):
        return evaluate_shapes(method, data, split, most)
    if isinstance(data, Collection):
        return evaluate_collection(method, data, split, keep, most, lpips)
    assert isinstance(data, Scene)
    return evaluate(method, data, split, keep, most, lpips, right_halves)


def evaluate_run(
    run: Trained,
    method: Method,
    data: Dataset,
    split: str = "test",
    save_images: bool = False,
    most: int | None = None,
    lpips: Lpips | None = None,
    right_halves: bool = False,
) -> dict[str, Any]:
    """Evaluate a Run's Method on its dataset and write the files. Returns what eval.json says."""
    claim_evaluation(run, split, save_images)

    def keep(name: str, rendering: Rendering) -> None:
        if save_images:
            save_picture(image_of(run, name), rendering.rgb, "rendering")

    found, state = evaluate_on(method, data, split, keep, most, lpips, right_halves), run.state
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
    figures = [f"{score.name} {score}" for score in found.scores]
    title = " · ".join([run.method_name, scene_name(run.settings.scene.source), found.compared, *figures])
    with counting("Drawing the contact sheet"):
        save_picture(run.folder / f"{stem(split)}.png", found.contact_sheet(title), "evaluation")
    write_json(run.folder / f"{stem(split)}.json", result, "evaluation")
    return result


def claim_evaluation(run: Trained, split: str, save_images: bool, overwrite: bool | None = None) -> None:
    """Raise LumigraphError unless what an evaluation writes may be written into its run; see `files.claim`."""
    for ending in (".json", ".png"):
        claim(run.folder / f"{stem(split)}{ending}", "evaluation", overwrite)
    for name in run.view_names().get(split, []) if save_images else []:
        claim(image_of(run, name), "rendering", overwrite)


def image_of(run: Trained, name: str) -> Path:
    """Path of the rendering of a view."""
    return run.folder / "eval" / f"{file_name(name)}.png"


def stem(split: str) -> str:
    """Stem of the file names of a split."""
    return "eval" if split == "test" else f"eval-{split}"
