"""Prior: a method trained on many scenes or shapes, and inference of a single one."""

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
    """Prior of a trained method. method: trained on a Collection with a Scene as evidence, or on several shapes with
    one of them, or a scan or picture of it, as evidence; see `Method.accepts`"""

    method: Method

    @staticmethod
    def of(method: Method, learnt_from: str, where: Path | str) -> Prior:
        """The prior in a trained method.

        learnt_from: training data, in the words of `Dataset.kind`
        Raises LumigraphError, naming `where`, for a method without one.
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
        """Infer an ordinary method of one scene from its training photographs; or of one shape. The prior itself is not
        trained.

        Raises LumigraphError if the photographs exceed memory.
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
        """Generate an ordinary method of a new object. Raises LumigraphError for a prior that cannot."""
        return needs(self.method, CanDraw).draw_object(seed)
