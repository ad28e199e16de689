"""Model: a method with packed tensors, fine-tuned as such; and the ladder of its sizes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ...datasets.scene import Scene
from ...errors import LumigraphError
from ...exchange import packing
from ...exchange.packing import Recipe, Table
from ...method import Method
from ...method.capabilities import CanCompress, needs
from ...system.progress import counting

TUNING_RATE = 0.1  # step of tuning, as a share of the quantisation error
FINAL_RATE_SCALE = 0.1  # of that rate, at the end
BETAS = 0.9, 0.99


class CompressedModel:
    """A trained method on a rung of the ladder.

    step: of its training, at which tuning begins
    Raises LumigraphError for a method that cannot be compressed.
    """

    def __init__(self, method: Method, importance: dict[str, Tensor], rung: Rung, step: int):
        self.method, self.rung, self.step = method, rung, step
        weights = needs(method, CanCompress).thin(importance, rung.pruned)
        stored = needs(method, CanCompress).storage()
        chance = torch.Generator().manual_seed(0)
        self.tensors: dict[str, Tensor | Table] = {}
        for name, tensor in method.state_dict().items():
            how = stored.get(name)
            self.tensors[name] = (
                tensor if how is None else packing.packed(tensor, how, rung.recipe, weights.get(name), chance)
            )
        parameters = dict(method.named_parameters())
        self.tuned = [(parameters[name], x) for name, x in self.tables.items() if x.forms and name in parameters]
        self.steps, self.seconds = 0, 0.0
        self.show()

    @property
    def tables(self) -> dict[str, Table]:
        return {name: x for name, x in self.tensors.items() if isinstance(x, Table)}

    def show(self) -> None:
        """Set the method's tensors to the decoded numbers."""
        own = self.method.state_dict()
        for name, table in self.tables.items():
            if table.forms:
                table.put(own[name])

    def packed(self) -> bytes:
        """Packed bytes of the model."""
        return packing.write(self.tensors)

    def tune(self, scene: Scene, steps: int | None, seconds: float | None) -> None:
        """Fine-tune on photographs with fixed codes: codebooks, separate rows and scaled numbers are optimised through
        the rounding, at a decaying rate."""
        forms = [form for _, table in self.tuned for form in table.forms]
        rates = [(latent.requires_grad_(), unit) for form in forms for latent, unit in form.learning()]
        optimizer = torch.optim.Adam([{"params": [x], "lr": 0.0, "unit": unit} for x, unit in rates], betas=BETAS)
        generator, begin, taken = torch.Generator().manual_seed(self.steps), time.perf_counter(), 0
        self.method.train()
        total = steps if steps is not None else round(seconds or 0)
        with counting("Tuning", total) as done:
            while (share := progress(taken, time.perf_counter() - begin, steps, seconds)) < 1:
                for group in optimizer.param_groups:
                    group["lr"] = TUNING_RATE * FINAL_RATE_SCALE**share * group["unit"]
                self._descend(self.method.batch(scene, generator), optimizer)
                taken, self.steps = taken + 1, self.steps + 1
                done(int(share * total))
        self.method.eval()
        for latent, _ in rates:
            latent.requires_grad_(False)
        self.show()
        self.seconds += time.perf_counter() - begin

    def _descend(self, batch: Any, optimizer: torch.optim.Optimizer) -> None:
        """One step: gradients of the method's tensors are passed on to their encoded form."""
        values = [table.values() for _, table in self.tuned]
        for (parameter, table), some in zip(self.tuned, values, strict=True):
            table.put(parameter.data, some.detach())
            parameter.grad = None
        terms = self.method.loss(batch, self.step + self.steps)
        loss = torch.stack(list(terms.values())).sum()
        if not loss.isfinite():
            raise LumigraphError("Tuning stopped because the loss is not finite; give fewer --steps or --seconds")
        loss.backward()
        reached = [
            (some, table.taken(parameter.grad.to_dense()))
            for (parameter, table), some in zip(self.tuned, values, strict=True)
            if parameter.grad is not None and some.requires_grad
        ]
        optimizer.zero_grad()
        torch.autograd.backward([some for some, _ in reached], [grad for _, grad in reached])
        optimizer.step()


def progress(step: int, passed: float, steps: int | None, seconds: float | None) -> float:
    """The share of tuning that is over."""
    if steps is not None:
        return step / steps if steps else 1.0
    return passed / seconds if seconds else 1.0


@dataclass(frozen=True)
class Rung:
    """pruned: share of all importance to prune, the least important rows first"""

    pruned: float
    recipe: Recipe


# The second is VQRF's: it prunes 0.1 % of importance and keeps 60 % out of a codebook of 4096.
LADDER: tuple[Rung, ...] = (
    Rung(0.0, Recipe(apart=1.0)),
    Rung(0.001, Recipe(apart=0.6)),
    Rung(0.003, Recipe(apart=0.3, coarser=1)),
    Rung(0.01, Recipe(apart=0.1, coarser=2)),
    Rung(0.02, Recipe(apart=0.02, coarser=2)),
    Rung(0.03, Recipe(apart=0.005, coarser=2)),
    Rung(0.04, Recipe(2048, apart=0.0, coarser=3)),
    Rung(0.08, Recipe(1024, apart=0.0, coarser=3)),
    Rung(0.15, Recipe(256, apart=0.0, coarser=4)),
)

STEPS_BETWEEN_RUNGS = 4  # interpolated settings from one rung to the next
RUNG_POSITIONS = [i / STEPS_BETWEEN_RUNGS for i in range(STEPS_BETWEEN_RUNGS * (len(LADDER) - 1) + 1)]


def rung_at(place: float) -> Rung:
    """A rung, or an interpolation of two: the lower one's recipe, with more pruned and fewer separate rows."""
    low, high = LADDER[int(place)], LADDER[min(int(place) + 1, len(LADDER) - 1)]
    share = place - int(place)
    pruned = low.pruned + share * (high.pruned - low.pruned)
    apart = low.recipe.apart + share * (high.recipe.apart - low.recipe.apart)
    return Rung(pruned, replace(low.recipe, apart=apart))
