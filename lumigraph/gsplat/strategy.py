"""Density control with the names of gsplat.strategy (Ye 2024): Kerbl 2023 and Kheradmand 2024 on dictionaries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..components.clouds.adaptive import SPLIT_FACTOR
from ..errors import LumigraphError
from ..gaussians import Gaussians
from ..gaussians.projection import covariances_of
from ..geometry import to_matrix
from ..methods.gaussian_splatting.mcmc import GROWTH_FACTOR, MAX_COPIES, shared_out
from .tensor_cloud import REQUIRED, Optimizers, Params, TensorCloud

State = dict[str, Any]


@dataclass
class Strategy:
    """Base class of strategies."""

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Raises AssertionError, as gsplat does, unless each trainable parameter has an optimizer of its own."""
        trainable = {name for name, value in params.items() if value.requires_grad}
        assert trainable == set(optimizers), f"parameters {trainable} need optimizers of these names: {set(optimizers)}"
        assert all(len(x.param_groups) == 1 for x in optimizers.values()), "an optimizer must have one group"

    def step_pre_backward(self, *args: Any, **kwargs: Any) -> None:
        """Called before the backward pass."""

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """Called after the backward pass."""


@dataclass
class DefaultStrategy(Strategy):
    """Adaptive density control (Kerbl 2023), with the options and defaults of gsplat.

    grow_grad2d: gradient of a centre, in half pictures, beyond which a Gaussian is duplicated, or split where its
                 scale exceeds grow_scale3d of the scene or its radius grow_scale2d of the picture
    absgrad:     by the absolute gradients (Ye 2024, arXiv 2404.10484)
    revised_opacity: halves of a split are fainter (Rota Bulo 2024, arXiv 2404.06109)
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    absgrad: bool = False
    revised_opacity: bool = False
    verbose: bool = False
    key_for_gradient: str = "means2d"

    def initialize_state(self, scene_scale: float = 1.0) -> State:
        """State of a training. scene_scale: extent of the scene, in its units"""
        return {"grad2d": None, "count": None, "scene_scale": scene_scale} | (
            {"radii": None} if self.refine_scale2d_stop_iter > 0 else {}
        )

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        super().check_sanity(params, optimizers)
        require_names(params)

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Any) -> None:
        assert self.key_for_gradient in info, f"{self.key_for_gradient} is not in the dictionary"
        info[self.key_for_gradient].retain_grad()

    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: State,
        step: int,
        info: Any,
        packed: bool = False,
        scene: Any = None,
    ) -> None:
        if step >= self.refine_stop_iter:
            return
        self.record(len(params["means"]), state, info, packed)
        paused = step % self.reset_every < self.pause_refine_after_reset
        if step > self.refine_start_iter and step % self.refine_every == 0 and not paused:
            self.grow(params, optimizers, state, step)
            self.prune(params, optimizers, state, step)
            for name in ("grad2d", "count", "radii"):
                if state.get(name) is not None:
                    state[name].zero_()
            say(self.verbose, step, params)
        if step % self.reset_every == 0 and step > 0:
            reset_opa(params, optimizers, state, 2 * self.prune_opa)

    @torch.no_grad()
    def record(self, count: int, state: State, info: Any, packed: bool) -> None:
        """Add one step's gradients, in half pictures, and the largest radii."""
        centres = info[self.key_for_gradient]
        gradient = centres.absgrad if self.absgrad else centres.grad
        half = gradient.new_tensor([info["width"], info["height"]]) / 2 * info["n_cameras"]
        radii, ids = info["radii"], info["gaussian_ids"]
        if not packed:
            seen = (radii > 0).all(-1)
            ids, gradient, radii = seen.nonzero()[:, -1], gradient[seen], radii[seen]
        for name in ("grad2d", "count", "radii")[: 3 if self.refine_scale2d_stop_iter > 0 else 2]:
            if state.get(name) is None:
                state[name] = gradient.new_zeros(count)
        state["grad2d"].index_add_(0, ids, (gradient * half).norm(dim=-1))
        state["count"].index_add_(0, ids, torch.ones_like(ids, dtype=torch.float32))
        if state.get("radii") is not None:
            share = radii.amax(-1) / max(info["width"], info["height"])
            state["radii"].scatter_reduce_(0, ids.long(), share, "amax")

    @torch.no_grad()
    def grow(self, params: Params, optimizers: Optimizers, state: State, step: int) -> None:
        """Duplicate small Gaussians with a large gradient, split large ones."""
        high = state["grad2d"] / state["count"].clamp_min(1) > self.grow_grad2d
        small = params["scales"].exp().amax(-1) <= self.grow_scale3d * state["scene_scale"]
        halved = high & ~small
        if step < self.refine_scale2d_stop_iter:
            halved |= state["radii"] > self.grow_scale2d
        twice = high & small
        duplicate(params, optimizers, state, twice)
        halved = torch.cat([halved, halved.new_zeros(int(twice.sum()))])
        split(params, optimizers, state, halved, self.revised_opacity)

    @torch.no_grad()
    def prune(self, params: Params, optimizers: Optimizers, state: State, step: int) -> None:
        """Remove faint Gaussians and, after the first reset, large ones."""
        gone = params["opacities"].flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            gone |= params["scales"].exp().amax(-1) > self.prune_scale3d * state["scene_scale"]
            if step < self.refine_scale2d_stop_iter:
                gone |= state["radii"] > self.prune_scale2d
        remove(params, optimizers, state, gone)


