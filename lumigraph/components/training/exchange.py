"""Parameters that change size while they are learnt: a new one takes the old one's place."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


def exchange(
    module: nn.Module,
    name: str,
    values: Tensor,
    optimizer: torch.optim.Optimizer | None,
    state: dict[str, Any] | None = None,
) -> None:
    """A new parameter for a module's old one, whose size the graph of the last step still remembers.

    optimizer: updates the new one from now on; None where there is none yet
    state:     what it remembers of the new one; nothing by default, so that its moments begin at zero
    """
    old = getattr(module, name)
    new = nn.Parameter(values.to(old.device))
    setattr(module, name, new)
    if optimizer is not None:
        optimizer.state.pop(old, None)
        if state:
            optimizer.state[new] = state
        for group in optimizer.param_groups:
            group["params"] = [new if p is old else p for p in group["params"]]
