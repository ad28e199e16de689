"""A scene with fewer photographs to learn from, to see how many a method needs; or with all that there are."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..camera import Camera
from ..datasets.scene import Scene
from ..errors import LumigraphError


def with_fewer_views(scene: Scene, views: int) -> Scene:
    """The scene with so many photographs in its "train" split, spread evenly over the cameras; see `spread_out`.

    Held-out photographs, frame and sparse points stay what all photographs gave, so that scores can be compared.
    Raises LumigraphError for fewer than one, and for more than there are.
    """
    train = scene.splits["train"]
    if not 1 <= views <= len(train):
        raise LumigraphError(
            f"{scene.source} has {len(train)} photographs to learn from, so --views cannot be {views}; "
            f"give a number from 1 to {len(train)}"
        )
    kept = spread_out(scene.cameras[train])[:views].sort().values
    return replace(scene, splits=scene.splits | {"train": train[kept]})


def with_all_views(scene: Scene) -> Scene:
    """The scene with every photograph in its "train" split, those that test as well."""
    return replace(scene, splits=scene.splits | {"train": torch.arange(len(scene.cameras))})


def spread_out(cameras: Camera) -> Int[Tensor, " camera"]:
    """Cameras in an order whose every beginning is spread evenly over all of them.

    The first is the one nearest the mean, each further one the farthest from those before it (farthest point sampling,
    Gonzalez 1985). How far apart two are is told by their positions, in units of the positions' deviation, and by where
    they look. Among equals the first comes first.
    """
    position, direction = cameras.position, cameras.pose[:, :, 2]
    centred = position - position.mean(0)
    deviation = centred.square().sum(-1).mean().sqrt().clamp_min(1e-9)
    points = torch.cat([centred / deviation, direction], -1)
    order = [int(distances(points, points.mean(0)).argmin())]
    nearest = distances(points, points[order[0]])
    while len(order) < len(points):
        nearest[order[-1]] = -1.0  # taken, and no further for any other at the same place
        order.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, distances(points, points[order[-1]]))
    return torch.tensor(order)


def distances(points: Float[Tensor, "point axis"], origin: Float[Tensor, " axis"]) -> Float[Tensor, " point"]:
    return (points - origin).norm(dim=-1)