@dataclass
class MCMCStrategy(Strategy):
    """Gaussians as samples of a Markov chain (Kheradmand 2024), with the options and defaults of gsplat.

    noise_lr: noise on the centres, times their learning rate;  cap_max: Gaussians at most
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    noise_injection_stop_iter: int = -1
    refine_every: int = 100
    min_opacity: float = 0.005
    verbose: bool = False
    noise_opacity_t: float = 0.005
    noise_opacity_k: float = 100.0

    def initialize_state(self) -> State:
        """State of a training; the binomials are gsplat's, and the relocation needs none."""
        return {"binoms": binomials(MAX_COPIES)}

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        super().check_sanity(params, optimizers)
        require_names(params)

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: State,
        step: int,
        info: Any,
        lr: float,
        scene: Any = None,
    ) -> None:
        """Relocate, add, and move by noise. lr: learning rate of the means"""
        if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
            dead = params["opacities"].flatten().sigmoid() <= self.min_opacity
            relocate(params, optimizers, {}, dead, min_opacity=self.min_opacity)
            count = len(params["means"])
            joining = max(min(self.cap_max, int(GROWTH_FACTOR * count)) - count, 0)
            sample_add(params, optimizers, {}, joining, min_opacity=self.min_opacity)
            say(self.verbose, step, params)
        if self.noise_injection_stop_iter < 0 or step < self.noise_injection_stop_iter:
            inject_noise_to_position(
                params, optimizers, {}, lr * self.noise_lr, t=self.noise_opacity_t, k=self.noise_opacity_k
            )


def require_names(params: Params) -> None:
    """Raises AssertionError for parameters without the names that strategies read."""
    for name in REQUIRED:
        assert name in params, f"{name} is not among the parameters"


def say(verbose: bool, step: int, params: Params) -> None:
    if verbose:
        print(f"Step {step}: {len(params['means'])} Gaussians")


def duplicate(params: Params, optimizers: Optimizers, state: State, mask: Bool[Tensor, " gaussian"]) -> None:
    """Copy the Gaussians of a mask, behind all others."""
    copies = mask.nonzero()[:, 0]
    source = torch.cat([torch.arange(len(mask), device=mask.device), copies])
    TensorCloud(params, optimizers, state=state).rebuild(source, torch.arange(len(source)) >= len(mask))


@torch.no_grad()
def split(
    params: Params,
    optimizers: Optimizers,
    state: State,
    mask: Bool[Tensor, " gaussian"],
    revised_opacity: bool = False,
) -> None:
    """Replace the Gaussians of a mask by two random samples of each, 1.6 times smaller, behind all others."""
    chosen, kept = mask.nonzero()[:, 0], (~mask).nonzero()[:, 0]
    source = torch.cat([kept, chosen, chosen])
    fresh = torch.arange(len(source), device=mask.device) >= len(kept)
    TensorCloud(params, optimizers, state=state).rebuild(source, fresh)
    scales = params["scales"][fresh].exp()
    offset = to_matrix(params["quats"][fresh]) @ (scales * torch.randn_like(scales))[..., None]
    params["means"][fresh] += offset[..., 0]
    params["scales"][fresh] = (scales / SPLIT_FACTOR).log()
    if revised_opacity:
        opacity = params["opacities"][fresh].sigmoid()
        params["opacities"][fresh] = (1 - (1 - opacity).sqrt()).logit()


