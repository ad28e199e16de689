"""Evaluate a method on unseen members of a collection, given the evidence that it may use of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from ..camera.rays import Rendering
from ..datasets.collection import Collection
from ..datasets.scene import Scene
from ..datasets.shapes import Shapes
from ..errors import LumigraphError
from ..method import Method
from ..metrics.lpips import Lpips
from .reveal import reveal
from .shapes import ShapesEvaluation, evaluate_shapes
from .views import Evaluation, evaluate

Keep = Callable[[str, Rendering], object]


def evaluate_collection(
    method: Method, data: Collection, split: str = "test", keep: Keep | None = None, views: int | None = None,
    lpips: Lpips | None = None,
) -> Evaluation | ShapesEvaluation:  # fmt: skip
    """Evaluate each member of a split on its own held-out views or as a shape, and put all of it together.

    keep:  told each view's name and rendering; names begin with the member's
    views: of each member at most
    """
    scenes: dict[str, Evaluation] = {}
    shapes: dict[str, ShapesEvaluation] = {}
    for name, member in data.members(split):
        told = reveal(method, member)
        if isinstance(member, Scene):

            def keep_of(view: str, seen: Rendering, name: str = name) -> object:
                return keep(f"{name}/{view}", seen) if keep else None

            scenes[name] = evaluate(told, member, "test", keep_of, views, lpips)
        elif isinstance(member, Shapes):
            shapes[name] = evaluate_shapes(told, member, "test", views)
    if scenes and shapes:
        raise LumigraphError(f"{data.source} holds scenes and shapes, whose scores have no mean; name one kind")
    members = {"split": split, "members": len(scenes or shapes)}
    return joined_views(scenes, members) if scenes else joined_shapes(shapes, members)


def joined_views(parts: dict[str, Evaluation], members: dict[str, Any]) -> Evaluation:
    views = [replace(view, name=f"{name}/{view.name}") for name, part in parts.items() for view in part.views]
    shown = {f"{name}/{view}": seen for name, part in parts.items() for view, seen in list(part.shown.items())[:2]}
    sizes = list(dict.fromkeys(view.resolution for view in views))
    counts = {key: sum(part.protocol[key] for part in parts.values()) for key in ("views", "of")}
    about = next(iter(parts.values())).protocol | members | counts
    about["resolution"] = sizes[0] if len(sizes) == 1 else sizes
    return Evaluation(views, about, sum(part.compile_seconds for part in parts.values()), shown)


def joined_shapes(parts: dict[str, ShapesEvaluation], members: dict[str, Any]) -> ShapesEvaluation:
    shapes = [replace(shape, name=f"{name}/{shape.name}") for name, part in parts.items() for shape in part.shapes]
    shown = {f"{name}/{shape}": seen for name, part in parts.items() for shape, seen in list(part.shown.items())[:2]}
    counts = {key: sum(part.protocol[key] for part in parts.values()) for key in ("shapes", "of")}
    return ShapesEvaluation(shapes, next(iter(parts.values())).protocol | members | counts, shown)
