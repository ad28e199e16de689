"""pytest plugin that runs gsplat's own tests on a CPU with the functions of lumigraph.gsplat in place of gsplat's.

`gsplat_compat.py` copies a checkout's tests, with "cuda" replaced by "cpu" in them, and loads this file. The package
gsplat around them is the checkout's: its plain PyTorch references stay what our results are compared with. Where a
reference needs a CUDA operator, or nerfacc, a few lines of PyTorch here take its place. LUMIGRAPH_OUTCOMES names the
file that the outcomes go to: passed, refused (a sentence of ours), cuda (an operator of its extension that is no
public function), failed.
"""

from __future__ import annotations

import json
import os
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import lumigraph.gsplat as ours
from lumigraph.errors import LumigraphError
from lumigraph.gsplat import rendering, strategy

THIN = 1500  # the tests' scene keeps one Gaussian in so many: their references are loops
SMALLER = 12  # and pictures so many times smaller
NO_EXTENSION = "UnavailableCuda", "CUDA extension is not available", "_OpNamespace"
OUTCOMES: dict[str, list[str]] = {}


class MissingOperatorError(Exception):
    """An operator of gsplat's CUDA extension."""


def no_operator(name: str) -> Any:
    def call(*args: Any, **kwargs: Any) -> None:
        raise MissingOperatorError(name)

    return call


def pytest_configure(config: Any) -> None:
    """Replace the names of gsplat before its tests are imported."""
    torch.cuda.is_available = lambda: True
    for name in ("synchronize", "empty_cache", "manual_seed_all"):
        setattr(torch.cuda, name, lambda *args: None)
    sys.modules["nerfacc"] = stand_in()
    backend: Any = types.ModuleType("gsplat.cuda._backend")
    backend._C = types.SimpleNamespace()
    sys.modules["gsplat.cuda._backend"] = backend
    import gsplat
    import gsplat._helper as helper
    import gsplat.cuda._wrapper as wrapper
    import gsplat.relocation as relocation
    import gsplat.strategy as strategies
    import gsplat.strategy.ops as ops

    wrapper._make_lazy_cuda_func = wrapper._make_lazy_cuda_obj = no_operator
    wrapper.UnscentedTransformParameters = ours.UnscentedTransformParameters
    for feature in ("3dgs", "2dgs", "3dgut", "reloc"):
        for module in (gsplat, wrapper):
            setattr(module, f"has_{feature}", lambda: True)
    wrapper.has_camera_wrappers = lambda: True
    for name in ours.__all__:
        for module in (gsplat, wrapper, gsplat.rendering, strategies):
            if hasattr(module, name):
                setattr(module, name, getattr(ours, name))
    for module in (gsplat, wrapper):
        module.rasterize_to_indices_in_range = module.rasterize_to_indices_in_range_2dgs = indices_in_range
    gsplat.rendering.rasterization = rendering.rasterization
    for name in ("relocate", "sample_add", "duplicate", "split", "remove", "reset_opa", "inject_noise_to_position"):
        setattr(ops, name, getattr(strategy, name))
    relocation.compute_relocation = strategy.compute_relocation
    whole = helper.load_test_data

    def thin(*args: Any, **kwargs: Any) -> Any:
        means, quats, scales, opacities, colors, viewmats, Ks, width, height = whole(*args, **kwargs)
        Ks = Ks.clone()
        Ks[..., :2, :] /= SMALLER
        own = (x[::THIN] for x in (means, quats, scales, opacities, colors))
        return *own, viewmats, Ks, width // SMALLER, height // SMALLER

    helper.load_test_data = thin


@pytest.fixture(scope="session")
def dist_init() -> None:
    """No group of processes: calls with several GPUs are refused."""


