"""Distances between two shapes (Mescheder 2019, Occupancy Networks, section 4)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor


def intersection_over_union(a: Bool[Tensor, " point"], b: Bool[Tensor, " point"]) -> float:
    """Intersection over union of two volumes, by the points inside of each. In [0, 1]; 1 if both are empty.

    The points should lie evenly in a box that holds both.
    """
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 1.0


def chamfer_distance(
    learnt: Float[Tensor, "learnt 3"], true: Float[Tensor, "true 3"], size: float
) -> tuple[float, float, float]:
    """Chamfer-L1 between points of two surfaces, in tenths of a size: the mean of accuracy (from what is learnt to the
    nearest true point) and completeness (the other way), and these two."""
    accuracy, completeness = nearest(learnt, true)[0].mean(), nearest(true, learnt)[0].mean()
    unit = size / 10
    return float(accuracy + completeness) / 2 / unit, float(accuracy) / unit, float(completeness) / unit


def normal_consistency(
    learnt: Float[Tensor, "learnt 3"],
    learnt_normals: Float[Tensor, "learnt 3"],
    true: Float[Tensor, "true 3"],
    true_normals: Float[Tensor, "true 3"],
) -> float:
    """The mean |cosine| between the normals of each point and of the nearest one on the other surface, both ways. In
    [0, 1]."""
    there, back = nearest(learnt, true)[1], nearest(true, learnt)[1]
    a = (learnt_normals * true_normals[there]).sum(-1).abs().mean()
    b = (true_normals * learnt_normals[back]).sum(-1).abs().mean()
    return float(a + b) / 2


def nearest(
    points: Float[Tensor, "point 3"], others: Float[Tensor, "other 3"]
) -> tuple[Float[np.ndarray, " point"], Tensor]:
    """The distance of each point to the nearest of the others, and its number."""
    distance, number = cKDTree(others.double().numpy()).query(points.double().numpy())
    return distance, torch.from_numpy(number)
