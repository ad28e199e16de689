"""CodedSurface: a SurfaceMethod with latent codes of shapes: of training members, and of a given shape."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...datasets.scene import Frame, Photograph
from ...datasets.shapes import Shape, Shapes
from ...errors import LumigraphError
from ...method import Method
from ...method.controls import Control, Value
from ..fields.instance_codes import FOUND, InstanceCodes
from ..fields.kept_photographs import Kept
from .surface_method import SurfaceMethod

Evidence = Literal["mesh", "half scan", "points", "picture"]


class CodedSurface(SurfaceMethod):
    """Surface method trained on several shapes, which fits a code to a new one, or to evidence of it. Write `find`.

    codes:       of members
    found:       code of the given or generated shape; no row without one
    taken_kinds: accepted kinds of evidence
    """

    accepts: ClassVar[tuple[type, ...]] = (Shapes,)
    taken_kinds: ClassVar[tuple[Evidence, ...]] = ("mesh",)

    def __init__(self, frame: Frame, config: Any):
        super().__init__(frame, config)
        self.codes = InstanceCodes(config.members, config.code)
        self.found = Kept(torch.empty(0, config.code))

    @abstractmethod
    def find(self, evidence: Shape | Photograph) -> Float[Tensor, " code"]:
        """Fit a code to evidence of a shape. It may change `frame`."""

    @property
    def code(self) -> Float[Tensor, " code"]:
        """Code of the current instance; that of a single shape without a choice."""
        if len(self._instances) < 2:
            return self.codes.average
        return self.codes.code_of(str(self.control("instance")), self.found.rows)

    @property
    def _instances(self) -> tuple[str, ...]:
        return (*([FOUND] if len(self.found.rows) else []), *self.codes.names)

    @property
    def controls(self) -> tuple[Control, ...]:
        instance = [self.codes.control(len(self.found.rows) > 0)] if len(self._instances) > 1 else []
        return (*instance, *super().controls)

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Fit the code of a shape to its mesh, a scan or a picture."""
        for piece in evidence[-1:]:
            if isinstance(piece, Shapes) and len(piece) != 1:
                raise LumigraphError(f"{piece.source} holds {len(piece)} shapes, and one is completed; name its file")
            one: Any = piece.members[0] if isinstance(piece, Shapes) else piece
            if isinstance(one, Shape):
                self.frame = one.frame
            self._show(self.find(one))

    def draw_object(self, seed: int) -> Method:
        """The method with a generated shape: a code sampled from the Gaussian of the trained ones."""
        told: Any = self.given()
        told._show(self.codes.draw_code(seed))
        return told

    def _show(self, code: Float[Tensor, " code"]) -> None:
        self.found = Kept(code.detach()[None])
        self.settings.pop("instance", None)
