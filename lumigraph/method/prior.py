"""Prior: knowledge of a method that learnt from many scenes or shapes, and its method of one that it is given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..datasets.collection import Collection
from ..datasets.scene import Scene
from ..datasets.shapes import Shapes
from ..errors import LumigraphError
from ..system.memory import ask_for, room_for
from .capabilities import CanDraw, needs
from .method import Method


@dataclass(frozen=True)
class Prior:
    """method: one that learns from a Collection and takes a Scene as evidence, or learns from several shapes and takes
    one of them, or a scan or picture of it; see `Method.accepts`"""

    method: Method

    @staticmethod
    def of(method: Method, learnt_from: str, where: Path | str) -> Prior:
        """The prior in a trained method.

        learnt_from: what it learnt from, in the words of `Dataset.kind`
        Raises LumigraphError, naming `where`, for a method that is none.
        """
        evidence = {Collection.kind: Scene, Shapes.kind: Shapes}.get(learnt_from)
        if evidence not in method.accepts:
            raise LumigraphError(
                f"{where} is no prior, for it learnt from {learnt_from}, and priors learn from a collection; "
                "name one that did, or train it: lumigraph train pixelnerf procedural:toys"
            )
        return Prior(method)

    @property
    def of_shapes(self) -> bool:
        """True for a prior of shapes, False for one of scenes."""
        return Scene not in self.method.accepts

    def infer(self, scene: Any) -> Method:
        """An ordinary method of one scene, given its photographs to learn from; or of one shape. The prior itself
        learns nothing.

        Raises LumigraphError where memory does not hold what there is to find in so many photographs.
        """
        if not isinstance(scene, Scene):
            return self.method.given(scene)
        views, device = len(scene.splits["train"]), self.method.device
        size = self.method.evidence_bytes(scene)
        fits = room_for(max(size // views, 1), device)
        less = f"give fewer --views; {fits} would fit" if fits else "give a larger --downscale"
        ask_for(size, device, f"Looking at {views} photographs of {scene.source}", less)
        return self.method.given(scene)

    def draw(self, seed: int) -> Method:
        """An ordinary method of an object that nobody has photographed. Raises LumigraphError for a prior that draws
        none."""
        return needs(self.method, CanDraw).drawn(seed)
