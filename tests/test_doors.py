"""What kernels refuse at their public doors, before a loop that checks no index sees it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from budgets import budget

from lumigraph import kernels
from lumigraph.kernels import HashLevels, _operation, composite, hash_encode, march, perceptron, rasterize, tile

pytestmark = budget("kernels")

LEVELS = HashLevels(levels=2, features=2, log2_entries=6, coarsest=2, finest=9)
POINTS, TABLE = torch.rand(5, 3), torch.rand(LEVELS.entries, 2)
STARTS = torch.tensor([0, 2, 5])
FOOTPRINTS = torch.rand(4, 2) * 16, torch.tensor([[0.1, 0.0, 0.1]]).repeat(4, 1), torch.full((4,), 0.9)
DEPTHS = torch.rand(4)
TILES = tile(*FOOTPRINTS, DEPTHS, (16, 16), 16)
RAYS = torch.zeros(3, 3), torch.eye(3), torch.zeros(3), torch.ones(3)
CELLS = torch.ones(1, 4, 4, 4, dtype=torch.bool)
GRID, RESAMPLING = torch.rand(2, 2, 2), kernels.Resampling(4, 2, 1.0, 0.01, 1e-5, 30.0)


def drawn(tiles):
    return rasterize(*FOOTPRINTS, torch.rand(4, 3), DEPTHS, tiles)


REFUSED = {
    "no levels": lambda: HashLevels(levels=0),
    "a million levels": lambda: HashLevels(levels=1_000_000),
    "a table of one entry": lambda: HashLevels(log2_entries=0),
    "a negative coarsest level": lambda: HashLevels(coarsest=-1),
    "a negative finest level": lambda: HashLevels(finest=-1),
    "a finest level beyond 32 bits": lambda: HashLevels(finest=10**12),
    "tables beyond 32 bits": lambda: HashLevels(levels=64, log2_entries=30, coarsest=2000),
    "another pyramid's table": lambda: hash_encode(POINTS, TABLE, replace(LEVELS, coarsest=1)),
    "a table of other features": lambda: hash_encode(POINTS, TABLE[:, :1], LEVELS),
    "flat points": lambda: hash_encode(POINTS[:, :2], TABLE, LEVELS),
    "points of another type": lambda: hash_encode(POINTS.double(), TABLE, LEVELS),
    "whole points": lambda: hash_encode(POINTS.long(), TABLE, LEVELS),
    "starts that leave the samples": lambda: composite(torch.rand(4), torch.rand(4, 1), STARTS),
    "starts that go back": lambda: composite(torch.rand(5), torch.rand(5, 1), torch.tensor([0, 9, 5])),
    "negative starts": lambda: composite(torch.rand(5), torch.rand(5, 1), torch.tensor([0, -3, 5])),
    "starts of 32 bits": lambda: composite(torch.rand(5), torch.rand(5, 1), STARTS.int()),
    "no starts": lambda: composite(torch.rand(0), torch.rand(0, 1), STARTS[:0]),
    "values of other samples": lambda: composite(torch.rand(5), torch.rand(4, 1), STARTS),
    "five bands": lambda: kernels.spherical_harmonics(torch.rand(3, 3), 5),
    "no bands": lambda: kernels.spherical_harmonics(torch.rand(3, 3), 0),
    "no layers": lambda: perceptron(torch.rand(3, 4)),
    "layers that do not fit": lambda: perceptron(torch.rand(3, 4), torch.rand(5, 4), torch.rand(2, 6)),
    "pictures of two sizes": lambda: kernels.photometric(torch.rand(4, 4, 3), torch.rand(4, 5, 3)),
    "pictures without pixels": lambda: kernels.photometric(torch.rand(0, 4, 3), torch.rand(0, 4, 3)),
    "a step of nothing": lambda: march(*RAYS, CELLS, CELLS.float(), 0.0),
    "a tiny step": lambda: march(*RAYS, CELLS, CELLS.float(), 1e-30),
    "a step that is none": lambda: march(*RAYS, CELLS, CELLS.float(), float("nan")),
    "a step backwards": lambda: march(*RAYS, CELLS, CELLS.float(), 0.1, -0.5),
    "cells that are no cubes": lambda: march(*RAYS, CELLS[..., :3], CELLS[..., :3].float(), 0.1),
    "densities of other cells": lambda: march(*RAYS, CELLS, torch.rand(1, 3, 3, 3), 0.1),
    "occupancy as numbers": lambda: march(*RAYS, CELLS.float(), CELLS.float(), 0.1),
    "proposals without bins": lambda: kernels.sample_proposals(*RAYS, GRID, replace(RESAMPLING, bins=0)),
    "proposals of a flat grid": lambda: kernels.sample_proposals(*RAYS, GRID[:1], RESAMPLING),
    "proposals without weight": lambda: kernels.sample_proposals(*RAYS, GRID, replace(RESAMPLING, min_weight=0.0)),
    "a frustum without depth": lambda: kernels.sample_proposals(*RAYS, GRID, RESAMPLING, (1.0, 1.0, 0.0)),
    "a picture of no size": lambda: tile(*FOOTPRINTS, DEPTHS, (0, 16)),
    "a tile of any side": lambda: tile(*FOOTPRINTS, DEPTHS, (16, 16), 7),
    "fewer depths": lambda: tile(*FOOTPRINTS, DEPTHS[:3], (16, 16)),
    "a Gaussian that is not there": lambda: drawn(replace(TILES, order=TILES.order + 4)),
    "a negative Gaussian": lambda: drawn(replace(TILES, order=TILES.order - 4)),
    "tiles beyond their list": lambda: drawn(replace(TILES, starts=TILES.starts + 1)),
    "tiles of another picture": lambda: drawn(replace(TILES, size=(64, 64))),
}


@pytest.mark.parametrize("call", REFUSED.values(), ids=REFUSED)
def test_a_door_refuses(call):
    with pytest.raises(ValueError):
        call()


@pytest.mark.parametrize("name", _operation.operations())
def test_every_operation_has_a_door(name):
    assert hasattr(getattr(kernels, name), "__wrapped__")


def test_what_is_no_number_leads_no_index_astray():
    """Points and Gaussians that hold NaN or infinity, as from a damaged file, are nowhere, or anywhere inside."""
    bad = torch.tensor([float("nan"), float("inf"), -float("inf"), 1e30])
    points = torch.cartesian_prod(bad, bad, bad).requires_grad_()
    table = TABLE.clone().requires_grad_()
    hash_encode(points, table, LEVELS).sum().backward()
    assert table.grad is not None and table.grad.shape == TABLE.shape
    centres, conics, opacities = (x.repeat(16, *[1] * (x.ndim - 1)) for x in FOOTPRINTS)
    centres[::3], conics[1::3] = float("nan"), float("nan")
    tiles = tile(centres, conics, opacities, DEPTHS.repeat(16), (40, 40), 16)
    assert set(tiles.order.tolist()) <= set(range(2, 64, 3)) and len(tiles.order) == int(tiles.starts[-1])
