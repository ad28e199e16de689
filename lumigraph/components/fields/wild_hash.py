"""A hash table for photographs in the wild: the heads of Martin-Brualla 2021 on the field of Müller 2022."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from ...datasets.scene import Frame
from .activations import truncated_exp
from .coded_field import Places
from .coded_hash import CodedHash
from .hash_field import side_by_side
from .mlp import MLP
from .wild_field import Passing, WildField

THIN = 3.0  # transient density is exp(-THIN) per scene unit at first, so that what needs no passer-by gets none


class WildHash(CodedHash, WildField):
    """A hash table of what stays, with a head for what passes.

    The grid holds what stays. One photograph alone sees a passer-by and cannot tell how far away they stood, so these
    are learnt where its rays look anyway: at the surfaces behind them.
    """

    def __init__(self, frame: Frame, config: Any):
        super().__init__(frame, config, config.appearance_code)
        inputs = config.levels * config.features_per_level + config.transient_code
        self.transient = MLP(inputs, *[config.transient_width] * config.transient_layers, 5)

    def passing(self, places: Places, codes: Float[Tensor, "sample code"]) -> Passing:
        raw = self.transient(side_by_side(places.unseen, codes))
        return Passing(truncated_exp(raw[:, 0] - THIN), raw[:, 1:4].sigmoid(), softplus(raw[:, 4]))
