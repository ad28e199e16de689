"""TensorCloud: density control for Gaussians in a plain dictionary of tensors, in anybody's training loop."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ..components.clouds.adaptive import RECOVERY_INTERVALS, AdaptiveDensity, AdaptiveNumbers
from ..components.clouds.density_control import PRUNE_OPACITY, RefineNumbers
from ..components.clouds.error_density import ErrorDensity
from ..errors import LumigraphError
from ..gaussians import Gaussians

REQUIRED = ("means", "quats", "scales", "opacities")
Params = MutableMapping[str, Any]  # or a torch.nn.ParameterDict
Optimizers = Mapping[str, torch.optim.Optimizer]


class TensorCloud:
    """The names of `Cloud` for tensors of a dictionary, which density control changes in place.

    params: means, quats (w, x, y, z), scales (logarithms), opacities (logits), and any further tensors of as many rows
    optimizers: of one tensor each, by the same names; their moments follow the rows
    state:  further tensors of as many rows, which follow too
    """

    def __init__(self, params: Params, optimizers: Optimizers, extent: float = 1.0, state: Params | None = None):
        if lacking := [name for name in REQUIRED if name not in params]:
            raise LumigraphError(f"The parameters lack {', '.join(lacking)}; name them so")
        self.params, self.optimizers, self.extent, self.state = params, optimizers, extent, state

    def __len__(self) -> int:
        return len(self.params["means"])

    @property
    def means(self) -> Float[Tensor, "gaussian 3"]:
        return self.params["means"]

    @property
    def log_scales(self) -> Float[Tensor, "gaussian 3"]:
        return self.params["scales"]

    @property
    def opacities(self) -> Float[Tensor, " gaussian"]:
        return self.params["opacities"].view(len(self))

    def gaussians(self) -> Gaussians:
        """The cloud without colours."""
        p = self.params
        return Gaussians(p["means"], p["quats"], p["scales"], self.opacities, p["means"].new_zeros(len(self), 1, 3))

    @torch.no_grad()
    def rebuild(self, source: Int[Tensor, " new"], fresh: Bool[Tensor, " new"]) -> None:
        """Make Gaussian i a copy of source[i]; the optimizers' moments of the fresh ones are zero."""
        count = len(self)
        for name in [*self.params]:
            self.exchange(name, self.params[name].detach()[source], lambda x: _moved(x, source, fresh, count))
        for name, value in (self.state or {}).items():
            if isinstance(value, Tensor) and value.ndim and len(value) == count:
                self.state[name] = value[source]  # type: ignore[index]

    def exchange(self, name: str, value: Tensor, change: Any) -> None:
        """Replace a parameter, and each tensor of its optimizer's state but the step by change(tensor)."""
        old = self.params[name]
        new = nn.Parameter(value, requires_grad=old.requires_grad)
        self.params[name] = new
        if name not in self.optimizers:
            if old.requires_grad:
                raise LumigraphError(f"The parameter {name} needs gradients and has no optimizer; give it one")
            return
        optimizer = self.optimizers[name]
        state = optimizer.state.pop(old, {})
        for key, moment in state.items():
            if key != "step" and isinstance(moment, Tensor):
                state[key] = change(moment)
        optimizer.state[new] = state
        optimizer.param_groups[0]["params"] = [new]

    def reset_opacity(self, most: float) -> None:
        """Clamp opacities, and forget their moments."""
        limit = float(torch.tensor(most).logit())
        self.exchange("opacities", self.params["opacities"].detach().clamp(max=limit), torch.zeros_like)


def _moved(moment: Tensor, source: Tensor, fresh: Tensor, count: int) -> Tensor:
    """Rows of an optimizer's state after `rebuild`."""
    if not moment.ndim or len(moment) != count:
        return moment
    moment = moment[source]
    moment[fresh] = 0
    return moment


@dataclass(frozen=True)
class DensitySteps:
    """Our density control as functions of dictionaries: adaptive (Kerbl 2023) or by error (Mallick 2024).

    steps: of the whole training;  cap: Gaussians at most
    kind:  "adaptive" reads the gradient of info["means2d"]; "error" that of info["explained"], which is rendered as a
           channel of zeros and multiplied by each pixel's error in the loss
    """

    steps: int
    cap: int
    kind: str = "adaptive"
    refine: RefineNumbers = RefineNumbers()
    numbers: AdaptiveNumbers = AdaptiveNumbers()

    def initialize_state(self, count: int, extent: float = 1.0, seed: int = 0) -> dict[str, Any]:
        """State of a training that begins with `count` Gaussians. extent: of the cameras, in scene units"""
        kind = {"adaptive": AdaptiveDensity, "error": ErrorDensity}.get(self.kind)
        if kind is None:
            raise LumigraphError(f"kind={self.kind!r} is not one of adaptive, error; take one of these")
        control = kind(self.refine, self.numbers, count)
        control.initial_count.fill_(count)
        return {"control": control, "extent": extent, "random": torch.Generator().manual_seed(seed)}

    @torch.no_grad()
    def step(
        self, params: Params, optimizers: Optimizers, state: dict[str, Any], number: int, info: Mapping[str, Any]
    ) -> bool:
        """Follow a step after its backward pass, and change the Gaussians where that is due. True if it did."""
        control, progress = state["control"], number / self.steps
        if progress >= self.refine.refine_until:
            return False
        cloud = TensorCloud(params, optimizers, state["extent"])
        self.record(control, info, len(cloud))
        due = control.due(number, progress)
        if due:
            share = min(1.0, progress / self.refine.refine_until) ** control.ramp if self.refine.cap_ramp else 1.0
            first = int(control.initial_count)
            cap = int(first + share * max(self.cap - first, 0))
            control.refine(cloud, state["extent"], cap, state["random"])
            for name in control.grows:
                setattr(control, name, getattr(control, name).new_zeros(len(cloud)))
        every = self.numbers.opacity_reset_interval
        if (
            self.kind == "adaptive"
            and number
            and number % every == 0
            and self.steps - number >= RECOVERY_INTERVALS * every
        ):
            cloud.reset_opacity(2 * PRUNE_OPACITY)
        return due

    def record(self, control: AdaptiveDensity, info: Mapping[str, Any], count: int) -> None:
        """Add one step's gradients, of all cameras in the dictionary."""
        if self.kind == "error":
            assert isinstance(control, ErrorDensity)
            control.explained += info["explained"].grad.view(-1, count).sum(0)
            return
        centres, ids = info["means2d"], info.get("gaussian_ids")
        if centres.grad is None:
            raise LumigraphError("means2d has no gradient; call info['means2d'].retain_grad() before the backward pass")
        gradient = centres.grad * centres.new_tensor([info["width"], info["height"]]) / 2 * info["n_cameras"]
        if ids is None:
            seen = (info["radii"] > 0).all(-1)
            ids, gradient = seen.nonzero()[:, -1], gradient[seen]
        control.positional_gradient_sum.index_add_(0, ids, gradient.norm(dim=-1))
        control.visible_count.index_add_(0, ids, torch.ones_like(gradient[:, 0]))