def remove(params: Params, optimizers: Optimizers, state: State, mask: Bool[Tensor, " gaussian"]) -> None:
    """Remove the Gaussians of a mask."""
    source = (~mask).nonzero()[:, 0]
    TensorCloud(params, optimizers, state=state).rebuild(source, torch.zeros_like(source, dtype=torch.bool))


def reset_opa(params: Params, optimizers: Optimizers, state: State, value: float) -> None:
    """Clamp opacities to a value, and forget their moments."""
    TensorCloud(params, optimizers).reset_opacity(value)


@torch.no_grad()
def relocate(
    params: Params,
    optimizers: Optimizers,
    state: State,
    mask: Bool[Tensor, " gaussian"],
    binoms: Tensor | None = None,
    min_opacity: float = 0.005,
) -> None:
    """Make the dead Gaussians of a mask copies of living ones, drawn by opacity (section 3.2)."""
    dead = mask.nonzero()[:, 0]
    source = torch.arange(len(mask), device=mask.device)
    weights = params["opacities"].flatten().sigmoid().masked_fill(mask, 0)
    if len(dead) and float(weights.sum()) > 0:
        source[dead] = torch.multinomial(weights, len(dead), replacement=True)
        share(params, optimizers, state, source, len(mask), min_opacity)


@torch.no_grad()
def sample_add(
    params: Params,
    optimizers: Optimizers,
    state: State,
    n: int,
    binoms: Tensor | None = None,
    min_opacity: float = 0.005,
) -> None:
    """Add n copies of Gaussians drawn by opacity, which together render like the originals."""
    if n > 0:
        weights = params["opacities"].flatten().sigmoid()
        drawn = torch.multinomial(weights, n, replacement=True)
        source = torch.cat([torch.arange(len(weights), device=drawn.device), drawn])
        share(params, optimizers, state, source, len(weights), min_opacity)


def share(
    params: Params,
    optimizers: Optimizers,
    state: State,
    source: Int[Tensor, " new"],
    count: int,
    min_opacity: float,
) -> None:
    """Rebuild by `source`, with opacity and scale of several copies shared out."""
    copies = torch.bincount(source, minlength=count)[source]
    touched = copies > 1
    cloud = TensorCloud(params, optimizers, state=state)
    cloud.rebuild(source, touched)
    found = shared_out(cloud.gaussians()[touched], copies[touched], min_opacity)
    params["opacities"][touched] = found.opacities.view(-1, *params["opacities"].shape[1:])
    params["scales"][touched] = found.log_scales


@torch.no_grad()
def compute_relocation(
    opacities: Float[Tensor, " gaussian"],
    scales: Float[Tensor, "gaussian 3"],
    ratios: Int[Tensor, " gaussian"],
    binoms: Tensor | None = None,
    min_opacity: float = 0.005,
) -> tuple[Float[Tensor, " gaussian"], Float[Tensor, "gaussian 3"]]:
    """Opacity and scale of each of several copies that together render like one Gaussian (Kheradmand 2024, eq. 9).

    ratios: number of copies;  binoms: accepted, and not needed
    """
    zeros = opacities.new_zeros(len(opacities), 3)
    turns = torch.nn.functional.pad(zeros, (1, 0), value=1.0)
    plain = Gaussians(zeros, turns, scales.log(), opacities.logit(), zeros[:, None])
    found = shared_out(plain, ratios.clamp(min=1), min_opacity)
    return found.opacities.sigmoid().clamp_min(min_opacity), found.log_scales.exp()


@torch.no_grad()
def inject_noise_to_position(
    params: Params,
    optimizers: Optimizers,
    state: State,
    noise_scale: float | None = None,
    *,
    scaler: float | None = None,
    t: float = 0.005,
    k: float = 100.0,
) -> None:
    """Move means by noise along their own axes, where opacity is below t (eqs. 8 and 9). scaler: former name"""
    amount = scaler if noise_scale is None else noise_scale
    if amount is None:
        raise LumigraphError("inject_noise_to_position() has no noise_scale; give one")
    gate = torch.sigmoid(k * (t - params["opacities"].flatten().sigmoid()))
    noise = torch.randn_like(params["means"]) * gate[:, None] * amount
    params["means"] += (covariances_of(params["quats"], params["scales"].exp()) @ noise[..., None])[..., 0]


def binomials(count: int) -> Float[Tensor, "n k"]:
    """Pascal's triangle."""
    table = torch.zeros(count, count, dtype=torch.float64)
    table[:, 0] = 1
    for n in range(1, count):
        table[n, 1:] = table[n - 1, 1:] + table[n - 1, :-1]
    return table.float()