def pytest_runtest_makereport(item: Any, call: Any) -> None:
    if call.excinfo is None and call.when != "call":
        return
    error = None if call.excinfo is None else call.excinfo.value
    kind = "passed" if error is None else "failed"
    if isinstance(error, LumigraphError):
        kind = "refused"
    elif isinstance(error, MissingOperatorError) or any(x in str(error) for x in NO_EXTENSION):
        kind = "cuda"
    elif type(error).__name__ == "Skipped":
        kind = "skipped"
    reason = "" if error is None else f"{type(error).__name__}: {str(error)[:160]}".replace("\n", " ")
    OUTCOMES[item.nodeid] = [kind, reason]
    Path(os.environ["LUMIGRAPH_OUTCOMES"]).write_text(json.dumps(OUTCOMES, indent=1), encoding="utf-8")


def stand_in() -> Any:
    """The two functions of nerfacc that gsplat's references call, for samples sorted by ray."""
    module: Any = types.ModuleType("nerfacc")

    def weights(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        log = (1 - alphas.double()).log()
        order = ray_indices.argsort(stable=True)
        whole = log[order].cumsum(0)
        before = whole - log[order]
        first = torch.searchsorted(ray_indices[order].contiguous(), ray_indices[order].contiguous())
        light = torch.empty_like(log).index_copy(0, order, (before - before[first]).exp()).to(alphas)
        return alphas * light, light

    def along(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
        each = weights[:, None] if values is None else weights[:, None] * values
        return each.new_zeros(n_rays, each.shape[1]).index_add(0, ray_indices, each)

    module.render_weight_from_alpha, module.accumulate_along_rays = weights, along
    return module


@torch.no_grad()
def indices_in_range(
    first: int,
    last: int,
    transmittances: Tensor,
    means2d: Tensor,
    shapes: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    side: int,
    offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussians, pixels and images of the pairs that count, all of them at once.

    shapes: conics, or ray transforms of discs
    """
    if first > 0:
        return (torch.zeros(0, dtype=torch.int64),) * 3
    count, found = means2d.shape[-2], []
    discs = shapes.ndim == means2d.ndim + 1
    centres, alphas = means2d.reshape(-1, 2), opacities.reshape(-1)
    shapes = shapes.reshape(-1, 3, 3) if discs else shapes.reshape(-1, 3)
    starts = torch.cat([offsets.flatten().long(), torch.tensor([len(flatten_ids)])])
    down, across = offsets.shape[-2:]
    for k in (starts.diff() > 0).nonzero()[:, 0].tolist():
        image, tile = divmod(k, down * across)
        ids = flatten_ids[starts[k] : starts[k + 1]].long()
        y, x = (torch.arange(side) + n * side for n in divmod(tile, across))
        pixels = torch.cartesian_prod(y[y < height], x[x < width])
        d = pixels.flip(-1)[:, None] + 0.5 - centres[ids]
        if discs:
            u, v, w = shapes[ids].unbind(1)
            at = pixels.flip(-1)[:, None] + 0.5
            cross = torch.linalg.cross(at[..., :1] * w - u, at[..., 1:] * w - v)
            apart = (cross[..., :2] / cross[..., 2:]).square().sum(-1)
            sigma = 0.5 * torch.minimum(apart, 2 * d.square().sum(-1))
        else:
            a, b, c = shapes[ids].unbind(-1)
            sigma = 0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) + b * d[..., 0] * d[..., 1]
        alpha = (alphas[ids] * torch.exp(-sigma)).clamp(max=0.99)
        alpha = torch.where((alpha < 1 / 255) | (sigma < 0), 0.0, alpha)
        counts = (alpha > 0) & ((1 - alpha).cumprod(1) > 1e-4)
        pixel, rank = counts.nonzero().unbind(-1)
        found.append((ids[rank] % count, pixels[pixel] @ torch.tensor([width, 1]), torch.full_like(rank, image)))
    if not found:
        return (torch.zeros(0, dtype=torch.int64),) * 3
    gaussians, places, images = (torch.cat(x) for x in zip(*found, strict=True))
    return gaussians, places, images
